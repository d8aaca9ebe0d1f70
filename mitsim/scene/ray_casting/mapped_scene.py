"""Visible surfaces of a view and their F and sigma from a map, from the primary ray on, in one kernel.

Signal chain: rays of the pixels in which the scene can be -> nearest surface, its front -> frustum of every other
camera and of the projector -> rays toward those -> |V| and N in the view frame -> F and sigma of the face's own finish
(:mod:`mitsim.scene.ray_casting.map_tables`) -> images.

It casts the rays of :func:`mitsim.scene.ray_casting.raycast.cast`, but brings back only what a prediction needs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from characterisation.maps.tables import Surface
from characterisation.point_cloud import Status, ViewGrid
from mitsim.scene.backend import dr, mi
from mitsim.scene.load import Scene
from mitsim.scene.ray_casting.distortion import Distortion
from mitsim.scene.ray_casting.eye import Eye, shadow_ray
from mitsim.scene.ray_casting.map_tables import MapTables
from mitsim.scene.ray_casting.raycast import PixelRays, registered
from mitsim.sensor.camera import Camera
from mitsim.sensor.roi import Roi
from mitsim.sensor.transforms import Transform


@dataclass(frozen=True)
class MappedView:
    """Images (h, w) of the pixels of ``roi``; outside of it no pixel shows the scene.

    ``status`` is VALID where every eye sees the point, else says which does not; ``shape`` index into the scene's
    names, -1 where a ray meets nothing; ``distance`` |V| [mm], NaN there; ``normal`` (3, h, w) in the view frame, if it
    was asked for; ``fraction`` F and ``sigma`` [mm], NaN where the status is not VALID or the map has no answer.
    """

    roi: Roi
    status: NDArray[np.uint8]
    shape: NDArray[np.int16]
    distance: NDArray[np.float32]
    normal: NDArray[np.float32] | None
    fraction: NDArray[np.float32]
    sigma: NDArray[np.float32]


class _OtherEye:
    """A camera or the projector that must see a point as well; ``without`` is the status of one that it does not."""

    def __init__(self, camera: Camera, without: Status) -> None:
        self.camera, self.without = camera, without
        self.lens, self.place = Distortion(camera), Eye(camera.sensor_from_camera)

    def sees(self, point: Any) -> Any:
        """Whether a point of the sensor frame lies in the image."""
        local = self.place.local(point - self.place.position)
        return self.lens.image(local.x / local.z, local.y / local.z, local.z > 0)[2]


class ViewRays:
    """The rays of a cloud's grid and the eyes that must see what they meet, laid on the device once.

    Parameters
    ----------
    grid, seen_by_reference
        The grid, and which of its pixels (H, W) the reference camera has.
    baseline
        (3,) unit vector of the sensor frame along which normals have their x.
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
        self.grid, self.rays = grid, PixelRays.of_grid(grid)
        self.pinhole, self.shown = replace(grid, normalised=None), None
        if grid.normalised is not None:
            self.shown = np.ascontiguousarray(np.moveaxis(grid.pinhole_positions(), -1, 0))
        self.seen = mi.Bool(seen_by_reference.ravel())
        self.baseline, self.origin = mi.Vector3f(_point(baseline)), _point(grid.origin)
        # the projector comes last: what has no light needs no other reason
        self.eyes = [_OtherEye(camera, Status.HIDDEN) for camera in cameras]
        self.eyes += [_OtherEye(projector, Status.SHADOWED)] if projector else []

    def roi(self, bounds: NDArray[np.floating], world_from_sensor: Transform, margin: int) -> Roi:
        """Return the region that can show a box (2, 3) [mm] of the world, widened by ``margin``; one pixel at least."""
        size = np.array([self.grid.width, self.grid.height])
        corners = np.stack(np.meshgrid(*np.asarray(bounds).T, indexing="ij"), axis=-1).reshape(-1, 3)
        at = self.pinhole.project(world_from_sensor.inverse().points(corners))
        if not np.isfinite(at).all():
            return Roi.whole(self.grid.width, self.grid.height)
        low, high = np.floor(at.min(axis=0)), np.ceil(at.max(axis=0))
        if self.shown is not None:  # a lens bends the box's edges: which pixels show what lies between them?
            column, row = self.shown
            inside = (column >= low[0]) & (column <= high[0]) & (row >= low[1]) & (row <= high[1])
            spans = [np.flatnonzero(inside.any(axis)) for axis in (0, 1)]
            low, high = (np.array([span[end] if len(span) else 0 for span in spans]) for end in (0, -1))
        low = np.clip(low - margin, 0, size - 1).astype(int)
        high = np.clip(high + margin + 1, low + 1, size).astype(int)
        return Roi.between(*low, *high)

    def pixels(self, roi: Roi) -> Any:
        """Flat indices of the pixels of a region."""
        left, top, width = (dr.opaque(mi.UInt32, each) for each in (roi.left, roi.top, roi.width))
        index = dr.arange(mi.UInt32, roi.width * roi.height)
        return (index // width + top) * self.grid.width + index % width + left

    def in_view_frame(self, normal: Any, ray: Any) -> Any:
        """A normal of the sensor frame in the view frame (:func:`characterisation.coupon.view_frame.view_frame`)."""
        z = -ray
        x = dr.normalize(self.baseline - z * dr.dot(z, self.baseline))
        return mi.Vector3f(dr.dot(x, normal), dr.dot(dr.cross(z, x), normal), dr.dot(z, normal))


class MappedScene:
    """A scene of whose faces a map tells F and sigma, laid on the device once.

    ``surfaces`` holds the fields of each shape's finish, in the order of the scene's names; None where nothing is
    known.
    """

    def __init__(self, scene: Scene, surfaces: Sequence[Surface | None]) -> None:
        self.scene = scene
        known: list[Surface] = []
        numbers = []
        for surface in surfaces:
            if surface is not None and not any(surface is one for one in known):
                known.append(surface)
            numbers.append(-1 if surface is None else next(i for i, one in enumerate(known) if one is surface))
        self.tables = MapTables(known) if known else None
        # by Mitsuba's own number of a shape: its index, its surface, whether its back is seen
        ids = [registered(shape) for shape in scene.shapes]
        rows = np.full((max(ids) + 1, 3), -1, np.int32)
        for index, (number, shape) in enumerate(zip(ids, scene.shapes, strict=True)):
            two_sided = bool(int(shape.bsdf().flags()) & int(mi.BSDFFlags.BackSide))
            rows[number] = index, numbers[index], two_sided
        self.shapes, self.count = mi.Int32(rows.ravel()), len(rows)
        dr.eval(self.shapes)

    def look(self, view: ViewRays, world_from_sensor: Transform, margin: int = 0, normals: bool = False) -> MappedView:
        """Return the visible surfaces of a view from a pose, with F and sigma of the map.

        ``margin`` pixels are added around those that can show the scene; with ``normals`` the normals are returned too.
        """
        roi = view.roi(self.scene.bounds, world_from_sensor, margin)
        size = (roi.height, roi.width)
        images = self._images(view, world_from_sensor, roi)
        dr.eval(images)
        normal = np.array(images["normal"]).reshape(3, *size) if normals else None
        status, shape, distance, fraction, sigma = (
            np.array(images[name]).reshape(size) for name in ("status", "shape", "distance", "fraction", "sigma")
        )
        return MappedView(roi, status, shape.astype(np.int16), distance, normal, fraction, sigma)

    def _images(self, view: ViewRays, world_from_sensor: Transform, roi: Roi) -> dict[str, Any]:
        pixel = view.pixels(roi)
        frame = view.rays.frame(world_from_sensor)
        ray = dr.gather(mi.Vector3f, view.rays.directions, pixel)
        direction = frame.turn(ray)
        surface = self.scene.mitsuba.ray_intersect(
            mi.Ray3f(frame.position, direction), ray_flags=mi.RayFlags.Minimal, coherent=True
        )
        number = dr.reinterpret_array(mi.UInt32, surface.shape)
        met = surface.is_valid() & (number < self.count)  # what an instance holds has a number beyond
        index, known, two_sided = dr.gather(mi.Array3i, self.shapes, number, met)
        facing = dr.select(dr.dot(surface.n, direction) > 0, -1.0, 1.0)
        hit = met & (index >= 0) & ((facing > 0) | (two_sided > 0))
        normal = surface.n * facing
        shown = hit & dr.gather(mi.Bool, view.seen, pixel)
        status = self._occluded(view, world_from_sensor, surface, normal, view.origin + ray * surface.t, shown)
        in_view = view.in_view_frame(frame.local(normal), ray)
        fraction = sigma = dr.full(mi.Float, dr.nan, dr.width(pixel))
        if self.tables is not None:
            asked = (status == _code(Status.VALID)) & (known >= 0)
            fraction, sigma = self.tables.look_up(mi.UInt32(known), surface.t, in_view, asked)
        return {
            "status": dr.uint8_array_t(mi.Float)(status),
            "shape": dr.select(hit, index, -1),
            "distance": dr.select(hit, surface.t, dr.nan),
            "normal": in_view,
            "fraction": fraction,
            "sigma": sigma,
        }

    def _occluded(
        self, view: ViewRays, world_from_sensor: Transform, surface: Any, normal: Any, point: Any, shown: Any
    ) -> Any:
        """Status of every pixel; ``point`` is in the sensor frame, the surface in the world."""
        inside, status = shown, _code(Status.VALID)
        for eye in view.eyes:
            inside &= eye.sees(point)
        for eye in view.eyes:
            to_eye = _point(world_from_sensor.points(eye.camera.centre)) - surface.p
            length = dr.norm(to_eye)
            front = inside & (dr.dot(normal, to_eye) > 0)
            free = front & ~self.scene.mitsuba.ray_test(shadow_ray(surface, to_eye / length, length), front)
            status = dr.select(free, status, _code(eye.without))
        return dr.select(inside, status, _code(Status.NO_SURFACE))


def _code(status: Status) -> Any:
    return mi.UInt32(int(status))


def _point(place: NDArray[np.floating]) -> Any:
    """Three numbers on the device, opaque so that others do not mean another kernel."""
    return mi.Point3f(*[dr.opaque(mi.Float, float(v)) for v in place])
