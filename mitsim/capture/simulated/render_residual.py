"""Measure the error of a rendering, relative to the noise that the sensor adds.

A rendering has two errors:

- *Noise*. Directions of later bounces and of emitters are random, so another seed gives another image. Direct light
  from the projector has no noise.
- *Quadrature error*. A pixel is the mean over a few positions in it, and more positions give another mean. It is the
  same in all captures of a pose.

Either would be mistaken for an error of the sensor if it were not small.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from characterisation.words.numbers import two_digits
from characterisation.words.progress import say
from mitsim.capture.capture import Capture
from mitsim.capture.simulated.rendering import Rendering
from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.scene.load import Scene
from mitsim.scene.visible_surfaces import sees_nothing
from mitsim.sensor.imager import Imager
from mitsim.sensor.sensor import Sensor
from mitsim.sensor.transforms import Transform
from mitsim.sensor.working_volume import roi_around

#: largest error of a rendering, over the sensor's noise, without a warning
LIMIT = 0.2

#: number of images that are compared
IMAGES = 4


@dataclass(frozen=True)
class RenderResidual:
    """Errors of a rendering over lit pixels, relative to the imager's temporal noise in the same pixel [1].

    All are NaN if nothing is lit.

    - ``noise``, ``quadrature``: noise of one rendering, and error of its samples per pixel: 68.3 % of the pixels are
      below, which is one standard deviation of a normal distribution. Interreflections on metal, and pixels at edges,
      have far heavier tails.
    - ``outliers``: share of pixels whose noise or error exceeds the sensor's noise.
    """

    noise: float
    quadrature: float
    outliers: float

    @property
    def worst(self) -> float:
        """The larger of noise and quadrature error."""
        return max(self.noise, self.quadrature)

    def __str__(self) -> str:
        if not self.noise >= 0:
            return "render noise: not known, since no pixel is lit"
        return (
            f"render noise {self.noise:.3f} times the sensor's noise, quadrature error {self.quadrature:.3f} times; "
            f"one of them exceeds it in {100 * self.outliers:.1f} % of the pixels"
        )


def render_residual(
    simulated: SimulatedSensor,
    scene: Scene,
    world_from_sensor: Transform,
    camera: str,
    rendering: Rendering,
    *,
    seed: int,
    around: NDArray[np.floating] | None = None,
) -> RenderResidual:
    """Return the errors of a camera's images, from two seeds and from four times the samples.

    Parameters
    ----------
    simulated, scene, world_from_sensor, camera, rendering, seed
        The rendering to check, and the seed of the first one.
    around
        (n, 3) points in the sensor frame [mm]; only the part of the images around them is rendered. All if None.
    """
    roi = None if around is None else roi_around(simulated.sensor.rig.cameras[camera], around, 0)

    def radiance(offset: int, finer: int) -> NDArray[np.float32]:
        settings = rendering.finer(finer)
        return simulated.radiance(scene, world_from_sensor, camera, settings, seed=seed + offset, roi=roi)

    return residual_of(radiance, simulated.sensor)


def residual_of(radiance: Callable[[int, int], NDArray[np.float32]], sensor: Sensor) -> RenderResidual:
    """Return the errors of images (P, h, w) that a function renders, given an offset to its seed and a factor.

    The factor is that of its numbers of samples. Of the images a few are compared, from the first to the last.
    """
    scale = sensor.electrons()

    def electrons_per_s(offset: int, finer: int) -> NDArray[np.float32]:
        images = radiance(offset, finer)
        # the first pattern is often the coarsest and the last the finest
        last = len(images) - 1 - sensor.ambient_image
        selected: NDArray[np.float32] = images[np.unique(np.linspace(0, last, IMAGES).astype(int))]
        del images  # frees up to 164 MB, for a sensor of 3 megapixels
        selected *= np.float32(scale)
        return selected

    one, other, finer = electrons_per_s(0, 1), electrons_per_s(1, 1), electrons_per_s(2, 4)
    exposures = sensor.exposure.exposures(finer[np.argmax(finer.mean(axis=(1, 2)))], sensor.imager.full_well)
    fitting = np.zeros_like(finer)  # the longest exposure that does not saturate the pixel
    for exposure in sorted(exposures):
        fitting[finer * np.float32(exposure) < sensor.imager.full_well] = exposure
    lit = (finer > 0) & (fitting > 0)
    if not lit.any():
        return RenderResidual(float("nan"), float("nan"), float("nan"))
    one, other, finer = (images[lit] * fitting[lit] for images in (one, other, finer))
    temporal = temporal_noise(finer, sensor.imager)
    noise = (one - other) / np.sqrt(2.0) / temporal
    error = (0.5 * (one + other) - finer) / temporal
    size, error_size = np.percentile(np.abs(noise), 68.3), np.percentile(np.abs(error), 68.3)
    # subtract the noise of the three renderings: 1/2 + 1/4 of the variance of one
    error_size = np.sqrt(max(error_size**2 - 0.75 * size**2, 0.0))
    return RenderResidual(float(size), float(error_size), float(np.mean(np.maximum(np.abs(noise), np.abs(error)) > 1)))


def checked_rendering(
    capture: Capture,
    simulated: SimulatedSensor,
    scene: Scene,
    world_from_sensor: Transform,
    rendering: Rendering,
    seed: int,
) -> tuple[RenderResidual, str]:
    """Record the errors of a capture's rendering in its settings; return them, and a warning if it sees nothing.

    Parameters
    ----------
    capture
        Capture whose settings get ``render_residual`` (null if nothing is lit) and the warning.
    simulated, scene, world_from_sensor, rendering, seed
        Those of the capture. Images of the first camera are compared.
    """
    rig = simulated.sensor.rig
    residual = render_residual(simulated, scene, world_from_sensor, next(iter(rig.cameras)), rendering, seed=seed)
    capture.settings["render_residual"] = asdict(residual) if np.isfinite(residual.noise) else None
    blind = [eye if eye == "projector" else f"camera {eye}" for eye in sees_nothing(scene, rig, world_from_sensor)]
    if not blind:
        return residual, ""
    unseen = f"no pixel of the {', '.join(blind)} shows the part: check position, target and roll"
    capture.settings["warnings"] = [*capture.settings.get("warnings", []), unseen]
    return residual, unseen


def advice(residual: RenderResidual, rendering: Rendering) -> str:
    """Return what to do about errors above :data:`LIMIT` of a rendering; empty if none are.

    Noise decreases with the square root of the number of samples.
    """
    if not residual.worst > LIMIT:
        return ""
    if not residual.noise > LIMIT:
        return f"more samples reduce the error to {LIMIT} times"
    needed = two_digits(rendering.samples * (residual.noise / LIMIT) ** 2)
    fewer = ", or fewer with smoothed interreflections" if rendering.indirect is None and rendering.depth > 1 else ""
    return f"about {needed} samples reduce the noise to {LIMIT} times{fewer}"


def warn_above_limit(subject: str, residual: RenderResidual) -> RenderResidual:
    """Print a warning if a residual exceeds :data:`LIMIT`; return the residual."""
    if residual.worst > LIMIT:
        say(f"{subject}: {residual}; above {LIMIT}: use more samples_per_pixel")
    return residual


def largest_residual(residuals: Iterable[RenderResidual]) -> RenderResidual | None:
    """Return the residual with the largest error; None if nothing was lit in any."""
    return max((residual for residual in residuals if residual.worst >= 0), key=lambda one: one.worst, default=None)


def temporal_noise(mean: NDArray[np.floating], imager: Imager) -> NDArray[np.float64]:
    """Return the standard deviation [e-] of a pixel between images at a mean signal [e-].

    Linear model of EMVA 1288: shot noise, read noise, row noise and quantisation. Dark current is left out.
    """
    quantisation = 1.0 / (np.sqrt(12.0) * imager.gain)
    return np.asarray(np.sqrt(mean + imager.read_noise**2 + imager.row_noise**2 + quantisation**2))
