r"""Bias of a time-of-flight path by interreflections.

Signal chain: correlations of direct light and of interreflections (:mod:`mitsim.maps.prediction.interreflections`) ->
complex amplitudes A_1 and A_2 at every frequency -> A_2 relative to the phase of A_1, smoothed over one face -> its
ratio z to A_1 -> phases with and without arg(1 + z) -> the sensor's decoder
(:func:`mitsim.decoding.time_of_flight.joint_path`) -> bias of the path, whether the decoder rejects the phases, and its
sigma with A_1 + A_2 over that with A_1.

A time-of-flight imager adds amplitudes: it measures the phase of A_1 + A_2, where A_2 has travelled a longer path. A
concave face, or one next to another, therefore appears too far away ("multipath"; Fuchs, ICPR 2010, recalled). Where
the two are nearly in phase the amplitude grows, and the noise falls. The model has no fitted constants.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from characterisation.files.arrays import Floats
from mitsim.capture.simulated.indirect_light import smoothed
from mitsim.decoding.time_of_flight import joint_path
from mitsim.maps.prediction.perturbation import Ideal
from mitsim.sensor.imager import Imager
from mitsim.sensor.modulation import AmplitudeModulation, TimeOfFlightSettings, sample_variance

Complex = NDArray[np.complex128]

#: standard deviation of the window that averages A_2 [px] of the sensor, equal to that of rendered captures; a wider
#: window flattens the gradients next to a corner
WINDOW_PX = 1.5


def path_amplitudes(images: NDArray[np.floating], code: AmplitudeModulation) -> Complex:
    """Return the complex amplitude (F, H, W) of the correlations (P, H, W); its argument is the phase."""
    by_frequency = np.asarray(images, float).reshape(-1, code.steps, *images.shape[1:])
    return np.asarray(np.einsum("k,fkij->fij", np.exp(1j * code.delays) * 2 / code.steps, by_frequency))


def path_bias(
    direct: Complex,
    other: Complex,
    code: AmplitudeModulation,
    settings: TimeOfFlightSettings,
    imager: Imager,
    shape: NDArray[np.integer],
    step: int,
) -> tuple[Floats, Floats, Floats]:
    """Return the bias of the path [mm], whether the decoder rejects the phases, 1 or 0, and a factor on sigma; (H, W).

    Without direct light the bias is 0 and the factor 1. ``direct`` and ``other`` are A_1 and A_2 (F, H, W) [DN];
    ``shape`` (H, W) that of a pixel, -1 for none; ``step`` the number of sensor pixels per pixel along an axis.
    """
    size, direct_phase = np.abs(direct), np.angle(direct)
    turned = other * np.exp(-1j * direct_phase)
    layers = np.concatenate([turned.real, turned.imag]).astype(np.float32)
    mean = smoothed(layers, shape, WINDOW_PX / step).astype(float)
    with np.errstate(divide="ignore", invalid="ignore"):
        z = (mean[: len(size)] + 1j * mean[len(size) :]) / size
    lit = np.isfinite(z).all(axis=0)
    z = np.where(lit, z, 0.0)

    def decoded(phase: Floats, amplitude: Floats) -> tuple[Floats, NDArray[np.float32], NDArray[np.float32]]:
        """Return path, sigma and disagreement (H, W) of phases and amplitudes [DN] (F, H, W)."""
        noise = [
            sample_variance(level, float(contrast), imager) * 2 / code.steps / np.maximum(level, 1e-3) ** 2
            for level, contrast in zip(amplitude.astype(np.float32), code.contrasts, strict=True)
        ]
        within = np.mod(phase, 2 * math.pi).astype(np.float32)
        return joint_path(within, np.stack(noise).astype(np.float32), code, settings.systematic_rad)

    nominal, read = decoded(direct_phase, size), decoded(direct_phase + np.angle(1 + z), size * np.abs(1 + z))
    rejected = lit & (read[2] > settings.consistency_sigma**2)
    noisier = np.where(lit, read[1] / nominal[1], 1.0)
    return np.where(lit, read[0] - nominal[0], 0.0), rejected.astype(float), noisier.astype(float)


def range_bias(path: Floats, light_source: NDArray[np.floating], ideal: Ideal) -> Floats:
    """Return the range bias (n,) [mm] along the rays for a path bias ``path`` (n,) [mm]; positive is too far.

    ``light_source`` (3,) [mm] is its position p in the sensor frame. The path is t + |t d - p| for a distance t on a
    ray d.
    """
    from_source = ideal.point - light_source
    cosine = (ideal.ray * from_source).sum(1) / np.linalg.norm(from_source, axis=1)
    return np.asarray(path / (1 + cosine))
