"""Errors of drawn points: within the limit of false points, with the sigma of the map."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import norm

from characterisation.point_cloud import FALSE_SHARE_OF_DISTANCE
from mitsim.maps.prediction.cut_noise import cut_deviates
from mitsim.report.export import map_kernel

DISTANCE = 2000.0
LIMIT = FALSE_SHARE_OF_DISTANCE * DISTANCE


def cut(deviates, sigma):
    return cut_deviates(deviates, np.full(deviates.shape, sigma), np.full(deviates.shape, DISTANCE))


@pytest.mark.parametrize("share", [0.1, 0.3, 0.4, 0.5, 0.57])
def test_sigma_stays_and_no_error_exceeds_the_limit(share):
    """Against quantiles of the standard normal distribution, evenly spaced: their variance is 1 within 1e-4."""
    sigma, deviates = share * LIMIT, norm.ppf((np.arange(400_000) + 0.5) / 400_000)
    found = cut(deviates, sigma)
    assert found.std() == pytest.approx(1.0, abs=1e-3)
    assert np.abs(found * sigma).max() <= LIMIT
    assert (np.diff(found) > 0).all()
    assert np.array_equal(found, deviates) == (share < 0.15)


def test_errors_are_those_of_a_normal_distribution_without_what_lies_beyond_the_limit(rng):
    """Sigma is that of normal errors of 0.5 of the limit, those beyond it left out; quantiles of 200,000 draws."""
    drawn = 0.5 * LIMIT * rng.standard_normal(400_000)
    left = drawn[np.abs(drawn) <= LIMIT]
    found = cut(rng.standard_normal(len(left)), left.std()) * left.std()
    quantiles = [0.01, 0.1, 0.25, 0.5, 0.75, 0.9, 0.99]
    np.testing.assert_allclose(np.quantile(found, quantiles), np.quantile(left, quantiles), atol=0.01 * LIMIT)
    assert np.abs(drawn).max() > 1.5 * LIMIT


def test_a_sigma_that_no_distribution_within_the_limit_has_gives_a_uniform_one():
    deviates = norm.ppf((np.arange(100_000) + 0.5) / 100_000)
    errors = cut(deviates, 0.9 * LIMIT) * 0.9 * LIMIT
    np.testing.assert_allclose(errors, np.linspace(-LIMIT, LIMIT, 100_000), atol=2e-3 * LIMIT)


def test_unknown_values_stay_unknown():
    assert cut_deviates(np.ones(2), np.array([np.nan, 4.0]), np.array([100.0, np.nan])).tolist() == [1.0, 1.0]


def test_the_kernel_of_an_exported_map_cuts_the_same(rng):
    deviates = rng.standard_normal(20_000)
    for share in (0.1, 0.35, 0.5, 0.8):
        found = map_kernel._cut(deviates, np.full(deviates.shape, 1 / share))
        np.testing.assert_allclose(found, cut(deviates, share * LIMIT), atol=0.01)
