"""From Ra to the lobe: closed forms, the full diffraction integral, and the table of the prior."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import j0

from mitsim.scene.metals import CONSTANTS, normal_reflectance, refractive_index
from mitsim.scene.roughness import PROCESSES, band_limited_slope, correlation_length, matern, scatter, stylus_slope


def test_coherent_share_is_bennett_and_porteus():
    sigma = np.sqrt(np.pi / 2) * 0.05
    assert np.isclose(scatter(0.05, "ground", 850).coherent, np.exp(-((4 * np.pi * sigma / 0.85) ** 2)))
    assert scatter(0.4, "ground", 850).coherent < 1e-12


def test_matern_of_one_half_is_exponential_and_starts_at_one():
    lag = np.array([0.0, 0.3, 1.0, 4.0])
    assert np.allclose(matern(lag, 0.5), np.exp(-lag), atol=1e-6)


@pytest.mark.parametrize("nu", [0.7, 1.0, 1.5])
def test_band_limited_slope_is_the_integral_of_the_spectrum(nu):
    sigma, length, cutoff = 0.4, 6.0, 2.5
    b = 2 * np.pi * length

    def integrand(f):
        spectrum = sigma**2 * nu * b**2 / np.pi * (1 + (b * f) ** 2) ** (-nu - 1)
        return (2 * np.pi * f) ** 2 * spectrum * 2 * np.pi * f

    assert np.isclose(band_limited_slope(sigma, length, nu, cutoff), np.sqrt(quad(integrand, 0, 1 / cutoff)[0]))


@pytest.mark.parametrize("process", sorted(PROCESSES))
@pytest.mark.parametrize("roughness", [0.05, 0.2, 0.8])
def test_the_correlation_length_gives_the_slope_that_was_asked_for(process, roughness):
    nu = (PROCESSES[process].exponent - 1) / 2
    sigma = np.sqrt(np.pi / 2) * roughness
    wanted = stylus_slope(roughness, process)
    length = correlation_length(sigma, wanted, nu)
    assert np.isclose(band_limited_slope(sigma, length, nu), wanted, rtol=1e-6)


def test_lapped_metal_has_the_tabulated_widths():
    """Table of the reference note for C = 2.6, Beckmann-equivalent alpha at 405, 450, 660, 850 and 940 nm."""
    table = {
        0.05: [0.026, 0.025, 0.024, 0.026, 0.027],
        0.1: [0.050, 0.047, 0.038, 0.033, 0.032],
        0.2: [0.088, 0.085, 0.073, 0.065, 0.061],
        0.4: [0.152, 0.147, 0.129, 0.117, 0.113],
        0.8: [0.257, 0.249, 0.221, 0.204, 0.197],
    }
    for roughness, expected in table.items():
        found = [scatter(roughness, "lapped", wavelength).alpha for wavelength in (405, 450, 660, 850, 940)]
        assert np.allclose(found, expected, atol=0.0006)


def test_the_width_is_that_of_the_diffraction_integral():
    """Median facet slope of the Hankel transform of exp(-g(1-rho)) against 0.833 alpha, for a rough surface."""
    roughness, wavelength = 0.4, 0.85
    light = scatter(roughness, "lapped", 850)
    nu = (PROCESSES["lapped"].exponent - 1) / 2
    g = (4 * np.pi * np.sqrt(np.pi / 2) * roughness / wavelength) ** 2
    lags = np.linspace(0, 6 * wavelength / (2 * np.pi * light.alpha), 4000)
    coherence = np.exp(-g * (1 - matern(lags / light.correlation_um, nu)))
    slopes = np.linspace(0, 1.2, 400)
    density = np.array([
        np.trapezoid(coherence * j0(4 * np.pi / wavelength * slope * lags) * lags, lags) for slope in slopes
    ]) * slopes  # fmt: skip
    energy = np.cumsum(np.maximum(density, 0))
    median = np.interp(0.5, energy / energy[-1], slopes)
    assert np.isclose(median, 0.833 * light.alpha, rtol=0.07)


def test_more_roughness_is_a_wider_lobe():
    for process in PROCESSES:
        widths = [scatter(ra, process, 850).alpha for ra in (0.1, 0.2, 0.4, 0.8)]
        assert widths == sorted(widths)


def test_metals_reflect_as_the_tables_say():
    assert np.isclose(normal_reflectance("aluminium", 850), 0.870, atol=0.001)
    assert np.isclose(normal_reflectance("copper", 450), 0.538, atol=0.001)
    assert np.isclose(normal_reflectance("stainless_steel", 660), 0.669, atol=0.001)
    for metal in CONSTANTS:
        assert 0.3 < normal_reflectance(metal, 700) < 1
    with pytest.raises(ValueError, match="not at 1064 nm"):
        refractive_index("aluminium", 1064)
