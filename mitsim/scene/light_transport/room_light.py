"""Light of a room that comes from all sides, as a camera sees it on a part.

Signal chain: finish -> share of diffuse light that it returns toward each angle (directional albedo) -> shape and
angle that each pixel shows -> radiance per unit of irradiance.

The room is taken as equally bright all around. Shading of one face by another, and light that goes from face to face,
are left out: on bright metal they nearly cancel (in a furnace whose walls all have one radiance, a part that absorbs
nothing cannot be seen).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mitsim.scene.backend import dr, mi
from mitsim.scene.load import Scene
from mitsim.scene.ray_casting.raycast import PixelRays, cast
from mitsim.sensor.transforms import Transform

_ANGLES = 24
_SAMPLES = 8192


def room_radiance(
    scene: Scene, albedos: list[NDArray[np.float64]], rays: PixelRays, world_from_sensor: Transform
) -> NDArray[np.float32]:
    """Radiance (H, W) [1/sr] per unit of irradiance on a freely turned surface; 0 where the part is not seen.

    ``albedos`` of the scene's shapes, from :func:`directional_albedos`.
    """
    seen = cast(scene, rays, world_from_sensor, np.empty((0, 3)))
    out = np.zeros(seen.shape.shape, np.float32)
    cosines = _cosines()
    directions = np.array(rays.directions, np.float32).T.reshape(*rays.size, 3)
    for index, albedo in enumerate(albedos):
        here = seen.shape == index
        facing = np.abs((seen.normal[here] * directions[here]).sum(axis=-1))
        out[here] = np.interp(facing, cosines[::-1], albedo[::-1]) / np.pi
    return out


def directional_albedos(scene: Scene) -> list[NDArray[np.float64]]:
    """:func:`directional_albedo` of every shape; shapes of one BSDF share it."""
    known: dict[str, NDArray[np.float64]] = {}
    bsdfs = [shape.bsdf() for shape in scene.shapes]
    for bsdf in bsdfs:
        if bsdf.id() not in known:
            known[bsdf.id()] = directional_albedo(bsdf)
    return [known[bsdf.id()] for bsdf in bsdfs]


def directional_albedo(bsdf: Any) -> NDArray[np.float64]:
    """Share of light from all sides that a BSDF returns toward each of a few angles, (m,), steep ones last.

    By reciprocity it is the share of light from that angle that is returned to all sides: the mean weight of the
    BSDF's own samples, over the azimuth too, with a fixed seed.
    """
    cosines = _cosines()
    count = len(cosines) * _SAMPLES
    random = mi.PCG32(size=count, initstate=7)
    cosine = mi.Float(np.repeat(cosines, _SAMPLES).astype(np.float32))
    azimuth = 2 * dr.pi * random.next_float32()
    sine = dr.sqrt(1 - dr.square(cosine))
    surface = dr.zeros(mi.SurfaceInteraction3f, count)
    surface.wi = mi.Vector3f(sine * dr.cos(azimuth), sine * dr.sin(azimuth), cosine)
    pick, place = random.next_float32(), mi.Point2f(random.next_float32(), random.next_float32())
    _, weight = bsdf.sample(mi.BSDFContext(), surface, pick, place)
    return np.asarray(np.array(weight[0], float).reshape(len(cosines), _SAMPLES).mean(axis=1))


def _cosines() -> NDArray[np.float64]:
    return np.cos(np.linspace(0, np.radians(88), _ANGLES))
