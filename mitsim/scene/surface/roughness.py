r"""Derive the autocorrelation of a face's heights from its roughness.

Signal chain: Ra -> Rq (Gaussian heights) -> lateral scale l, so that the slope seen by a stylus is the measured one
(Rdq, RSm) or follows a prior for the process -> height autocorrelation rho(tau).

Ra alone does not determine the scattering; the lateral scale is needed too (Le Bohec et al., Optik, 2024, for metal
samples). Unless given, it comes from a prior with a one-sigma factor of 1.6. The prior is an engineering judgement
between four published slope laws (Tanner & Fahoum, Wear 36, 1976; Antonetti; Yovanovich; Lambert & Fletcher, as
reviewed by Bahrami et al., Appl. Mech. Rev. 59, 2006).

Symbols: sigma = Rq; C the exponent of the power spectral density; nu = (C - 1)/2 the Matern smoothness; alpha the
width of the slope distribution in Beckmann's sense. alpha is the rms gradient of an isotropic surface (Sdq), sqrt(2)
times the rms slope of a profile across it (Rdq).
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import brentq
from scipy.special import gamma, kv

from mitsim.scene.surface.processes import PROCESSES

#: shortest spatial wavelength that a stylus instrument resolves [um] (ISO 3274: lambda_s of the usual set-up)
STYLUS_CUTOFF_UM = 2.5

#: alpha beyond which neither the prior nor single-scattering lobes are valid
ALPHA_LARGEST = 0.5


def rms_height(roughness_um: float) -> float:
    """Return Rq [um] of Gaussian heights of mean deviation Ra [um]: sqrt(pi / 2) Ra."""
    return float(np.sqrt(np.pi / 2) * roughness_um)


def stylus_slope(roughness_um: float, process: str) -> float:
    """Return alpha [1] across the lay as seen by an instrument with a 2.5 um cut-off: 0.195 Ra^0.6, by process."""
    return float(min(0.195 * roughness_um**0.6 * PROCESSES[process].slope, ALPHA_LARGEST))


def slope_of_spacing(sigma_um: float, spacing_um: float) -> float:
    """Return the rms slope Rdq [1] of a random profile of rms height Rq and mean spacing RSm [um]: 2 pi Rq / RSm.

    This follows from Rice's mean rate of upward zero crossings of a Gaussian profile. The RSm of instruments ignores
    small peaks, so the slope is a lower bound.
    """
    return 2 * np.pi * sigma_um / spacing_um


def matern(lag: ArrayLike, nu: float) -> NDArray[np.float64]:
    """Return the Matern autocorrelation rho at lag tau/l [1]; rho(0) = 1."""
    x: NDArray[np.float64] = np.maximum(np.asarray(lag, float), 1e-12)
    return np.asarray(2 ** (1 - nu) / gamma(nu) * x**nu * kv(nu, x))


def band_limited_slope(sigma_um: float, correlation_um: float, nu: float, cutoff_um: float = STYLUS_CUTOFF_UM) -> float:
    """Return Sdq [1] of a Matern surface from its spatial wavelengths above ``cutoff_um`` only.

    Its spectrum is S(f) = sigma^2 nu B^2 / pi (1 + B^2 f^2)^-(nu + 1), B = 2 pi l, with Rq ``sigma_um``, lateral scale
    l and smoothness ``nu`` [1]. The slope is the root of the integral of (2 pi f)^2 S over the disc f < 1 / cutoff.
    """
    x = (2 * np.pi * correlation_um / cutoff_um) ** 2

    def antiderivative(t: float) -> float:
        power = np.log1p(t) if abs(nu - 1) < 1e-9 else (1 + t) ** (1 - nu) / (1 - nu)
        return float(power + (1 + t) ** -nu / nu)

    return float(sigma_um / correlation_um * np.sqrt(nu * (antiderivative(x) - antiderivative(0.0))))


@lru_cache(maxsize=1024)
def correlation_length(sigma_um: float, slope: float, nu: float) -> float:
    """Return the lateral scale l [um] at which the band-limited slope is ``slope``.

    Of the two solutions it is the longer one: below about half a micrometre the surface's slopes lie beyond the
    cut-off, where a stylus sees less and less of them. If the slope is steeper than every scale gives, the result is
    the scale of the steepest slope.
    """
    lengths = np.geomspace(1e-2, 1e5, 400)
    slopes = np.array([band_limited_slope(sigma_um, length, nu) for length in lengths])
    steepest = int(np.argmax(slopes))
    if slope >= slopes[steepest]:
        return float(lengths[steepest])

    def excess(log_length: float) -> float:
        return float(np.log(band_limited_slope(sigma_um, np.exp(log_length), nu) / slope))

    return float(np.exp(brentq(excess, np.log(lengths[steepest]), np.log(1e5))))
