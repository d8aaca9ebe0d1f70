"""Fit the light of the room to captures with the projector off.

Signal chain: grey levels of a uniform sheet -> electrons -> divided by those of 1 W/mm^2 from all sides on the model's
sheet, including the loss of the lens -> trimmed means of patches -> least squares on 1, x, y, xx, xy, yy of the slopes
of the view ray -> irradiance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from characterisation.files.arrays import MEDIAN_TO_STD, Floats
from mitsim.sensor.imager import electrons_per_radiance
from mitsim.sensor.sensor import Sensor
from mitsim.sensor.vignetting import camera_illumination
from mitsim.twin.compare.plate import REFLECTANCE
from mitsim.twin.compare.rebuild import like
from mitsim.twin.finish.electrons import chip_of, linearised
from mitsim.twin.finish.find_specimen import MARGIN_PX, image_mask
from mitsim.twin.finish.specimen import Specimen
from mitsim.twin.sensor.estimate import FittedKey
from mitsim.twin.sensor.figures import FEWEST_FOR_TERMS, SpecimenField
from mitsim.twin.sensor.input_captures import InputCapture
from mitsim.twin.sensor.parameters import ROOM_KEYS

#: side of a patch, which gives one value of the light [px]; chosen
_PATCH_PX = 20

#: distance from a patch's median beyond which a pixel shows a speck, in standard deviations of noise; chosen. A trimmed
#: mean of whole grey levels is off by up to 0.2 levels, a median by half of one
_SPECK = 5.0

#: the same at least [DN]; chosen
_SPECK_DN = 2.0

#: standard uncertainties of the irradiance up to which it has no shape; chosen
_SURE = 2.0


@dataclass(frozen=True)
class RoomFit:
    """Six ``terms`` of the irradiance [W/mm^2], and the estimates of the file's numbers."""

    terms: tuple[float, ...]
    estimates: tuple[FittedKey, ...]


def fit_room(input_captures: list[InputCapture], sensor: Sensor, specimens: dict[str, Specimen]) -> RoomFit | None:
    """Fit the light of the room to captures with the projector off; None if none shows enough of a sheet."""
    rows, values = [], []
    for source in input_captures:
        camera = source.capture.rig.reference
        capture_sensor = like(source.capture, sensor, source.name)
        if capture_sensor.exposure.base_s is None:
            continue
        chip = chip_of(source.capture, sensor.imager, source.name)
        electrons = linearised(source.image, chip)
        loss = camera_illumination(sensor.imager.corner_illumination, camera)
        scale = electrons_per_radiance(sensor.imager, sensor.wavelength_nm, capture_sensor.exposure.base_s)
        irradiance = electrons / (scale * REFLECTANCE / np.pi) / (1.0 if loss is None else loss)
        field = SpecimenField.of(camera, image_mask(specimens[source.name], camera, MARGIN_PX), _PATCH_PX)
        corners = field.corners + np.array([field.roi.top, field.roi.left])
        if not len(corners):
            continue
        middles = corners[:, ::-1] + (_PATCH_PX - 1) / 2
        rays = camera.rays(middles)
        x, y = (rays[:, :2] / rays[:, 2:]).T
        rows.append(np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1))
        windows = [np.s_[r : r + _PATCH_PX, c : c + _PATCH_PX] for r, c in corners]
        values.append([_without_specks(irradiance[window], source.image[window].astype(float)) for window in windows])
    if not rows:
        return None
    design, seen = np.concatenate(rows), np.concatenate([np.array(means) for means in values])
    if len(seen) < FEWEST_FOR_TERMS:
        design = design[:, :1]
    solution, covariance = _fitted(design, seen)
    if solution[0] <= _SURE * np.sqrt(covariance[0, 0]):
        solution, covariance = _fitted(design[:, :1], seen)
        solution = np.maximum(solution, 0.0)  # a black level that is too high makes it negative
    terms = np.zeros(len(ROOM_KEYS))
    terms[: len(solution)] = solution
    names, estimates = tuple(source.name for source in input_captures), []
    for index in range(len(solution)):
        gradient = np.zeros(len(solution))
        if index == 0:
            gradient[0], value = 1.0, solution[0]
        else:
            value = solution[index] / solution[0]
            gradient[index], gradient[0] = 1 / solution[0], -value / solution[0]
        spread = float(np.sqrt(gradient @ covariance @ gradient))
        key, unit = f"room.{ROOM_KEYS[index]}", "W/mm^2" if index == 0 else "1"
        estimates.append(FittedKey(key, float(value), spread, unit, names, "level with the projector off"))
    return RoomFit(tuple(float(term) for term in terms), tuple(estimates))


def _without_specks(values: Floats, levels: Floats) -> float:
    """Return the mean of a patch's values (h, w), without those of pixels whose levels [DN] are far from the median."""
    off = np.abs(levels - np.median(levels))
    return float(values[off <= max(_SPECK * MEDIAN_TO_STD * float(np.median(off)), _SPECK_DN)].mean())


def _fitted(design: Floats, seen: Floats) -> tuple[Floats, Floats]:
    """Return the least-squares solution of values, and its covariance from their scatter."""
    solution = np.linalg.lstsq(design, seen, rcond=None)[0]
    residual = seen - design @ solution
    variance = float(residual @ residual) / max(len(seen) - design.shape[1], 1)
    return np.asarray(solution), np.asarray(variance * np.linalg.inv(design.T @ design))
