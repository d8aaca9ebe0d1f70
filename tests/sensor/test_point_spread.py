"""The point spread of a lens on whole pixels."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter1d

from mitsim.sensor.point_spread import point_spread


def variance(weights):
    places = np.arange(len(weights)) - len(weights) // 2
    return float((weights * places**2).sum())


@given(st.floats(0.02, 5.0))
def test_its_variance_is_what_was_asked_for(sigma):
    weights = point_spread(sigma)
    assert weights.sum() == pytest.approx(1.0, abs=1e-12)
    np.testing.assert_array_equal(weights, weights[::-1])
    assert variance(weights) == pytest.approx(sigma**2, rel=1e-2)  # what lies beyond its reach


@given(st.floats(0.1, 2.0), st.floats(0.1, 2.0))
def test_two_in_a_row_are_one_of_the_summed_variances(one, other):
    both = np.convolve(point_spread(one), point_spread(other))
    alone = point_spread(np.hypot(one, other))
    padded = np.pad(alone, max(0, (len(both) - len(alone)) // 2))
    np.testing.assert_allclose(padded, np.pad(both, max(0, (len(padded) - len(both)) // 2)), atol=2e-4)


@given(st.floats(0.1, 3.0), st.floats(0.0, 0.5))
def test_its_transfer_is_the_exponential_of_lindeberg(sigma, frequency):
    """sum T(n; t) exp(-2 pi i f n) = exp(t (cos 2 pi f - 1)): the generating function of I_n."""
    weights = point_spread(sigma)
    places = np.arange(len(weights)) - len(weights) // 2
    transfer = (weights * np.cos(2 * np.pi * frequency * places)).sum()
    assert transfer == pytest.approx(np.exp(sigma**2 * (np.cos(2 * np.pi * frequency) - 1)), abs=3e-4)


def test_a_wide_one_is_all_but_the_sampled_gaussian_and_a_narrow_one_is_not():
    """exp(-t) I_0(t) = (1 + 1 / (8 t) + ...) / sqrt(2 pi t) for large t: DLMF 10.40.1."""
    wide = point_spread(3.0)
    assert wide.max() == pytest.approx((1 + 1 / 72 + 9 / 2 / 72**2) / np.sqrt(2 * np.pi * 9), rel=2e-4)
    # sampled at whole pixels, 0.4 px would act as 0.28: the defect that this replaced
    impulse = np.zeros(41)
    impulse[20] = 1
    assert variance(gaussian_filter1d(impulse, 0.4)) != pytest.approx(0.16, rel=0.4)
    assert variance(point_spread(0.4)) == pytest.approx(0.16, rel=1e-2)
