"""Rank correlation, ROC area and the coverage of predicted uncertainties, beside scipy and by hand."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy import stats

from characterisation.scores.coverage import coverage_interval
from characterisation.scores.deciles import spearman
from tests.proofs.screening_figures import roc_area

NAN, INF = math.nan, math.inf

values = st.one_of(st.integers(-3, 3).map(float), st.floats(-1e6, 1e6))


@given(arrays(float, 12, elements=values), arrays(float, 12, elements=values))
def test_rank_correlation_is_scipys(x, y):
    if np.ptp(x) == 0 or np.ptp(y) == 0:
        assert math.isnan(spearman(x, y))
    else:
        assert spearman(x, y) == pytest.approx(stats.spearmanr(x, y).statistic, abs=1e-12)


def test_few_pairs_have_no_rank_correlation():
    assert math.isnan(spearman([1, 2, 3], [1, 2, 3]))
    assert spearman([1, 2, 3, 4], [1, 2, 3, 4]) == 1.0


scores = arrays(float, 9, elements=st.sampled_from([NAN, -INF, -1.0, 0.0, 0.5, 2.0]))
flags = arrays(bool, 9)


@given(scores, flags)
def test_roc_area_is_the_chance_that_a_measurable_view_scores_higher(score, measurable):
    lowest = np.where(np.isnan(score), -INF, score)
    pairs = [(a > b) + 0.5 * (a == b) for a in lowest[measurable] for b in lowest[~measurable]]
    if pairs:
        assert roc_area(score, measurable) == pytest.approx(np.mean(pairs))
    else:
        assert math.isnan(roc_area(score, measurable))


@given(st.integers(1, 60), st.integers(0, 60))
def test_the_interval_of_single_trials_is_clopper_and_pearsons(views, hits):
    hits = min(hits, views)
    z = np.where(np.arange(views) < hits, 0.0, 5.0)[:, None]
    coverage, low, high = coverage_interval(z)
    exact = stats.binomtest(hits, views).proportion_ci(method="exact")
    assert (coverage, low, high) == pytest.approx((hits / views, exact.low, exact.high))


def test_repeats_that_only_copy_one_another_count_once():
    z = np.random.default_rng(4).normal(size=(60, 1)) * 2
    assert coverage_interval(np.repeat(z, 5, axis=1)) == pytest.approx(coverage_interval(z))
    inside = np.zeros((60, 5))  # all inside: nothing tells whether repeats count, so they do not
    assert coverage_interval(inside) == pytest.approx(coverage_interval(inside[:, :1]))


def test_the_effective_number_of_trials_by_hand():
    """Inside are 2, 1 and 2 of two: p = 5/6, variance 3/2 (1 + 4 + 1) / 9 / 6^2 = 1/36, effective 5/36 over it = 5."""
    coverage, low, high = coverage_interval(np.array([[0.0, 1.0], [0.0, 3.0], [1.0, -1.0]]))
    x = 5 * coverage
    assert coverage == pytest.approx(5 / 6)
    assert (low, high) == pytest.approx((stats.beta.ppf(0.025, x, 6 - x), stats.beta.ppf(0.975, x + 1, 5 - x)))


def test_repeats_that_know_nothing_of_one_another_count_in_full():
    z = np.random.default_rng(6).normal(size=(400, 5)) * 2
    _, low, high = coverage_interval(z)
    exact = stats.binomtest(int((np.abs(z) <= 2).sum()), z.size).proportion_ci(method="exact")
    # the variance between 400 views is known to sqrt(2 / 399) = 7 %, so the width to 3.5 %; 4 of them
    assert (high - low) / (exact.high - exact.low) == pytest.approx(1, abs=0.14)


def test_the_interval_covers_where_views_have_errors_of_their_own():
    """Half of the variance of z belongs to the view; intervals over all repeats as if independent would cover less."""
    draw = np.random.default_rng(7)
    trials, covered, naive = 250, 0, 0
    for _ in range(trials):
        z = draw.normal(size=(80, 1)) + draw.normal(size=(80, 6))
        _, low, high = coverage_interval(z)
        inside = math.erf(1.0)  # sigma is sqrt(2): erf(2 / (sqrt(2) sqrt(2)))
        covered += low <= inside <= high
        exact = stats.binomtest(int((np.abs(z) <= 2).sum()), z.size).proportion_ci(method="exact")
        naive += exact.low <= inside <= exact.high
    assert covered / trials > 0.95 - 4 * 0.0138  # binomial standard deviations of 250
    assert naive < covered - 4 * 0.0138 * trials
