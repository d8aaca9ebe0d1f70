"""Light by way of other surfaces, and what it takes from a view: a map made of flat coupons knows nothing of it.

Signal chain: the projector all white, the reference camera with large pixels -> radiance L_1 of direct light, and L_2
of light over two to ``depth`` surfaces -> rho = L_2 / L_1 at every possible point -> F g(rho), sigma h(rho); and of a
code in phase its fringes -> the phase that is read too far (:mod:`mitsim.predict.fringe_pull`).

A plate and a pillar of bright metal make a corner, and a corner throws light back: beside it rho is 1 to 30. What
comes that way carries the code of another place. Up to about rho = 1 it is a background, from which a matcher has less
contrast by 1 / (1 + rho), and a phase more shot noise by sqrt(1 + rho); beyond, the other code wins, and what is
decoded is refused or lies elsewhere.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mitsim.capture.indirect_light import smoothed
from mitsim.predict.fringe_pull import amplitude, finest_fringe, fringes, phase_read_too_far
from mitsim.scene.camera_rays import CameraRays
from mitsim.scene.lamp import LitPatterns
from mitsim.scene.load import Scene
from mitsim.scene.raycast import PixelRays, shapes_met
from mitsim.scene.transport import trace
from mitsim.sensor.frames import Transform
from mitsim.sensor.matcher import MatcherSettings
from mitsim.sensor.preset import Sensor

Floats = NDArray[np.float64]

#: pixels of the coarse camera, at most of a size so that a fringe covers so many
PIXELS, PIXELS_OF_FRINGE = 20_000, 6

#: paths from the camera, and photons, of a render of later light: of one, or of each of two where a code in phase is
#: read, whose noise has to be told from a pull. Photons find most of it where pixels are large: 300 000 take out two
#: thirds of the noise of 80 000 paths alone
PATHS, PHOTONS = 180_000, 400_000

#: standard deviation of the window in which rho is a mean, in pixels of the sensor
SMOOTHED_PX = 3.0

#: rho at which half of the points are lost, and how fast: 1/(1 + (rho / HALF_LOST)^STEEPNESS) are found within 1 % of
#: their distance. Read off rendered views of two pillars on a plate: 200 000 points in Ra 0.37, 0.46 and 0.74 seen by
#: an active-stereo sensor, and 160 000 in Ra 0.37 and 0.74 by a fringe projector. It holds for rho to 7 and within some
#: 0.04, of either face and in every finish, also where the imager is full at its shortest exposure
HALF_LOST, HALF_LOST_OF_CODES, STEEPNESS = 2.25, 1.85, 1.4

#: points that are found lie off by some 0.6 rho sigma beside that noise, alike over many pixels; beyond rho of 7 it
#: grows no more. Of codes in phase, whose pull is foretold, less is left, and half of the pull: single patches of 8 mm
#: scatter by more than that, but fits in Ra 0.37 and 0.74 by no more, as neighbours differ
PULL, PULL_OF_CODES, MOST_PULLED, PULL_LEFT = 0.6, 0.25, 7.0, 0.5


@dataclass(frozen=True)
class OtherLight:
    """Light by way of other surfaces at n points: ``rho`` (n,) over direct light, NaN where there is none of that.

    ``full`` (n,) tells where the imager is, in its shortest exposure; ``phase`` (n,) [rad] how much too far a code in
    phase is read, and ``uneven`` (n,) [rad] how far it scatters about that; both 0 of other codes.
    """

    rho: Floats
    full: NDArray[np.bool_]
    phase: Floats
    uneven: Floats


class Interreflections:
    """A sensor's light over up to ``depth`` surfaces, laid out once for any number of views of any scene.

    ``paths`` of a camera, and ``photons``, are those of one render. ``matched`` tells whether the sensor
    compares images; ``fringe`` is that of a code in phase, None of others
    (:func:`~mitsim.predict.fringe_pull.finest_fringe`).
    """

    def __init__(self, sensor: Sensor, depth: int = 2, paths: int = PATHS, photons: int = PHOTONS) -> None:
        camera = sensor.rig.reference
        self.depth, self.photons = depth, photons
        self.matched, self.fringe = isinstance(sensor.settings, MatcherSettings), finest_fringe(sensor)
        step = math.sqrt(camera.width * camera.height / PIXELS)
        if self.fringe is not None:  # it has to be seen
            step = min(step, self.fringe * float(camera.matrix[0, 0]) / PIXELS_OF_FRINGE)
        self.step = max(1, math.floor(step))
        self.coarse = camera.binned(self.step)
        self.samples = max(1, round(paths / (self.coarse.width * self.coarse.height)))
        self.rays = CameraRays(self.coarse)  # a pinhole: large pixels see no blur
        self.middles = PixelRays.of_camera(self.coarse)
        optics = sensor.projector.optics
        white = np.ones((1, optics.height, optics.width), np.float32)
        self.light = LitPatterns(np.concatenate([white, fringes(sensor)]), sensor.projector)
        exposures = sensor.exposure.exposures(None, sensor.imager.full_well)
        self.full = sensor.imager.full_well / (sensor.electrons() * min(exposures))

    def at(self, scene: Scene, world_from_sensor: Transform, points: NDArray[np.floating], seed: int = 1) -> OtherLight:
        """Light by way of other surfaces at points (n, 3) of the sensor frame."""
        given = scene, self.rays, self.light, world_from_sensor
        shape = shapes_met(scene, self.middles, world_from_sensor)
        direct = trace(*given, samples=self.samples, seed=seed)
        later = [
            trace(
                *given, samples=self.samples, seed=2 * seed + half, depth=self.depth, photons=self.photons,
                only_later=True,
            )
            for half in range(1 if self.fringe is None else 2)
        ]  # fmt: skip
        white = np.stack([direct[0], np.mean([one[0] for one in later], axis=0)])
        own, other = smoothed(white, shape, SMOOTHED_PX / self.step).astype(float)
        with np.errstate(divide="ignore", invalid="ignore"):
            rho = np.where(own > 0, other / own, np.nan)
        full = (direct[0] > 0) & (direct[0] + other > self.full)
        place, inside = self._pixels(points)
        phase, uneven = np.zeros((2, len(place[0])))
        if self.fringe is not None:
            one, *two = (amplitude(images[1:]) for images in (direct, *later))
            found = phase_read_too_far(one, (two[0], two[1]), shape, self.step)
            phase, uneven = (np.where(inside, values[place], 0.0) for values in found)
        return OtherLight(np.where(inside, rho[place], np.nan), inside & full[place], phase, uneven)

    def _pixels(self, points: NDArray[np.floating]) -> tuple[tuple[NDArray[np.int64], ...], NDArray[np.bool_]]:
        """Row and column of the large pixels that show points (n, 3), 0 for those outside; and which are inside."""
        places = np.nan_to_num(self.coarse.project(np.asarray(points, float)), nan=-9)
        column, row = np.rint(places).astype(int).T
        inside = (column >= 0) & (row >= 0) & (column < self.coarse.width) & (row < self.coarse.height)
        return (np.where(inside, row, 0), np.where(inside, column, 0)), inside


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
    known = np.minimum(np.where(np.isfinite(rho), rho, 0.0), MOST_PULLED)
    return np.asarray((PULL if matched else PULL_OF_CODES) * known)


def noise_factor(rho: Floats, matched: bool) -> Floats:
    """h(rho): the noise over that of direct light alone; 1 where rho is not known.

    1 + rho for a match of images, whose contrast is smaller by 1 / (1 + rho); sqrt(1 + rho) for a phase, where other
    light adds its shot noise to the same amplitude (EMVA 1288, the variance of a photon signal is its mean).
    """
    lit = 1 + np.where(np.isfinite(rho), rho, 0.0)
    return np.asarray(lit if matched else np.sqrt(lit))
