"""The sensor's numbers that one capture of dots on a sheet tells.

Signal chain: capture -> plane and bend of the sheet -> figures over the field (:mod:`mitsim.twin.figures`) -> power,
room, dots, noise, corners by simulated moments (:mod:`mitsim.twin.moments`, :mod:`mitsim.twin.parameters`) before the
bench (:mod:`mitsim.twin.bench`).

What the terms of level and contrast over the field leave beyond chance is light that six terms of a room do not have:
its mean square is added to the covariance of these terms, and the fit is made once more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from mitsim.capture.capture import Capture
from mitsim.errors import InputError
from mitsim.fit.place import Place
from mitsim.scene.camera_rays import Window
from mitsim.sensor.preset import Sensor
from mitsim.twin.bench import Bench
from mitsim.twin.figures import TERMS, Field, field_figures
from mitsim.twin.moments import Found, Prior, match_moments
from mitsim.twin.parameters import Parameter, room_parameters, with_room_terms
from mitsim.validation.specimen_patches import run_length
from mitsim.validation.specimen_place import MARGIN_PX, image_mask

Floats = NDArray[np.float64]

#: side of a patch [px], and patches under which a capture tells nothing
PATCH_PX, FEWEST_PATCHES = 40, 8

#: windows of local means [px], and runs of the pattern that one holds: as `mitsim validate captures`
_WINDOWS, _RUNS = (7, 31), 2.5

_ALONE = ("crossings", "sharpness", "noise in the dark half", "noise in the bright half", "grain")

#: room that the fit starts with, as a share of the projector's own light; chance that a misfit is none
_FIRST_ROOM, _CHANCE = 0.2, 0.01


@dataclass(frozen=True)
class DotsFit:
    """Parameters found in one capture, in the order of ``parameters``; ``patches`` and chi-square of the last fit.

    ``uneven`` is the standard deviation of the field's terms that no parameter explains [1].
    """

    parameters: tuple[Parameter, ...]
    found: Found
    patches: int
    uneven: float
    start: Floats

    def sensor(self, sensor: Sensor) -> Sensor:
        """The sensor with the parameters that were told."""
        for parameter, value, told in zip(self.parameters, self.found.values, self.found.told, strict=True):
            if told:
                sensor = parameter.set(sensor, float(value))
        return sensor


def fit_dots(
    capture: Capture, sensor: Sensor, place: Place, parameters: Sequence[Parameter], where: str, *,
    room: Sequence[float] | None = None, seed: int = 1, draws: int = 1, patch_px: int = PATCH_PX,
) -> DotsFit:  # fmt: skip
    """Fit parameters to one capture of dots.

    Parameters
    ----------
    sensor
        With the capture's own cameras and exposure, from :func:`mitsim.validation.rebuild.like`.
    parameters
        To be varied, without those of the room.
    room
        Six terms of the irradiance [W/mm^2] of the room where another capture told them; else they are fitted too.

    Raises
    ------
    InputError
        If too little of the sheet is seen.
    """
    name, camera = next(iter(capture.rig.cameras.items()))
    field = Field.of(camera, image_mask(place, camera, MARGIN_PX if patch_px >= PATCH_PX else 2.0), patch_px)
    if len(field.corners) < FEWEST_PATCHES:
        seen = f"{len(field.corners)} patches of {patch_px} px of it"
        raise InputError(where, "specimen", seen, f"{FEWEST_PATCHES} or more", "a larger --window, or a nearer view")
    part = Window(field.column, field.row, *field.there.shape[::-1])
    window = int(np.clip(np.nan_to_num(_RUNS * run_length(capture, place), nan=_WINDOWS[1]), *_WINDOWS)) // 2 * 2 + 1
    black = sensor.imager.black_level
    real = field_figures(capture.images[name][0][part.inside].astype(float), field, window, black)
    bench = Bench(sensor, place, part)
    unit = bench.projector_irradiance(sensor, seed)
    own = list(parameters)
    if room is None:
        own += room_parameters(unit)
        sensor = with_room_terms(unit, sensor, [_FIRST_ROOM, 0.0, 0.0, 0.0, 0.0, 0.0])
    else:
        sensor = with_room_terms(unit, sensor, [term / unit for term in room])
    even = np.isfinite(real.coefficients[1, 0])
    terms = TERMS if even else TERMS[:1]
    names = [(figure, term) for figure in ("level", "contrast") for term in terms] + [(name, "1") for name in _ALONE]
    spatial = np.array([term != "1" for _, term in names])
    wanted, covariance = real.of(names)

    def built(theta: Floats) -> Sensor:
        out = sensor
        for parameter, value in zip(own, theta, strict=True):
            out = parameter.set(out, float(value))
        return out

    def simulate(theta: Floats, number: int) -> tuple[Floats, Floats]:
        levels = bench.levels(built(theta), 1000 * seed + number)
        return field_figures(levels.astype(float), field, window, black).of(names)

    start = np.array([parameter.get(sensor) for parameter in own])
    for index, parameter in enumerate(own):
        if parameter.key == "projector.flux_w":
            start[index] += wanted[0] - simulate(start, 0)[0][0]
    prior = Prior(
        start, *(np.array([getattr(parameter, part_) for parameter in own]) for part_ in ("spread", "step", "low",
        "high"))
    )  # fmt: skip
    found = match_moments(wanted, covariance, simulate, prior, draws)
    uneven = 0.0
    if found.chi_square > chi2.isf(_CHANCE, max(found.freedom, 1)) and spatial.sum() > 0:
        off = wanted - np.mean([simulate(found.values, number)[0] for number in range(draws)], axis=0)
        excess = float(np.mean(off[spatial] ** 2 - np.diag(covariance)[spatial]))
        uneven = float(np.sqrt(max(excess, 0.0)))
        again = covariance + np.diag(np.where(spatial, uneven**2, 0.0))
        found = match_moments(wanted, again, simulate, replace(prior, start=found.values), draws)
    return DotsFit(tuple(own), found, len(field.corners), uneven, start)
