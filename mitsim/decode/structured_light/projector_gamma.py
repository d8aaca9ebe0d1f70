"""The projector's gamma: from the harmonics that it puts into the fringes, and out of the phase again.

Signal chain: pattern p = mean + contrast cos(phi) -> light a + b p^gamma -> images of N shifts -> their first and
second harmonic -> gamma; and gamma -> error of the phase as a function of the phase -> corrected phase.

With mean = contrast the second harmonic is (gamma - 1) / (gamma + 2) of the first (Pan, Kemao, Huang and Asundi, Optics
Letters 34(4), 2009); for other fringes the ratio is computed. Neither the surface's reflectance nor ambient light
changes it. Blur does: it takes more from the second harmonic, so gamma comes out nearer to 1 than it is. The correction
by a table of the phase error is that of Zhang and Huang, Optical Engineering 46(6), 2007.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from characterisation.errors import InputError

#: gammas that are looked for
GAMMA_RANGE = (0.2, 5.0)

_SAMPLES = 2048


def estimate_gamma(stack: NDArray[np.generic], mean: float, contrast: float, minimum_modulation: float = 0.0) -> float:
    """Gamma of the projector from the N >= 5 equidistant shifts of one period, (N, H, W) [DN].

    Each pixel's second harmonic is turned back by twice its own phase, and the sums over all pixels of at least
    ``minimum_modulation`` [DN] are divided: what noise and third harmonics (they alias onto the second at N = 5) add
    cancels over the phases. The pixels must show all phases about equally often.

    Raises
    ------
    InputError
        If there are fewer than five shifts, no pixel has the modulation, or no gamma fits.
    """
    steps = len(stack)
    if steps < 5:
        raise InputError("gamma", "steps", steps, "5 or more: with fewer, the second harmonic cannot be told")
    flat = stack.reshape(steps, -1).astype(np.float32)
    delta = 2 * np.pi * np.arange(steps) / steps
    first, second = (np.exp(1j * k * delta).astype(np.complex64) @ flat for k in (1, 2))
    strength = np.abs(first)
    used = 2 / steps * strength > max(minimum_modulation, 1e-6)
    if not used.any():
        raise InputError("gamma", "modulation", "no fringes", "a stack that shows fringes")
    first, second, strength = first[used], second[used], strength[used]
    ratio = float(np.sum((second * np.conj(first / strength) ** 2).real) / np.sum(strength))
    low, high = GAMMA_RANGE
    if not harmonic_ratio(low, mean, contrast) < ratio < harmonic_ratio(high, mean, contrast):
        raise InputError("gamma", "second harmonic", f"{ratio:.3g} of the first", f"that of a gamma of {low} to {high}")
    return float(brentq(lambda gamma: harmonic_ratio(gamma, mean, contrast) - ratio, low, high, xtol=1e-9))


def gamma_from_white(
    offset: NDArray[np.floating],
    white: NDArray[np.generic],
    black: NDArray[np.generic],
    mean: float,
    contrast: float,
    used: NDArray[np.bool_],
) -> float:
    """Gamma from the fringes' mean level between black and white, for any number of steps.

    (A - black) / (white - black) is, in the mean over all phases, that of (mean + contrast cos phi)^gamma. Neither
    reflectance, nor blur, nor light by way of other surfaces changes it: all of them act on the means alike. A pixel
    whose white is saturated does, so give ``used`` (H, W) without them; it must show all phases about equally often.

    Raises
    ------
    InputError
        If no pixel is used, or no gamma fits.
    """
    bottom = float(black[used].sum(dtype=np.float64))
    span = float(white[used].sum(dtype=np.float64)) - bottom
    if span <= 0:
        raise InputError("gamma", "white", "no brighter than black", "a white and a black image of lit surfaces")
    ratio = (float(offset[used].sum(dtype=np.float64)) - bottom) / span
    low, high = GAMMA_RANGE
    if not mean_level(high, mean, contrast) < ratio < mean_level(low, mean, contrast):
        raise InputError("gamma", "mean level", f"{ratio:.3g} of white", f"that of a gamma of {low} to {high}")
    return float(brentq(lambda gamma: mean_level(gamma, mean, contrast) - ratio, low, high, xtol=1e-9))


def mean_level(gamma: float, mean: float, contrast: float) -> float:
    """Mean of (mean + contrast cos phi)^gamma over all phases."""
    phi = 2 * np.pi * (np.arange(_SAMPLES) + 0.5) / _SAMPLES
    return float(np.mean(np.maximum(mean + contrast * np.cos(phi), 0) ** gamma))


def equidistant_order(shifts: NDArray[np.floating]) -> NDArray[np.intp]:
    """Order in which shifts [rad] rise by 2 pi / N from the first of them on.

    Raises
    ------
    InputError
        If they are not equidistant.
    """
    turn = np.mod(shifts - shifts[0], 2 * np.pi)
    turn[turn > 2 * np.pi - 1e-6] = 0.0
    order = np.argsort(turn)
    if not np.allclose(turn[order], 2 * np.pi * np.arange(len(shifts)) / len(shifts), atol=1e-4):
        found = np.round(np.degrees(shifts), 2).tolist()
        raise InputError("gamma", "shifts", f"{found} deg", "equidistant steps: of others gamma's error is not known")
    return order


def harmonic_ratio(gamma: float, mean: float, contrast: float) -> float:
    """Second harmonic of (mean + contrast cos phi)^gamma over its first, signed."""
    phi = 2 * np.pi * (np.arange(_SAMPLES) + 0.5) / _SAMPLES
    light = np.maximum(mean + contrast * np.cos(phi), 0) ** gamma
    return float((light @ np.cos(2 * phi)) / (light @ np.cos(phi)))


def phase_error(gamma: float, steps: int, mean: float, contrast: float) -> NDArray[np.float64]:
    """Error of the N-step phase [rad] that gamma causes, at ``_SAMPLES`` true phases from 0 on."""
    phi = 2 * np.pi * np.arange(_SAMPLES) / _SAMPLES
    delta = 2 * np.pi * np.arange(steps) / steps
    light = np.maximum(mean + contrast * np.cos(phi[:, None] - delta), 0) ** gamma
    return np.asarray(np.angle((light @ np.exp(1j * delta)) * np.exp(-1j * phi)))


def correct_phase(
    phase: NDArray[np.float32], gamma: float, steps: int, mean: float, contrast: float
) -> NDArray[np.float32]:
    """Phase (...) [rad] without the error that ``gamma`` caused in ``steps`` equidistant steps."""
    true = 2 * np.pi * np.arange(_SAMPLES) / _SAMPLES
    error = phase_error(gamma, steps, mean, contrast)
    # the error is wanted where a phase was measured, not where it is true
    return np.asarray(phase - np.interp(phase, true + error, error, period=2 * np.pi)).astype(np.float32)
