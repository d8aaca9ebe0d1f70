"""Compute the light of a room, which comes from all sides, as a camera sees it on a part.

Signal chain: BSDF -> share of diffuse light that it returns toward each angle (directional albedo) -> shape and angle
at each pixel -> radiance per unit of irradiance.

The room is *assumed* to be equally bright on all sides. Shading of one face by another and interreflections are left
out. On bright metal they nearly cancel: inside a furnace whose walls have one radiance, a part that absorbs nothing
cannot be seen.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

from characterisation.region_of_interest import Roi
from mitsim.scene.backend import dr, mi
from mitsim.scene.device import to_device, vectors_to_host
from mitsim.scene.load import Scene
from mitsim.scene.ray_casting.raycast import PixelRays, cast
from mitsim.sensor.transforms import Transform

_ANGLES = 24
_SAMPLES = 1024


@dataclass(frozen=True)
class SeenSurfaces:
    """The shape (h, w) of each pixel of a region, -1 for none, and the cosine (h, w) between its ray and its normal."""

    shape: NDArray[np.integer]
    cosine: NDArray[np.floating]

    @classmethod
    def of(cls, scene: Scene, rays: PixelRays, world_from_sensor: Transform, roi: Roi | None = None) -> SeenSurfaces:
        """Return the surfaces that rays meet.

        Parameters
        ----------
        scene, rays, world_from_sensor
            The scene, the rays of the pixels, and the pose of the sensor.
        roi
            Region of the image, by default all of it.
        """
        surfaces = cast(scene, rays, world_from_sensor, np.empty((0, 3)))
        directions = vectors_to_host(rays.directions).reshape(*rays.size, 3)
        region = slice(None) if roi is None else roi.slices
        cosine = np.abs((surfaces.normal[region] * directions[region]).sum(axis=-1))
        return cls(surfaces.shape[region], cosine)

    def room_radiance(self, albedos: list[NDArray[np.float64]]) -> NDArray[np.float32]:
        """Return the radiance (h, w) [1/sr] per unit of irradiance on a surface with a free view.

        It is 0 outside the part. ``albedos`` of the scene's shapes come from :func:`directional_albedos`.
        """
        out = np.zeros(self.shape.shape, np.float32)
        cosines = _cosines()
        for index, albedo in enumerate(albedos):
            pixels = self.shape == index
            out[pixels] = np.interp(self.cosine[pixels], cosines[::-1], albedo[::-1]) / np.pi
        return out


def directional_albedos(scene: Scene) -> list[NDArray[np.float64]]:
    """Return the :func:`directional_albedo` of each shape; shapes with one BSDF share it."""
    bsdfs = [shape.bsdf() for shape in scene.shapes]
    albedos = {bsdf: directional_albedo(bsdf) for bsdf in dict.fromkeys(bsdfs)}
    return [albedos[bsdf] for bsdf in bsdfs]


def directional_albedo(bsdf: Any) -> NDArray[np.float64]:
    """Return the share of light from all sides that a BSDF returns toward some angles, (m,), grazing angles last.

    By reciprocity it equals the share of light from that angle that is returned to all sides. It is the mean weight of
    samples of the BSDF at low-discrepancy points, over the azimuth too, with a fixed seed.
    """
    cosines = _cosines()
    count = len(cosines) * _SAMPLES
    azimuth, sample1, *sample2 = (to_device(np.tile(column, len(cosines))) for column in _points().T)
    cosine = to_device(np.repeat(cosines, _SAMPLES))
    sine = dr.sqrt(1 - dr.square(cosine))
    surface = dr.zeros(mi.SurfaceInteraction3f, count)
    azimuth *= 2 * dr.pi
    surface.wi = mi.Vector3f(sine * dr.cos(azimuth), sine * dr.sin(azimuth), cosine)
    _, weight = bsdf.sample(mi.BSDFContext(), surface, sample1, mi.Point2f(*sample2))
    return np.asarray(np.array(weight[0], float).reshape(len(cosines), _SAMPLES).mean(axis=1))


@cache
def _points() -> NDArray[np.float64]:
    """Return points (n, 4) that fill the unit cube evenly, below 1 in single precision."""
    return np.asarray(np.minimum(qmc.Sobol(4, seed=7).random(_SAMPLES), 1 - 2.0**-24))


def _cosines() -> NDArray[np.float64]:
    """Return the cosines of the angles to the normal, from 0 to 88 deg."""
    return np.cos(np.linspace(0, np.radians(88), _ANGLES))
