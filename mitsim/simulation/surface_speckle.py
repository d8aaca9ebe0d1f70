"""Speckle of a scene as one camera of a sensor sees it.

Signal chain: what each shape is made of -> contrast C of its speckle at this camera -> C of every pixel -> one
realisation for the pose: a gain, and an angle by which the code is read beside the point.

The lateral shift on the surface is C lambda / (2 pi sin u_obs), and sin u_obs is the radius of the lens over the
distance: seen from the camera it is the angle C lambda / (pi D), whatever the distance. Likewise the ratio of the two
apertures' half-angles is that of their diameters. So a scene of one material needs no ray to draw its speckle.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mitsim.scene.load import Scene
from mitsim.scene.materials import Finish
from mitsim.scene.ray_casting.raycast import PixelRays, cast
from mitsim.sensor.camera import Camera
from mitsim.sensor.preset import Sensor
from mitsim.sensor.roi import Roi
from mitsim.sensor.speckle import (
    SpeckleField,
    SpeckleOptics,
    SpeckleSurface,
    contrast,
    lateral_shift_std,
    speckle_field,
    speckle_size_um,
)
from mitsim.sensor.transforms import Transform

#: spread of the path lengths inside white paint [um], in the place of a metal's Rq. Assumed
PAINT_DEPTH_UM = 30.0

#: rms height [um] of a surface that we know nothing of. Assumed
UNKNOWN_HEIGHT_UM = 1.0


def finish_contrast(finish: Finish | None, sensor: Sensor, camera: Camera) -> float:
    """Speckle contrast C of a finish in one camera's pixels [1]; 0 where the light's linewidth is not known."""
    if sensor.linewidth_nm is None:
        return 0.0
    scatter = finish.scatter if finish is not None else None
    height, coherent, depolarising = UNKNOWN_HEIGHT_UM, 0.0, False
    if scatter is not None:
        depolarising = scatter.depolarising
        coherent = scatter.coherent * (1.0 - scatter.wide_angle)
        height = PAINT_DEPTH_UM if math.isnan(scatter.height_um) else scatter.height_um
    optics = SpeckleOptics(
        sensor.wavelength_nm,
        sensor.linewidth_nm,
        u_illumination=sensor.projector.aperture_mm,
        u_observation=sensor.pupil_mm(camera),
        pixel_um=sensor.imager.pixel_um,
        f_number=sensor.imager.f_number,
    )
    return contrast(SpeckleSurface(height, coherent, depolarising), optics)


def shift_angle(sensor: Sensor, camera: Camera) -> float:
    """Standard deviation of the code's lateral shift at full contrast, as an angle seen from the camera [rad]."""
    return lateral_shift_std(1.0, sensor.wavelength_nm, 1.0) * 2.0 / sensor.pupil_mm(camera)


def contrast_map(
    scene: Scene, sensor: Sensor, camera: Camera, rays: PixelRays, world_from_sensor: Transform
) -> float | NDArray[np.float32]:
    """C of every pixel (H, W), or one number where the whole scene has the same."""
    values = [finish_contrast(finish, sensor, camera) for finish in scene.finishes]
    if len(set(values)) == 1:
        return values[0]
    surfaces = cast(scene, rays, world_from_sensor, np.empty((0, 3)))
    return np.array([*values, 0.0], np.float32)[surfaces.shape]  # -1, nothing there, takes the last


def draw_speckle(
    scene: Scene,
    sensor: Sensor,
    camera: Camera,
    rays: PixelRays,
    world_from_sensor: Transform,
    roi: Roi,
    rng: np.random.Generator,
) -> SpeckleField | None:
    """Draw gain (h, w) and shift (2, h, w) [rad] of a region of one camera, for one pose; None without speckle."""
    values = contrast_map(scene, sensor, camera, rays, world_from_sensor)
    if not np.any(values):
        return None
    if isinstance(values, np.ndarray):
        values = values[roi.slices]
    size_px = speckle_size_um(sensor.wavelength_nm, sensor.imager.f_number) / sensor.imager.pixel_um
    field = speckle_field((roi.height, roi.width), values, size_px, rng)
    angle = np.asarray(values * shift_angle(sensor, camera), np.float32)
    return SpeckleField(field.gain, field.shift * angle)
