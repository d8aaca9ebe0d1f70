"""Light by way of other surfaces, and what it takes from a view: a map made of flat coupons knows nothing of it.

Signal chain: the projector all white, the reference camera with large pixels -> radiance L_1 of direct light, and L of
light over up to ``depth`` surfaces -> rho = L / L_1 - 1 at every possible point -> F g(rho), sigma h(rho).

A plate and a pillar of bright metal make a corner, and a corner throws light back: beside it rho is 1 to 30. What
comes that way carries the code of another place. Up to about rho = 1 it is a background which makes the contrast of the
surface's own code smaller by 1 / (1 + rho), and so the noise larger; beyond, the other code wins, and what is decoded
is refused or lies elsewhere.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mitsim.scene.camera_rays import CameraRays
from mitsim.scene.lamp import LitPatterns
from mitsim.scene.load import Scene
from mitsim.scene.transport import trace
from mitsim.sensor.frames import Transform
from mitsim.sensor.matcher import MatcherSettings
from mitsim.sensor.preset import Sensor

Floats = NDArray[np.float64]

#: pixels of the coarse camera, about
PIXELS = 20_000

#: rho at which half of the points are lost, and how fast: 1/(1 + (rho / HALF_LOST)^STEEPNESS) are found within 1 % of
#: their distance. Read off rendered views of two pillars on a plate: 200 000 points in Ra 0.37, 0.46 and 0.74 seen by
#: an active-stereo sensor, and 160 000 in Ra 0.37 and 0.74 by a fringe projector. It holds for rho to 7 and within some
#: 0.04, of either face and in every finish, also where the imager is full at its shortest exposure
HALF_LOST, HALF_LOST_OF_CODES, STEEPNESS = 2.25, 1.85, 1.4

#: points that are found lie off by some 0.6 rho sigma beside the noise (1 + rho) sigma, alike over many pixels; beyond
#: rho of 7 it grows no more. A code in phase is pulled by more of its own, far smaller, sigma: 2 rho sigma, read off
#: three views in Ra 0.74, and the same in Ra 0.37
PULL, PULL_OF_CODES, MOST_PULLED = 0.6, 2.0, 7.0


class Interreflections:
    """A sensor's light over up to ``depth`` surfaces, laid out once for any number of views of any scene.

    ``matched`` tells whether the sensor compares images, which then may agree on a mirror image.
    """

    def __init__(self, sensor: Sensor, depth: int = 2, samples: int = 4) -> None:
        camera = sensor.rig.reference
        self.depth, self.samples = depth, samples
        self.matched = isinstance(sensor.settings, MatcherSettings)
        step = max(1, math.floor(math.sqrt(camera.width * camera.height / PIXELS)))
        self.coarse = camera.binned(step)
        self.rays = CameraRays(self.coarse)  # a pinhole: large pixels see no blur
        optics = sensor.projector.optics
        self.light = LitPatterns(np.ones((1, optics.height, optics.width), np.float32), sensor.projector)
        exposures = sensor.exposure.exposures(None, sensor.imager.full_well)
        self.full = sensor.imager.full_well / (sensor.electrons() * min(exposures))

    def ratio(
        self, scene: Scene, world_from_sensor: Transform, points: NDArray[np.floating], seed: int = 1
    ) -> tuple[Floats, NDArray[np.bool_]]:
        """Light by way of other surfaces over direct light at points (n, 3) of the sensor frame: rho (n,).

        And whether the imager is full there at its shortest exposure. NaN where the camera sees no direct light.
        """
        direct, all_light = (
            trace(scene, self.rays, self.light, world_from_sensor, samples=self.samples, seed=seed, depth=depth)[0]
            for depth in (1, self.depth)
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            rho = np.where(direct > 0, np.maximum(all_light / direct - 1, 0), np.nan)
        places = self.coarse.project(np.asarray(points, float))
        column, row = (np.rint(np.nan_to_num(places[:, k], nan=-9)).astype(int) for k in (0, 1))
        inside = (column >= 0) & (row >= 0) & (column < self.coarse.width) & (row < self.coarse.height)
        out, full = np.full(len(points), np.nan), np.zeros(len(points), bool)
        out[inside] = rho[row[inside], column[inside]]
        full[inside] = ((direct > 0) & (all_light > self.full))[row[inside], column[inside]]
        return out, full


def kept_share(rho: Floats, matched: bool) -> Floats:
    """g(rho): share of the points that are still found where they should be; 1 where rho is not known.

    ``matched`` where blocks of images are compared.
    """
    known = np.nan_to_num(rho, nan=0.0, posinf=np.inf)
    with np.errstate(over="ignore"):
        return np.asarray(1 / (1 + (known / (HALF_LOST if matched else HALF_LOST_OF_CODES)) ** STEEPNESS))


def lasting_factor(rho: Floats, matched: bool) -> Floats:
    """b(rho): what is added to the persistent noise, in units of the map's sigma; 0 where rho is not known.

    The other code pulls neighbouring points the same way.
    """
    pull = PULL if matched else PULL_OF_CODES
    return np.asarray(pull * np.minimum(np.where(np.isfinite(rho), rho, 0.0), MOST_PULLED))


def noise_factor(rho: Floats) -> Floats:
    """h(rho) = 1 + rho: the noise of a code whose contrast is smaller by 1 / (1 + rho); 1 where rho is not known."""
    return np.asarray(1 + np.where(np.isfinite(rho), rho, 0.0))
