"""What moves a map's answers in one view: light by way of other surfaces, and that a point is an average.

Signal chain: ideal points of a view, and by how far an average over a footprint displaces them -> rho, the light by way
of other surfaces over direct light -> where a matcher finds mirror images, or a code what is mirrored -> F, sigma,
what lasts, and displacement, as a disturbance of the map's answers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mitsim.predict.interreflection import Interreflections, kept_share, lasting_factor, noise_factor
from mitsim.predict.mirror_image import Images, displacement, glint_share, mirror_images
from mitsim.predict.mirrored_code import found_elsewhere, mirrored_depth
from mitsim.predict.predictor import Ideal, Predictor
from mitsim.scene.load import Scene
from mitsim.scene.raycast import Surfaces
from mitsim.sensor.frames import Transform

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Disturbance:
    """What moves the map's answer at ideal points, arrays (n,) [1].

    F is multiplied by ``kept`` and sigma by ``noisier``; ``lasting`` times sigma adds to the persistent noise.
    ``displaced`` [mm] is by how much points lie too far along their rays in the mean. ``blinded`` is the share of
    points that the map says to be lost and that come back elsewhere: F becomes (1 - blinded) F kept + blinded.
    """

    kept: Floats
    noisier: Floats
    lasting: Floats
    displaced: Floats
    blinded: Floats

    @staticmethod
    def of_displaced(displaced: Floats) -> Disturbance:
        """Points that are displaced, and nothing else."""
        as_it_is, none = np.ones(len(displaced)), np.zeros(len(displaced))
        return Disturbance(as_it_is, as_it_is, none, displaced, none)


@dataclass(frozen=True)
class Indirect:
    """Light by way of other surfaces at the n ideal points of a view.

    ``rho`` (n,) over direct light; ``images`` the mirror images that a matcher sees; ``mirrored`` (n,) [mm] how far
    behind its surface a point lies that has the code of what it mirrors. The last two are None for other sensors.
    """

    rho: Floats
    images: Images | None
    mirrored: Floats | None


def indirect_light(
    interreflections: Interreflections, predictor: Predictor, scene: Scene, world_from_sensor: Transform,
    whole: Surfaces, ideal: Ideal,
) -> Indirect:  # fmt: skip
    """Light by way of other surfaces in a view, of which ``whole`` and ``ideal`` are what ``predictor`` sees."""
    rho, images, mirrored = interreflections.ratio(scene, world_from_sensor, ideal.point), None, None
    if interreflections.matched:
        images = mirror_images(predictor, scene, world_from_sensor, ideal)
    elif predictor.footprint is not None:
        mirrored = mirrored_depth(predictor, predictor.footprint.second, scene, world_from_sensor, whole, ideal)
    return Indirect(rho, images, mirrored)


def disturbed(
    indirect: Indirect, displaced: Floats, scene: Scene, ideal: Ideal, size: tuple[int, ...], pitch: float, step: int
) -> Disturbance:
    """What light by way of other surfaces does to points that an average displaces already, (n,) [mm].

    What a matcher does not find on a face that mirrors another, it finds at the mirror image. ``size`` of the grid, of
    which ``step`` pixels of the sensor, ``pitch`` [rad] apart, make one.
    """
    rho = indirect.rho
    glint, elsewhere = np.zeros((2, len(rho)))
    kept = kept_share(rho)
    if indirect.images is not None:
        pixel_mm, alpha = ideal.distance * pitch, _alpha(scene, ideal)
        glint = glint_share(indirect.images, rho, ideal, size, pixel_mm, step)
        elsewhere = displacement(indirect.images, rho, alpha, pixel_mm, glint)
        mirrors = np.isfinite(indirect.images.surface) & np.isfinite(alpha) & np.isfinite(rho)
        kept = np.where(mirrors, 1.0, kept)
    if indirect.mirrored is not None:
        kept, elsewhere = found_elsewhere(indirect.mirrored, kept)
    lasting = lasting_factor(rho, matched=indirect.images is not None)
    return Disturbance(kept, noise_factor(rho), lasting, elsewhere + displaced, glint)


def _alpha(scene: Scene, ideal: Ideal) -> Floats:
    """Width of the lobe of each ideal point's face, NaN where it has none."""
    scatters = [None if one is None else one.scatter for one in scene.finishes]
    own = [math.nan if one is None else math.sqrt(one.alpha_u * one.alpha_v) for one in scatters]
    return np.array([*own, math.nan])[ideal.shape]
