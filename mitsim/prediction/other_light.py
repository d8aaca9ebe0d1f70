r"""Light by way of other surfaces, and what it does to a view: a map made of flat coupons knows nothing of it.

Signal chain: the projector's codes, the reference camera with large pixels -> radiance L_1 of direct light, and L_2 of
light over two to ``depth`` surfaces -> rho = L_2 / L_1 at every point -> F g(rho), sigma h(rho); of a code in phase its
fringes -> the phase that is read too far (:mod:`mitsim.prediction.multipath_phase_bias`); of the time of flight its
correlations -> the path that is read too long (:mod:`mitsim.prediction.multipath_range_bias`).

A plate and a pillar of bright metal make a corner, and a corner throws light back: beside it rho is 1 to 30. What comes
that way carries the code of another place. Where that is weak it is a background, from which a matcher has less
contrast,

    h = 1 + rho,

and a phase more shot noise, h = sqrt(1 + rho) (EMVA 1288: the variance of a photon signal is its mean). Where it is
strong the other code wins, and what is decoded is refused or lies elsewhere. The share that is found where it should be
is

    g = 1 / (1 + (rho / r)^k)

with r and k of matchers and of codes as :data:`LOSSES` has them; that file says what they were read off, and
`mitsim validate losses` reads them off again. A time-of-flight sensor loses what its own decoder refuses.

Left out: what a matcher makes of mirror images, of the projector or of a face; where points lie that the other code
has won.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from importlib.resources import files

import numpy as np
from numpy.typing import NDArray

from characterisation.documents import Document, read_toml
from mitsim.prediction.multipath_phase_bias import amplitude, finest_fringe, fringes, phase_bias
from mitsim.prediction.multipath_range_bias import path_amplitudes, path_bias, range_bias
from mitsim.prediction.perturbation import LookedAt, Perturbation
from mitsim.scene.light_transport.projector_light import LitPatterns, ModulatedLight
from mitsim.scene.light_transport.transport import LightPaths, trace
from mitsim.scene.load import Scene
from mitsim.scene.ray_casting.camera_rays import CameraRays
from mitsim.scene.ray_casting.raycast import PixelRays, shapes_met
from mitsim.sensor.camera import Camera
from mitsim.sensor.matcher import MatcherSettings
from mitsim.sensor.modulation import AmplitudeModulation, TimeOfFlightSettings
from mitsim.sensor.preset import Sensor
from mitsim.sensor.transforms import Transform
from mitsim.sensor.vignetting import camera_illumination
from mitsim.simulation.indirect_light import smoothed

Floats = NDArray[np.float64]

#: pixels of the coarse camera, at most of a size so that a fringe covers so many
PIXELS, PIXELS_OF_FRINGE = 20_000, 6

#: paths from the camera, and photons, of a render of later light: of one, or of each of two where a code in phase is
#: read, whose noise has to be told from a pull. Photons find most of it where pixels are large: 300 000 take out two
#: thirds of the noise of 80 000 paths alone
PATHS, PHOTONS = 180_000, 400_000

#: standard deviation of the window in which rho is a mean, in pixels of the sensor
SMOOTHED_PX = 3.0

#: a matcher's noise does not grow by more than this: what scatters farther is refused
NOISIEST = 4.0


class Loss(Document):
    """Constants r, ``half``, and k, ``steepness``, of g(rho), each with its 95 % interval."""

    half: float
    half_interval: tuple[float, float]
    steepness: float
    steepness_interval: tuple[float, float]


class Losses(Document):
    """The data file of g(rho): what it was read off, by which command, and what came out."""

    command: str
    cases: list[str]
    matched: Loss
    coded: Loss


@cache
def losses() -> Losses:
    """Constants of g(rho) that come with mitsim."""
    return read_toml(str(files("mitsim.prediction") / "other_light.toml"), Losses)


@dataclass(frozen=True)
class OtherLight:
    """Light by way of other surfaces at n points: ``rho`` (n,) over direct light, NaN where there is none of that.

    ``displaced`` and ``scattered`` (n,): how much too far a code in phase [rad], or a path [mm], is read, and how far
    it scatters about that; ``refused`` (n,) is the share that a time-of-flight decoder refuses. 0 for others.
    """

    rho: Floats
    displaced: Floats
    scattered: Floats
    refused: Floats


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


class OtherLightEffect:
    """A sensor's light over up to ``depth`` surfaces, laid out once for any number of views of any scene.

    ``paths`` of a camera, and ``photons``, are those of one render.
    """

    def __init__(self, sensor: Sensor, depth: int = 2, paths: int = PATHS, photons: int = PHOTONS) -> None:
        camera = sensor.rig.reference
        self.sensor, self.depth, self.photons = sensor, depth, photons
        self.fringe = finest_fringe(sensor)
        step = math.sqrt(camera.width * camera.height / PIXELS)
        if self.fringe is not None:  # it has to be seen
            step = min(step, self.fringe.period * float(camera.matrix[0, 0]) / PIXELS_OF_FRINGE)
        self.step = max(1, math.floor(step))
        self.coarse = camera.binned(self.step)
        self.samples = max(1, round(paths / (self.coarse.width * self.coarse.height)))
        self.rays = CameraRays(self.coarse)  # a pinhole: large pixels see no blur
        self.middles = PixelRays.of_camera(self.coarse)
        self.light = _light(sensor)

    def __call__(self, view: LookedAt) -> Perturbation:
        """What it does to the ideal points of a view."""
        found = self.look(view.scene, view.world_from_sensor).at(view.ideal.point)
        rho = np.where(np.isfinite(found.rho), found.rho, 0.0)
        nothing = Perturbation.none(len(rho))
        if isinstance(self.sensor.settings, MatcherSettings):
            noisier = 1 + rho / (1 + rho / (NOISIEST - 1))
            return Perturbation(found_share(rho, losses().matched), noisier, *_rest(nothing))
        kept, displaced, scattered = found_share(rho, losses().coded), nothing.displaced, nothing.scattered
        if isinstance(self.sensor.pattern, AmplitudeModulation):
            kept = 1.0 - found.refused
            lamp = self.sensor.projector.optics.centre
            displaced = range_bias(found.displaced, lamp, view.ideal)
        elif self.fringe is not None:
            displaced, scattered = (
                self.fringe.range_bias(phase, view.ideal) for phase in (found.displaced, found.scattered)
            )
        return Perturbation(kept, np.sqrt(1 + rho), displaced, np.abs(scattered), nothing.shared)

    def look(self, scene: Scene, world_from_sensor: Transform, seed: int = 1) -> OtherLightImage:
        """Light by way of other surfaces in a view."""
        given = scene, self.rays, self.light, world_from_sensor
        shape = shapes_met(scene, self.middles, world_from_sensor)
        direct = trace(*given, LightPaths(samples=self.samples, seed=seed))
        later = [
            trace(
                *given,
                LightPaths(
                    samples=self.samples, seed=2 * seed + half, depth=self.depth, photons=self.photons, only_later=True
                ),
            )
            for half in range(1 if self.fringe is None else 2)
        ]
        code = self.sensor.pattern
        own = 1 if not isinstance(code, AmplitudeModulation) else code.steps  # images whose mean is all the light
        white = np.stack([direct[:own].mean(axis=0), np.mean([one[:own].mean(axis=0) for one in later], axis=0)])
        first, other = smoothed(white, shape, SMOOTHED_PX / self.step).astype(float)
        with np.errstate(divide="ignore", invalid="ignore"):
            rho = np.where(first > 0, other / first, np.nan)
        displaced, scattered, refused = np.zeros((3, *rho.shape))
        if isinstance(code, AmplitudeModulation):
            assert isinstance(self.sensor.settings, TimeOfFlightSettings)
            levels = self._levels()
            displaced, refused = path_bias(
                path_amplitudes(direct, code) * levels,
                path_amplitudes(later[0], code) * levels,
                code,
                self.sensor.settings,
                self.sensor.imager,
                shape,
                self.step,
            )
        elif self.fringe is not None:
            one, *two = (amplitude(images[1:]) for images in (direct, *later))
            displaced, scattered = phase_bias(one, (two[0], two[1]), shape, self.step)
        return OtherLightImage(self.coarse, np.stack([rho, displaced, scattered, refused]))

    def _levels(self) -> float | Floats:
        """Grey levels of a radiance [DN / (W mm^-2 sr^-1)] in the shortest exposure, pixel by pixel (H, W)."""
        sensor = self.sensor
        seconds = min(sensor.exposure.exposures(None, sensor.imager.full_well))
        levels = sensor.electrons() * seconds * sensor.imager.gain
        loss = camera_illumination(sensor.imager.corner_illumination, self.coarse)
        return levels if loss is None else np.asarray(levels * loss, float)


def _light(sensor: Sensor) -> LitPatterns | ModulatedLight:
    """White, and what a phase or a path is read from."""
    if isinstance(sensor.pattern, AmplitudeModulation):
        return ModulatedLight(sensor.projector, *sensor.pattern.images())
    optics = sensor.projector.optics
    white = np.ones((1, optics.height, optics.width), np.float32)
    return LitPatterns(np.concatenate([white, fringes(sensor)]), sensor.projector)


def _rest(nothing: Perturbation) -> tuple[Floats, Floats, Floats]:
    return nothing.displaced, nothing.scattered, nothing.shared


def found_share(rho: Floats, loss: Loss) -> Floats:
    """g(rho): share of the points that are still found where they should be."""
    with np.errstate(over="ignore"):
        return np.asarray(1 / (1 + (rho / loss.half) ** loss.steepness))
