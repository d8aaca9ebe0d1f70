"""What moves a map's answers in one view: light by way of other surfaces, and that a point is an average.

Signal chain: ideal points of a view, and by how far an average over a footprint displaces them -> rho, the light by way
of other surfaces over direct light -> where a matcher finds the glint, or a code what is mirrored, and by how much that
pulls a phase -> F, sigma, what lasts, and displacement, as a disturbance of the map's answers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from characterisation.point_cloud import FALSE_SHARE_OF_DISTANCE
from mitsim.predict.fringe_pull import pulled
from mitsim.predict.glint import CARRIED_SPREAD, glint, lamp_depth
from mitsim.predict.interreflection import PULL_LEFT, Interreflections, kept_share, lasting_factor, noise_factor
from mitsim.predict.mirrored_code import Mirrored, mirrored_code, read_off
from mitsim.predict.predictor import Ideal, Predictor
from mitsim.scene.load import Scene
from mitsim.scene.raycast import Surfaces
from mitsim.sensor.frames import Transform

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Disturbance:
    """What moves the map's answer at ideal points, arrays (n,) [1].

    F is multiplied by ``kept`` and sigma by ``noisier``; ``lasting`` times sigma and ``uneven`` [mm] add to the
    persistent noise. ``displaced`` [mm] is by how much points lie too far along their rays in the mean. ``blinded`` is
    the share of points that the map says to be lost and that come back elsewhere: F becomes
    (1 - blinded) F kept + blinded. ``scattered`` [mm] adds to their sigma.
    """

    kept: Floats
    noisier: Floats
    lasting: Floats
    uneven: Floats
    displaced: Floats
    blinded: Floats
    scattered: Floats

    @staticmethod
    def of_displaced(displaced: Floats) -> Disturbance:
        """Points that are displaced, and nothing else."""
        as_it_is, none = np.ones(len(displaced)), np.zeros(len(displaced))
        return Disturbance(as_it_is, as_it_is, none, none, displaced, none, none)


@dataclass(frozen=True)
class Indirect:
    """Light by way of other surfaces at the n ideal points of a view.

    ``rho`` (n,) over direct light; ``full`` (n,) where the imager is, in its shortest exposure; ``lamp`` (n,) [mm] how
    far behind its surface a matcher finds the glint; ``mirrored`` where a point lies that has the code of what is
    mirrored there. Both are None for other sensors. ``pull`` (n,) [mm] how far behind it a point lies
    whose phase is pulled, and ``uneven`` (n,) [mm] how far it scatters about that; 0 for sensors that read none.
    """

    rho: Floats
    full: NDArray[np.bool_]
    lamp: Floats | None
    mirrored: Mirrored | None
    pull: Floats
    uneven: Floats


def indirect_light(
    interreflections: Interreflections, predictor: Predictor, scene: Scene, world_from_sensor: Transform,
    whole: Surfaces, ideal: Ideal,
) -> Indirect:  # fmt: skip
    """Light by way of other surfaces in a view, of which ``whole`` and ``ideal`` are what ``predictor`` sees."""
    light = interreflections.at(scene, world_from_sensor, ideal.point)
    lamp, mirrored, (pull, uneven) = None, None, np.zeros((2, len(ideal.point)))
    if interreflections.matched:
        lamp = lamp_depth(predictor, scene, world_from_sensor, ideal)
    elif predictor.footprint is not None:
        second = predictor.footprint.second
        mirrored = mirrored_code(predictor, second, scene, world_from_sensor, whole, ideal)
        if interreflections.fringe is not None:
            pull = pulled(light.phase, interreflections.fringe, second, ideal)
            uneven = np.abs(pulled(light.uneven, interreflections.fringe, second, ideal))
    return Indirect(light.rho, light.full, lamp, mirrored, pull, uneven)


def disturbed(
    indirect: Indirect, displaced: Floats, fraction: Floats, scene: Scene, ideal: Ideal, size: tuple[int, ...],
    pitch: float, step: int,
) -> Disturbance:  # fmt: skip
    """What light by way of other surfaces does to points that an average displaces already, (n,) [mm].

    ``fraction`` F (n,) that the map says; ``size`` of the grid, of which ``step`` pixels of the sensor, ``pitch`` [rad]
    apart, make one.
    """
    rho, matched = indirect.rho, indirect.lamp is not None
    kept = kept_share(rho, matched)
    blinded, uneven, elsewhere, scattered = np.zeros((4, len(rho)))
    if indirect.lamp is not None:
        taken, carried = glint(
            indirect.lamp, indirect.full, _alpha(scene, ideal), ideal, size, ideal.distance * pitch, step
        )
        # one row for each point: at the glint where most of its like are, unless that is no point of the face
        most = (taken > 0.5) & (indirect.lamp < FALSE_SHARE_OF_DISTANCE * ideal.distance)
        blinded, kept = np.where(most, taken, 0.0), np.where(most, 0.0, kept * (1 - taken))
        elsewhere, uneven = np.where(most, indirect.lamp, carried), np.where(most, 0.0, CARRIED_SPREAD * carried)
    if indirect.mirrored is not None:
        read = read_off(indirect.mirrored, indirect.pull, kept, fraction)
        kept, blinded, elsewhere = read.kept, read.blinded, read.displaced
        scattered = np.hypot(read.scattered, indirect.uneven)
        uneven = PULL_LEFT * np.abs(np.where(blinded > 0, 0.0, indirect.pull))
    return Disturbance(
        kept, noise_factor(rho, matched), lasting_factor(rho, matched), uneven, elsewhere + displaced, blinded,
        scattered,
    )  # fmt: skip


def _alpha(scene: Scene, ideal: Ideal) -> Floats:
    """Width of the lobe of each ideal point's face, NaN where it has none."""
    scatters = [None if one is None else one.scatter for one in scene.finishes]
    own = [math.nan if one is None else math.sqrt(one.alpha_u * one.alpha_v) for one in scatters]
    return np.array([*own, math.nan])[ideal.shape]
