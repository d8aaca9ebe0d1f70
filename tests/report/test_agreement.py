"""Whether the prediction held: order and size of u against the errors that were found, by closed forms."""

import math

import numpy as np
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import beta, spearmanr

from characterisation.scores.deciles import spearman
from mitsim.report.agreement import CHANCE, CONFIRMED, REVERSED, TOO_FEW, agreement, chance_level


def scores_of(u, V, possible=None):
    u = np.asarray([u], float)
    possible = np.isfinite(u) if possible is None else np.asarray([possible])
    fields = {"predicted_uncertainty": u, "V_m": np.asarray([V], float), "uncertainty_possible": possible}
    return xr.Dataset(
        {name: (("measurement", "view"), values) for name, values in fields.items()},
        {"measurement": ["m"], "view": np.arange(u.shape[1])},
    )


def checks_of(views, errors):
    return xr.Dataset(
        {"error": (("measurement", "view", "repeat"), np.asarray([errors], float))},
        {"measurement": ["m"], "view": views},
    )


def found_of(u, V, errors, possible=None):
    return agreement(scores_of(u, V, possible), checks_of(np.arange(len(u)), errors), "m")


def test_agreement_of_checked_views():
    nan = np.nan
    scores = scores_of([0.1, 0.2, 0.4, 1.0, nan], [5, 4, 3, 1, 2])
    checks = checks_of([4, 3, 2, 1, 0], [[8, -8], [1, nan], [-0.6, 0.2], [nan, nan], [0.05, -0.3]])
    found = agreement(scores, checks, "m")
    np.testing.assert_array_equal(found.uncertainty, [nan, 1.0, 0.4, 0.2, 0.1])
    np.testing.assert_array_equal(found.possible, [False, True, True, True, True])
    np.testing.assert_array_equal(found.score, [2, 1, 3, 4, 5])
    np.testing.assert_allclose(found.error, [8, 1, 0.4, nan, 0.175])
    np.testing.assert_array_equal(found.least, [8, 1, 0.2, nan, 0.05])
    np.testing.assert_array_equal(found.most, [8, 1, 0.6, nan, 0.3])
    np.testing.assert_array_equal(found.failed, [0, 0.5, 0, 1, 0])
    # by u the impossible view comes last, and has the largest error; V_m swaps it with the one before
    assert found.count == 4 and found.spearman == pytest.approx(1) and found.score_spearman == pytest.approx(0.8)
    # |z| of those with a u: 1, 1.5, 0.5, 0.5, 3
    assert found.trials == 5 and found.coverage == pytest.approx(0.8) and found.ratio == pytest.approx(1.0)


def test_errors_that_are_whole_numbers_are_numbers_too():
    scores, errors = scores_of([0.1, 0.2], [2, 1]), [[1, -3], [0, 2]]
    checks = checks_of([0, 1], errors)
    whole = checks.assign(error=checks["error"].astype("i8"))
    np.testing.assert_array_equal(agreement(scores, whole, "m").error, [2.0, 1.0])
    np.testing.assert_array_equal(agreement(scores, whole, "m").least, [1.0, 0.0])


def test_nothing_is_known_where_no_view_was_measured():
    """The race measures none if the map predicts that no view can make the measurement."""
    checks = xr.Dataset(
        {"error": (("measurement", "view", "repeat"), np.empty((1, 0, 0)))},
        {"measurement": ["m"], "view": np.empty(0, int)},
    )
    found = agreement(scores_of([math.nan, math.nan], [0, 0]), checks, "m")
    assert found.count == found.trials == len(found.error) == 0 and found.order == TOO_FEW


def test_a_view_that_u_says_to_be_impossible_ranks_last_though_it_has_a_u():
    errors = [[1], [2], [3], [4]]
    assert found_of([0.4, 0.1, 0.2, 0.3], [1] * 4, errors).spearman == pytest.approx(-0.2)
    found = found_of([0.2, 0.3, 0.4, 0.1], [1] * 4, errors, [True, True, True, False])
    assert found.spearman == pytest.approx(1) and math.isnan(found.score_spearman)
    assert found.trials == 4  # its error is held against its u all the same


def test_order_is_told_in_words():
    views = np.arange(1.0, 11.0)
    assert found_of(views, -views, views[:, None]).order == CONFIRMED
    assert found_of(views, -views, -views[::-1, None]).order == REVERSED
    assert found_of(views[:3], -views[:3], views[:3, None]).order == TOO_FEW
    shuffled = views[[4, 0, 8, 2, 6, 1, 9, 3, 7, 5]]
    assert abs(spearman(views, shuffled)) < chance_level(10)
    assert found_of(views, -views, shuffled[:, None]).order == CHANCE


def test_u_is_too_small_only_where_the_interval_of_the_coverage_ends_below_that_of_a_normal():
    def found(inside, views):
        errors = np.where(np.arange(views) < inside, 1.0, 3.0)[:, None]
        return found_of(np.ones(views), np.ones(views), errors)

    for inside, views, too_small in ((20, 20, False), (17, 20, False), (15, 20, True), (0, 2, True), (2, 3, False)):
        one = found(inside, views)
        # one repeat of each view: Clopper and Pearson's interval of independent trials
        high = 1.0 if inside == views else float(beta.ppf(0.975, inside + 1, views - inside))
        assert one.high == pytest.approx(high, abs=1e-6)
        assert one.optimistic is (high < 0.9545) is too_small
    none = found_of([math.nan], [1.0], [[1.0]])
    assert none.trials == 0 and math.isnan(none.coverage) and math.isnan(none.ratio) and not none.optimistic


def test_a_right_u_is_seldom_called_too_small_and_one_of_half_the_size_mostly():
    rng = np.random.default_rng(8)

    def share(factor, runs=100):
        return np.mean(
            [found_of(np.full(20, factor), np.ones(20), rng.normal(0, 1, (20, 2))).optimistic for _ in range(runs)]
        )

    # a right u: the interval ends below the truth with 2.5 % at most; 100 runs scatter by 1.6 %
    assert share(1.0) <= 0.025 + 3 * 0.016
    # |z| up to 1 instead of 2: 68 % lie inside, and 40 trials see that nearly always
    assert share(0.5) > 0.9


def test_median_ratio_of_a_right_u_is_that_of_a_normal_variable():
    rng = np.random.default_rng(4)
    u = np.exp(rng.normal(0, 1, 4000))
    found = found_of(u, np.ones(4000), rng.normal(0, 1, (4000, 2)) * u[:, None])
    # standard error of a median: 1 / (2 f sqrt(n)) with f = 2 phi(0.674) = 0.636 and n = 8000, that is 0.009
    assert found.ratio == pytest.approx(0.6745, abs=4 * 0.009)
    assert found.coverage == pytest.approx(0.9545, abs=4 * math.sqrt(0.9545 * 0.0455 / 8000))


@given(st.lists(st.tuples(st.integers(0, 9), st.integers(0, 9)), min_size=4, max_size=30))
def test_rank_correlation_is_scipys_with_ties(pairs):
    x, y = np.array(pairs, float).T
    mine = spearman(x, y)
    if np.ptp(x) == 0 or np.ptp(y) == 0:
        assert math.isnan(mine)
    else:
        assert mine == pytest.approx(spearmanr(x, y).statistic, abs=1e-12)


def test_chance_level_is_where_students_test_gives_five_percent():
    rng = np.random.default_rng(3)
    n, level = 10, chance_level(10)
    sizes = [abs(spearman(rng.random(n), rng.random(n))) for _ in range(1500)]
    # 1500 draws: the share scatters by 0.0056, and the approximation is off by 0.002
    assert np.mean(np.array(sizes) > level) == pytest.approx(0.05, abs=0.02)
    assert math.isnan(chance_level(3))


def test_trials_that_were_not_made_have_not_failed():
    checks = checks_of([0, 1], [[0.1, 0.2, 0.3, np.nan], [0.1, np.nan, np.nan, np.nan]])
    tried = np.array([[[1, 1, 1, 1], [1, 0, 0, 0]]], np.int8)
    checks = checks.assign(tried=(("measurement", "view", "repeat"), tried))
    np.testing.assert_array_equal(agreement(scores_of([0.1, 0.2], [2, 1]), checks, "m").failed, [0.25, 0.0])
