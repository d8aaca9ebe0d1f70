"""Find the surfaces that the pixels of a sensor's reference camera see, and those that every eye of the sensor sees.

Signal chain: a ray for every pixel -> nearest surface, its shape and side -> shadow rays to the other cameras and the
projector -> surfaces that all of them see.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from characterisation.files.arrays import Floats
from mitsim.scene.first_hits import first_hits
from mitsim.scene.load import Scene
from mitsim.scene.ray_casting.raycast import PixelRays, cast, shapes_met
from mitsim.sensor.camera import Rig
from mitsim.sensor.rig_parameters import eyes
from mitsim.sensor.transforms import Transform


@dataclass(frozen=True)
class VisibleSurfaces:
    """Surfaces that the pixels of the reference camera see."""

    shape: NDArray[np.int16]  # (H, W) index of the first shape on the ray, whichever side it shows; -1 for none
    front: NDArray[np.bool_]  # (H, W) whether the reflecting side of the shape is seen
    #: ``normal`` (H, W, 3) toward the camera and ``point`` (H, W, 3) [mm], sensor frame; NaN without a shape
    normal: Floats
    point: Floats
    #: (H, W) whether the front is seen and every other camera and the projector has a free line to it
    seen_by_all: NDArray[np.bool_]


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
    hits = first_hits(scene.mitsuba, np.broadcast_to(origin, world.shape), world)
    rays = PixelRays(camera.centre, directions)  # PixelRays.of_camera would undistort all pixels again
    seen = cast(scene, rays, world_from_sensor, np.array([eye.centre for eye in list(eyes(rig).values())[1:]])).seen
    normal = world_from_sensor.inverse().directions(hits.normal).reshape(*shape, 3)
    point = camera.centre + directions * hits.distance.reshape(*shape, 1)
    seen_by_all = np.asarray(hits.front.reshape(shape) & seen.all(axis=0))
    return VisibleSurfaces(hits.shape.reshape(shape), hits.front.reshape(shape), normal, point, seen_by_all)
