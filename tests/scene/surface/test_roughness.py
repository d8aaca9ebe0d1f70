"""From Ra to heights, slopes and their autocorrelation: closed forms and the integral of the spectrum."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad

from mitsim.scene.surface.processes import PROCESSES, feed, feed_slope, micro_roughness
from mitsim.scene.surface.roughness import (
    band_limited_slope,
    correlation_length,
    matern,
    rms_height,
    slope_of_spacing,
    stylus_slope,
)
from tests.figures_of_surfaces import short_wave_height


def test_matern_of_one_half_is_exponential_and_starts_at_one():
    lag = np.array([0.0, 0.3, 1.0, 4.0])
    assert np.allclose(matern(lag, 0.5), np.exp(-lag), atol=1e-6)


def spectrum(frequency, sigma, length, nu):
    b = 2 * np.pi * length
    return sigma**2 * nu * b**2 / np.pi * (1 + (b * frequency) ** 2) ** (-nu - 1)


@pytest.mark.parametrize("nu", [0.7, 1.0, 1.5])
def test_band_limited_slope_is_the_integral_of_the_spectrum(nu):
    sigma, length, cutoff = 0.4, 6.0, 2.5

    def integrand(f):
        return (2 * np.pi * f) ** 2 * spectrum(f, sigma, length, nu) * 2 * np.pi * f

    assert np.isclose(band_limited_slope(sigma, length, nu, cutoff), np.sqrt(quad(integrand, 0, 1 / cutoff)[0]))


@pytest.mark.parametrize("nu", [0.7, 1.0, 1.5])
def test_height_of_short_waves_is_the_rest_of_the_spectrum(nu):
    sigma, length, longest = 0.4, 6.0, 30.0
    long_waves = quad(lambda f: spectrum(f, sigma, length, nu) * 2 * np.pi * f, 0, 1 / longest)[0]
    assert np.isclose(short_wave_height(sigma, length, nu, longest) ** 2, sigma**2 - long_waves)


@pytest.mark.parametrize("process", sorted(PROCESSES))
@pytest.mark.parametrize("roughness", [0.05, 0.2, 0.8])
def test_the_correlation_length_gives_the_slope_that_was_asked_for(process, roughness):
    nu = (PROCESSES[process].exponent - 1) / 2
    sigma = rms_height(roughness)
    wanted = stylus_slope(roughness, process)
    length = correlation_length(sigma, wanted, nu)
    assert np.isclose(band_limited_slope(sigma, length, nu), wanted, rtol=1e-6)


def test_spacing_of_a_random_profile_gives_its_slope(rng):
    """Rice's rate of upward crossings, counted on a Gaussian profile; 1 % from some 8000 crossings."""
    white = rng.normal(size=2**18)
    frequency = np.fft.rfftfreq(len(white))
    z = np.fft.irfft(np.fft.rfft(white) * np.exp(-((np.pi * frequency * 10) ** 2) / 2))
    spacing = len(z) / np.count_nonzero((z[:-1] < 0) & (z[1:] >= 0))
    slope = np.sqrt(np.mean(np.gradient(z) ** 2))
    assert np.isclose(slope_of_spacing(float(z.std()), spacing), slope, rtol=0.02)


def test_an_ideal_turned_profile_has_its_roughness_and_slope():
    """Ra and rms slope of a sampled row of parabolas."""
    radius, marks = 0.8, feed(0.8, 0.8)
    x = np.linspace(-marks / 2, marks / 2, 200001)
    z = x**2 / (2 * radius)
    assert np.isclose(np.abs(z - z.mean()).mean() * 1e3, 0.8, rtol=1e-4)
    assert np.isclose(np.sqrt(np.mean((x / radius) ** 2)), feed_slope(marks, radius), rtol=1e-4)
    assert np.isclose(marks, 0.141, atol=0.001)


def test_micro_roughness_stays_inside_its_range():
    found = [micro_roughness(ra) for ra in (0.01, 0.8, 6.0)]
    assert found == [0.02, 0.2, 0.3]


def test_wide_angle_share_grows_with_roughness_and_lies_in_its_range():
    for name, process in PROCESSES.items():
        low, high = process.usual
        shares = [process.wide_angle.share(ra) for ra in np.geomspace(low, high, 5)]
        assert shares == sorted(shares), name
        for ra, share in zip(np.geomspace(low, high, 5), shares, strict=True):
            below, above = process.wide_angle.range(ra)
            assert 0 < below < share < above <= 1, name


def test_wide_angle_share_of_ground_metal_is_the_one_that_the_maps_were_made_with():
    share = PROCESSES["ground"].wide_angle.share
    assert [round(share(ra), 3) for ra in (0.09, 0.37, 3.0)] == [0.022, 0.092, 0.3]
