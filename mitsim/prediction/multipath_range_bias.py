r"""By how much light by way of other surfaces lengthens a path that is measured by the time of flight.

Signal chain: correlations of direct light, and of light by way of other surfaces
(:mod:`mitsim.prediction.other_light`) -> complex amplitudes A_1 and A_2 at every frequency -> A_2 as it stands to the
phase of A_1, smoothed over one face -> its ratio z to A_1 -> phases, with and without arg(1 + z) -> the sensor's own
decoder (:func:`mitsim.decode.time_of_flight.joint_path`) -> path that is too long, and whether the phases still agree.

A time-of-flight imager adds amplitudes: a phase is that of A_1 + A_2, where A_2 has taken a longer way. So a hollow
face, or one beside another, is seen too far away ("multipath"; Fuchs, ICPR 2010, recalled). Nothing in it is fitted.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mitsim.decode.time_of_flight import joint_path
from mitsim.prediction.predictor import Ideal
from mitsim.sensor.imager import Imager
from mitsim.sensor.modulation import AmplitudeModulation, TimeOfFlightSettings, sample_variance
from mitsim.simulation.indirect_light import smoothed

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]

#: standard deviation of the window over which A_2 is a mean [px] of the sensor: as narrow as captures are rendered
#: with, since a wider one flattens the gradients beside a corner
WINDOW_PX = 1.5


def path_amplitudes(images: NDArray[np.floating], code: AmplitudeModulation) -> Complex:
    """Complex amplitude (F, H, W) of the correlations (P, H, W); its argument is the phase."""
    each = np.asarray(images, float).reshape(-1, code.steps, *images.shape[1:])
    return np.asarray(np.einsum("k,fkij->fij", np.exp(1j * code.delays) * 2 / code.steps, each))


def path_bias(
    direct: Complex,
    other: Complex,
    code: AmplitudeModulation,
    settings: TimeOfFlightSettings,
    imager: Imager,
    shape: NDArray[np.integer],
    step: int,
) -> tuple[Floats, Floats]:
    """Path (H, W) [mm] by which points are read too far, 0 without direct light; and 1 where no path fits the phases.

    ``direct`` and ``other`` (F, H, W) [DN]; ``shape`` (H, W) that a pixel shows, -1 nothing; ``step`` pixels of the
    sensor make one.
    """
    size, own = np.abs(direct), np.angle(direct)
    turned = other * np.exp(-1j * own)
    layers = np.concatenate([turned.real, turned.imag]).astype(np.float32)
    mean = smoothed(layers, shape, WINDOW_PX / step).astype(float)
    with np.errstate(divide="ignore", invalid="ignore"):
        z = (mean[: len(size)] + 1j * mean[len(size) :]) / size
    lit = np.isfinite(z).all(axis=0)
    z = np.where(lit, z, 0.0)
    noise = np.stack(
        [
            sample_variance(one, float(contrast), imager) * 2 / code.steps / np.maximum(one, 1e-3) ** 2
            for one, contrast in zip((size * np.abs(1 + z)).astype(np.float32), code.contrasts, strict=True)
        ]
    ).astype(np.float32)
    nominal, read = (
        joint_path(np.mod(phase, 2 * math.pi).astype(np.float32), noise, code, settings.systematic_rad)
        for phase in (own, own + np.angle(1 + z))
    )
    refused = lit & (read[2] > settings.consistency_sigma**2)
    return np.where(lit, read[0] - nominal[0], 0.0), refused.astype(float)


def range_bias(path: Floats, lamp: NDArray[np.floating], ideal: Ideal) -> Floats:
    """Depth (n,) [mm] along their rays by which points lie too far whose path (n,) [mm] is read too long.

    ``lamp`` (3,) [mm] in the sensor frame, p; the path is t + |t d - p| at a distance t on a ray d.
    """
    from_lamp = ideal.point - lamp
    cosine = (ideal.ray * from_lamp).sum(1) / np.linalg.norm(from_lamp, axis=1)
    return np.asarray(path / (1 + cosine))
