"""Exposure rules."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mitsim.sensor.exposure import automatic, bracket

LIMITS = (1e-5, 1e-2)
positive = st.floats(1e-6, 1e3)


def test_automatic_exposure_brings_the_percentile_to_the_level():
    rates = np.linspace(0, 1e7, 1001).reshape(7, 11, 13)
    exposure = automatic(rates, 20000, 0.8, 99, LIMITS)
    assert np.isclose(exposure * np.percentile(rates, 99), 0.8 * 20000, rtol=1e-12)
    assert np.isclose((rates * exposure > 16000).mean(), 0.01, atol=1e-3)


def test_automatic_exposure_stops_at_the_limits_of_the_device():
    assert automatic(np.full(9, 1e12), 20000, 0.8, 50, LIMITS) == LIMITS[0]
    assert automatic(np.full(9, 1.0), 20000, 0.8, 50, LIMITS) == LIMITS[1]
    assert automatic(np.zeros(9), 20000, 0.8, 50, LIMITS) == LIMITS[1]


def test_automatic_exposure_leaves_unknown_pixels_out():
    assert automatic(np.array([np.nan, 1e7, np.nan]), 20000, 0.5, 90, LIMITS) == pytest.approx(1e-3, rel=1e-12)


def test_a_bracket_is_centred_on_its_base():
    assert bracket(1e-3, 3, 4, LIMITS) == pytest.approx((0.25e-3, 1e-3, 4e-3))
    assert bracket(1e-3, 2, 4, LIMITS) == pytest.approx((0.5e-3, 2e-3))
    assert bracket(1e-3, 1, 4, LIMITS) == (1e-3,)


def test_exposures_beyond_the_limits_become_one():
    assert bracket(1e-3, 7, 10, LIMITS) == pytest.approx((1e-5, 1e-4, 1e-3, 1e-2))
    assert bracket(1.0, 5, 2, LIMITS) == (1e-2,)


@given(positive, st.integers(1, 300), st.floats(1.001, 1e6), positive, positive)
def test_a_bracket_rises_within_the_limits(base, count, factor, one, other):
    limits = (min(one, other), max(one, other))
    exposures = bracket(base, count, factor, limits)
    assert 1 <= len(exposures) <= count
    assert np.all(np.diff(exposures) > 0)
    assert limits[0] <= exposures[0] <= exposures[-1] <= limits[1]


@given(st.lists(st.floats(0, 1e12), min_size=1), st.floats(0.01, 1), st.floats(0, 100))
def test_automatic_exposure_is_always_within_the_limits(rates, level, percentile):
    assert LIMITS[0] <= automatic(np.array(rates), 20000, level, percentile, LIMITS) <= LIMITS[1]
