"""Correlation of residuals: fields of known correlation come back, with gaps."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from characterisation.coupon.residual_field import Autocorrelation, autocorrelation


def filtered(rng, shape, sigma):
    """White noise through Gaussians of ``sigma`` (2,): unit variance, rho = exp(-x^2 / 4 sx^2 - y^2 / 4 sy^2)."""
    if not np.any(sigma):
        return rng.normal(size=shape)
    impulse = np.zeros((65, 65))
    impulse[32, 32] = 1
    gain = np.sqrt((gaussian_filter(impulse, sigma) ** 2).sum())
    return gaussian_filter(rng.normal(size=shape), (*[0] * (len(shape) - 2), *sigma), mode="wrap") / gain


@pytest.mark.parametrize("sigma", [(0.0, 0.0), (1.0, 1.0), (1.0, 2.0)])
@pytest.mark.parametrize("keep", [1.0, 0.6])
def test_the_correlation_of_a_field_with_gaps_comes_back(sigma, keep, rng):
    field = filtered(rng, (400, 500), sigma)
    field[rng.random(field.shape) > keep] = np.nan
    field[100:150, 200:300] = np.nan
    rho = autocorrelation(field, 5)
    row, column = np.mgrid[-5:6, -5:6]
    expected = (row == 0) & (column == 0)
    if any(sigma):
        expected = np.exp(-(row**2) / (4 * sigma[0] ** 2) - column**2 / (4 * sigma[1] ** 2))
    # of N pixels in areas of A = 4 pi s_x s_y each correlation is known to sqrt(A / N) or better; 5 of these
    area = max(4 * np.pi * sigma[0] * sigma[1], 1 / keep**2)
    assert np.abs(rho.values - expected).max() < 5 * np.sqrt(area / (195000))
    assert rho.pairs[5, 5] == np.isfinite(field).sum()
    assert np.allclose(rho.values, rho.values[::-1, ::-1])


def test_a_linear_decay_has_its_length_where_it_falls_under_one_over_e():
    row, column = np.mgrid[-8:9, -8:9]
    rho = Autocorrelation(np.maximum(1 - np.hypot(row, column) / 5, 0.0), np.full((17, 17), 1e6))
    assert np.isclose(rho.length(), 5 * (1 - np.exp(-1)))


def test_independent_pixels_have_the_length_of_the_interpolation(rng):
    # at lag 1 rho is known to sqrt(1 / (2 x 200000 pairs)) = 0.0016, and the length to half of that
    assert np.isclose(autocorrelation(rng.normal(size=(400, 500))).length(), 1 - np.exp(-1), atol=0.004)


def test_without_noise_or_points_nothing_is_claimed():
    for field in (np.zeros((13, 13)), np.full((13, 13), np.nan)):
        assert np.isnan(autocorrelation(field).length())
