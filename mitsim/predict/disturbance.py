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
from mitsim.predict.glint import CARRIED_SPREAD, LampImage, drawn_to_image, glint, lamp_image, stands_near
from mitsim.predict.interreflection import (
    LOST_BLURRED,
    LOST_FLAT,
    LOST_NEAR,
    LOST_OF_CODES,
    PULL_LEFT,
    Interreflections,
    OtherLightImage,
    kept_share,
    lasting_factor,
    noise_factor,
)
from mitsim.predict.mirrored_code import Mirrored, mirrored_code, read_off
from mitsim.predict.path_pull import too_far
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

    ``rho`` (n,) over direct light, of both eyes of a matcher; ``direct`` (n,) over what fills the imager in its
    shortest exposure; ``lamp`` is where a matcher finds the glint; ``mirrored`` where a point lies that has the code of
    what is mirrored there. Both are None for other sensors. ``pull`` (n,) [mm] how far behind it a point lies
    whose phase is pulled, and ``uneven`` (n,) [mm] how far it scatters about that; 0 for sensors that read none.
    """

    rho: Floats
    direct: Floats
    lamp: LampImage | None
    mirrored: Mirrored | None
    pull: Floats
    uneven: Floats
    modulated: bool = False


def indirect_light(
    interreflections: Interreflections, predictor: Predictor, scene: Scene, world_from_sensor: Transform,
    whole: Surfaces, ideal: Ideal,
) -> Indirect:  # fmt: skip
    """Light by way of other surfaces in a view, of which ``whole`` and ``ideal`` are what ``predictor`` sees."""
    image = interreflections.look(scene, world_from_sensor)
    light = image.at(ideal.point)
    rho, lamp, mirrored, (pull, uneven) = light.rho, None, None, np.zeros((2, len(ideal.point)))
    if interreflections.matched:
        lamp = lamp_image(predictor, scene, world_from_sensor, ideal)
        rho = of_both_eyes(image, rho, lamp.depth, predictor, ideal)
    elif interreflections.modulated:
        assert predictor.rig.projector is not None
        pull = too_far(light.phase, predictor.rig.projector.centre, predictor.grid.origin, ideal)
        return Indirect(rho, light.direct, None, None, pull, light.uneven, True)
    elif predictor.footprint is not None:
        second = predictor.footprint.second
        mirrored = mirrored_code(predictor, second, scene, world_from_sensor, whole, ideal)
        if interreflections.fringe is not None:
            pull = pulled(light.phase, interreflections.fringe, second, ideal)
            uneven = np.abs(pulled(light.uneven, interreflections.fringe, second, ideal))
    return Indirect(rho, light.direct, lamp, mirrored, pull, uneven)


def of_both_eyes(
    image: OtherLightImage, rho: Floats, depth: Floats, predictor: Predictor, ideal: Ideal
) -> Floats:  # fmt: skip
    """Geometric mean (n,) of ``rho`` (n,) that the first eye sees, and of what the second one sees at the same point.

    It sees there what the first one sees s' / |V| of the baseline aside, ``depth`` s' being that of the mirror image.
    A projector sees nothing.
    """
    first, *others = predictor.rig.cameras.values()
    if not others:
        return rho
    pixel_mm = ideal.distance * predictor.grid.angular_pitch / predictor.step
    share = np.where(stands_near(depth, pixel_mm), depth / ideal.distance, 0.0)[:, None]
    other = image.at(ideal.point - share * (others[0].centre - first.centre)).rho
    return np.sqrt(rho * np.where(np.isfinite(other), other, rho))


def disturbed(
    indirect: Indirect, displaced: Floats, fraction: Floats, scene: Scene, ideal: Ideal, size: tuple[int, ...],
    pitch: float, step: int, epipolar_axis: int = 1,
) -> Disturbance:  # fmt: skip
    """What light by way of other surfaces does to points that an average displaces already, (n,) [mm].

    ``fraction`` F (n,) that the map says; ``size`` of the grid, of which ``step`` pixels of the sensor, ``pitch`` [rad]
    apart, make one; disparities are along ``epipolar_axis`` of it.
    """
    rho, matched = indirect.rho, indirect.lamp is not None
    blinded, uneven, elsewhere, scattered = np.zeros((4, len(rho)))
    if indirect.lamp is not None:
        depth, alpha, pixel_mm = indirect.lamp.depth, _alpha(scene, ideal), ideal.distance * pitch
        taken, carried = glint(depth, indirect.direct, alpha, ideal, size, pixel_mm, step, epipolar_axis)
        carried = np.maximum(carried, drawn_to_image(depth, alpha, pixel_mm, rho))
        kept = np.minimum(kept_share(rho, *_lost(indirect.lamp, alpha, pixel_mm)), 1 - taken)
        # one row for each point: at the glint where most of its like are, unless that is no point of the face
        most = (taken > 0.5) & (depth < FALSE_SHARE_OF_DISTANCE * ideal.distance)
        blinded, kept = np.where(most, taken, 0.0), np.where(most, 0.0, kept)
        elsewhere, uneven = np.where(most, depth, carried), np.where(most, 0.0, CARRIED_SPREAD * carried)
    elif indirect.modulated:
        none = np.zeros(len(rho))
        return Disturbance(1.0 - indirect.uneven, noise_factor(rho, matched), none, none, indirect.pull + displaced,
                           none, none)
    else:
        kept = kept_share(rho, *LOST_OF_CODES)
    if indirect.mirrored is not None:
        read = read_off(indirect.mirrored, indirect.pull, kept, fraction)
        kept, blinded, elsewhere = read.kept, read.blinded, read.displaced
        scattered = np.hypot(read.scattered, indirect.uneven)
        uneven = PULL_LEFT * np.abs(np.where(blinded > 0, 0.0, indirect.pull))
    return Disturbance(
        kept, noise_factor(rho, matched), lasting_factor(rho, matched), uneven, elsewhere + displaced, blinded,
        scattered,
    )  # fmt: skip


def _lost(lamp: LampImage, alpha: Floats, pixel_mm: Floats) -> Floats:
    """At which rho half of a matcher's points are lost, and how fast, (2, n): by what the face makes of a mirror image.

    A rough face that has no lobe makes none.
    """
    dull = ~np.isfinite(alpha)
    near, blurred = stands_near(lamp.depth, pixel_mm) & ~dull, stands_near(lamp.across, pixel_mm) | dull
    flat, close, none = (np.array(one)[:, None] for one in (LOST_FLAT, LOST_NEAR, LOST_BLURRED))
    return np.where(near, close, np.where(blurred, none, flat))


def _alpha(scene: Scene, ideal: Ideal) -> Floats:
    """Width of the lobe of each ideal point's face, NaN where it has none."""
    scatters = [None if one is None else one.scatter for one in scene.finishes]
    own = [math.nan if one is None else math.sqrt(one.alpha_u * one.alpha_v) for one in scatters]
    return np.array([*own, math.nan])[ideal.shape]
