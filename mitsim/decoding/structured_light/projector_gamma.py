"""Estimate the projector's gamma from the fringes, and correct the phase error that it causes.

Signal chain: pattern p = mean + contrast cos(phi) -> light a + b p^gamma -> images of N shifts -> their first and
second harmonic, or their mean level between black and white -> gamma -> phase error as a function of the phase ->
corrected phase.

With mean = contrast the second harmonic is (gamma - 1) / (gamma + 2) of the first (Pan, Kemao, Huang and Asundi, Optics
Letters 34(4), 2009). For other fringes the ratio is computed numerically. It is independent of the surface's
reflectance and of ambient light. Blur attenuates the second harmonic more than the first, so the estimated gamma is too
near 1.

The correction by a table of the phase error follows Zhang and Huang, Optical Engineering 46(6), 2007.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from characterisation.files.errors import InputError

#: range of possible gammas
GAMMA_RANGE = (0.2, 5.0)

_SAMPLES = 2048


def estimate_gamma(stack: NDArray[np.generic], mean: float, contrast: float, minimum_modulation: float = 0.0) -> float:
    """Estimate the projector's gamma from N >= 5 equidistant shifts of one period.

    Each pixel's second harmonic is rotated back by twice its own phase. The sums of both harmonics over the pixels are
    then divided. Noise and the third harmonic, which aliases onto the second at N = 5, cancel over the phases. The
    pixels must therefore show all phases about equally often.

    ``stack``: (N, H, W) images [DN]. ``mean``, ``contrast``: of the projected cosine [1]. ``minimum_modulation``: least
    modulation of the pixels that are used [DN]. Raises InputError if there are fewer than five shifts, no pixel has the
    modulation, or no gamma fits.
    """
    steps = len(stack)
    if steps < 5:
        raise InputError("gamma", "steps", steps, "5 or more: fewer do not determine the second harmonic")
    flat = stack.reshape(steps, -1).astype(np.float32)
    delta = 2 * np.pi * np.arange(steps) / steps
    first, second = (np.exp(1j * k * delta).astype(np.complex64) @ flat for k in (1, 2))
    first_magnitude = np.abs(first)
    used = 2 / steps * first_magnitude > max(minimum_modulation, 1e-6)
    if not used.any():
        raise InputError("gamma", "modulation", "no fringes", "a stack that shows fringes")
    first, second, first_magnitude = first[used], second[used], first_magnitude[used]
    ratio = float(np.sum((second * np.conj(first / first_magnitude) ** 2).real) / np.sum(first_magnitude))
    low, high = GAMMA_RANGE
    if not harmonic_ratio(low, mean, contrast) < ratio < harmonic_ratio(high, mean, contrast):
        raise InputError(
            "gamma", "second harmonic", f"{ratio:.3g} of the first", f"the ratio of a gamma of {low} to {high}"
        )
    return float(brentq(lambda gamma: harmonic_ratio(gamma, mean, contrast) - ratio, low, high, xtol=1e-9))


def gamma_from_white(
    offset: NDArray[np.floating],
    white: NDArray[np.generic],
    black: NDArray[np.generic],
    mean: float,
    contrast: float,
    used: NDArray[np.bool_],
) -> float:
    """Estimate gamma from the fringes' mean level between black and white, for any number of steps.

    The mean of (A - black) / (white - black) over all phases equals that of (mean + contrast cos phi)^gamma.
    Reflectance, blur and interreflections do not affect it, since they change all means alike.

    - ``offset``: (H, W) mean level A of the fringes [DN].
    - ``white``, ``black``: (H, W) images of a white and a black frame [DN].
    - ``mean``, ``contrast``: of the projected cosine [1].
    - ``used``: (H, W) pixels to use. They must show all phases about equally often, and exclude pixels whose white is
      saturated.

    Raises InputError if no used pixel is brighter in white than in black, or no gamma fits.
    """
    black_sum = float(black[used].sum(dtype=np.float64))
    range_sum = float(white[used].sum(dtype=np.float64)) - black_sum
    if range_sum <= 0:
        raise InputError("gamma", "white", "no brighter than black", "a white and a black image of lit surfaces")
    ratio = (float(offset[used].sum(dtype=np.float64)) - black_sum) / range_sum
    low, high = GAMMA_RANGE
    if not mean_level(high, mean, contrast) < ratio < mean_level(low, mean, contrast):
        raise InputError("gamma", "mean level", f"{ratio:.3g} of white", f"the level of a gamma of {low} to {high}")
    return float(brentq(lambda gamma: mean_level(gamma, mean, contrast) - ratio, low, high, xtol=1e-9))


def mean_level(gamma: float, mean: float, contrast: float) -> float:
    """Return the mean of (mean + contrast cos phi)^gamma over all phases."""
    phi = 2 * np.pi * (np.arange(_SAMPLES) + 0.5) / _SAMPLES
    return float(np.mean(np.maximum(mean + contrast * np.cos(phi), 0) ** gamma))


def equidistant_order(shifts: NDArray[np.floating]) -> NDArray[np.intp]:
    """Return the order in which shifts [rad] rise by 2 pi / N, starting from the first; InputError if they do not."""
    angle = np.mod(shifts - shifts[0], 2 * np.pi)
    angle[angle > 2 * np.pi - 1e-6] = 0.0
    order = np.argsort(angle)
    if not np.allclose(angle[order], 2 * np.pi * np.arange(len(shifts)) / len(shifts), atol=1e-4):
        degrees = np.round(np.degrees(shifts), 2).tolist()
        raise InputError(
            "gamma", "shifts", f"{degrees} deg", "equidistant steps: the error by gamma is not known for others"
        )
    return order


def harmonic_ratio(gamma: float, mean: float, contrast: float) -> float:
    """Return the signed ratio of the second to the first harmonic of (mean + contrast cos phi)^gamma."""
    phi = 2 * np.pi * (np.arange(_SAMPLES) + 0.5) / _SAMPLES
    light = np.maximum(mean + contrast * np.cos(phi), 0) ** gamma
    return float((light @ np.cos(2 * phi)) / (light @ np.cos(phi)))


def correct_phase(
    phase: NDArray[np.float32], gamma: float, steps: int, mean: float, contrast: float
) -> NDArray[np.float32]:
    """Return phases (...) [rad] without a projector's gamma; ``mean``, ``contrast`` of the projected cosine [1]."""
    true = 2 * np.pi * np.arange(_SAMPLES) / _SAMPLES
    delta = 2 * np.pi * np.arange(steps) / steps
    light = np.maximum(mean + contrast * np.cos(true[:, None] - delta), 0) ** gamma
    error = np.angle((light @ np.exp(1j * delta)) * np.exp(-1j * true))
    # interpolated over the measured phase, not over the true one
    return np.asarray(phase - np.interp(phase, true + error, error, period=2 * np.pi)).astype(np.float32)
