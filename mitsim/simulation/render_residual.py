"""How far a render is from the light that it stands for, beside the noise that the sensor adds to it.

Signal chain: the same camera rendered three times -> differences in electrons -> over the standard deviation of the
imager's own temporal noise at that brightness.

Two things are left in a render. *Noise*: directions of later bounces and of lamps are drawn at random, and another seed
gives another image; direct light from the projector has none. *Quadrature error*: a pixel is a mean over a few places
in it, and more places give another mean; it is the same in every capture of a pose. Either would be read as the
sensor's if it were not small.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mitsim.progress import say
from mitsim.scene.load import Scene
from mitsim.sensor.imager import Imager
from mitsim.sensor.roi import roi_around
from mitsim.sensor.transforms import Transform
from mitsim.simulation.rendering import Rendering
from mitsim.simulation.simulate import SimulatedSensor

#: share of the sensor's noise that a render's own may reach before a command says so
LIMIT = 0.2

#: patterns that are looked at
IMAGES = 4


@dataclass(frozen=True)
class RenderResidual:
    """Over lit pixels, in units of the imager's temporal noise in the same pixel [1]; NaN where nothing is lit.

    ``noise`` of one render and ``quadrature`` error of its samples per pixel: what two thirds of the pixels stay under
    (68.3 %, one standard deviation of a normal distribution). Interreflections on metal have far heavier tails, and so
    have pixels on an edge; ``outliers`` is the share of pixels whose noise or error is over the sensor's own noise.
    """

    noise: float
    quadrature: float
    outliers: float

    @property
    def worst(self) -> float:
        """The larger of the two."""
        return max(self.noise, self.quadrature)

    def __str__(self) -> str:
        return (
            f"render noise {self.noise:.3f}, quadrature error {self.quadrature:.3f} of the sensor's noise; "
            f"either is over it in {100 * self.outliers:.1f} % of the pixels"
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
    """Residual of one camera's images, the first to the last of a few, from two seeds and four times the samples.

    ``around`` are points (n, 3) in the sensor frame [mm] to whose part of the images it keeps; all of them if None.
    """
    sensor = simulated.sensor
    roi = None if around is None else roi_around(sensor.rig.cameras[camera], around, 0)
    scale = sensor.electrons()
    # the first pattern is often the coarsest and the last the finest
    chosen = np.unique(np.linspace(0, simulated.patterns.count - 1, IMAGES).astype(int))

    def electrons_per_s(number: int, places: int) -> NDArray[np.float32]:
        own = replace(rendering, samples=places)
        images = simulated.radiance(scene, world_from_sensor, camera, own, seed=seed + number, roi=roi)
        some: NDArray[np.float32] = images[chosen]
        del images  # all images of a sensor of 3 megapixels are 164 MB
        some *= np.float32(scale)
        return some

    samples = rendering.samples
    one, other, finer = electrons_per_s(0, samples), electrons_per_s(1, samples), electrons_per_s(2, 4 * samples)
    exposure = sensor.exposure.exposures(finer[np.argmax(finer.mean(axis=(1, 2)))], sensor.imager.full_well)[0]
    lit = (finer > 0) & (finer * np.float32(exposure) < sensor.imager.full_well)
    if not lit.any():
        return RenderResidual(float("nan"), float("nan"), float("nan"))
    one, other, finer = (images[lit] * exposure for images in (one, other, finer))
    temporal = temporal_noise(finer, sensor.imager)
    noise = (one - other) / np.sqrt(2.0) / temporal
    error = (0.5 * (one + other) - finer) / temporal
    size, error_size = np.percentile(np.abs(noise), 68.3), np.percentile(np.abs(error), 68.3)
    # the three renders' own noise is in the error too: half of one's variance, and a quarter
    error_size = np.sqrt(max(error_size**2 - 0.75 * size**2, 0.0))
    return RenderResidual(float(size), float(error_size), float(np.mean(np.maximum(np.abs(noise), np.abs(error)) > 1)))


def told(what: str, residual: RenderResidual) -> RenderResidual:
    """The same residual, once the user has been told that it is over :data:`LIMIT`, if it is."""
    if residual.worst > LIMIT:
        say(f"{what}: {residual}; over {LIMIT}: take more samples_per_pixel")
    return residual


def worst_of(residuals: Iterable[RenderResidual]) -> RenderResidual | None:
    """The worst; None if nothing was lit in any."""
    return max((one for one in residuals if one.worst >= 0), key=lambda one: one.worst, default=None)


def temporal_noise(mean: NDArray[np.floating], imager: Imager) -> NDArray[np.float64]:
    """Standard deviation [e-] of one pixel from image to image at a mean signal [e-] (EMVA 1288, linear model)."""
    quantisation = 1.0 / (np.sqrt(12.0) * imager.gain)
    return np.asarray(np.sqrt(mean + imager.read_noise**2 + imager.row_noise**2 + quantisation**2))
