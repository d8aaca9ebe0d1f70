"""Light by way of other surfaces, and what it takes from a view: a map made of flat coupons knows nothing of it.

Signal chain: the projector all white, the reference camera with large pixels -> radiance L_1 of direct light, and L_2
of light over two to ``depth`` surfaces -> rho = L_2 / L_1 at every possible point -> F g(rho), sigma h(rho); and of a
code in phase its fringes -> the phase that is read too far (:mod:`mitsim.predict.fringe_pull`).

A plate and a pillar of bright metal make a corner, and a corner throws light back: beside it rho is 1 to 30. What
comes that way carries the code of another place. Where that is weak it is a background, from which a matcher has less
contrast, and a phase more shot noise by sqrt(1 + rho); where it is strong the other code wins, and what is decoded is
refused or lies elsewhere. A matcher compares two images of the other code as well as of its own, and what it loses
depends on what the face makes of them (:mod:`mitsim.predict.glint`): a flat one shows both eyes the same thing, one
that is curved along the baseline shows a smaller image just behind itself, and a blurred one no image.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mitsim.capture.indirect_light import smoothed
from mitsim.predict.fringe_pull import amplitude, finest_fringe, fringes, phase_read_too_far
from mitsim.predict.path_pull import amplitudes, path_read_too_long
from mitsim.scene.camera_rays import CameraRays
from mitsim.scene.lamp import LitPatterns, ModulatedLight
from mitsim.scene.load import Scene
from mitsim.scene.raycast import PixelRays, shapes_met
from mitsim.scene.transport import trace
from mitsim.sensor.camera import Camera
from mitsim.sensor.frames import Transform
from mitsim.sensor.matcher import MatcherSettings
from mitsim.sensor.modulation import AmplitudeModulation, TimeOfFlightSettings
from mitsim.sensor.preset import Sensor
from mitsim.sensor.vignetting import camera_illumination

Floats = NDArray[np.float64]

#: pixels of the coarse camera, at most of a size so that a fringe covers so many
PIXELS, PIXELS_OF_FRINGE = 20_000, 6

#: paths from the camera, and photons, of a render of later light: of one, or of each of two where a code in phase is
#: read, whose noise has to be told from a pull. Photons find most of it where pixels are large: 300 000 take out two
#: thirds of the noise of 80 000 paths alone
PATHS, PHOTONS = 180_000, 400_000

#: standard deviation of the window in which rho is a mean, in pixels of the sensor
SMOOTHED_PX = 3.0

#: rho at which half of the points are lost, and how fast: 1 / (1 + (rho / half)^steepness) are found within 1 % of
#: their distance. On a face that mirrors to a matcher as a plane does, on one whose mirror image lies just behind it,
#: and on one that blurs it; and of codes. Read off rendered views of two pillars on a plate in Ra 0.37, 0.46 and 0.74:
#: 25 000, 50 000 and 100 000 points seen by an active-stereo sensor, and 110 000 seen by a fringe projector
LOST_FLAT, LOST_NEAR, LOST_BLURRED, LOST_OF_CODES = (1.4, 2.0), (2.6, 2.0), (5.5, 1.6), (2.1, 2.2)

#: a matcher's noise does not grow by more than this
NOISIEST = 4.0

#: points that are found lie off by some 0.6 rho sigma beside that noise, alike over many pixels; beyond rho of 7 it
#: grows no more. Of codes in phase, whose pull is foretold, less is left, and half of the pull: single patches of 8 mm
#: scatter by more than that, but fits in Ra 0.37 and 0.74 by no more, as neighbours differ
PULL, PULL_OF_CODES, MOST_PULLED, PULL_LEFT = 0.6, 0.25, 7.0, 0.5


@dataclass(frozen=True)
class OtherLight:
    """Light by way of other surfaces at n points: ``rho`` (n,) over direct light, NaN where there is none of that.

    ``direct`` (n,) is direct light over what fills the imager in its shortest exposure; ``phase`` (n,) [rad] how much
    too far a code in phase is read, and ``uneven`` (n,) [rad] how far it scatters about that; both 0 of other codes.
    """

    rho: Floats
    direct: Floats
    phase: Floats
    uneven: Floats


@dataclass(frozen=True)
class OtherLightImage:
    """:class:`OtherLight` of every pixel of a ``camera``, (4, H, W) in its order."""

    camera: Camera
    values: Floats

    def at(self, points: NDArray[np.floating]) -> OtherLight:
        """Of the pixels that show points (n, 3) of the sensor frame; NaN and nothing for those outside."""
        places = np.nan_to_num(self.camera.project(np.asarray(points, float)), nan=-9)
        column, row = np.rint(places).astype(int).T
        inside = (column >= 0) & (row >= 0) & (column < self.camera.width) & (row < self.camera.height)
        rho, *others = self.values[:, np.where(inside, row, 0), np.where(inside, column, 0)]
        return OtherLight(np.where(inside, rho, np.nan), *(np.where(inside, one, 0.0) for one in others))


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
        self.light: LitPatterns | ModulatedLight = LitPatterns(
            np.concatenate([white, fringes(sensor)]), sensor.projector
        )
        self.sensor = sensor
        self.modulated = isinstance(sensor.pattern, AmplitudeModulation)
        if isinstance(sensor.pattern, AmplitudeModulation):
            self.light = ModulatedLight(sensor.projector, *sensor.pattern.images())
        exposures = sensor.exposure.exposures(None, sensor.imager.full_well)
        full = sensor.imager.full_well / (sensor.electrons() * min(exposures))
        loss = camera_illumination(sensor.imager.corner_illumination, self.coarse)
        self.full = full if loss is None else full / loss

    def look(self, scene: Scene, world_from_sensor: Transform, seed: int = 1) -> OtherLightImage:
        """Light by way of other surfaces in a view."""
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
        if isinstance(code := self.sensor.pattern, AmplitudeModulation):
            return self._path(direct, later[0], code, shape)
        white = np.stack([direct[0], np.mean([one[0] for one in later], axis=0)])
        own, other = smoothed(white, shape, SMOOTHED_PX / self.step).astype(float)
        with np.errstate(divide="ignore", invalid="ignore"):
            rho = np.where(own > 0, other / own, np.nan)
        phase, uneven = np.zeros((2, *rho.shape))
        if self.fringe is not None:
            one, *two = (amplitude(images[1:]) for images in (direct, *later))
            phase, uneven = phase_read_too_far(one, (two[0], two[1]), shape, self.step)
        return OtherLightImage(self.coarse, np.stack([rho, direct[0] / self.full, phase, uneven]))

    def _path(self, direct, later, code, shape):
        white = np.stack([direct[: code.steps].mean(0), later[: code.steps].mean(0)])
        own, other = smoothed(white, shape, SMOOTHED_PX / self.step).astype(float)
        with np.errstate(divide="ignore", invalid="ignore"):
            rho = np.where(own > 0, other / own, np.nan)
        settings = self.sensor.settings
        assert isinstance(settings, TimeOfFlightSettings)
        levels = float(np.mean(self.sensor.imager.full_scale / self.full))
        path, lost = path_read_too_long(
            amplitudes(direct, code), amplitudes(later, code), code, settings, self.sensor.imager, levels, shape,
            self.step,
        )
        return OtherLightImage(self.coarse, np.stack([rho, white[0] / self.full, path, lost.astype(float)]))


def kept_share(rho: Floats, half: float | Floats, steepness: float | Floats) -> Floats:
    """g(rho): share of the points that are still found where they should be; 1 where rho is not known."""
    known = np.nan_to_num(rho, nan=0.0, posinf=np.inf)
    with np.errstate(over="ignore"):
        return np.asarray(1 / (1 + (known / half) ** steepness))


def lasting_factor(rho: Floats, matched: bool) -> Floats:
    """b(rho): what is added to the persistent noise, in units of the map's sigma; 0 where rho is not known.

    The other code pulls neighbouring points the same way.
    """
    known = np.minimum(np.where(np.isfinite(rho), rho, 0.0), MOST_PULLED)
    return np.asarray((PULL if matched else PULL_OF_CODES) * known)


def noise_factor(rho: Floats, matched: bool) -> Floats:
    """h(rho): the noise over that of direct light alone; 1 where rho is not known.

    1 + rho at first for a match of images, whose contrast is smaller by 1 / (1 + rho), and no more than
    :data:`NOISIEST`: what scatters farther is refused. sqrt(1 + rho) for a phase, where other light adds its shot noise
    to the same amplitude (EMVA 1288, the variance of a photon signal is its mean).
    """
    known = np.where(np.isfinite(rho), rho, 0.0)
    return np.asarray(1 + known / (1 + known / (NOISIEST - 1)) if matched else np.sqrt(1 + known))
