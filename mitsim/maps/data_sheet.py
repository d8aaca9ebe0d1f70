"""Measure the data sheet of a simulated sensor: its performance on plates and balls, as a maker would state it.

Signal chain: sensor -> plates and balls at known poses -> captures -> clouds -> floor, noise, recovery, residuals.

* *Floor*: matt white, all noise off. The remaining errors come from the code and its decoder. Results are offset and
  flatness of a plane square to the axis and of a tilted one, and the radius error of a ball.
* *Noise*: matt white, all noise on, over the working range. Results are sigma along V in discs of 113 pixels as in maps
  (:func:`characterisation.coupon.patches.measure_patches`), the standard deviation along V over the whole plate, and
  the recovered fraction. Others publish the second. The plate is tilted by 5 deg: exactly square to the axis, a depth
  that is quantised in steps would show no noise.
* *Recovery*: recovered fraction and sigma on tilted metal.
* *Residuals* along V from the fitted plane, at mid range on matt white: the talk's noise distributions. Neighbouring
  points are correlated, so normality is tested on points at least two correlation lengths apart.

All captures use direct light, since a single plate has no interreflections, and the sensor's own exposure rule.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy import stats

from characterisation.coupon.patches import Coupon, measure_patches
from characterisation.features.fits import fit_plane, fit_sphere
from characterisation.features.robust_fit import FitError
from characterisation.files.arrays import Floats
from characterisation.point_cloud import FALSE_SHARE_OF_DISTANCE, PointCloud
from characterisation.words.progress import track
from mitsim.capture.capture import Capture
from mitsim.capture.simulated.rendering import Rendering
from mitsim.decoding.cloud import capture_cloud
from mitsim.maps.campaign.acquire import coupon_cloud
from mitsim.maps.campaign.orders import prepared_sensor
from mitsim.maps.campaign.plan import coupon_pose
from mitsim.running.executor import Executor, results_of
from mitsim.scene.load import Scene
from mitsim.scene.test_targets import FINISHES, ball, ball_on_plate, plate
from mitsim.sensor.noise_sources import Noise
from mitsim.sensor.sensor import Sensor
from mitsim.sensor.transforms import Transform, look_at

#: side of a plate, over its distance from the sensor
PLATE_SHARE = 0.25

#: radius of a ball, over its distance from the sensor
BALL_SHARE = 0.1

#: number of distances over the working range
DISTANCES = 5

#: tilts of metal
TILTS_DEG = (0.0, 20.0, 40.0)

#: tilt of the second plane of the floor
FLOOR_TILT_DEG = 20.0

#: tilt of noise plates: a depth that is quantised in steps would show no noise on a square one
NOISE_TILT_DEG = 5.0

METALS = [finish for finish in FINISHES if finish != "matt white"]

#: azimuth of the tilt axis: halfway between the baseline and the direction across it, so that neither is favoured
AZIMUTH_DEG = 45.0

#: largest angle between normal and view ray on a ball; points beyond it belong to the limb and bias the radius
_EDGE_DEG = 60.0

#: a plate or ball is measured with more points than this; chosen
_LEAST_POINTS = 100

#: excluded border of a plate, as a fraction of its size
_BORDER = 0.1

SAMPLES_PER_PIXEL = 16


@dataclass(frozen=True)
class PlaneFloor:
    """A plane without noise: ``offset`` of the points from the true plane, ``flatness`` about the fitted plane.

    Both are along the view ray [mm]: mean and standard deviation. ``fraction`` is the recovered fraction [1].
    """

    tilt_deg: float
    offset: float
    flatness: float
    fraction: float


@dataclass(frozen=True)
class Recovery:
    """Measured values of a flat sample at ``distance`` [mm] and ``tilt_deg``.

    ``fraction`` is F [1], the mean over discs. ``sigma`` is the noise along V in a disc, the median [mm]. ``spread`` is
    the standard deviation along V about the plane fitted to the whole plate [mm]. Unknown values are NaN.
    """

    finish: str
    distance: float
    tilt_deg: float
    fraction: float
    sigma: float
    spread: float


@dataclass(frozen=True)
class Residuals:
    """Residuals along V about the fitted plane.

    ``values`` (n,) are in mm, and ``image`` (H, W) has them at their pixels, NaN elsewhere. ``correlation_px`` is the
    lag along a row at which their autocorrelation falls below 1/e. ``independent`` is the number of points at that
    spacing. ``skewness`` and ``excess_kurtosis`` are those of all values. ``p_normal`` is the p-value of the test of
    D'Agostino and Pearson on the independent points (Biometrika 60, 1973).
    """

    distance: float
    values: Floats
    correlation_px: float
    independent: int
    skewness: float
    excess_kurtosis: float
    p_normal: float
    image: Floats


@dataclass(frozen=True)
class DataSheet:
    """All measured values of a sensor."""

    sensor: Sensor
    mid_mm: float
    planes: list[PlaneFloor]
    radius_mm: float
    radius_error: float
    noise: list[Recovery]
    metal: list[Recovery]
    residuals: Residuals

    def numbers(self) -> dict[str, Any]:
        """Return the values for JSON, without the single residuals."""
        sensor: Any = self.sensor.name
        entries = asdict(replace(self, sensor=sensor))
        del entries["residuals"]["values"], entries["residuals"]["image"]
        return entries | {"exposure_rule": self.sensor.exposure.rule}


@dataclass(frozen=True)
class SheetPiece:
    """One capture of a data sheet as plain values: ``method`` of the simulated targets, and its ``arguments``."""

    sensor: Sensor
    seed: int
    method: str
    arguments: tuple[Any, ...]


def measure_sensor(sensor: Sensor, seed: int = 1, workers: Executor | None = None) -> DataSheet:
    """Measure a simulated sensor, in this process or by workers; progress goes to stderr."""
    near, far = sensor.working_range_mm
    mid = math.sqrt(near * far)
    radius = BALL_SHARE * mid
    asked: list[tuple[str, tuple[Any, ...]]] = [("plane_floor", (mid, tilt)) for tilt in (0.0, FLOOR_TILT_DEG)]
    asked += [("ball", (mid, radius))]
    distances = np.geomspace(near, far, DISTANCES).tolist()
    asked += [("recovery", ("matt white", distance, NOISE_TILT_DEG)) for distance in distances]
    asked += [("recovery", (metal, mid, tilt)) for metal in METALS for tilt in TILTS_DEG]
    asked += [("residuals", (mid,))]
    pieces = [SheetPiece(sensor, seed + number, *request) for number, request in enumerate(asked)]
    done = results_of(pieces, measure_piece, workers, sensor.name)
    planes, noise, metal = done[:2], done[3 : 3 + DISTANCES], done[3 + DISTANCES : -1]
    return DataSheet(sensor, mid, planes, radius, done[2], noise, metal, done[-1])


def measure_piece(piece: SheetPiece) -> Any:
    """Take and measure one capture of a data sheet; workers call this function."""
    targets = _SimulatedTargets(piece.sensor, piece.seed)
    return getattr(targets, piece.method)(*piece.arguments)


def gallery(sensor: Sensor, seed: int = 1) -> list[tuple[str, Capture, PointCloud]]:
    """Return capture and cloud of a ball on a plate, at mid range and 35 deg from above, in every finish."""
    targets = _SimulatedTargets(sensor, seed)
    mid = math.sqrt(math.prod(sensor.working_range_mm))
    radius, angle = 0.1 * mid, math.radians(35.0)
    target = np.array([0.0, 0.0, radius])
    eye = target + mid * np.array([0.0, -math.sin(angle), math.cos(angle)])
    pose = look_at(eye, target, (0.0, 0.0, 1.0)) @ sensor.rig.reference.sensor_from_camera.inverse()
    rendered = []
    for finish in track(list(FINISHES), f"{sensor.name}: gallery"):
        scene = ball_on_plate(radius, 0.6 * mid, finish, sensor.wavelength_nm)
        capture = targets.simulated.capture(scene, pose, seed=seed, rendering=Rendering(SAMPLES_PER_PIXEL))
        rendered.append((finish, capture, targets.decoded(capture)))
    return rendered


class _SimulatedTargets:
    """A simulated sensor, and the test targets in front of it."""

    def __init__(self, sensor: Sensor, seed: int) -> None:
        prepared = prepared_sensor(sensor)
        self.sensor, self.seed = sensor, seed
        self.simulated, self.geometry = prepared.simulated, prepared.geometry
        self.axis = sensor.rig.reference.sensor_from_camera.rotation[:, 2]
        # distances count from the camera in which clouds are given, not from the origin of the sensor frame
        self.eye = sensor.rig.reference.sensor_from_camera.translation

    def plane_floor(self, distance: float, tilt_deg: float) -> PlaneFloor:
        cloud, coupon = self._plate("matt white", distance, tilt_deg, Noise.none())
        points, view, _ = _on_plate(cloud, coupon)
        off = np.linalg.norm(points, axis=1) - _to_plane(coupon.centre - cloud.grid.origin, coupon.normal, view)
        offset = float(off.mean()) if len(points) > _LEAST_POINTS else math.nan
        flatness = float(_about_plane(points, view).std())
        return PlaneFloor(tilt_deg, offset, flatness, _mean_fraction(measure_patches(cloud, coupon)))

    def ball(self, distance: float, radius: float) -> float:
        """Return the error of the radius of a ball without noise [mm]."""
        pose = Transform(np.eye(3), self.eye + self.axis * (distance + radius))
        scene = ball(radius, "matt white", self.sensor.wavelength_nm)
        around = pose.translation + radius * np.array([[a, b, c] for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)])
        cloud = self.decoded(self._capture(scene, pose, around, Noise.none()))
        points, view = _seen(cloud)
        centre = pose.translation - cloud.grid.origin
        out = points - centre
        near = np.abs(np.linalg.norm(out, axis=1) - radius) < 0.1 * radius
        facing = -(out * view).sum(axis=1) / np.maximum(np.linalg.norm(out, axis=1), 1e-9)
        kept = near & (facing > math.cos(math.radians(_EDGE_DEG)))
        try:
            enough = kept.sum() > _LEAST_POINTS
            return float(fit_sphere(points[kept], np.zeros(3)).radius - radius) if enough else math.nan
        except FitError:
            return math.nan

    def recovery(self, finish: str, distance: float, tilt_deg: float) -> Recovery:
        cloud, coupon = self._plate(finish, float(distance), tilt_deg, Noise())
        patches = measure_patches(cloud, coupon)
        sigmas = patches.ray_noise_inliers.values
        finite = sigmas[np.isfinite(sigmas)]
        sigma = float(np.median(finite)) if len(finite) else math.nan
        points, view, _ = _on_plate(cloud, coupon)
        spread = float(_about_plane(points, view).std())
        return Recovery(finish, float(distance), tilt_deg, _mean_fraction(patches), sigma, spread)

    def residuals(self, distance: float) -> Residuals:
        cloud, coupon = self._plate("matt white", distance, NOISE_TILT_DEG, Noise())
        points, view, inner = _on_plate(cloud, coupon)
        values = _about_plane(points, view)
        image = np.full(cloud.status.shape, np.nan)
        image.flat[np.flatnonzero(cloud.valid)[inner]] = values
        if not np.isfinite(values).any():
            return Residuals(distance, values, math.nan, 0, math.nan, math.nan, math.nan, image)
        length = correlation_length(image)
        step = max(1, math.ceil(2 * length))
        apart = image[::step, ::step]
        apart = apart[np.isfinite(apart)]
        p_normal = float(stats.normaltest(apart).pvalue) if len(apart) >= 20 else math.nan
        skewness, kurtosis = float(stats.skew(values)), float(stats.kurtosis(values))
        return Residuals(distance, values, length, len(apart), skewness, kurtosis, p_normal, image)

    def _plate(self, finish: str, distance: float, tilt_deg: float, noise: Noise) -> tuple[PointCloud, Coupon]:
        size = PLATE_SHARE * distance
        pose = coupon_pose(tilted(tilt_deg), distance, self.axis, self.eye)
        coupon = Coupon(pose.translation, pose.rotation[:, 2], pose.rotation[:, 0], size, size)
        scene = plate(size, finish, self.sensor.wavelength_nm)
        capture = self._capture(scene, pose, coupon.corners(), noise)
        return coupon_cloud(capture, coupon, self.geometry, self.sensor), coupon

    def _capture(self, scene: Scene, pose: Transform, around: Floats, noise: Noise) -> Capture:
        self.seed += 1
        return self.simulated.capture(
            scene, pose.inverse(), seed=self.seed, rendering=Rendering(SAMPLES_PER_PIXEL), around=around, noise=noise
        )

    def decoded(self, capture: Capture) -> PointCloud:
        return capture_cloud(capture, self.sensor.settings, self.geometry, imager=capture.decoding.imager)


def tilted(tilt_deg: float) -> Floats:
    """Return the unit normal (3,) in the view frame at an incidence, halfway between baseline and across."""
    tilt, azimuth = math.radians(tilt_deg), math.radians(AZIMUTH_DEG)
    return np.array([math.sin(tilt) * math.cos(azimuth), math.sin(tilt) * math.sin(azimuth), math.cos(tilt)])


def correlation_length(image: Floats) -> float:
    """Return the lag [px] at which the autocorrelation along a row falls below 1/e; NaN pixels are ignored."""
    centred = image - np.nanmean(image)
    variance = np.nanmean(centred**2)
    if not variance > 0:
        return 0.0
    before = 1.0
    for lag in range(1, min(64, image.shape[1] - 1)):
        products = centred[:, lag:] * centred[:, :-lag]
        here = float(np.nanmean(products) / variance) if np.isfinite(products).any() else 0.0
        if here < math.exp(-1):
            return lag - 1 + (before - math.exp(-1)) / (before - here)
        before = here
    return 64.0


def _mean_fraction(patches: xr.Dataset) -> float:
    return float(patches.recovered_fraction.mean()) if patches.sizes["patch"] else math.nan


def _seen(cloud: PointCloud) -> tuple[Floats, Floats]:
    """Return the points relative to the eye of the grid, and the unit directions of their rays."""
    points = cloud.points[cloud.valid].astype(float) - cloud.grid.origin
    return points, points / np.linalg.norm(points, axis=1, keepdims=True)


def _on_plate(cloud: PointCloud, coupon: Coupon) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Return points near the coupon and off its border, by their rays, these rays, and which valid points they are."""
    points, view = _seen(cloud)
    centre = coupon.centre - cloud.grid.origin
    reach = _to_plane(centre, coupon.normal, view)
    foot = view * reach[:, None] - centre
    along = np.cross(coupon.normal, coupon.across)
    half_width, half_height = (0.5 - _BORDER) * coupon.width, (0.5 - _BORDER) * coupon.height
    true = np.abs(np.linalg.norm(points, axis=1) / reach - 1) < FALSE_SHARE_OF_DISTANCE
    inner = true & (np.abs(foot @ coupon.across) < half_width) & (np.abs(foot @ along) < half_height)
    return points[inner], view[inner], inner


def _to_plane(centre: Floats, normal: Floats, view: Floats) -> Floats:
    return np.asarray((centre @ normal) / (view @ normal))


def _about_plane(points: Floats, view: Floats) -> Floats:
    """Return the signed residuals along the rays about the best-fit plane [mm], one NaN where points determine none."""
    try:
        plane = fit_plane(points, np.zeros(3)) if len(points) > _LEAST_POINTS else None
    except FitError:
        plane = None
    if plane is None:
        return np.array([math.nan])
    return np.asarray(np.linalg.norm(points, axis=1) - _to_plane(plane.point, plane.normal, view))
