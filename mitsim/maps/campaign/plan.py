"""Plan of a campaign: coupons, distances, orientations and stage.

Signal chain: campaign TOML + sensor -> distances, coupons of each distance, normals in the view frame -> the
:class:`Series` of each coupon and distance -> :class:`Shot`, each with its own seed and folder.

A shot is identified by its coupon, sensor, distance and normal, not by its number in a plan. A plan that is refined or
reordered therefore keeps the captures.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from characterisation.coupon.view_frame import view_frame
from characterisation.files.documents import read_toml
from characterisation.files.errors import InputError
from characterisation.maps.building import Variant
from characterisation.stage.angles import Stage
from characterisation.words.version import __version__
from mitsim.maps.campaign.campaign_file import DISTANCE_RATIO, CampaignFile
from mitsim.maps.campaign.stage_pose import StageTable
from mitsim.scene.coupons import VARIANTS, CouponRecipe, Sample, load_sample
from mitsim.sensor.sensor import Sensor
from mitsim.sensor.sensor_text import written
from mitsim.sensor.transforms import Transform
from mitsim.sensor.working_volume import field_of_view

#: largest size of a coupon as a fraction of the narrower side of the common field of view
WIDEST_SHARE = 0.9

#: settings of a device without influence on a capture
_PATIENCE = {"capture_timeout_s", "timeout_s"}

#: increased if the metrics of a capture change, so that kept captures are measured again
MEASUREMENT_VERSION = 2


@dataclass(frozen=True, eq=False)
class Series:
    """One sample, or a variant of it, at one nominal distance |V| [mm]; ``name`` is that of its folder."""

    sample: Sample
    distance: float
    variant: Variant | None
    name: str
    seed: int


@dataclass(frozen=True, eq=False)
class Shot:
    """One capture of a campaign: the coupon of a series with its ``normal`` (3,) in the view frame.

    ``found`` is the digest of a capture that exists already.
    """

    series: Series
    normal: NDArray[np.float64]
    sensor_from_coupon: Transform
    found: str | None = None

    @property
    def name(self) -> str:
        """Return text such as ``+0.1234-0.0567``: the normal along and across the baseline."""
        across, along = (round(float(component), 4) + 0.0 for component in self.normal[:2])  # never -0.0
        return f"{across:+.4f}{along:+.4f}"

    @property
    def seed(self) -> int:
        """Return the seed of all random values; the same for a sample and its variants."""
        components = [round(1e6 * (1.0 + float(component))) for component in self.normal]
        return int(np.random.SeedSequence([self.series.seed, *components]).generate_state(1)[0])


@dataclass(frozen=True)
class Campaign:
    """A campaign ready to run with one sensor; all ``stages`` must be able to show each of its normals."""

    file: CampaignFile
    sensor: Sensor
    distances: tuple[float, ...]
    series: tuple[Series, ...]
    stages: tuple[Stage, ...] = ()

    def reachable(self, normals: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return which of the normals (n, 3) the stages can show; all of them without a stage."""
        reached = np.ones(len(normals), bool)
        for stage in self.stages:
            reached &= np.isfinite(stage.angles(normals)).all(axis=1)
        return reached

    @property
    def exposure_rule(self) -> str:
        """Return the exposure of its captures in words."""
        if self.file.device is None:
            return self.sensor.exposure.rule
        return f"fixed at {self.file.device.settings.exposure_s:g} s on the {self.file.device.kind} camera"

    @property
    def samples(self) -> list[Sample]:
        """Return the samples at the nearest distance, without their variants."""
        return [one.sample for one in self.series if one.variant is None and one.distance == self.distances[0]]

    def shot(self, series: Series, normal: NDArray[np.float64]) -> Shot:
        """Return a shot of the coupon of a series with a given normal."""
        axis = self.sensor.rig.reference.sensor_from_camera
        pose = coupon_pose(normal, series.distance, axis.rotation[:, 2], axis.translation)
        return Shot(series, normal, pose)


def read_campaign(path: str | Path, sensor: Sensor, distances_mm: list[float] | None = None) -> Campaign:
    """Read a campaign file, and the coupons that it names (paths relative to it), for one sensor.

    ``distances_mm`` apply if the file has none; without both, the distances cover the sensor's working range. Raises
    InputError for anything that would stop the campaign later, including an exposure that follows the scene.
    """
    return plan_campaign(path, read_toml(path, CampaignFile), sensor, distances_mm)


def plan_campaign(
    path: str | Path,
    file: CampaignFile,
    sensor: Sensor,
    distances_mm: list[float] | None = None,
    *,
    stage_tables: Mapping[float, StageTable] | None = None,
) -> Campaign:
    """Plan a campaign file that has been read from ``path``.

    Parameters
    ----------
    path, file, sensor
        The campaign file, its content, and the sensor to characterise.
    distances_mm, stage_tables
        Distances if the file has none; live stage as calibrated at each distance, for captures with the file's
        ``device``.
    """
    if file.device is not None and stage_tables is None:
        hint = "only campaigns and validations of maps take captures with a device"
        raise InputError(path, "device", f"a live {file.device.kind}", "no device: these captures are simulated", hint)
    stages: tuple[Stage, ...] = () if file.stage is None else (file.stage,)
    if stage_tables is None:
        check_exposure(sensor)
        distances = tuple(sorted(set(file.distances_mm or distances_mm or covering(sensor, file.distance_ratio))))
    else:
        distances, stages = tuple(sorted(stage_tables)), tuple(stage_tables.values())
    calibrations = {distance: str(stage.calibration) for distance, stage in (stage_tables or {}).items()}
    series = [
        entry
        for index in range(len(file.samples))
        for distance in distances
        for entry in _series_of(Path(path), file, index, distance, sensor, calibrations.get(distance, ""))
    ]
    campaign = Campaign(file, sensor, distances, tuple(series), stages)
    labels = [sample.label() for sample in campaign.samples]
    if twice := next((label for label in labels if labels.count(label) > 1), None):
        hint = "a map identifies a sample by its finish and Ra"
        raise InputError(path, "samples", f"{twice}, more than once", "one coupon of each finish and Ra", hint)
    return campaign


def covering(sensor: Sensor, ratio: float = DISTANCE_RATIO) -> list[float]:
    """Return distances [mm] over a sensor's working range, in equal ratios of at most ``ratio``."""
    near, far = sensor.working_range_mm
    steps = math.ceil(math.log(far / near) / math.log(ratio) - 1e-9)
    return [float(f"{distance:.4g}") for distance in np.geomspace(near, far, steps + 1)]


def half_size(sensor: Sensor, distance: float, side_px: float) -> float:
    """Return half the side [mm] of a coupon that covers ``side_px`` at a distance, within the common field of view."""
    camera = sensor.rig.reference
    focal_px = math.sqrt(camera.matrix[0, 0] * camera.matrix[1, 1])
    return min(side_px * distance / focal_px, WIDEST_SHARE * min(field_of_view(sensor, distance))) / 2


def check_exposure(sensor: Sensor) -> None:
    """Raise InputError for a sensor whose exposure follows the scene."""
    if sensor.exposure.base_s is None:
        hint = "a map holds for one exposure: with an automatic one, F depends on the rest of the view, "
        hint += "not only on distance, normal and finish"
        raise InputError(f"sensor {sensor.name}", "exposure.rule", sensor.exposure.rule, "fixed, matt_white", hint)


def coupon_pose(
    normal: NDArray[np.float64], distance: float, axis: NDArray[np.float64], eye: NDArray[np.float64] | None = None
) -> Transform:
    """Return ``sensor_from_coupon`` with the coupon's centre on the view axis.

    ``normal``, ``distance``: (3,) in the view frame (z toward the sensor, x toward the second eye), and |V| [mm].
    ``axis``, ``eye``: (3,) unit view direction and (3,) position of the camera [mm], by default the origin, in the
    sensor frame.
    """
    z = view_axes(axis) @ normal
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    translation = axis * distance + (0.0 if eye is None else eye)
    return Transform(np.stack([x, np.cross(z, x), z], axis=1), translation)


def view_axes(axis: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the axes of the view frame along a view direction (3,), as columns (3, 3) in the sensor frame."""
    return view_frame(axis, np.array([1.0, 0.0, 0.0])).T


def _series_of(
    path: Path, file: CampaignFile, index: int, distance: float, sensor: Sensor, calibration: str
) -> list[Series]:
    entry = file.samples[index]
    parameters = {name: str(value) for name, value in entry.parameters.items()}
    if file.coupon_px is not None:
        parameters["half_size"] = f"{half_size(sensor, distance, file.coupon_px):.4g}"
    recipe = CouponRecipe(str(path.parent / entry.scene), tuple(sorted(parameters.items())), sensor.wavelength_nm)
    where = (path, f"samples.{index}.scene")
    try:
        sample = load_sample(recipe, where)
    except InputError as error:
        if error.field != "half_size":
            raise
        found = "a scene with a parameter half_size [mm], as coupon_px needs"
        allowed = "give the scene <default name='half_size' value='60'/>, or leave out coupon_px"
        raise InputError(*where, entry.scene, found, allowed) from None
    shown: list[tuple[Variant | None, Sample]] = [(None, sample)]
    if entry.spread:
        shown += [(name, load_sample(recipe.moved(deviation), where)) for name, deviation in VARIANTS.items()]
    made = []
    for variant, shown_sample in shown:
        name = f"{shown_sample.label()} {distance:g}mm".replace("/", "-").replace(" ", "_")
        if variant is not None and shown_sample.origin != sample.origin:
            name += "_" + "_".join(variant)
        digest = _digest(file, sensor, shown_sample, distance, calibration)
        seed = int(_digest(file, sensor, sample, distance, calibration), 16) % 2**32
        made.append(Series(shown_sample, distance, variant, f"{name}_{digest}", seed))
    return made


def _digest(file: CampaignFile, sensor: Sensor, sample: Sample, distance: float, calibration: str) -> str:
    """Return twelve hex digits of what determines a series, but its normals; a stage by its calibration's checksum."""
    common = [__version__, MEASUREMENT_VERSION, file.samples_per_pixel, file.keep_images, file.seed]
    values = [written(sensor), sample.origin, sample.label(), f"{distance:.6g}"]
    if file.device is not None:  # campaigns without a device keep their former digest
        values += [file.device.model_dump_json(exclude={"settings": _PATIENCE}), calibration]
    text = json.dumps([*common, *values])
    return hashlib.sha256(text.encode()).hexdigest()[:12]
