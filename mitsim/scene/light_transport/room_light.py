"""Compute the light of a room, which comes from all sides, as a camera sees it on a part.

Signal chain: BSDF -> share of diffuse light that it returns toward each angle (directional albedo) -> shape and angle
at each pixel -> radiance per unit of irradiance.

The room is *assumed* to be equally bright on all sides. Shading of one face by another and interreflections are left
out. On bright metal they nearly cancel: inside a furnace whose walls have one radiance, a part that absorbs nothing
cannot be seen.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mitsim.scene.backend import dr, mi
from mitsim.scene.device import to_device, vectors_to_host
from mitsim.scene.load import Scene
from mitsim.scene.ray_casting.raycast import PixelRays, cast
from mitsim.sensor.transforms import Transform

_ANGLES = 24
_SAMPLES = 8192


def room_radiance(
    scene: Scene, albedos: list[NDArray[np.float64]], rays: PixelRays, world_from_sensor: Transform
) -> NDArray[np.float32]:
    """Return the radiance (H, W) [1/sr] per unit of irradiance on a surface with a free view; 0 outside the part.

    Parameters
    ----------
    scene, rays, world_from_sensor
        The scene, the rays of the pixels, and the pose of the sensor.
    albedos
        Of the scene's shapes, from :func:`directional_albedos`.
    """
    surfaces = cast(scene, rays, world_from_sensor, np.empty((0, 3)))
    out = np.zeros(surfaces.shape.shape, np.float32)
    cosines = _cosines()
    directions = vectors_to_host(rays.directions).reshape(*rays.size, 3)
    for index, albedo in enumerate(albedos):
        pixels = surfaces.shape == index
        cosine = np.abs((surfaces.normal[pixels] * directions[pixels]).sum(axis=-1))
        out[pixels] = np.interp(cosine, cosines[::-1], albedo[::-1]) / np.pi
    return out


def directional_albedos(scene: Scene) -> list[NDArray[np.float64]]:
    """Return the :func:`directional_albedo` of each shape; shapes with one BSDF share it."""
    known: dict[str, NDArray[np.float64]] = {}
    bsdfs = [shape.bsdf() for shape in scene.shapes]
    for bsdf in bsdfs:
        if bsdf.id() not in known:
            known[bsdf.id()] = directional_albedo(bsdf)
    return [known[bsdf.id()] for bsdf in bsdfs]


def directional_albedo(bsdf: Any) -> NDArray[np.float64]:
    """Return the share of light from all sides that a BSDF returns toward some angles, (m,), grazing angles last.

    By reciprocity it equals the share of light from that angle that is returned to all sides. It is the mean weight of
    samples of the BSDF, over the azimuth too, with a fixed seed.
    """
    cosines = _cosines()
    count = len(cosines) * _SAMPLES
    random = mi.PCG32(size=count, initstate=7)
    cosine = to_device(np.repeat(cosines, _SAMPLES))
    azimuth = 2 * dr.pi * random.next_float32()
    sine = dr.sqrt(1 - dr.square(cosine))
    surface = dr.zeros(mi.SurfaceInteraction3f, count)
    surface.wi = mi.Vector3f(sine * dr.cos(azimuth), sine * dr.sin(azimuth), cosine)
    sample1, sample2 = random.next_float32(), mi.Point2f(random.next_float32(), random.next_float32())
    _, weight = bsdf.sample(mi.BSDFContext(), surface, sample1, sample2)
    return np.asarray(np.array(weight[0], float).reshape(len(cosines), _SAMPLES).mean(axis=1))


def _cosines() -> NDArray[np.float64]:
    """Return the cosines of the angles to the normal, from 0 to 88 deg."""
    return np.cos(np.linspace(0, np.radians(88), _ANGLES))
