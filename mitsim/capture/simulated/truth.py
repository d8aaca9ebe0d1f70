"""Compute the ground truth of each pixel of a simulated camera: geometry, visibility and share of indirect light.

Signal chain: scene and pose -> one ray through the centre of each pixel, with distortion -> surface, its normal, shape
and position in the projector's image; shadow ray to the projector. Rendering of a white frame -> share of indirect
light, 1 - direct light / all light, up to a chosen depth.

An average of labels or depths over a pixel is no truth, so the geometry is never filtered.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.capture.truth import Truth
from mitsim.scene.light_transport.light_paths import LightPaths
from mitsim.scene.light_transport.projected_codes import ProjectedPatterns
from mitsim.scene.light_transport.transport import trace
from mitsim.scene.load import Scene
from mitsim.scene.ray_casting.raycast import PixelRays, cast
from mitsim.sensor.transforms import Transform


def true_images(
    simulated: SimulatedSensor, scene: Scene, world_from_sensor: Transform, *, samples: int, depth: int, seed: int
) -> dict[str, Truth]:
    """Return the ground truth of every camera by name.

    The share of indirect light follows paths of at least three surfaces, also where a capture has direct light alone.

    Parameters
    ----------
    simulated, scene, world_from_sensor
        Sensor, scene that it sees, and pose of the sensor.
    samples, depth, seed
        Light paths per pixel, surfaces on a light path, and seed, for the share of indirect light.
    """
    paths = LightPaths(samples=samples, seed=seed, depth=max(depth, 3), with_ambient=True)
    cameras = simulated.sensor.rig.cameras
    return {name: _true_image(simulated, scene, world_from_sensor, name, paths) for name in cameras}


def _true_image(
    simulated: SimulatedSensor, scene: Scene, world_from_sensor: Transform, camera: str, paths: LightPaths
) -> Truth:
    """Return the ground truth of one camera; ``paths`` are for the share of indirect light."""
    # the camera as it is, not as its calibration says: these are the rays that the image shows
    eye, projector = simulated.sensor.true_rig.cameras[camera], simulated.sensor.projector
    directions = eye.pixel_directions()
    surfaces = cast(scene, PixelRays(eye.centre, directions), world_from_sensor, projector.optics.centre[None])
    points = eye.centre + directions * surfaces.distance[..., None].astype(float)
    projected = np.full((*surfaces.distance.shape, 2), np.nan)
    valid = np.isfinite(surfaces.distance)
    projected[valid] = projector.optics.project(points[valid])
    edge = np.array([projector.optics.width, projector.optics.height]) - 0.5
    with np.errstate(invalid="ignore"):
        inside = np.all((projected > -0.5) & (projected < edge), axis=-1)
    axis = eye.sensor_from_camera.rotation[:, 2]

    size = (1, projector.optics.height, projector.optics.width)
    white = ProjectedPatterns(np.ones(size, np.float32), projector)

    def light(surfaces_on_path: int) -> NDArray[np.float32]:
        of_depth = replace(paths, depth=surfaces_on_path)
        lit, ambient = trace(scene, simulated.rays[camera], white, world_from_sensor, of_depth)
        return np.asarray(lit - ambient)

    direct, total = light(1), light(paths.depth)
    with np.errstate(invalid="ignore", divide="ignore"):
        indirect = np.where(total > 0, 1.0 - direct / total, np.nan)
    return Truth(
        distance=surfaces.distance,
        depth=(surfaces.distance * (directions @ axis)).astype(np.float32),
        normal=surfaces.normal,
        feature=surfaces.shape,
        feature_names=scene.names,
        projector=projected.astype(np.float32),
        lit=surfaces.seen[0] & inside,
        indirect=np.clip(indirect, 0.0, 1.0).astype(np.float32),
    )
