"""Shares inside intervals and regrets: closed forms, and statistics with fixed seeds."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import binomtest

from characterisation.statements.coverage import share
from tests.proofs.judgement import falsely_accepted, pooled_share, regret, true_risk, within


def test_share_is_the_exact_interval_of_an_independent_package():
    for k, n in ((0, 20), (7, 20), (20, 20), (95, 100)):
        mine = share(np.arange(n) < k)
        other = binomtest(k, n).proportion_ci(0.95, method="exact")
        assert (mine.low, mine.high) == pytest.approx((other.low, other.high), abs=1e-12)


def test_pooled_share_widens_with_the_correlation_of_measurements():
    rng = np.random.default_rng(1)
    base = rng.random((1, 60)) < 0.9
    alone, copied = pooled_share(base.astype(float)), pooled_share(np.repeat(base, 5, axis=0).astype(float))
    assert copied.value == alone.value
    assert copied.high - copied.low == pytest.approx(alone.high - alone.low, rel=0.05)


def test_pooled_share_covers_the_true_share():
    rng = np.random.default_rng(2)
    hits = 0
    for k in range(300):
        world = rng.normal(size=(1, 80))
        errors = np.sqrt(0.5) * (world + rng.normal(size=(4, 80)))
        found = pooled_share(np.abs(errors) < 1.6449, seed=k)
        hits += found.low <= 0.9 <= found.high
    assert 0.90 <= hits / 300 <= 0.98


def test_within_leaves_out_what_has_no_value():
    assert np.array_equal(within([0.0, 2.0, np.nan, -1.0], (-1.0, 1.0)), [1, 0, np.nan, 1], equal_nan=True)


def test_an_error_beyond_its_guard_band_accepts_what_is_outside():
    found = falsely_accepted([0.0, -0.3, -0.1, 0.2, 0.19, np.nan], (0.2, 0.3))
    assert found[:5].tolist() == [0, 1, 0, 1, 0] and np.isnan(found[5])


def test_risk_of_a_view_that_measures_half_the_time():
    assert true_risk([[2.0, np.nan, -2.0, np.nan], [np.nan] * 4]) == pytest.approx([2 * np.sqrt(2), np.inf])


def test_regret_of_equal_views_is_one_without_bias():
    """The least of 24 equal risks is 0.8 of each in 30 worlds: the plain ratio says 1.25, the halves 1."""
    rng = np.random.default_rng(3)
    found = [regret(rng.normal(size=(24, 30)), 0, seed=k) for k in range(40)]
    assert np.mean([one.ratio for one in found]) > 1.2
    assert np.mean(np.log([one.unbiased for one in found])) == pytest.approx(0.0, abs=0.04)


def test_regret_of_a_bad_view_is_its_ratio():
    rng = np.random.default_rng(4)
    scale = np.array([1.0, 3.0, 3.0, 3.0])[:, None]
    found = [regret(scale * rng.normal(size=(4, 40)), 2, seed=k) for k in range(30)]
    assert np.exp(np.mean(np.log([one.unbiased for one in found]))) == pytest.approx(3.0, rel=0.08)
    assert np.mean([one.low <= 3.0 <= one.high for one in found]) >= 0.9
    assert {one.best for one in found} == {0}


def test_worlds_that_share_a_draw_stay_together():
    """Errors of pairs of worlds are equal, so 40 worlds are 20 independent ones, and the interval is wider."""
    rng = np.random.default_rng(5)
    scale = np.array([1.0, 2.0])[:, None]
    pairs = [np.repeat(scale * rng.normal(size=(2, 20)), 2, axis=1) for _ in range(60)]
    apart, together = (np.array([_ends(regret(errors, 1, block=block)) for errors in pairs]) for block in (1, 2))
    width = [np.mean(np.log(found[:, 1] / found[:, 0])) for found in (apart, together)]
    assert width[1] / width[0] == pytest.approx(np.sqrt(2), rel=0.15)
    inside = [np.mean((found[:, 0] <= 2.0) & (found[:, 1] >= 2.0)) for found in (apart, together)]
    assert inside[1] >= 0.9 and inside[1] > inside[0]


def _ends(one):
    return one.low, one.high


def test_regret_of_a_view_without_a_value_is_infinite():
    errors = np.ones((2, 10))
    errors[1] = np.nan
    assert regret(errors, 1).ratio == np.inf and regret(errors, 1).unbiased == np.inf


def test_one_half_without_a_value_of_the_best_view_does_not_move_the_median():
    """The best view has values in the first fifth of the worlds only; halves that lack them say nothing about it."""
    rng = np.random.default_rng(6)
    errors = np.array([3.0, 1.0])[:, None] * rng.normal(size=(2, 30))
    errors[1, 3:] = np.nan
    found = regret(errors, 0)
    assert found.unbiased == 0 and found.middle > 0
