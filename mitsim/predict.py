"""Predict the cloud that a sensor would make of a part, from its performance map alone.

Signal chain (slides *Simulating the Point Cloud*): rays of the view grid x part -> ideal points -> frustum, back face
and ray-traced occlusion toward every camera and the projector -> F and sigma of each point from the map, by distance,
normal in the view frame and the material of its face -> eps = R_N sigma along the view ray, kept if R_U < F.

What it leaves out, as the talk does: noise that is correlated between neighbours, light that arrives by way of
another surface, and the matcher's behaviour at edges.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, minimum_filter

from characterisation.coupon.patches import in_view_frame
from characterisation.maps.noise_structure import noise_structure
from characterisation.maps.performance_map import PerformanceMap
from characterisation.point_cloud import PointCloud, Status, ViewGrid
from characterisation.tasks.uncertainty import ExpectedPoints
from mitsim.capture.cloud import Geometry
from mitsim.scene.load import Scene
from mitsim.scene.materials import Finish
from mitsim.scene.raycast import PixelRays, Surfaces, cast
from mitsim.sensor.camera import Rig
from mitsim.sensor.frames import Transform
from mitsim.sensor.matcher import MatcherSettings
from mitsim.sensor.preset import Sensor

#: pixels next to the edge of a feature that are given to no feature, at least: a matching block there sees two surfaces
EDGE_MARGIN_PX = 3


@dataclass(frozen=True)
class Ideal:
    """What a perfect sensor would see, pixel by pixel; flat arrays over the n pixels that meet a surface.

    ``pixel`` (n,) flat index into the grid; ``point`` (n, 3) and ``ray`` (n, 3) in the sensor frame [mm];
    ``distance`` (n,) |V| [mm]; ``normal`` (n, 3) in the view frame; ``shape`` (n,) index into the scene's names;
    ``status`` (n,) VALID where every eye sees the point.
    """

    pixel: NDArray[np.int64]
    point: NDArray[np.float64]
    ray: NDArray[np.float64]
    distance: NDArray[np.float64]
    normal: NDArray[np.float64]
    shape: NDArray[np.int16]
    status: NDArray[np.uint8]


@dataclass(frozen=True)
class Disturbance:
    """What moves the map's answer at ideal points, arrays (n,) [1].

    F is multiplied by ``kept`` and sigma by ``noisier``; ``lasting`` times sigma adds to the persistent noise.
    """

    kept: NDArray[np.float64]
    noisier: NDArray[np.float64]
    lasting: NDArray[np.float64]


class Predictor:
    """A rig's grid of rays, laid out once; predicts clouds of any scene from any map of that sensor."""

    def __init__(
        self, rig: Rig, grid: ViewGrid, seen_by_reference: NDArray[np.bool_], sensor: str,
        edge_margin_px: int = EDGE_MARGIN_PX,
    ) -> None:  # fmt: skip
        self.rig, self.grid, self.sensor, self.edge_margin_px = rig, grid, sensor, edge_margin_px
        self.seen = seen_by_reference
        self.rays = PixelRays.of_grid(grid)
        self.directions = grid.rays().reshape(-1, 3)
        self.eyes = [*list(rig.cameras.values())[1:], *([rig.projector] if rig.projector else [])]

    @staticmethod
    def of_sensor(sensor: Sensor, geometry: Geometry) -> Predictor:
        """That of a sensor, on the grid of its clouds; half a matching block and a pixel are kept from edges."""
        settings, margin = sensor.settings, EDGE_MARGIN_PX
        if isinstance(settings, MatcherSettings):
            margin = max(margin, settings.block_size // 2 + 1)
        return Predictor(sensor.measuring_rig, geometry.grid, geometry.seen, sensor.name, margin)

    def thinned(self, step: int) -> Predictor:
        """One that looks along every ``step``-th ray of every ``step``-th row, for expectations over many views."""
        first = step // 2
        return Predictor(
            self.rig, self.grid.thinned(step), self.seen[first::step, first::step], self.sensor,
            -(-self.edge_margin_px // step),
        )  # fmt: skip

    def thinned_to(self, rays: int) -> tuple[Predictor, int]:
        """One that looks along about so many rays, and its step: every ``step``-th of every ``step``-th row."""
        step = max(1, math.floor(math.sqrt(self.grid.width * self.grid.height / rays)))
        return (self.thinned(step) if step > 1 else self), step

    def surfaces(self, scene: Scene, world_from_sensor: Transform) -> Surfaces:
        """Ray-cast truth of a view, in the sensor frame."""
        return cast(scene, self.rays, world_from_sensor, np.array([eye.centre for eye in self.eyes]))

    def ideal(self, surfaces: Surfaces) -> Ideal:
        """Points that a perfect sensor would see, and what hides the others."""
        pixel = np.flatnonzero((surfaces.shape.ravel() >= 0) & self.seen.ravel())
        distance = surfaces.distance.ravel()[pixel].astype(float)
        ray = self.directions[pixel]
        point = self.grid.origin + ray * distance[:, None]
        normal = surfaces.normal.reshape(-1, 3)[pixel].astype(float)
        status = np.full(len(pixel), Status.VALID, np.uint8)
        outside = np.zeros(len(pixel), bool)
        for index, eye in enumerate(self.eyes):  # the projector comes last: what has no light needs no other reason
            where = eye.project(point)
            size = np.array([eye.width, eye.height])
            outside |= ~(np.isfinite(where).all(-1) & (where > -0.5).all(-1) & (where < size - 0.5).all(-1))
            hidden = ~surfaces.seen[index].ravel()[pixel]
            status[hidden] = Status.SHADOWED if eye is self.rig.projector else Status.HIDDEN
        status[outside] = Status.NO_SURFACE
        view = in_view_frame(normal, ray, self.rig.baseline_direction)
        return Ideal(pixel, point, ray, distance, view, surfaces.shape.ravel()[pixel], status)

    def labels(self, surfaces: Surfaces) -> NDArray[np.int16]:
        """Which shape each pixel shows, (H, W); -1 within ``edge_margin_px`` of an edge. For any cloud on this grid."""
        size = 2 * self.edge_margin_px + 1
        uniform = minimum_filter(surfaces.shape, size) == maximum_filter(surfaces.shape, size)
        return np.where(uniform, surfaces.shape, np.int16(-1))

    def draw(
        self, scene: Scene, ideal: Ideal, labels: NDArray[np.int16], fraction: NDArray[np.float64],
        sigma: NDArray[np.float64], rng: np.random.Generator,
    ) -> PointCloud:  # fmt: skip
        """A predicted cloud: noise and loss drawn from F and sigma (n,), which are NaN where the map has no answer."""
        shape = (self.grid.height, self.grid.width)
        status = np.full(shape, Status.NO_SURFACE, np.uint8)
        points = np.full((*shape, 3), np.nan, np.float32)
        spread = np.full(shape, np.nan, np.float32)
        known = np.isfinite(fraction) & (np.isfinite(sigma) | (fraction == 0))
        here = ideal.status.copy()
        here[(here == Status.VALID) & ~known] = Status.OUT_OF_RANGE
        epsilon = rng.standard_normal(len(fraction)) * np.nan_to_num(sigma)
        kept = rng.random(len(fraction)) < np.nan_to_num(fraction)
        here[(here == Status.VALID) & ~kept] = Status.DROPPED
        valid = here == Status.VALID
        status.reshape(-1)[ideal.pixel] = here
        points.reshape(-1, 3)[ideal.pixel[valid]] = (ideal.point + epsilon[:, None] * ideal.ray)[valid]
        spread.reshape(-1)[ideal.pixel[valid]] = sigma[valid]
        return PointCloud(
            points, status, self.grid, self.sensor, "predicted", self.rig.baseline_direction, labels, scene.names,
            spread,
        )  # fmt: skip


def performance(
    ideal: Ideal, scene: Scene, performance_map: PerformanceMap, finish: Finish | None = None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """F and sigma (n,) of every ideal point; 0 and NaN where an eye is hidden, NaN where the map has no answer.

    ``finish`` replaces the scene's own finishes: matt white, for the view score's normalisers.
    """
    fraction = np.full(len(ideal.pixel), np.nan)
    sigma = np.full(len(ideal.pixel), np.nan)
    for index, own in enumerate(scene.finishes):
        used = finish or own
        mask = (ideal.shape == index) & (ideal.status == Status.VALID)
        if used is None or not mask.any():
            continue
        answer = performance_map.query(used.name, used.roughness, ideal.distance[mask], ideal.normal[mask])
        fraction[mask], sigma[mask] = answer.fraction, answer.sigma
    fraction[ideal.status != Status.VALID] = 0.0
    return fraction, sigma


def expected_points(
    ideal: Ideal, labels: NDArray[np.int16], scene: Scene, shape: int, performance_map: PerformanceMap,
    world_from_sensor: Transform, thinning: float = 1.0, angular_pitch: float = np.nan,
    disturbance: Disturbance | None = None,
) -> ExpectedPoints:  # fmt: skip
    """What a view lets expect of one shape, in the world, which is the part's frame: a row for each possible point.

    ``thinning`` pixels of the sensor, ``angular_pitch`` [rad] apart, stand behind each ray. Where the map knows no
    noise area it is that of independent points, 1/F, and there is no persistent noise. ``disturbance`` is
    what the map does not know of (:mod:`mitsim.interreflection`).
    """
    finish = scene.finishes[shape]
    mask = (labels.reshape(-1)[ideal.pixel] == shape) & (ideal.status == Status.VALID)
    if finish is None:
        mask[:] = False
    distance, normal = ideal.distance[mask], ideal.normal[mask]
    place = np.stack(np.divmod(ideal.pixel[mask], labels.shape[1]), axis=-1)
    unknown = np.full(len(distance), np.nan)
    fraction, fraction_error, sigma, area, persistent = unknown, unknown, unknown, unknown, unknown
    if finish is not None and mask.any():
        answer = performance_map.query(finish.name, finish.roughness, distance, normal)
        structure = noise_structure(performance_map, finish.name, finish.roughness, distance, normal)
        fraction, fraction_error, sigma = answer.fraction, answer.fraction_error, answer.sigma
        area, persistent = structure.area, structure.persistent_share * sigma
        if disturbance is not None:
            fraction, fraction_error = (one * disturbance.kept[mask] for one in (fraction, fraction_error))
            persistent = np.hypot(np.nan_to_num(persistent), sigma * disturbance.lasting[mask])
            sigma = sigma * disturbance.noisier[mask]
    possible = np.isfinite(fraction) & (fraction > 0) & np.isfinite(sigma)
    fraction, sigma = fraction[possible], sigma[possible]
    return ExpectedPoints(
        world_from_sensor.points(ideal.point[mask][possible]),
        ideal.ray[mask][possible] @ world_from_sensor.rotation.T,
        np.rint(place[possible] * np.sqrt(thinning)).astype(np.int64), normal[possible], fraction,
        np.nan_to_num(fraction_error[possible]), sigma,
        np.where(np.isfinite(area[possible]), area[possible], 1 / fraction), np.nan_to_num(persistent[possible]),
        thinning, angular_pitch,
    )  # fmt: skip


def feature_statistics(
    ideal: Ideal, labels: NDArray[np.int16], fraction: NDArray[np.float64], sigma: NDArray[np.float64],
    shapes: list[int],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:  # fmt: skip
    """Expected points n and mean sigma [mm] of each shape, (features,) each; sigma is NaN where n is 0.

    The mean of sigma is over the points that are expected, so each pixel weighs by its F.
    """
    label = labels.reshape(-1)[ideal.pixel]
    weight = np.where(np.isfinite(sigma), np.nan_to_num(fraction), 0.0)
    n = np.array([weight[label == shape].sum() for shape in shapes])
    total = np.array([(weight * np.nan_to_num(sigma))[label == shape].sum() for shape in shapes])
    with np.errstate(invalid="ignore", divide="ignore"):
        return n, np.where(n > 0, total / n, np.nan)
