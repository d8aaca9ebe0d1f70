"""Draw the speckle of a scene as one camera of a sensor sees it.

Signal chain: finish of each shape -> contrast C of its speckle in this camera -> C of each pixel -> one realisation for
the pose: a gain, and the angle between the point and the position at which the code is read.

The lateral shift on the surface is C lambda / (2 pi sin u_obs) (:mod:`mitsim.sensor.speckle`). sin u_obs is the radius
of the lens, of diameter D, over the distance. Seen from the camera the shift is therefore the angle C lambda / (pi D)
at any distance. Likewise, the ratio of the half-angles of both apertures is the ratio of their diameters. A scene of
one material therefore needs no rays.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from characterisation.region_of_interest import Roi
from mitsim.scene.load import Scene
from mitsim.scene.materials import Finish
from mitsim.scene.ray_casting.raycast import PixelRays, cast
from mitsim.sensor.camera import Camera
from mitsim.sensor.sensor import Sensor
from mitsim.sensor.speckle import (
    SpeckleField,
    SpeckleOptics,
    SpeckleSurface,
    contrast,
    correlation_size_px,
    lateral_shift_std,
    speckle_field,
)
from mitsim.sensor.transforms import Transform

#: spread of the path lengths inside white paint [um], used in place of a metal's Rq. Assumed
PAINT_DEPTH_UM = 30.0

#: rms height [um] of a surface without data (a stock BSDF). Assumed
UNKNOWN_HEIGHT_UM = 1.0


def finish_contrast(finish: Finish | None, sensor: Sensor, camera: Camera) -> float:
    """Return the speckle contrast C of a finish in a camera's pixels [1]; 0 if the linewidth is not given."""
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
    """Return the standard deviation of the lateral shift of the code at C = 1, seen from the camera [rad]."""
    return lateral_shift_std(1.0, sensor.wavelength_nm, 1.0) * 2.0 / sensor.pupil_mm(camera)


def _contrasts(
    scene: Scene, sensor: Sensor, camera: Camera, rays: PixelRays, world_from_sensor: Transform
) -> float | NDArray[np.float32]:
    """Return C of each pixel (H, W), or one number if the whole scene has the same."""
    values = [finish_contrast(finish, sensor, camera) for finish in scene.finishes]
    if len(set(values)) == 1:
        return values[0]
    surfaces = cast(scene, rays, world_from_sensor, np.empty((0, 3)))
    return np.array([*values, 0.0], np.float32)[surfaces.shape]  # index -1, for no surface, selects the last value


def draw_speckle(
    scene: Scene,
    sensor: Sensor,
    camera: Camera,
    rays: PixelRays,
    world_from_sensor: Transform,
    roi: Roi,
    rng: np.random.Generator,
) -> SpeckleField | None:
    """Draw the speckle of a region of one camera's image for one pose; None without speckle.

    The gain is (h, w) [1], the shift (2, h, w) [rad].

    Parameters
    ----------
    scene, sensor, camera
        Scene with the finishes, sensor with its wavelength and imager, and camera that sees the speckle.
    rays, world_from_sensor, roi, rng
        View rays of all its pixels, pose of the sensor, region of the image, and generator of the draws.
    """
    values = _contrasts(scene, sensor, camera, rays.within(roi), world_from_sensor)
    if not np.any(values):
        return None
    imager = sensor.imager
    size_px = correlation_size_px(imager.pixel_um, sensor.wavelength_nm, imager.f_number)
    field = speckle_field((roi.height, roi.width), values, size_px, rng)
    angle = np.asarray(values * shift_angle(sensor, camera), np.float32)
    return SpeckleField(field.gain, field.shift * angle)
