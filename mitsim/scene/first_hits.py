"""First surfaces that rays meet, whichever side they show, and the view of a sensor's reference camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mitsim.scene.backend import dr, mi
from mitsim.scene.load import Scene
from mitsim.scene.ray_casting.raycast import PixelRays, cast
from mitsim.sensor.camera import Rig
from mitsim.sensor.transforms import Transform

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Sight:
    """Surfaces that the reference camera's own pixels see, (H, W) each.

    ``shape`` index of the first shape met, -1 for none, backs included; ``front`` whether its reflecting side is seen;
    ``normal`` (H, W, 3) toward the camera and ``point`` (H, W, 3) [mm], both in the sensor frame; ``everyone`` whether
    every other eye has a free line to it.
    """

    shape: NDArray[np.int16]
    front: NDArray[np.bool_]
    normal: Floats
    point: Floats
    everyone: NDArray[np.bool_]


@dataclass(frozen=True)
class Hits:
    """First surfaces met by n rays.

    ``shape`` (n,), -1 for none; ``front`` (n,) whether its reflecting side is met; ``normal`` (n, 3) toward the ray's
    origin and ``distance`` (n,) [mm], NaN where nothing is met.
    """

    shape: NDArray[np.int16]
    front: NDArray[np.bool_]
    normal: Floats
    distance: Floats


def trace(scene: Scene, origins: NDArray[np.floating], directions: NDArray[np.floating]) -> Hits:
    """Follow n rays, (n, 3) each [mm, unit], world frame, to the first surface, whichever side it shows."""
    start, along = (np.asarray(a, np.float32).reshape(-1, 3).T for a in (origins, directions))
    ray = mi.Ray3f(mi.Point3f(start), mi.Vector3f(along))
    surface = scene.mitsuba.ray_intersect(ray)
    behind = dr.dot(surface.n, ray.d) > 0
    two_sided = (surface.bsdf().flags() & mi.UInt32(int(mi.BSDFFlags.BackSide))) != 0
    front = ~behind | two_sided
    normal = dr.select(behind, -surface.n, surface.n)
    number = dr.select(surface.is_valid(), dr.reinterpret_array(mi.UInt32, surface.shape), 0)
    distance = dr.select(surface.is_valid(), surface.t, dr.nan)
    dr.eval(front, normal, number, distance)
    numbers = np.array(number)
    lookup = np.full(int(numbers.max(initial=0)) + 1, -1, np.int16)
    for index, one in enumerate(scene.shapes):
        own = int(np.ravel(np.array(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(one))))[0])
        if own < len(lookup):
            lookup[own] = index
    lookup[0] = -1
    shape = lookup[numbers]
    vectors = np.where((shape >= 0)[:, None], np.array(normal, float).T, np.nan)
    return Hits(shape, np.array(front, bool) & (shape >= 0), vectors, np.array(distance, float))


def look(scene: Scene, rig: Rig, world_from_sensor: Transform) -> Sight:
    """Return the surfaces that the pixels of a rig's reference camera see from one pose."""
    camera = rig.reference
    eyes = [*list(rig.cameras.values())[1:], *([rig.projector] if rig.projector else [])]
    directions = camera.sensor_from_camera.directions(camera.rays(camera.pixel_grid()))
    size = directions.shape[:2]
    origin = world_from_sensor.points(camera.centre)
    world = world_from_sensor.directions(directions.reshape(-1, 3))
    hits = trace(scene, np.broadcast_to(origin, world.shape), world)
    rays = PixelRays(camera.centre, directions)  # PixelRays.of_camera, without undistorting all pixels once more
    seen = cast(scene, rays, world_from_sensor, np.array([eye.centre for eye in eyes])).seen
    normal = world_from_sensor.inverse().directions(hits.normal).reshape(*size, 3)
    point = camera.centre + directions * hits.distance.reshape(*size, 1)
    everyone = np.asarray(hits.front.reshape(size) & seen.all(axis=0))
    return Sight(hits.shape.reshape(size), hits.front.reshape(size), normal, point, everyone)
