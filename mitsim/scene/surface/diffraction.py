"""Compute the specular share of light and the width of the lobe of a rough surface by wave optics.

    g = (4 pi sigma cos(theta) / lambda)^2        A = exp(-g)
    [exp(-g (1 - rho(tau*))) - A] / (1 - A) = 1/e        alpha = lambda / (2 pi tau*)       at normal incidence

A at normal incidence is that of Bennett and Porteus (JOSA 51, 123, 1961). At the angle of incidence theta it is that of
Beckmann and Spizzichino ("The Scattering of Electromagnetic Waves from Rough Surfaces", 1963, chapter 5). Their phase
variance of a pair of directions uses the mean of the two cosines. It holds while facets do not shadow one another, up
to about 75 deg. The width holds near normal incidence.

The incoherent far field is the Fourier transform of exp(-g (1 - rho)) - A (Beckmann-Kirchhoff), so its width follows
from the lag tau* at which the coherence has fallen to 1/e. The median facet slope of the full transform is 0.833 alpha
to 5 %. For a Gaussian rho and a rough surface alpha is the geometric 2 sigma / l. rho may be any function of the lag,
or samples from a measurement. The model does not apply to periodic surfaces: they diffract into orders, and exp(-g)
does not hold for them (Wu et al., 2011).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import brentq

#: autocorrelation of heights at a lag [um]
Autocorrelation = Callable[[NDArray[np.float64]], NDArray[np.float64]]


def phase_variance(sigma_um: float, wavelength_nm: float, incidence: float = 0.0) -> float:
    """Return the variance g [rad^2] of the phase that heights of rms ``sigma_um`` cause at ``incidence`` [rad]."""
    return float((4 * np.pi * sigma_um * np.cos(incidence) / (wavelength_nm * 1e-3)) ** 2)


def coherent_share(sigma_um: float, wavelength_nm: float, incidence: float = 0.0) -> float:
    """Return the share A [1] of the reflected light that is specular: exp(-g)."""
    return float(np.exp(-phase_variance(sigma_um, wavelength_nm, incidence)))


def lobe_alpha(autocorrelation: Autocorrelation, sigma_um: float, wavelength_nm: float) -> float:
    """Return alpha [1], in Beckmann's sense, of the incoherent light along the direction of the lags.

    Raises ValueError if the autocorrelation never falls far enough (a profile too short for its waviness), or falls
    within the shortest lag (noise).
    """
    g = phase_variance(sigma_um, wavelength_nm)

    def excess(log_lag: ArrayLike) -> NDArray[np.float64]:
        rho = np.maximum(autocorrelation(np.exp(np.asarray(log_lag, float))), 0.0)
        # [exp(-g (1 - rho)) - A] / (1 - A) written without cancellation for a smooth surface
        return np.asarray(np.exp(-g * (1 - rho)) * np.expm1(-g * rho) / np.expm1(-g) - np.exp(-1))

    logs = np.log(np.geomspace(1e-4, 1e5, 400))
    fallen = np.flatnonzero(excess(logs) < 0)
    if not len(fallen):
        raise ValueError("heights whose autocorrelation does not fall far enough for light to lose its coherence")
    if fallen[0] == 0:
        raise ValueError("uncorrelated neighbouring heights: noise, or too coarse a spacing")
    lag = np.exp(brentq(lambda x: float(excess(x)), logs[fallen[0] - 1], logs[fallen[0]], xtol=1e-9))
    return float(wavelength_nm * 1e-3 / (2 * np.pi * lag))


def sampled(lags_um: ArrayLike, rho: ArrayLike) -> Autocorrelation:
    """Return the autocorrelation as a function, from samples at increasing lags > 0 [um].

    1 - rho, the structure function, is interpolated as a power of the lag. Below the first lag it continues with the
    power of the first two, because the lags that matter for light (tau* of 0.5 to 3 um) are often finer than the
    instrument's. Beyond the last lag rho is constant.
    """
    log_lags = np.log(np.asarray(lags_um, float))
    log_structure = np.log(np.maximum(1 - np.asarray(rho, float), 1e-12))
    # the exponent of a surface lies between 0 (white noise) and 2 (smooth)
    power = float(np.clip((log_structure[1] - log_structure[0]) / (log_lags[1] - log_lags[0]), 0.0, 2.0))

    def autocorrelation(lag: NDArray[np.float64]) -> NDArray[np.float64]:
        log_lag = np.log(np.maximum(np.asarray(lag, float), 1e-300))
        inside = np.interp(log_lag, log_lags, log_structure)
        below = log_structure[0] + power * (log_lag - log_lags[0])
        return np.asarray(1 - np.exp(np.where(log_lag < log_lags[0], below, inside)))

    return autocorrelation
