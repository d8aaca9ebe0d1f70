r"""What a projected code makes of a glossy face in which another surface is mirrored: points on that one's code.

Signal chain: ideal points of a view -> mirrored view rays -> next surface, and the coordinate u with which the
projector lights it -> where the view ray itself meets that u: depth s' behind the face -> which points lie there, with
rho, the light that comes by way of other surfaces over direct light.

A pixel that sees a plate sees mirrored in it a pillar, with the stripes that the projector casts upon the pillar. Where
these are the brighter, the pixel is given the pillar's u, and lies where its own ray meets the plane of that stripe:
with a baseline along the pillars centimetres before the plate, and behind the pillar where that mirrors the plate. What
is read so lies in one sheet, and a robust fit follows it where it is more than half of a feature.

One code or the other wins. Of the points that the surface's own code loses
(:func:`mitsim.predict.interreflection.kept_share`) the share :data:`FOUND` is found on the other. It was read off
three views of the two-pillar artefact in Ra 0.74, seen by ``david-sls-3``: a third to three quarters of such points
came back, and with the baseline along the pillars they lay 0.74 s' behind the plate and 1.1 s' behind a pillar in the
median.

Where the own code wins it is pulled by the other: :mod:`mitsim.predict.fringe_pull`. Left out: that a rough face
mirrors more than one place, and light that is mirrored on its way to the face, before and not after the other surface.
"""

from __future__ import annotations

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


def mirrored_depth(
    predictor: Predictor, second: SecondEye, scene: Scene, world_from_sensor: Transform, whole: Surfaces, ideal: Ideal
) -> Floats:  # fmt: skip
    """Depth s' (n,) [mm] behind each ideal point, along its view ray, of the code of what is mirrored there.

    Negative before the face; NaN where nothing is mirrored, or that code is met nowhere ahead of the sensor.
    """
    rays = predictor.rays
    found = reflections(scene, rays, world_from_sensor, predictor.rig.baseline_direction)
    length = found.distance.ravel()[ideal.pixel]
    normal = whole.normal.reshape(-1, 3)[ideal.pixel].astype(float)
    mirrored = ideal.ray - 2 * (ideal.ray * normal).sum(-1, keepdims=True) * normal
    shown = ideal.point + np.where(np.isfinite(length), length, np.nan)[:, None] * mirrored
    with np.errstate(invalid="ignore", divide="ignore"):
        coordinate, depth = second.tangent(shown)
        behind = second.reach(coordinate, ideal.point, ideal.ray)
        return np.where((behind > -ideal.distance) & (depth > 0), behind, np.nan)


def found_elsewhere(depth: Floats, pull: Floats, kept: Floats) -> tuple[Floats, Floats]:
    """Share of F that comes back (n,), and its displacement [mm] (n,), where one of two codes wins.

    ``depth`` s' [mm], NaN where nothing is mirrored; ``pull`` [mm] is the displacement where the surface's own code
    wins, and ``kept`` the share of points that it keeps.
    """
    found = FOUND * (1 - kept)
    elsewhere = np.isfinite(depth) & (found > kept)
    return np.where(elsewhere, found, kept), np.where(elsewhere, depth, pull)
