r"""Effect of interreflections on a view, which a map made from flat coupons does not contain.

Signal chain: codes of the projector, reference camera with large pixels -> radiance L_1 of direct light, and L_2 of
light over two to ``depth`` surfaces -> rho = L_2 / L_1 at every point -> F g(rho), sigma h(rho). For a phase code also:
fringes -> phase bias (:mod:`mitsim.maps.prediction.multipath_phase_bias`). For time of flight also: correlations ->
path bias (:mod:`mitsim.maps.prediction.multipath_range_bias`).

Next to a corner of bright metal, such as a plate and a pillar, rho is 1 to 30. The interreflected light carries the
code of another place. Weak interreflections are a background that reduces the contrast for a matcher,

    h = 1 + rho,

and adds shot noise to a phase, h = sqrt(1 + rho) (EMVA 1288: the variance of a photon signal is its mean). For time of
flight h is the ratio of the decoder's sigma: the modulation of interreflected light counts too. Under strong
interreflections the other code prevails: the decoder rejects the pixel, or the point is false. The share of points that
are found at the right place is

    g = 1 / (1 + (rho / r)^k)

with one pair of constants r and k for matchers and one for codes (:func:`losses`). Their file states its source;
`python -m tests.proofs losses` estimates them. A time-of-flight sensor loses the points that its own decoder rejects.

Not included: the response of a matcher to mirror images of the projector or of a face, and the positions of false
points.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files

import numpy as np
from numpy.typing import NDArray

from characterisation.files.arrays import Floats, Singles
from characterisation.files.documents import Document, read_toml
from characterisation.region_of_interest import Roi
from mitsim.capture.simulated.indirect_light import smoothed
from mitsim.maps.prediction.multipath_phase_bias import amplitude, finest_fringe, fringes, phase_bias
from mitsim.maps.prediction.multipath_range_bias import path_amplitudes, path_bias, range_bias
from mitsim.maps.prediction.perturbation import Perturbation, SceneView
from mitsim.scene.light_transport.light_paths import LightPaths
from mitsim.scene.light_transport.projected_codes import ModulatedLight, ProjectedPatterns
from mitsim.scene.light_transport.transport import trace_poses
from mitsim.scene.load import Scene
from mitsim.scene.ray_casting.camera_rays import CameraRays
from mitsim.scene.ray_casting.raycast import PixelRays, shapes_met
from mitsim.sensor.camera import Camera
from mitsim.sensor.matcher import MatcherSettings
from mitsim.sensor.modulation import AmplitudeModulation, TimeOfFlightSettings
from mitsim.sensor.sensor import Sensor
from mitsim.sensor.transforms import Transform
from mitsim.sensor.vignetting import camera_illumination

#: number of pixels of the coarse camera. With three times the pixels, paths and photons screening takes 1.3 to 1.7
#: times as long. Least rank correlation with twelve times the paths, here and there: ensenso-n10 0.99 and 1.00,
#: realsense-d435 0.98 and 1.00, photoneo-phoxi-s 0.65 and 0.74, zivid-2-m70 0.71 and 0.60 (32 views of two pillars).
#: Command: python tests/benchmarks/screening_light.py SENSOR
PIXELS = 7_000

#: least number of its pixels that a fringe covers
PIXELS_OF_FRINGE = 6

#: camera paths per render of interreflections. A phase code has two renders, which distinguish their noise from a bias
PATHS = 60_000

#: photons per render. With large pixels four photons per camera path remove two thirds of the noise of the paths
PHOTONS = 130_000

#: number of views that are rendered at once: recording a kernel takes about as long as rendering one of them
TOGETHER = 16

#: points along an edge of the box around a scene whose images limit the region that is rendered, since a distortion
#: bends the edges; chosen
_BOX_POINTS = 5

#: pixels of the coarse camera that are rendered around this region; chosen
_AROUND_PX = 2

#: standard deviation of the window that averages rho, in pixels of the sensor
SMOOTHED_PX = 3.0

#: largest factor on a matcher's noise; points that scatter farther are rejected
NOISIEST = 4.0


class LossCurve(Document):
    """Constants r, ``half``, and k, ``steepness``, of g(rho), each with its 95 % interval."""

    half: float
    half_interval: tuple[float, float]
    steepness: float
    steepness_interval: tuple[float, float]


class Losses(Document):
    """The data file of g(rho): its cases, the command that wrote it, and the constants."""

    command: str
    cases: list[str]
    matched: LossCurve
    coded: LossCurve


@cache
def losses() -> Losses:
    """Return the constants of g(rho) that come with mitsim."""
    return read_toml(str(files("mitsim.maps.prediction") / "interreflections.toml"), Losses)


@dataclass(frozen=True)
class Interreflections:
    """Interreflections at n points: ``rho`` (n,) relative to direct light, NaN without direct light.

    ``displaced`` (n,) is the bias of a phase code [rad] or of a path [mm], ``scattered`` (n,) the standard deviation
    about it. ``rejected`` (n,) is the share that a time-of-flight decoder rejects. All three are 0 for other sensors.
    ``noisier`` (n,) is the factor on the noise of a path, or that of a phase.
    """

    rho: Floats
    displaced: Floats
    scattered: Floats
    rejected: Floats
    noisier: Floats


@dataclass(frozen=True)
class InterreflectionImage:
    """:class:`Interreflections` of the pixels of a ``region`` of a ``camera``, (5, h, w) in the order of its fields."""

    camera: Camera
    region: Roi
    values: Floats

    def at(self, points: NDArray[np.floating]) -> Interreflections:
        """Return the values of the pixels that show points (n, 3) of the sensor frame.

        Points outside the region have rho NaN, ``noisier`` 1, and 0 for the other values.
        """
        pixels = np.nan_to_num(self.camera.project(np.asarray(points, float)), nan=-9)
        column, row = (np.rint(pixels).astype(int) - [self.region.left, self.region.top]).T
        inside = (column >= 0) & (row >= 0) & (column < self.region.width) & (row < self.region.height)
        values = self.values[:, np.where(inside, row, 0), np.where(inside, column, 0)]
        return Interreflections(*np.where(inside, values, np.array([[np.nan], [0], [0], [0], [1]])))


class InterreflectionEffect:
    """Interreflections over up to ``depth`` surfaces for a sensor, prepared for any number of views of any scene.

    ``paths`` of the camera and ``photons`` are numbers per render. ``poses`` are views in the order in which they will
    be asked for: :data:`TOGETHER` of them are rendered at once, faster and with the same result.
    """

    def __init__(
        self,
        sensor: Sensor,
        depth: int = 2,
        paths: int = PATHS,
        photons: int = PHOTONS,
        poses: Sequence[Transform] = (),
    ) -> None:
        camera = sensor.rig.reference
        self.sensor, self.depth, self.photons = sensor, depth, photons
        self.fringe = finest_fringe(sensor)
        step = math.sqrt(camera.width * camera.height / PIXELS)
        if self.fringe is not None:  # the coarse camera must resolve it
            step = min(step, self.fringe.period * float(camera.matrix[0, 0]) / PIXELS_OF_FRINGE)
        self.step = max(1, math.floor(step))
        self.coarse = camera.binned(self.step)
        self.samples = max(1, round(paths / (self.coarse.width * self.coarse.height)))
        self.rays = CameraRays(self.coarse)  # a pinhole, since large pixels exceed the blur
        self.middles = PixelRays.of_camera(self.coarse)
        self.light = _light(sensor)
        self.poses, self.ready = list(poses), dict[int, InterreflectionImage]()
        self.indices = {_key(pose): index for index, pose in enumerate(self.poses)}

    def __call__(self, view: SceneView) -> Perturbation:
        """Return the perturbation of the ideal points of a view."""
        interreflections = self._rendered_with_next(view.scene, view.world_from_sensor).at(view.ideal.point)
        rho = np.where(np.isfinite(interreflections.rho), interreflections.rho, 0.0)
        nothing = Perturbation.none(len(rho))
        if isinstance(self.sensor.settings, MatcherSettings):
            noisier = 1 + rho / (1 + rho / (NOISIEST - 1))
            return replace(nothing, kept=found_share(rho, losses().matched), noisier=noisier)
        kept, displaced, scattered = found_share(rho, losses().coded), nothing.displaced, nothing.scattered
        if isinstance(self.sensor.pattern, AmplitudeModulation):
            kept = 1.0 - interreflections.rejected
            light_source = self.sensor.projector.optics.centre
            displaced = range_bias(interreflections.displaced, light_source, view.ideal)
        elif self.fringe is not None:
            phases = (interreflections.displaced, interreflections.scattered)
            displaced, scattered = (self.fringe.range_bias(phase, view.ideal) for phase in phases)
        return Perturbation(kept, interreflections.noisier, displaced, np.abs(scattered), nothing.shared)

    def _rendered_with_next(self, scene: Scene, pose: Transform) -> InterreflectionImage:
        """Return the image of a view; if it is one of ``poses``, render it together with those that follow."""
        index = self.indices.get(_key(pose))
        if index is None:
            return self.render(scene, pose)
        if index not in self.ready:
            end = index + TOGETHER
            if len(self.poses) == end + 1:  # a render of one view would be another kernel
                end += 1
            images = self.render_views(scene, self.poses[index:end])
            self.ready = dict(enumerate(images, index))
        return self.ready[index]

    def render(self, scene: Scene, world_from_sensor: Transform, seed: int = 1) -> InterreflectionImage:
        """Render the interreflections in a view."""
        return self.render_views(scene, [world_from_sensor], seed)[0]

    def render_views(self, scene: Scene, poses: Sequence[Transform], seed: int = 1) -> list[InterreflectionImage]:
        """Render the interreflections in several views at once; each image is the one that :meth:`render` returns."""
        region = self._region(scene, poses)
        arguments = scene, self.rays, self.light, poses
        direct = trace_poses(*arguments, LightPaths(samples=self.samples, seed=seed), region)
        paths = LightPaths(self.samples, 2 * seed, self.depth, photons=self.photons, indirect_only=True)
        halves = range(1 if self.fringe is None else 2)
        indirect = [trace_poses(*arguments, replace(paths, seed=2 * seed + half), region) for half in halves]
        middles = self.middles.within(region)
        return [
            self._image(region, shapes_met(scene, middles, pose), direct[k], [views[k] for views in indirect])
            for k, pose in enumerate(poses)
        ]

    def _region(self, scene: Scene, poses: Sequence[Transform]) -> Roi:
        """Return the region of the image that shows the box around the scene at all poses, the whole one if behind."""
        whole = self.rays.whole
        steps = np.stack(np.meshgrid(*[np.linspace(0.0, 1.0, _BOX_POINTS)] * 3), axis=-1).reshape(-1, 3)
        box = scene.bounds[0] + steps * (scene.bounds[1] - scene.bounds[0])
        pixels = np.concatenate([self.coarse.project(pose.inverse().points(box)) for pose in poses])
        if not np.isfinite(pixels).all():
            return whole
        first, last = np.floor(pixels.min(axis=0)) - _AROUND_PX, np.ceil(pixels.max(axis=0)) + _AROUND_PX + 1
        return Roi.between(*first, *last).overlap(whole) or Roi.whole(1, 1)

    def _image(
        self, region: Roi, shape: NDArray[np.integer], direct: Singles, indirect: Sequence[Singles]
    ) -> InterreflectionImage:
        """Return the interreflections of one view from its direct light, and one or two renders of the other light."""
        code = self.sensor.pattern
        # number of images whose mean is the total light
        white_count = code.steps if isinstance(code, AmplitudeModulation) else 1
        means = [images[:white_count].mean(axis=0) for images in (direct, *indirect)]
        white = np.stack([means[0], np.mean(means[1:], axis=0)])
        first, other = smoothed(white, shape, SMOOTHED_PX / self.step).astype(float)
        with np.errstate(divide="ignore", invalid="ignore"):
            rho = np.where(first > 0, other / first, np.nan)
        displaced, scattered, rejected = np.zeros((3, *rho.shape))
        noisier = np.sqrt(1 + np.nan_to_num(rho))
        if isinstance(code, AmplitudeModulation):
            settings, levels = self.sensor.settings, self._levels(region)
            assert isinstance(settings, TimeOfFlightSettings)
            first_path, other_path = (path_amplitudes(images, code) * levels for images in (direct, indirect[0]))
            biases = path_bias(first_path, other_path, code, settings, self.sensor.imager, shape, self.step)
            displaced, rejected, noisier = biases
        elif self.fringe is not None:
            first_phase, *others = (amplitude(images[1:]) for images in (direct, *indirect))
            displaced, scattered = phase_bias(first_phase, (others[0], others[1]), shape, self.step)
        return InterreflectionImage(self.coarse, region, np.stack([rho, displaced, scattered, rejected, noisier]))

    def _levels(self, region: Roi) -> float | Floats:
        """Return grey levels per radiance [DN / (W mm^-2 sr^-1)] in the shortest exposure, for pixels of a region."""
        sensor = self.sensor
        seconds = min(sensor.exposure.exposures(None, sensor.imager.full_well))
        levels = sensor.electrons() * seconds * sensor.imager.gain
        loss = camera_illumination(sensor.imager.corner_illumination, self.coarse)
        return levels if loss is None else np.asarray(levels * loss[region.slices], float)


def _key(pose: Transform) -> bytes:
    return pose.matrix().tobytes()


def _light(sensor: Sensor) -> ProjectedPatterns | ModulatedLight:
    """Return white light and the patterns from which a phase or a path is measured."""
    if isinstance(sensor.pattern, AmplitudeModulation):
        return ModulatedLight(sensor.projector, *sensor.pattern.images())
    optics = sensor.projector.optics
    white = np.ones((1, optics.height, optics.width), np.float32)
    return ProjectedPatterns(np.concatenate([white, fringes(sensor)]), sensor.projector)


def found_share(rho: Floats, loss: LossCurve) -> Floats:
    """Return g(rho), the share of points that are found at the right place."""
    with np.errstate(over="ignore"):
        return np.asarray(1 / (1 + (rho / loss.half) ** loss.steepness))
