"""Ideal points of a view, and clouds drawn from them.

Signal chain: rays of the view grid x part -> ideal points -> frustum, back face and ray-traced occlusion toward every
camera and the projector -> F and sigma of each point from the map -> eps = R_N sigma along the view ray, kept if R_U <
F.

F and sigma are computed in two ways. :meth:`Predictor.ideal` with :func:`mitsim.maps.prediction.performance`, on
:meth:`Predictor.surfaces`, is the reference and gives the errors of the map too. :meth:`Predictor.predict` computes the
same in one kernel on the device, for clouds.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d, minimum_filter1d

from characterisation.coupon.view_frame import in_frame, view_frame
from characterisation.files.arrays import Floats
from characterisation.files.threads import in_threads
from characterisation.point_cloud import PointCloud, Status, ViewGrid
from characterisation.region_of_interest import Roi
from mitsim.decoding.cloud import Geometry
from mitsim.maps.prediction.characterised_scene import CharacterisedScene
from mitsim.maps.prediction.cut_noise import cut_deviates
from mitsim.maps.prediction.noise_field import correlated_noise
from mitsim.maps.prediction.perturbation import Ideal
from mitsim.scene.load import Scene
from mitsim.scene.ray_casting.mapped_scene import MappedView, ViewRays
from mitsim.scene.ray_casting.raycast import PixelRays, Surfaces, cast_together, shapes_met
from mitsim.sensor.camera import Camera, Rig
from mitsim.sensor.matcher import MatcherSettings
from mitsim.sensor.sensor import Sensor
from mitsim.sensor.transforms import Transform

#: smallest margin at the edge of a feature whose pixels belong to no feature: a matching block there covers two
#: surfaces
EDGE_MARGIN_PX = 3


@dataclass(frozen=True)
class Predicted:
    """Prediction of a view from a map: F and sigma of the pixels ``seen``; ``labels`` (H, W) int16, see Predictor."""

    seen: MappedView
    labels: NDArray[np.int16]


class Predictor:
    """The ray grid of a rig, prepared once; predicts clouds of any scene from any map of that sensor.

    ``grid`` is the sensor's grid. The predictor casts every ``step``-th ray of every ``step``-th row, those of
    ``self.grid``.
    """

    def __init__(
        self,
        rig: Rig,
        grid: ViewGrid,
        seen_by_reference: NDArray[np.bool_],
        sensor: str,
        edge_margin_px: int = EDGE_MARGIN_PX,
        step: int = 1,
    ) -> None:
        self.rig, self.every, self.step, self.sensor = rig, grid, step, sensor
        self.edge_margin_px = edge_margin_px
        self.margin = -(-edge_margin_px // step)  # margin in cast rays, rounded up
        self.grid = grid = grid.thinned(step) if step > 1 else grid
        self.seen = seen_by_reference[step // 2 :: step, step // 2 :: step]
        cameras = list(rig.cameras.values())[1:]
        self.view = ViewRays(grid, self.seen, rig.baseline_direction, cameras, rig.projector)
        self.rays = self.view.rays
        self.directions = self.view.directions.reshape(-1, 3)
        self.eyes = [*cameras, *([rig.projector] if rig.projector else [])]

    @cached_property
    def single_directions(self) -> NDArray[np.float32]:
        """Return the directions of the rays (H, W, 3) in single precision, for clouds."""
        return self.view.directions.astype(np.float32)

    @staticmethod
    def of_sensor(sensor: Sensor, geometry: Geometry) -> Predictor:
        """Return the predictor of a sensor on the grid of its clouds; the margin is half a block and a pixel."""
        settings, margin = sensor.settings, EDGE_MARGIN_PX
        if isinstance(settings, MatcherSettings):
            margin = max(margin, settings.block_size // 2 + 1)
        return Predictor(sensor.measuring_rig, geometry.grid, geometry.seen, sensor.name, margin)

    def thinned(self, step: int) -> Predictor:
        """Return a predictor that casts every ``step``-th ray of every ``step``-th row, for expectations."""
        assert self.step == 1, "thinned already"
        return Predictor(self.rig, self.grid, self.seen, self.sensor, self.edge_margin_px, step)

    def thinned_to(self, rays: int) -> Predictor:
        """Return a predictor that casts about ``rays`` rays, as :meth:`thinned`."""
        step = max(1, math.floor(math.sqrt(self.grid.width * self.grid.height / rays)))
        return self.thinned(step) if step > 1 else self

    def closer(self, bounds: NDArray[np.floating], world_from_sensor: Transform, rays: int) -> Predictor:
        """Return a predictor of the region that can show a box (2, 3) [mm] of the world frame, by up to ``rays`` rays.

        Its pixels are those of the sensor, or every ``step``-th of every ``step``-th row.
        """
        assert self.step == 1, "thinned already"
        roi = self.view.roi(bounds, world_from_sensor, self.margin)
        step = math.ceil(math.sqrt(roi.width * roi.height / rays))
        grid, seen = self.grid.cropped(roi), self.seen[roi.slices]
        return Predictor(self.rig, grid, seen, self.sensor, self.edge_margin_px, step)

    def surfaces(self, scene: Scene, world_from_sensor: Transform) -> Surfaces:
        """Return the ray-cast surfaces of a view, in the sensor frame."""
        return surfaces_of([self], scene, world_from_sensor)[0]

    def ideal(self, surfaces: Surfaces) -> Ideal:
        """Return the points of a perfect sensor, and the reason why eyes do not see some of them."""
        pixel = np.flatnonzero((surfaces.shape.ravel() >= 0) & self.seen.ravel())
        distance = surfaces.distance.ravel()[pixel].astype(float)
        ray = self.directions[pixel]
        point = self.grid.origin + ray * distance[:, None]
        normal = surfaces.normal.reshape(-1, 3)[pixel].astype(float)
        status = np.full(len(pixel), Status.VALID, np.uint8)
        outside = np.zeros(len(pixel), bool)
        for index, eye in enumerate(self.eyes):  # the projector comes last, so that its shadow takes precedence
            outside |= ~_in_image(eye, self.view.eyes[index].distortion.reach, point)
            hidden = ~surfaces.seen[index].ravel()[pixel]
            status[hidden] = Status.SHADOWED if eye is self.rig.projector else Status.HIDDEN
        status[outside] = Status.NO_SURFACE
        frames = view_frame(ray, self.rig.baseline_direction)
        view = in_frame(normal, frames)
        u = surfaces.along
        along = None if u is None else in_frame(u.reshape(-1, 3)[pixel].astype(float), frames)
        return Ideal(pixel, point, ray, distance, view, surfaces.shape.ravel()[pixel], status, along)

    def labels(self, scene: Scene, world_from_sensor: Transform, surfaces: Surfaces) -> NDArray[np.int16]:
        """Return the shape that each pixel shows, (H, W), for any cloud on this grid.

        Pixels within ``edge_margin_px`` of an edge are -1. The margin is in pixels of the sensor. A thinned grid lacks
        these pixels, so rays near a change of shape are cast again at that distance. Otherwise the wider margin would
        exclude the limb of a pillar, whose points have the largest errors and are in the cloud.
        """
        return self._labels(scene, world_from_sensor, surfaces.shape, Roi.whole(self.grid.width, self.grid.height))

    def quick_labels(self, scene: Scene, world_from_sensor: Transform) -> NDArray[np.int16]:
        """Return :meth:`labels` for decoded points, at a tenth of the cost; back faces count as shapes."""
        roi = self.view.roi(scene.bounds, world_from_sensor, self.margin)  # all beyond it is -1
        shape = shapes_met(scene, self.rays.within(roi), world_from_sensor)
        labels = np.full((self.grid.height, self.grid.width), -1, np.int16)
        labels[roi.slices] = self._labels(scene, world_from_sensor, shape, roi)
        return labels

    def _labels(
        self, scene: Scene, world_from_sensor: Transform, shape: NDArray[np.int16], roi: Roi
    ) -> NDArray[np.int16]:
        """Return the labels of the shapes (h, w) in a window of the image."""
        labels = _away_from_edges(shape, self.margin)
        rows, columns = np.nonzero((shape >= 0) & (labels < 0))
        if self.step == 1 or not len(rows):
            return labels
        shapes = shape[rows, columns]
        beside = self.edge_margin_px * np.array([(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j])[..., None]
        row, column = (
            np.clip((start + index) * self.step + self.step // 2 + aside, 0, size - 1)
            for index, start, aside, size in (
                (rows, roi.top, beside[:, 0], self.every.height),
                (columns, roi.left, beside[:, 1], self.every.width),
            )
        )
        rays = PixelRays(self.every.origin, self.every.rays_at(column, row))
        agree = (shapes_met(scene, rays, world_from_sensor) == shapes).all(axis=0)
        labels[rows[agree], columns[agree]] = shapes[agree]
        return labels

    def look_up(
        self, characterised: CharacterisedScene, world_from_sensor: Transform, normals: bool = False
    ) -> Predicted:
        """Return F and sigma of every pixel of a view that shows the scene, and on request normals, from one kernel.

        Raises InputError if the view shows a face whose finish was not characterised.
        """
        seen = characterised.mapped.cast(self.view, world_from_sensor, self.margin, normals)
        for index, error in characterised.unknown.items():
            if ((seen.shape == index) & (seen.status == Status.VALID)).any():
                raise error
        labels = np.full(self.seen.shape, -1, np.int16)
        labels[seen.roi.slices] = self._labels(characterised.scene, world_from_sensor, seen.shape, seen.roi)
        return Predicted(seen, labels)

    def predict(
        self,
        characterised: CharacterisedScene,
        world_from_sensor: Transform,
        rng: np.random.Generator,
        correlated: bool = False,
    ) -> PointCloud:
        """Return a random cloud of a view: P_eps = P + eps V^ if R_U < F, with eps = R_N sigma.

        P is the ideal point, V^ the unit vector along its ray, R_N a normal deviate, cut where a point would be false
        (:mod:`mitsim.maps.prediction.cut_noise`), and R_U a uniform one. The talk of Kinnell and Justham (2018; slide
        *Simulating the Point Cloud*) writes rho_e for F and sigma_e for sigma. The equations are in :meth:`_cloud`.

        Raises InputError if the view shows a face whose finish was not characterised.

        Parameters
        ----------
        characterised, world_from_sensor, rng
            The scene with F and sigma of its faces; pose of the sensor; random generator.
        correlated
            Whether the deviates of neighbours are correlated as measured in the map; otherwise independent, as in the
            talk.
        """
        predicted = self.look_up(characterised, world_from_sensor, correlated)
        seen, size = predicted.seen, predicted.seen.status.shape
        standard, chance = _deviates(size, rng)
        if correlated:
            standard = correlated_noise(characterised.scene, characterised.performance_map, seen, rng)
        return self._cloud(characterised.scene, seen, predicted.labels, standard, chance)

    def draw(
        self,
        scene: Scene,
        ideal: Ideal,
        labels: NDArray[np.int16],
        fraction: Floats,
        sigma: Floats,
        rng: np.random.Generator,
    ) -> PointCloud:
        """Draw a cloud from ideal points, F and sigma (n,), with the equations of :meth:`predict`.

        Parameters
        ----------
        scene, ideal, labels, rng
            Scene with the shapes, points of the view, the shapes (H, W) that the pixels show, and random generator.
        fraction, sigma
            F and sigma [mm] (n,); NaN where the map has no answer. Such points are lost.
        """
        size = (self.grid.height, self.grid.width)

        def image(values: NDArray[Any], missing: float) -> NDArray[Any]:
            out = np.full(size, missing, values.dtype)
            out.reshape(-1)[ideal.pixel] = values
            return out

        status, shape = image(ideal.status, Status.NO_SURFACE), image(ideal.shape, -1)
        distance, fractions, sigmas = (image(values, np.nan) for values in (ideal.distance, fraction, sigma))
        seen = MappedView(Roi.whole(size[1], size[0]), status, shape, distance, None, fractions, sigmas)
        noise = image(rng.standard_normal(len(fraction)), 0.0)
        return self._cloud(scene, seen, labels, noise, image(rng.random(len(fraction)), 1.0))

    def _cloud(
        self, scene: Scene, seen: MappedView, labels: NDArray[np.int16], noise: NDArray[Any], chance: NDArray[Any]
    ) -> PointCloud:
        """Return points with errors ``noise`` (h, w) in units of sigma, kept if ``chance``, R_U (h, w), is below F."""
        part, size = seen.roi.slices, (self.grid.height, self.grid.width)
        visible = seen.status == Status.VALID
        mapped = np.isfinite(seen.fraction) & (np.isfinite(seen.sigma) | (seen.fraction == 0))
        kept = visible & mapped & (chance < seen.fraction)
        status, spread = np.full(size, Status.NO_SURFACE, np.uint8), np.full(size, np.nan, np.float32)
        points = np.full((*size, 3), np.nan, np.float32)
        lost = np.where(mapped, np.uint8(Status.DROPPED), np.uint8(Status.OUT_OF_RANGE))
        status[part] = np.where(visible & ~kept, lost, seen.status)
        spread[part] = np.where(kept, seen.sigma, np.nan)
        error = cut_deviates(noise, seen.sigma, seen.distance) * seen.sigma
        distance = np.where(kept, seen.distance + error, np.nan).astype(np.float32, copy=False)
        np.multiply(self.single_directions[part], distance[..., None], out=points[part])
        if self.grid.origin.any():
            points[part] += self.grid.origin.astype(np.float32)
        baseline, names = self.rig.baseline_direction, scene.names
        return PointCloud(points, status, self.grid, self.sensor, "predicted", baseline, labels, names, spread)


def surfaces_of(predictors: Sequence[Predictor], scene: Scene, world_from_sensor: Transform) -> list[Surfaces]:
    """Return the :meth:`Predictor.surfaces` of several predictors of one sensor, from one launch."""
    eyes = np.array([eye.centre for eye in predictors[0].eyes])
    return cast_together(scene, [predictor.rays for predictor in predictors], world_from_sensor, eyes)


def _deviates(size: tuple[int, ...], rng: np.random.Generator) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return R_N and R_U of every pixel, (h, w) each; each half of the image has its own stream and thread."""
    normal, uniform = np.empty((2, *size), np.float32)
    middle = size[0] // 2

    def draw(half: tuple[slice, np.random.Generator]) -> None:
        part, stream = half
        stream.standard_normal(dtype=np.float32, out=normal[part])
        stream.random(dtype=np.float32, out=uniform[part])

    in_threads(draw, zip((slice(None, middle), slice(middle, None)), rng.spawn(2), strict=True))
    return normal, uniform


def _in_image(eye: Camera, reach: float, point: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return whether points (n, 3) [mm] lie in an eye's image; distortion may fold back beyond ``reach`` (x/z, y/z)."""
    where = eye.project(point)
    size = np.array([eye.width, eye.height])
    local = eye.sensor_from_camera.inverse().points(point)
    with np.errstate(invalid="ignore", divide="ignore"):
        near = np.hypot(local[:, 0], local[:, 1]) < reach * local[:, 2]
    return np.asarray(near & ((where > -0.5) & (where < size - 0.5)).all(-1))


def _away_from_edges(shape: NDArray[np.int16], margin: int) -> NDArray[np.int16]:
    """Return the shapes (h, w) of pixels whose neighbours within ``margin`` all show the same shape, else -1."""
    least, largest, size = shape, shape, 2 * margin + 1
    for axis in (0, 1):
        least = minimum_filter1d(least, size, axis, mode="nearest")
        largest = maximum_filter1d(largest, size, axis, mode="nearest")
    return np.where(least == largest, shape, np.int16(-1))
