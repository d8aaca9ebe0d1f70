"""Cast rays at the geometry of a scene, for ground truth and ideal clouds.

Signal chain: one ray through the centre of each pixel -> nearest surface -> distance, normal and shape; shadow rays to
the other cameras and the projector -> visibility.

There is one ray per pixel and no filter, because an average of labels is no label.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from characterisation.point_cloud import ViewGrid
from characterisation.region_of_interest import Roi
from mitsim.scene.backend import dr, mi
from mitsim.scene.device import known_to_device, opaque_index, opaque_point, vectors_to_host
from mitsim.scene.first_hits import numbers_met, shape_indices
from mitsim.scene.load import Scene
from mitsim.scene.ray_casting.eye import Eye, shadow_ray
from mitsim.sensor.camera import Camera
from mitsim.sensor.transforms import Transform


@dataclass(frozen=True)
class Surfaces:
    """Surfaces that the rays meet, in the sensor frame."""

    #: (H, W) |V| [mm]. NaN without a surface, or where only the back of a one-sided face is seen, which renders black
    distance: NDArray[np.float32]
    normal: NDArray[np.float32]  # (H, W, 3) toward the sensor
    shape: NDArray[np.int16]  # (H, W) index into the names of the scene; -1 where the distance is NaN
    seen: NDArray[np.bool_]  # (E, H, W) whether each eye is on the front side and has a free line of sight to the point
    #: (H, W, 3) derivative of the point by the surface parameter u; None in a scene without a lay
    along: NDArray[np.float32] | None = None


class PixelRays:
    """Rays from one point, on the device.

    ``origin`` (3,) [mm] and unit ``directions`` (H, W, 3), both in the sensor frame. A direction of NaN meets nothing;
    ``active`` is a mask of the others on the device, or True for all.
    """

    def __init__(self, origin: NDArray[np.floating], directions: NDArray[np.floating]) -> None:
        self.origin = np.asarray(origin, float)
        self.size = (directions.shape[0], directions.shape[1])
        self.directions, self.active = known_to_device(directions.reshape(-1, 3))

    def frame(self, world_from_sensor: Transform) -> Eye:
        """Return the origin of the rays and the axes of the sensor, in the world frame."""
        return Eye(Transform(world_from_sensor.rotation, world_from_sensor.points(self.origin)))

    def within(self, roi: Roi) -> PixelRays:
        """Return the rays of a region."""
        left, top, width, whole = (opaque_index(number) for number in (roi.left, roi.top, roi.width, self.size[1]))
        index = dr.arange(mi.UInt32, roi.width * roi.height)
        pixel = (index // width + top) * whole + index % width + left
        part = copy.copy(self)
        part.size = (roi.height, roi.width)
        part.directions = dr.gather(mi.Vector3f, self.directions, pixel)
        part.active = True if self.active is True else dr.gather(mi.Bool, self.active, pixel)
        return part

    @staticmethod
    def joined(groups: Sequence[PixelRays]) -> PixelRays:
        """Return the rays of all groups in one column; their origin is that of the first."""
        if len(groups) == 1:
            return groups[0]
        every = copy.copy(groups[0])
        every.size = (sum(group.size[0] * group.size[1] for group in groups), 1)
        every.directions = mi.Vector3f(*[dr.concat([group.directions[k] for group in groups]) for k in range(3)])
        if any(group.active is not True for group in groups):
            every.active = dr.concat(
                [group.active & dr.full(mi.Bool, True, dr.width(group.directions)) for group in groups]
            )
        return every

    @staticmethod
    def of_grid(grid: ViewGrid) -> PixelRays:
        """Return the rays of a cloud's grid."""
        return PixelRays(grid.origin, grid.rays())

    @staticmethod
    @lru_cache(maxsize=8)  # up to 0.6 s for all pixels of a camera, and 38 MB
    def of_camera(camera: Camera) -> PixelRays:
        """Return the rays of a camera's pixel centres, with its distortion."""
        rays = camera.rays(camera.pixel_grid())  # not pixel_directions, which would be kept in host memory, too
        return PixelRays(camera.centre, camera.sensor_from_camera.directions(rays))


def cast(scene: Scene, rays: PixelRays, world_from_sensor: Transform, eyes: NDArray[np.floating]) -> Surfaces:
    """Return the surfaces that given rays meet.

    Parameters
    ----------
    scene, rays, world_from_sensor
        The scene, the rays, and the pose of the sensor.
    eyes
        (E, 3) [mm], sensor frame: optical centres of the other cameras and the projector.

    See Also
    --------
    mitsim.scene.ray_casting.raycast.cast_together : several groups of rays
    mitsim.scene.ray_casting.raycast.shapes_met : the shapes alone
    """
    return cast_together(scene, [rays], world_from_sensor, eyes)[0]


def cast_together(
    scene: Scene, groups: Sequence[PixelRays], world_from_sensor: Transform, eyes: NDArray[np.floating]
) -> list[Surfaces]:
    """Return the surfaces of :func:`cast` for several groups of rays from one point.

    They share one launch: recording it takes as long as casting 40 000 rays, if the part has a hundred faces.

    Parameters
    ----------
    scene, world_from_sensor, eyes
        As for :func:`cast`.
    groups
        The rays, all from the same origin.

    See Also
    --------
    mitsim.scene.ray_casting.raycast.cast : one group
    """
    rays = PixelRays.joined(groups)
    frame = rays.frame(world_from_sensor)
    surface = scene.mitsuba.ray_intersect(mi.Ray3f(frame.position, frame.to_world(rays.directions)), rays.active)
    facing = dr.select(dr.dot(surface.n, frame.to_world(rays.directions)) > 0, -1.0, 1.0)
    two_sided = (surface.bsdf().flags() & mi.UInt32(int(mi.BSDFFlags.BackSide))) != 0
    hit = surface.is_valid() & ((facing > 0) | two_sided)
    normal = frame.to_local(surface.n * facing)
    shape = numbers_met(surface, hit)
    distance = dr.select(hit, surface.t, dr.nan)
    seen = []
    for eye in world_from_sensor.points(np.asarray(eyes, float).reshape(-1, 3)):
        to_eye = opaque_point(eye) - surface.p
        length = dr.norm(to_eye)
        ray = shadow_ray(surface, to_eye / length, length)
        front = hit & (dr.dot(surface.n * facing, to_eye) > 0)
        seen.append(front & ~scene.mitsuba.ray_test(ray, front))
    along = frame.to_local(surface.dp_du) if scene.has_lay else None
    dr.eval(distance, normal, shape, seen, along)

    distances, normals = np.array(distance, np.float32), vectors_to_host(normal)
    shapes = shape_indices(scene.mitsuba, shape)
    masks = np.array([np.array(mask, bool) for mask in seen], bool).reshape(len(seen), len(distances))
    directions = None if along is None else vectors_to_host(along)
    out, first = [], 0
    for size in (group.size for group in groups):
        part = slice(first, first + size[0] * size[1])
        first = part.stop
        out.append(
            Surfaces(
                distance=distances[part].reshape(size),
                normal=normals[part].reshape(*size, 3),
                shape=shapes[part].reshape(size),
                seen=masks[:, part].reshape(len(masks), *size),
                along=None if directions is None else directions[part].reshape(*size, 3),
            )
        )
    return out


def shapes_met(scene: Scene, rays: PixelRays, world_from_sensor: Transform) -> NDArray[np.int16]:
    """Return the index (H, W) of the shape that rays meet, front or back; -1 for none.

    It takes a tenth of the time of :func:`cast`.
    """
    frame = rays.frame(world_from_sensor)
    ray = mi.Ray3f(frame.position, frame.to_world(rays.directions))
    met = scene.mitsuba.ray_intersect_preliminary(ray, active=rays.active)
    return shape_indices(scene.mitsuba, numbers_met(met, met.is_valid())).reshape(rays.size)
