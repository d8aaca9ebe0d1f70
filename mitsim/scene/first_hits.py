"""Find the first surfaces that rays meet, on either side, and those that a sensor's reference camera sees.

Signal chain: rays -> nearest surface, its shape and side -> shadow rays to the other cameras and the projector ->
surfaces that all of them see.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mitsim.scene.backend import dr, mi
from mitsim.scene.device import known_to_device, vectors_to_device, vectors_to_host
from mitsim.scene.load import Scene
from mitsim.scene.ray_casting.raycast import PixelRays, cast, shape_indices, shapes_met
from mitsim.sensor.camera import Rig
from mitsim.sensor.rig_parameters import eyes
from mitsim.sensor.transforms import Transform

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class VisibleSurfaces:
    """Surfaces that the pixels of the reference camera see.

    - ``shape`` (H, W): index of the first shape on the ray, whichever side it shows; -1 for none.
    - ``front`` (H, W): whether the reflecting side of the shape is seen.
    - ``normal`` (H, W, 3) toward the camera and ``point`` (H, W, 3) [mm], sensor frame; NaN without a shape.
    - ``seen_by_all`` (H, W): whether the front is seen and every other camera and the projector has a free line to it.
    """

    shape: NDArray[np.int16]
    front: NDArray[np.bool_]
    normal: Floats
    point: Floats
    seen_by_all: NDArray[np.bool_]


@dataclass(frozen=True)
class Hits:
    """First surfaces on n rays.

    - ``shape`` (n,): index of the shape, of the instance for a shape in a group; -1 for none.
    - ``front`` (n,): whether the ray meets the reflecting side.
    - ``normal`` (n, 3) on the side of the ray's origin, world frame, and ``distance`` (n,) [mm]; NaN without a surface.
    """

    shape: NDArray[np.int16]
    front: NDArray[np.bool_]
    normal: Floats
    distance: Floats


def trace(scene: Scene, origins: NDArray[np.floating], directions: NDArray[np.floating]) -> Hits:
    """Trace n rays to the first surface, whichever side it shows.

    ``origins`` (n, 3) [mm] and unit ``directions`` (n, 3), world frame. A direction of NaN meets nothing.
    """
    start = vectors_to_device(np.asarray(origins).reshape(-1, 3))
    along, active = known_to_device(np.asarray(directions).reshape(-1, 3))
    ray = mi.Ray3f(mi.Point3f(start), along)
    surface = scene.mitsuba.ray_intersect(ray, active)
    behind = dr.dot(surface.n, ray.d) > 0
    two_sided = (surface.bsdf().flags() & mi.UInt32(int(mi.BSDFFlags.BackSide))) != 0
    front = ~behind | two_sided
    normal = dr.select(behind, -surface.n, surface.n)
    inside, instance = (dr.reinterpret_array(mi.UInt32, one) for one in (surface.shape, surface.instance))
    shape_id_of_ray = dr.select(surface.is_valid(), dr.select(instance != 0, instance, inside), 0)
    distance = dr.select(surface.is_valid(), surface.t, dr.nan)
    dr.eval(front, normal, shape_id_of_ray, distance)
    shape = shape_indices(scene, shape_id_of_ray)
    vectors = np.where((shape >= 0)[:, None], vectors_to_host(normal, float), np.nan)
    return Hits(shape, np.array(front, bool) & (shape >= 0), vectors, np.array(distance, float))


def sees_nothing(scene: Scene, rig: Rig, world_from_sensor: Transform) -> list[str]:
    """Return the names of the cameras, and ``projector``, in whose images no pixel shows the scene."""
    seen = {name: shapes_met(scene, PixelRays.of_camera(eye), world_from_sensor) for name, eye in eyes(rig).items()}
    return [name for name, shape in seen.items() if not (shape >= 0).any()]


def visible_surfaces(scene: Scene, rig: Rig, world_from_sensor: Transform) -> VisibleSurfaces:
    """Return the surfaces that the pixels of a rig's reference camera see from one pose."""
    camera = rig.reference
    directions = camera.pixel_directions()
    shape = directions.shape[:2]
    origin = world_from_sensor.points(camera.centre)
    world = world_from_sensor.directions(directions.reshape(-1, 3))
    hits = trace(scene, np.broadcast_to(origin, world.shape), world)
    rays = PixelRays(camera.centre, directions)  # PixelRays.of_camera would undistort all pixels again
    seen = cast(scene, rays, world_from_sensor, np.array([eye.centre for eye in list(eyes(rig).values())[1:]])).seen
    normal = world_from_sensor.inverse().directions(hits.normal).reshape(*shape, 3)
    point = camera.centre + directions * hits.distance.reshape(*shape, 1)
    seen_by_all = np.asarray(hits.front.reshape(shape) & seen.all(axis=0))
    return VisibleSurfaces(hits.shape.reshape(shape), hits.front.reshape(shape), normal, point, seen_by_all)
