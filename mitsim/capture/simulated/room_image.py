"""Compute the image of a part in the room light that a sensor file states (``[room]``), before the lens."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from characterisation.region_of_interest import Roi
from mitsim.scene.light_transport.room_light import SeenSurfaces, directional_albedos
from mitsim.scene.load import Scene
from mitsim.scene.ray_casting.raycast import PixelRays
from mitsim.sensor.sensor import Sensor
from mitsim.sensor.transforms import Transform


def room_image(
    sensor: Sensor, scene: Scene, world_from_sensor: Transform, camera: str, rays: PixelRays, roi: Roi
) -> NDArray[np.float32]:
    """Return the radiance (h, w) of a region of a camera's image in the room's light alone [W / (mm^2 sr)].

    Its gradient is along the axes of the sensor frame at the middle of the working range, the same for all cameras.
    """
    relative = SeenSurfaces.of(scene, rays, world_from_sensor, roi).room_radiance(directional_albedos(scene))
    eye, depth = sensor.rig.cameras[camera], float(np.mean(sensor.working_range_mm))
    pixels = np.stack(roi.pixels(), axis=-1).astype(float)
    directions = eye.sensor_from_camera.directions(eye.rays_to_fold(pixels))
    points = eye.centre + directions * ((depth - eye.centre[2]) / directions[..., 2:])
    return np.asarray(relative * sensor.room_irradiance(points), np.float32)
