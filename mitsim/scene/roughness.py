r"""From the roughness average Ra to the shape of the light that a machined metal scatters.

Signal chain: Ra -> Rq (Gaussian heights) -> lateral scale l, such that the slope seen by a stylus follows a prior
for the process -> height autocorrelation rho(tau) -> wave optics at the sensor's wavelength -> coherent share A and
lobe width alpha.

Ra alone does not fix the scattering: the lateral scale is needed too. Until the user gives it, it comes from a prior
with a one-sigma factor of 1.6, an engineering judgement between four published slope laws (Tanner & Fahoum, Wear 36,
1976; Antonetti; Yovanovich; Lambert & Fletcher, as reviewed by Bahrami et al., Appl. Mech. Rev. 59, 2006).

Symbols: sigma = Rq, lambda the wavelength, g = (4 pi sigma / lambda)^2, A = exp(-g) the coherent share (Bennett &
Porteus, JOSA 51, 1961), C the exponent of the power spectral density, nu = (C - 1)/2 the Matern smoothness.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq
from scipy.special import gamma, kv

#: shortest spatial wavelength that a stylus instrument resolves [um] (ISO 3274: lambda_s of the usual set-up)
STYLUS_CUTOFF_UM = 2.5

#: GGX lobe whose median slope equals that of a Beckmann lobe of width 1
GGX_PER_BECKMANN = 0.833

#: one-sigma factor of alpha when only Ra and the process are known
PRIOR_FACTOR = 1.6

ALPHA_LARGEST = 0.5


@dataclass(frozen=True)
class Process:
    """Prior of a machining process: slope relative to the default, PSD exponent C, usual range of Ra [um]."""

    slope: float
    exponent: float
    usual: tuple[float, float]


#: engineering priors, to be replaced by measurement; lay (anisotropy) is not in them yet
PROCESSES: dict[str, Process] = {
    "polished": Process(1.0, 2.4, (0.01, 0.1)),
    "lapped": Process(1.0, 2.6, (0.03, 0.4)),
    "ground": Process(1.1, 2.5, (0.05, 1.6)),
    "brushed": Process(1.0, 2.6, (0.2, 1.0)),
    "rolled": Process(0.7, 2.6, (0.05, 0.5)),
    "bead_blasted": Process(1.0, 3.5, (0.3, 2.0)),
    "grit_blasted": Process(1.2, 3.0, (1.0, 6.0)),
    "edm": Process(1.2, 3.0, (0.13, 6.0)),
}


@dataclass(frozen=True)
class Scatter:
    """How a rough metal scatters at one wavelength.

    ``coherent`` share A of the light that is reflected as by a mirror [1]; ``alpha`` of the incoherent lobe in
    Beckmann's sense [1]; ``beckmann`` share of that lobe which is Beckmann rather than GGX [1]; ``correlation_um``
    the lateral scale l [um]; ``alpha_factor`` its one-sigma factor.
    """

    coherent: float
    alpha: float
    beckmann: float
    correlation_um: float
    alpha_factor: float

    @property
    def alpha_ggx(self) -> float:
        """Width of the GGX lobe with the same median slope."""
        return GGX_PER_BECKMANN * self.alpha


def stylus_slope(roughness_um: float, process: str) -> float:
    """Rms gradient Sdq [1] that an instrument with a 2.5 um cut-off would report: 0.195 Ra^0.6, by process."""
    return float(min(0.195 * roughness_um**0.6 * PROCESSES[process].slope, ALPHA_LARGEST))


def matern(lag: np.ndarray, nu: float) -> np.ndarray:
    """Matern autocorrelation rho at lag tau/l [1]; rho(0) = 1."""
    lag = np.maximum(np.asarray(lag, float), 1e-12)
    return np.asarray(2 ** (1 - nu) / gamma(nu) * lag**nu * kv(nu, lag))


def band_limited_slope(sigma_um: float, correlation_um: float, nu: float, cutoff_um: float = STYLUS_CUTOFF_UM) -> float:
    """Sdq [1] of a Matern surface, counting spatial wavelengths above ``cutoff_um`` only.

    Its two-dimensional spectrum is S(f) = sigma^2 nu B^2 / pi (1 + B^2 f^2)^-(nu + 1), B = 2 pi l; the slope is the
    root of the integral of (2 pi f)^2 S over the disc f < 1 / cutoff.
    """
    x = (2 * np.pi * correlation_um / cutoff_um) ** 2

    def antiderivative(t: float) -> float:
        power = np.log1p(t) if abs(nu - 1) < 1e-9 else (1 + t) ** (1 - nu) / (1 - nu)
        return float(power + (1 + t) ** -nu / nu)

    return float(sigma_um / correlation_um * np.sqrt(nu * (antiderivative(x) - antiderivative(0.0))))


def correlation_length(sigma_um: float, slope: float, nu: float) -> float:
    """Lateral scale l [um] at which the band-limited slope is ``slope``.

    Of the two solutions the longer is taken: below about half a micrometre the surface's slopes lie beyond the
    cut-off, and a stylus would see ever less of them.
    """
    lengths = np.geomspace(1e-2, 1e5, 400)
    slopes = np.array([band_limited_slope(sigma_um, length, nu) for length in lengths])
    steepest = int(np.argmax(slopes))
    if slope >= slopes[steepest]:
        return float(lengths[steepest])

    def excess(log_length: float) -> float:
        return float(np.log(band_limited_slope(sigma_um, np.exp(log_length), nu) / slope))

    return float(np.exp(brentq(excess, np.log(lengths[steepest]), np.log(1e5))))


def scatter(roughness_um: float, process: str, wavelength_nm: float, alpha_factor: float = 1.0) -> Scatter:
    """Scatter of a metal of known Ra [um] and process at one wavelength [nm], light near normal incidence.

    The lag tau* at which the coherence [exp(-g (1 - rho)) - A] / (1 - A) has fallen to 1/e gives the width,
    alpha = lambda / (2 pi tau*). For a Gaussian rho and a rough surface this is the geometric alpha = 2 Rq / l.
    ``alpha_factor`` multiplies alpha, to carry the prior's uncertainty.
    """
    exponent = PROCESSES[process].exponent
    nu = (exponent - 1) / 2
    sigma = np.sqrt(np.pi / 2) * roughness_um
    wavelength_um = wavelength_nm * 1e-3
    g = (4 * np.pi * sigma / wavelength_um) ** 2
    coherent = float(np.exp(-g))
    length = correlation_length(sigma, stylus_slope(roughness_um, process), nu)

    def excess(log_lag: float) -> float:
        rho = float(matern(np.exp(log_lag) / length, nu))
        return float((np.exp(-g * (1 - rho)) - coherent) / (1 - coherent) - np.exp(-1))

    lag = float(np.exp(brentq(excess, np.log(1e-6 * length), np.log(50 * length))))
    alpha = min(wavelength_um / (2 * np.pi * lag) * alpha_factor, ALPHA_LARGEST)
    beckmann = float(np.interp(exponent, [2.4, 2.6, 3.0, 3.5], [0.0, 0.3, 0.6, 1.0]))
    return Scatter(coherent, alpha, beckmann, length, PRIOR_FACTOR)
