"""The closed form of the lobe's width against the full diffraction integral, and its limits."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import brentq
from scipy.special import j1

from mitsim.scene.surface.diffraction import coherent_share, lobe_alpha, phase_variance, sampled
from mitsim.scene.surface.roughness import correlation_length, matern, rms_height


def gaussian(length):
    return lambda lag: np.exp(-((lag / length) ** 2))


def test_coherent_share_is_bennett_and_porteus():
    sigma = np.sqrt(np.pi / 2) * 0.05
    assert np.isclose(coherent_share(sigma, 850), np.exp(-((4 * np.pi * sigma / 0.85) ** 2)))
    assert coherent_share(rms_height(0.4), 850) < 1e-12
    assert np.isclose(coherent_share(2 * sigma, 850, np.radians(60)), coherent_share(sigma, 850))


def median_slope(rho, sigma, wavelength_um, guess):
    """Facet slope inside which half the incoherent light falls, from the full Hankel transform.

    The energy inside |v| < V of the transform of C(tau) is V times the integral of C(tau) J1(V tau), and
    v = 4 pi s / lambda for facets of slope s.
    """
    g = (4 * np.pi * sigma / wavelength_um) ** 2
    lags = np.concatenate([[0], np.geomspace(1e-4, 2e3, 100_000)])
    coherence = np.exp(-g * (1 - rho(lags))) * np.expm1(-g * rho(lags)) / np.expm1(-g)
    last = np.searchsorted(-coherence, -1e-9)
    lags, coherence = lags[:last], coherence[:last]

    def excess(slope):
        v = 4 * np.pi / wavelength_um * slope
        return v * np.trapezoid(coherence * j1(v * lags), lags) - 0.5

    return brentq(excess, guess / 3, 3 * guess, rtol=1e-4)


@pytest.mark.parametrize("exponent", [2.2, 2.6, 3.0, 4.0])
@pytest.mark.parametrize("wavelength", [450.0, 850.0])
def test_the_width_is_that_of_the_diffraction_integral(exponent, wavelength):
    """Median facet slope over sqrt(ln 2) alpha: within 5 % for Ra 0.05 to 0.8 um."""
    nu = (exponent - 1) / 2
    for roughness in (0.05, 0.1, 0.2, 0.4, 0.8):
        sigma = rms_height(roughness)
        length = correlation_length(sigma, 0.195 * roughness**0.6, nu)

        def rho(lag, length=length):
            return matern(lag / length, nu)

        alpha = lobe_alpha(rho, sigma, wavelength)
        median = median_slope(rho, sigma, wavelength * 1e-3, 0.83 * alpha)
        assert abs(median / (np.sqrt(np.log(2)) * alpha) - 1) < 0.05, roughness


@given(st.floats(0.5, 5.0), st.floats(5.0, 50.0))
def test_a_rough_gaussian_surface_has_the_slope_of_geometry(sigma, length):
    """alpha = 2 sigma / l up to 1 / (4 g), the next term in the series of the closed form."""
    expected = 2 * sigma / length
    g = phase_variance(sigma, 850.0)
    assert np.isclose(lobe_alpha(gaussian(length), sigma, 850.0), expected, rtol=1 / (3 * g))


def test_incoherent_light_of_a_smooth_gaussian_surface_spreads_as_its_spectrum():
    """g -> 0: the coherence is rho itself, which falls to 1/e at l, so alpha = lambda / (2 pi l)."""
    assert np.isclose(lobe_alpha(gaussian(3.0), 1e-3, 850.0), 0.85 / (2 * np.pi * 3.0), rtol=1e-3)


@pytest.mark.parametrize("roughness", [0.1, 0.4])
def test_samples_say_what_the_function_says(roughness):
    """At the 0.5 um of a good instrument, with tau* down to 0.42 um: below it 1 - rho is continued as a power."""
    sigma = rms_height(roughness)
    for rho in (gaussian(8.0), lambda lag: matern(lag / 8.0, 0.7)):
        lags = np.arange(1, 200) * 0.5
        assert np.isclose(lobe_alpha(sampled(lags, rho(lags)), sigma, 850.0), lobe_alpha(rho, sigma, 850.0), rtol=0.03)


def test_heights_that_never_decorrelate_are_refused():
    with pytest.raises(ValueError, match="does not fall"):
        lobe_alpha(lambda lag: np.ones_like(lag), 0.4, 850.0)


def test_white_heights_are_refused():
    with pytest.raises(ValueError, match="uncorrelated"):
        lobe_alpha(sampled([1.0, 2.0, 3.0], [0.0, 0.0, 0.0]), 0.4, 850.0)
