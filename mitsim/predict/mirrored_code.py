r"""What a projected code makes of a glossy face in which another surface is mirrored: points on that one's code.

Signal chain: ideal points of a view -> mirrored view rays -> next surface, and the coordinate u with which the
projector lights it -> where the view ray itself meets that u: depth s' behind the face -> which points lie there, with
rho, the light that comes by way of other surfaces over direct light, and the map's F.

A pixel that sees a plate sees mirrored in it a pillar, with the stripes that the projector casts upon the pillar. Where
these are the brighter, the pixel is given the pillar's u, and lies where its own ray meets the plane of that stripe:
with a baseline along the pillars centimetres before the plate, and behind the pillar where that mirrors the plate. What
is read so lies in one sheet, and a robust fit follows it where it is more than half of a feature.

One code or the other wins. Of the points that the surface's own code loses
(:func:`mitsim.predict.interreflection.kept_share`) the share :data:`FOUND` is found on the other, whatever the map says
of them: a plate of Ra 0.09 that is turned away sends back nothing of the projector, and shows the stripes on a pillar.
It was read off views of the two-pillar artefact, seen by ``david-sls-3``. In three of Ra 0.74 a third to three quarters
of such points came back, and lay 0.74 s' behind the plate and 1.1 s' behind a pillar in the median. Where a plate of Ra
0.09 is said to send back nothing (F under 0.02, 21 views, 124 000 pixels), 52, 45, 39, 37, 33 and 24 % came back where
s' was 0 to 1, 3, 6, 12, 30 and 100 mm, and 34 to 37 % were said; of pillars, on which the pattern is finer, 4 to 18 %.
The middle half of the depths found on that plate spans 7, 4, 8, 11, 14 and 22 mm.

Where the own code wins it is pulled by the other: :mod:`mitsim.predict.fringe_pull`. Left out: that a rough face
mirrors more than one place, and light that is mirrored on its way to the face, before and not after the other surface.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mitsim.predict.predictor import Ideal, Predictor
from mitsim.scene.footprint import SecondEye
from mitsim.scene.load import Scene
from mitsim.scene.raycast import Surfaces
from mitsim.scene.reflections import reflections
from mitsim.sensor.frames import Transform

Floats = NDArray[np.float64]

#: share of the points that the surface's own code loses which come back with the mirrored one
FOUND = 0.5

#: how far those scatter about s', in units of it, and at least [mm]
SCATTERED, LEAST_SCATTERED = 0.8, 3.0

#: a face that shows what it mirrors smaller by more than this is too curved for a code to be read off it
FINER = 2.0


@dataclass(frozen=True)
class Mirrored:
    """What is mirrored at n ideal points: how far behind them its code lies, ``depth`` s' (n,) [mm] along the view ray.

    Negative before the face; NaN where nothing is mirrored, or that code is met nowhere ahead of the sensor. ``finer``
    (n,) is by how much smaller than a plane mirror the face shows it.
    """

    depth: Floats
    finer: Floats


@dataclass(frozen=True)
class ReadOff:
    """Which code n points have: the share ``kept`` (n,) of F has the own one, ``blinded`` (n,) of all the mirrored one.

    One of the two is 0. Points are ``displaced`` (n,) [mm] in the mean, and by ``scattered`` (n,) [mm] about that.
    """

    kept: Floats
    blinded: Floats
    displaced: Floats
    scattered: Floats


def mirrored_code(
    predictor: Predictor, second: SecondEye, scene: Scene, world_from_sensor: Transform, whole: Surfaces, ideal: Ideal
) -> Mirrored:  # fmt: skip
    """What ideal points mirror of a projected code."""
    rays = predictor.rays
    found = reflections(scene, rays, world_from_sensor, predictor.rig.baseline_direction)
    length = found.distance.ravel()[ideal.pixel]
    length = np.where(np.isfinite(length), length, np.nan)
    normal = whole.normal.reshape(-1, 3)[ideal.pixel].astype(float)
    mirrored = ideal.ray - 2 * (ideal.ray * normal).sum(-1, keepdims=True) * normal
    shown = ideal.point + length[:, None] * mirrored
    across, mixed, along = found.power.reshape(3, -1)[:, ideal.pixel]
    power = np.abs(across + along) / 2 + np.hypot((across - along) / 2, mixed)  # where it bends most
    with np.errstate(invalid="ignore", divide="ignore"):
        coordinate, depth = second.tangent(shown)
        behind = second.reach(coordinate, ideal.point, ideal.ray)
        met = (behind > -ideal.distance) & (depth > 0)
        return Mirrored(np.where(met, behind, np.nan), np.where(met, 1 + power * length, 1.0))


def read_off(mirrored: Mirrored, pull: Floats, kept: Floats, fraction: Floats) -> ReadOff:
    """Which of two codes wins, at each point the one that more points come back with.

    ``pull`` [mm] is the displacement where the surface's own code wins, of which the share ``kept`` of ``fraction`` F
    comes back (n,). F is 0 of a smooth plate that is turned away; what it mirrors is no darker for that. A curved face
    has it finer than a camera resolves: there it counts as much as the face's own.
    """
    own = np.nan_to_num(fraction)
    found = FOUND * (1 - kept) * np.where(mirrored.finer > FINER, own, 1.0)
    elsewhere = np.isfinite(mirrored.depth) & (found > kept * own)
    none = np.zeros(len(kept))
    return ReadOff(
        np.where(elsewhere, none, kept), np.where(elsewhere, found, none), np.where(elsewhere, mirrored.depth, pull),
        np.where(elsewhere, np.hypot(SCATTERED * mirrored.depth, LEAST_SCATTERED), none),
    )  # fmt: skip
