"""Find the visible surfaces of a view and their F and sigma in a map, in one kernel.

Signal chain: rays of the pixels that can show the scene -> nearest surface, if its front is seen -> image bounds of the
other cameras and the projector -> shadow rays toward them -> |V| and N in the view frame -> F and sigma of the
surface's finish (:mod:`mitsim.scene.ray_casting.map_tables`) -> images.

The rays are those of :func:`mitsim.scene.ray_casting.raycast.cast`, but only the data for a prediction is copied from
the device.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from characterisation.maps.tables import Surface
from characterisation.point_cloud import Status, ViewGrid
from characterisation.region_of_interest import Roi
from mitsim.scene.backend import dr, mi
from mitsim.scene.device import opaque_index, opaque_point, vectors_to_host
from mitsim.scene.first_hits import shape_numbers
from mitsim.scene.load import Scene
from mitsim.scene.ray_casting.distortion import Distortion
from mitsim.scene.ray_casting.eye import Eye, shadow_ray
from mitsim.scene.ray_casting.map_tables import MapTables
from mitsim.scene.ray_casting.raycast import PixelRays
from mitsim.sensor.camera import Camera
from mitsim.sensor.transforms import Transform


@dataclass(frozen=True)
class MappedView:
    """Images (h, w) of the pixels of ``roi``; no pixel outside it shows the scene."""

    roi: Roi
    status: NDArray[np.uint8]  # VALID if all cameras and the projector see the point; else the reason
    shape: NDArray[np.int16]  # index into the names of the scene; -1 without a surface
    distance: NDArray[np.float32]  # |V| [mm]; NaN without a surface
    normal: NDArray[np.float32] | None  # (3, h, w) in the view frame, if requested
    #: ``fraction``, ``sigma``: F [1] and sigma [mm]; NaN if the status is not VALID or the map has no value
    fraction: NDArray[np.float32]
    sigma: NDArray[np.float32]


class _OtherEye:
    """A camera or projector that must see a point too; ``hidden`` is the status of points that it does not see."""

    def __init__(self, camera: Camera, hidden: Status) -> None:
        self.camera, self.hidden = camera, hidden
        self.distortion, self.eye = Distortion(camera), Eye(camera.sensor_from_camera)

    def sees(self, point: Any) -> Any:
        """Whether a point of the sensor frame projects into the image."""
        local = self.eye.to_local(point - self.eye.position)
        return self.distortion.image(local.x / local.z, local.y / local.z, local.z > 0)[2]


_other_eye = lru_cache(maxsize=32)(_OtherEye)  # a view has rays of its own for each of its small features


class ViewRays:
    """The rays of a cloud's grid, and the cameras and projector that must see the surfaces, on the device.

    Parameters
    ----------
    grid, seen_by_reference
        The grid, and whether the reference camera has each of its pixels, (H, W).
    baseline
        (3,) unit vector of the sensor frame, whose projection is the x axis of normals.
    cameras, projector
        The other cameras, and the projector, of the sensor.
    """

    def __init__(
        self,
        grid: ViewGrid,
        seen_by_reference: NDArray[np.bool_],
        baseline: NDArray[np.floating],
        cameras: Sequence[Camera],
        projector: Camera | None,
    ) -> None:
        self.grid, self.directions = grid, grid.rays()
        self.rays = PixelRays(grid.origin, self.directions)
        self.pinhole, self.pinhole_pixels = replace(grid, normalised=None), None
        if grid.normalised is not None:
            self.pinhole_pixels = np.ascontiguousarray(np.moveaxis(grid.pinhole_positions(), -1, 0))
        self.seen = mi.Bool(seen_by_reference.ravel())
        self.baseline, self.origin = mi.Vector3f(opaque_point(baseline)), opaque_point(grid.origin)
        # the projector comes last, so that SHADOWED takes precedence over HIDDEN
        self.eyes = [_other_eye(camera, Status.HIDDEN) for camera in cameras]
        self.eyes += [_other_eye(projector, Status.SHADOWED)] if projector else []

    def roi(self, bounds: NDArray[np.floating], world_from_sensor: Transform, margin: int) -> Roi:
        """Return the region that can show a box (2, 3) [mm] of the world frame, widened by ``margin`` pixels.

        It has at least one pixel.
        """
        size = np.array([self.grid.width, self.grid.height])
        corners = np.stack(np.meshgrid(*np.asarray(bounds).T, indexing="ij"), axis=-1).reshape(-1, 3)
        pixels = self.pinhole.project(world_from_sensor.inverse().points(corners))
        if not np.isfinite(pixels).all():
            return Roi.whole(self.grid.width, self.grid.height)
        low, high = np.floor(pixels.min(axis=0)), np.ceil(pixels.max(axis=0))
        # distortion bends the box's edges: select pixels by their undistorted positions
        if self.pinhole_pixels is not None:
            column, row = self.pinhole_pixels
            inside = (column >= low[0]) & (column <= high[0]) & (row >= low[1]) & (row <= high[1])
            spans = [np.flatnonzero(inside.any(axis)) for axis in (0, 1)]
            low, high = (np.array([span[end] if len(span) else 0 for span in spans]) for end in (0, -1))
        low = np.clip(low - margin, 0, size - 1).astype(int)
        high = np.clip(high + margin + 1, low + 1, size).astype(int)
        return Roi.between(*low, *high)

    def pixels(self, roi: Roi) -> Any:
        """Return the flat indices of the pixels of a region."""
        left, top, width = (opaque_index(number) for number in (roi.left, roi.top, roi.width))
        index = dr.arange(mi.UInt32, roi.width * roi.height)
        return (index // width + top) * opaque_index(self.grid.width) + index % width + left

    def in_view_frame(self, normal: Any, ray: Any) -> Any:
        """Rotate a normal, or another vector, from the sensor frame to the view frame of a ray.

        The view frame is that of :func:`characterisation.coupon.view_frame.view_frame`.
        """
        z = -ray
        x = dr.normalize(self.baseline - z * dr.dot(z, self.baseline))
        return mi.Vector3f(dr.dot(x, normal), dr.dot(dr.cross(z, x), normal), dr.dot(z, normal))


class MappedScene:
    """A scene on the device, with the F and sigma of its surfaces from a map.

    ``surfaces`` are the map's fields for the finish of each shape, in the order of the scene's names; None if unknown.
    """

    def __init__(self, scene: Scene, surfaces: Sequence[Surface | None]) -> None:
        self.scene = scene
        distinct: list[Surface] = []
        numbers = []
        for surface in surfaces:
            if surface is not None and not any(surface is member for member in distinct):
                distinct.append(surface)
            numbers.append(-1 if surface is None else next(i for i, member in enumerate(distinct) if member is surface))
        self.tables = MapTables(distinct) if distinct else None
        if self.tables is not None:
            numbers = [-1 if row < 0 else self.tables.numbers[row] for row in numbers]
        self.with_lay = self.tables is not None and self.tables.directions > 0
        # a row for each of Mitsuba's shape numbers: index of the shape, index of its surface, whether its back is seen
        ids = shape_numbers(scene.mitsuba)
        rows = np.full((int(ids.max()) + 1, 3), -1, np.int32)
        for index, (number, shape) in enumerate(zip(ids, scene.shapes, strict=True)):
            two_sided = bool(int(shape.bsdf().flags()) & int(mi.BSDFFlags.BackSide))
            rows[number] = index, numbers[index], two_sided
        self.shapes, self.count = mi.Int32(rows.ravel()), opaque_index(len(rows))
        dr.eval(self.shapes)

    def cast(self, view: ViewRays, world_from_sensor: Transform, margin: int = 0, normals: bool = False) -> MappedView:
        """Return the visible surfaces of a view from a pose, with F and sigma of the map.

        Parameters
        ----------
        view, world_from_sensor
            The rays, and the pose of the sensor.
        margin
            Pixels that are added around the region that can show the scene.
        normals
            Whether to return the normals, too.
        """
        roi = view.roi(self.scene.bounds, world_from_sensor, margin)
        size = (roi.height, roi.width)
        images = self._images(view, world_from_sensor, roi)
        if not normals:
            del images["normal"]
        dr.eval(images)
        normal = vectors_to_host(images["normal"]).T.reshape(3, *size) if normals else None
        status, shape, distance, fraction, sigma = (
            np.array(images[name]).reshape(size) for name in ("status", "shape", "distance", "fraction", "sigma")
        )
        return MappedView(roi, status, shape.astype(np.int16), distance, normal, fraction, sigma)

    def _images(self, view: ViewRays, world_from_sensor: Transform, roi: Roi) -> dict[str, Any]:
        pixel = view.pixels(roi)
        frame = view.rays.frame(world_from_sensor)
        ray = dr.gather(mi.Vector3f, view.rays.directions, pixel)
        direction = frame.to_world(ray)
        surface = self._surface(mi.Ray3f(frame.position, direction), pixel, view)
        number = dr.reinterpret_array(mi.UInt32, surface.shape)
        met = surface.is_valid() & (number < self.count)  # shapes inside an instance have larger numbers
        index, surface_index, two_sided = dr.gather(mi.Array3i, self.shapes, number, met)
        facing = dr.select(dr.dot(surface.n, direction) > 0, -1.0, 1.0)
        hit = met & (index >= 0) & ((facing > 0) | (two_sided > 0))
        normal = surface.n * facing
        visible = hit & dr.gather(mi.Bool, view.seen, pixel)
        status = self._occluded(view, world_from_sensor, surface, normal, view.origin + ray * surface.t, visible)
        in_view = view.in_view_frame(frame.to_local(normal), ray)
        fraction = sigma = dr.full(mi.Float, dr.nan, dr.width(pixel))
        if self.tables is not None:
            queried = (status == _code(Status.VALID)) & (surface_index >= 0)
            if self.with_lay:
                along = view.in_view_frame(frame.to_local(surface.dp_du), ray)
                fraction, sigma = self.tables.look_up_lay(mi.UInt32(surface_index), surface.t, in_view, along, queried)
            else:
                fraction, sigma = self.tables.look_up(mi.UInt32(surface_index), surface.t, in_view, queried)
        return {
            "status": dr.uint8_array_t(mi.Float)(status),
            "shape": dr.select(hit, index, -1),
            "distance": dr.select(hit, surface.t, dr.nan),
            "normal": in_view,
            "fraction": fraction,
            "sigma": sigma,
        }

    def _surface(self, ray: Any, pixel: Any, view: ViewRays) -> Any:
        """Return the interactions of rays with the first surface."""
        flags = mi.RayFlags.dPdUV if self.with_lay else mi.RayFlags.Minimal
        active = True if view.rays.active is True else dr.gather(mi.Bool, view.rays.active, pixel)
        if len(self.scene.names) > 1:
            return self.scene.mitsuba.ray_intersect(ray, ray_flags=flags, coherent=True, active=active)
        # Mitsuba would record the interaction with every shape that is loaded, also of other scenes
        met = self.scene.mitsuba.ray_intersect_preliminary(ray, coherent=True, active=active)
        surface = self.scene.shapes[0].compute_surface_interaction(ray, met, int(flags), met.is_valid())
        surface.t, surface.shape = met.t, met.shape
        return surface

    def _occluded(
        self, view: ViewRays, world_from_sensor: Transform, surface: Any, normal: Any, point: Any, visible: Any
    ) -> Any:
        """Return the status of each pixel; ``point`` is in the sensor frame, ``surface`` in the world frame."""
        inside, status = visible, _code(Status.VALID)
        for eye in view.eyes:
            inside &= eye.sees(point)
        for eye in view.eyes:
            to_eye = opaque_point(world_from_sensor.points(eye.camera.centre)) - surface.p
            length = dr.norm(to_eye)
            facing = inside & (dr.dot(normal, to_eye) > 0)
            free = facing & ~self.scene.mitsuba.ray_test(shadow_ray(surface, to_eye / length, length), facing)
            status = dr.select(free, status, _code(eye.hidden))
        return dr.select(inside, status, _code(Status.NO_SURFACE))


def _code(status: Status) -> Any:
    return mi.UInt32(int(status))
