import csv
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy import stats

from characterisation.errors import InputError
from characterisation.scores.rank_agreement import (
    DECILES,
    IMPOSSIBLE,
    agreement_ranks,
    deciles,
    roc_area,
    roc_curve,
    spearman,
    spearman_interval,
)
from characterisation.scores.score_table import (
    ALL,
    FIGURES,
    Contest,
    calibrations,
    contests,
    mean_ranks,
    overall,
    write_calibrations,
    write_score_rows,
)
from characterisation.scores.score_validation import (
    REPEATS,
    UNCERTAINTY,
    V_M,
    CheckedViews,
    decile_errors,
    halved,
    judge,
    score_rows,
    view_errors,
)
from characterisation.scores.uncertainty_calibration import (
    NORMAL_COVERAGE,
    calibrate,
    calibrate_by_decile,
    coverage_interval,
)

NAN, INF = math.nan, math.inf


def checked(error, uncertainty=None, measurement="angle", sample="white", tolerance=NAN, **scores):
    error = np.asarray(error, float)
    uncertainty = np.full(len(error), 1.0) if uncertainty is None else uncertainty
    return CheckedViews(measurement, sample, "mm", scores, error, uncertainty, tolerance)


def rising(views=100, lost=0):
    """Views whose true errors are 1, 2, ... in four repeats of both signs; the last ``lost`` of them unmeasurable."""
    error = np.arange(1.0, views + 1)[:, None] * [1, -1, 1, -1]
    error[views - lost :] = np.nan
    return error


# ------------------------------------------------------------------------------------------------ rank agreement


def test_deciles_are_tenths_best_first_and_the_impossible_apart():
    score = np.array([*np.arange(30.0), NAN, -INF])
    bins = deciles(score)
    assert bins[:30].tolist() == np.repeat(np.arange(DECILES)[::-1], 3).tolist()
    assert bins[30:].tolist() == [IMPOSSIBLE] * 2


def test_equal_scores_fall_into_bins_at_random_and_the_same_way_every_time():
    bins = deciles(np.zeros(1000), seed=3)
    assert (bins == deciles(np.zeros(1000), seed=3)).all()
    assert (bins != deciles(np.zeros(1000), seed=4)).any()
    assert np.bincount(bins).tolist() == [100] * DECILES
    # the mean place of 100 of 1000 views drawn without replacement: 499.5 +- 288.7 sqrt(0.9 / 100) = 27.4; 4 of them
    assert abs(np.flatnonzero(bins == 0).mean() - 499.5) < 4 * 27.4


@given(arrays(float, st.integers(0, 40), elements=st.sampled_from([NAN, -INF, 0.0, 1.0, 2.0, 3.5])), st.integers(0, 9))
def test_deciles_hold_every_possible_view_once_and_never_put_a_better_one_behind(score, seed):
    bins = deciles(score, seed)
    possible = score > -INF
    assert ((bins == IMPOSSIBLE) == ~possible).all()
    sizes = np.bincount(bins[possible], minlength=DECILES)
    assert len(sizes) == DECILES and sizes.max() - sizes.min() <= 1
    assert sizes[0] > 0 or not possible.any()
    for one in np.flatnonzero(possible):
        assert (bins[possible & (score < score[one])] >= bins[one]).all()


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
    assert all(math.isnan(end) for end in spearman_interval([1, 2, 3], [1, 2, 3]))
    assert all(math.isnan(end) for end in spearman_interval(np.ones(9), np.arange(9)))


def test_impossible_scores_and_unmeasured_errors_are_tied_at_the_worst_rank():
    x, y = agreement_ranks(np.array([3.0, NAN, -INF, 1.0]), np.array([0.5, 0.1, NAN, NAN]))
    assert x.tolist() == [4, 1.5, 1.5, 3]
    assert y.tolist() == [3, 4, 1.5, 1.5]


def test_the_interval_of_a_rank_correlation_covers_it():
    """Of normal pairs of correlation r, Spearman's is 6 / pi asin(r / 2) (Kendall and Gibbons)."""
    r, trials, inside = 0.7, 400, 0
    truth = 6 / math.pi * math.asin(r / 2)
    draw = np.random.default_rng(5)
    for number in range(trials):
        x = draw.normal(size=80)
        y = r * x + math.sqrt(1 - r**2) * draw.normal(size=80)
        low, high = spearman_interval(x, y, seed=number, resamples=200)
        inside += low <= truth <= high
    assert abs(inside / trials - 0.95) < 4 * 0.0109  # binomial standard deviations of 400


def test_the_interval_is_that_of_views_drawn_one_by_one():
    draw = np.random.default_rng(1)
    x, y = draw.integers(5, size=30), draw.normal(size=30)  # with ties
    y = y + x
    times = np.random.default_rng(2).multinomial(30, np.full(30, 1 / 30), size=150)
    found = [stats.spearmanr(np.repeat(x, once), np.repeat(y, once)).statistic for once in times]
    ends = spearman_interval(x, y, seed=2, resamples=150, confidence=0.8)
    assert ends == pytest.approx(np.quantile(found, [0.1, 0.9]))
    assert ends != spearman_interval(x, y, seed=3, resamples=150, confidence=0.8)


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


@given(scores, flags)
def test_roc_area_is_the_area_under_the_roc_curve(score, measurable):
    false, true = roc_curve(score, measurable)
    if measurable.all() or not measurable.any():
        assert len(false) == len(true) == 0
    else:
        assert (false[0], true[0], false[-1], true[-1]) == (0, 0, 1, 1)
        assert (np.diff(false) >= 0).all() and (np.diff(true) >= 0).all()
        assert np.trapezoid(true, false) == pytest.approx(roc_area(score, measurable))


# ------------------------------------------------------------------------------------------------- one score


def test_a_perfect_score_is_perfect_by_every_figure():
    truth = checked(rising(100, lost=20), perfect=np.where(np.arange(100) < 80, -np.arange(100.0), NAN))
    row = judge(truth, "perfect")
    assert (row.views, row.possible, row.measurable) == (100, 80, 80)
    assert (row.decile_spearman, row.regret, row.lost, row.roc_area) == (1, 1, 0, 1)
    assert row.view_spearman == row.view_spearman_low == row.view_spearman_high == pytest.approx(1)
    assert row.measurable_spearman == row.top_spearman == pytest.approx(1)
    assert row.top_ratio == pytest.approx(20.5 / 4.5)  # means of 17 ... 24 and of 1 ... 8
    assert row.decile_ranks.tolist() == list(range(1, 11))


def test_a_reversed_score_is_as_wrong_as_can_be():
    row = judge(checked(rising(100, lost=20), wrong=np.arange(100.0)), "wrong")
    assert row.decile_spearman == pytest.approx(-stats.spearmanr(range(10), [1, 2, 3, 4, 5, 6, 7, 8, 9.5, 9.5])[0])
    assert row.measurable_spearman == pytest.approx(-1)
    assert (row.roc_area, row.regret, row.lost) == (0, INF, 1)
    whole = judge(checked(rising(100), wrong=np.arange(100.0)), "wrong")
    assert whole.decile_spearman == whole.view_spearman == whole.top_spearman == pytest.approx(-1)
    assert whole.regret == pytest.approx(95.5 / 5.5)
    assert math.isnan(whole.roc_area)  # every view is measurable


def test_a_random_score_is_right_by_chance_only():
    draw = np.random.default_rng(11)
    rows = [judge(checked(rising(100, lost=20), sample=str(k), random=draw.random(100)), "random") for k in range(100)]
    found = {name: np.array([getattr(row, name) for row in rows]) for name in FIGURES}
    # four standard errors of the mean of 100 each; of Spearman's correlation 1 / sqrt(n - 1), n = 10 deciles, 80 and
    # 30 views; of all views, 20 of them tied, not more than of 80
    assert abs(found["decile_spearman"].mean()) < 4 / 3 / 10
    assert abs(found["view_spearman"].mean()) < 4 / math.sqrt(79) / 10
    assert abs(found["measurable_spearman"].mean()) < 4 / math.sqrt(79) / 10
    assert abs(found["top_spearman"].mean()) < 4 / math.sqrt(29) / 10
    # Mann and Whitney: variance (m + n + 1) / (12 m n)
    assert abs(found["roc_area"].mean() - 0.5) < 4 * math.sqrt(101 / (12 * 80 * 20)) / 10
    # ten views of which 2 +- 1.21 are lost (hypergeometric: sqrt(10 0.2 0.8 90/99))
    assert abs(found["lost"].mean() - 0.2) < 4 * 0.121 / 10
    assert found["regret"].min() > 1


def test_the_regret_of_a_random_score_is_the_mean_error_over_that_of_the_best_tenth():
    draw = np.random.default_rng(2)
    regrets = [judge(checked(rising(1000)[:, :1], random=draw.random(1000)), "random").regret for _ in range(10)]
    # (1 + ... + 1000) / 1000 = 500.5 over 50.5; a mean of 100 of them, drawn without replacement, scatters by
    # 288.8 sqrt(0.9 / 100) = 27.4
    assert abs(np.mean(regrets) - 500.5 / 50.5) < 4 * 27.4 / 50.5 / math.sqrt(10)


def test_deciles_by_hand():
    error = np.full((22, 2), np.nan)
    error[:20] = np.repeat(np.arange(1.0, 11), 2)[:, None] * [1, -1]
    error[1] = [3.0, np.nan]  # measurable: half of its repeats are
    error[2] = np.nan  # not measurable, decile 2
    error[20:] = [[7.0, 7.0], [np.nan, np.nan]]
    score = np.array([*-np.arange(20.0), NAN, -INF])
    found = decile_errors(checked(error, score=score), "score")
    assert found.views.tolist() == [2] * 11
    assert found.measurable.tolist() == [1, 0.5, *[1] * 8, 0.5]
    assert found.mean.tolist() == [2, 2, *range(3, 11), 7]  # of |1| and |3|; of |-2| alone; ...; of the impossible
    assert found.std[0] == pytest.approx(np.std([1, -1, 3], ddof=1))
    assert found.std[1] == pytest.approx(np.std([2, -2], ddof=1))
    assert found.std[10] == 0
    assert found.rank.tolist() == [1.5, 1.5, *range(3, 11)]


def test_deciles_that_can_hardly_be_measured_rank_last_by_the_share_that_can():
    error = rising(40)
    error[:3] = np.nan  # the first decile: 1 of 4 left, with the least error of all
    error[4:8] = np.nan  # the second: none
    error[8:10] = np.nan  # the third: half, which is enough
    found = decile_errors(checked(error, score=-np.arange(40.0)), "score")
    assert found.measurable[:4].tolist() == [0.25, 0, 0.5, 1]
    assert found.rank.tolist() == [9, 10, *range(1, 9)]
    assert math.isnan(found.mean[1]) and found.mean[0] == 4


def test_the_true_error_of_a_view_is_the_mean_over_the_repeats_that_were_possible():
    mean, measurable = view_errors(
        np.array([[1, -3, NAN, NAN], [1, NAN, NAN, NAN], [NAN] * 4, [-2, 2, 2, 2], [0, 0, 0, 0]])
    )
    np.testing.assert_array_equal(mean, [2, NAN, NAN, 2, 0])
    assert measurable.tolist() == [True, False, False, True, True]


def test_fewer_than_ten_views_have_no_decile_ranks_but_a_best_decile():
    row = judge(checked(rising(9), score=-np.arange(9.0)), "score")
    assert math.isnan(row.decile_spearman) and np.isnan(row.decile_ranks).all()
    assert (row.regret, row.view_spearman) == (1, pytest.approx(1))


def test_one_view_says_nothing_of_order():
    row = judge(checked([[1.0, -1.0]], score=np.array([0.3])), "score")
    assert (row.views, row.possible, row.measurable, row.regret, row.lost) == (1, 1, 1, 1, 0)
    undefined = ("decile_spearman", "view_spearman", "measurable_spearman", "top_spearman", "top_ratio", "roc_area")
    assert all(math.isnan(getattr(row, name)) for name in undefined)
    assert math.isnan(row.view_spearman_low) and math.isnan(row.view_spearman_high)


def test_where_all_is_said_to_be_impossible_only_the_roc_area_is_defined():
    row = judge(checked(rising(50, lost=20), tolerance=3.0, none=np.full(50, NAN)), "none")
    assert (row.possible, row.measurable, row.roc_area) == (0, 30, 0.5)
    assert all(math.isnan(getattr(row, name)) for name in FIGURES if name != "roc_area")


def test_where_nothing_is_measurable_nothing_is_defined_but_that():
    row = judge(checked(np.full((50, 3), NAN), score=np.arange(50.0), tolerance=1.0), "score")
    assert (row.possible, row.measurable, row.lost, row.within) == (50, 0, 1, 0)
    assert all(math.isnan(getattr(row, name)) for name in FIGURES if name not in ("lost", "within"))


def test_a_best_decile_without_a_measurable_view_has_infinite_regret():
    error = rising(20)
    error[:2] = np.nan
    row = judge(checked(error, score=-np.arange(20.0)), "score")
    assert (row.regret, row.lost) == (INF, 1)
    assert math.isnan(row.top_ratio)


def test_regret_counts_as_many_best_views_as_were_measurable():
    error = rising(20)
    error[1] = np.nan  # one of the two chosen views; the other is the best there is
    row = judge(checked(error, score=-np.arange(20.0)), "score")
    assert (row.regret, row.lost) == (1, 0.5)
    error[0] = 5  # the one that is left is not the best, which is 3
    assert judge(checked(error, score=-np.arange(20.0)), "score").regret == pytest.approx(5 / 3)


def test_the_top_is_the_best_thirty_per_cent():
    score = np.concatenate([-np.arange(30.0), np.arange(-100.0, -30)])  # right in the top, reversed below
    row = judge(checked(rising(), score=score), "score")
    assert row.top_spearman == pytest.approx(1)
    assert row.view_spearman == pytest.approx(1 - 2 * (70**3 - 70) / (100**3 - 100))  # 70 views in reverse
    assert row.top_ratio == pytest.approx(25.5 / 5.5)


def test_errors_of_zero_do_not_divide():
    error = np.zeros((20, 2))
    perfect = judge(checked(error, score=np.arange(20.0)), "score")
    assert perfect.regret == 1 and math.isnan(perfect.top_ratio) and math.isnan(perfect.view_spearman)
    error[18:] = 1
    assert judge(checked(error, score=np.arange(20.0)), "score").regret == INF


def test_a_tolerance_counts_failed_repeats_as_outside():
    error = np.array([[0.1, -0.1, 0.3, NAN]] + [[9.0] * 4] * 9)
    assert judge(checked(error, score=-np.arange(10.0), tolerance=0.2), "score").within == 0.5
    assert math.isnan(judge(checked(error, score=-np.arange(10.0)), "score").within)


def test_repeats_that_agree_foretell_one_another_and_noise_does_not():
    same = halved(checked(rising(200)))
    row = judge(same, REPEATS)
    assert same.error.shape == (200, 2)
    assert (row.decile_spearman, row.regret, row.view_spearman) == (1, 1, pytest.approx(1))
    noise = np.random.default_rng(3).normal(size=(400, 4))
    row = judge(halved(checked(noise)), REPEATS)
    assert abs(row.view_spearman) < 4 / math.sqrt(399)
    # half-normal errors, two repeats: mean of all over that of the luckiest tenth, well over 1 though no view is bad
    assert row.regret > 2
    assert halved(checked(noise[:, :1])) is None


def test_a_score_that_knows_the_expected_error_beats_the_repeats():
    draw = np.random.default_rng(8)
    size = np.exp(draw.normal(size=500) / 2)
    views = checked(size[:, None] * draw.normal(size=(500, 4)), uncertainty=size)
    known, repeats = judge(views, UNCERTAINTY), judge(halved(views), REPEATS)
    assert repeats.view_spearman_high < known.view_spearman
    assert 1 < known.regret < repeats.regret


def test_the_predicted_uncertainty_is_a_score_unless_it_is_given_as_one():
    uncertainty = np.array([0.1, 0.2, NAN])
    assert checked(rising(3), uncertainty).scores[UNCERTAINTY][:2].tolist() == [-0.1, -0.2]
    given_one = checked(rising(3), uncertainty, **{UNCERTAINTY: np.zeros(3)})
    assert given_one.scores[UNCERTAINTY].tolist() == [0, 0, 0]


@pytest.mark.parametrize(
    "changes, said",
    [
        ({"error": np.zeros(3)}, r"angle, white: error: found shape \(3,\)"),
        ({"error": np.zeros((0, 4))}, "one of each or more"),
        ({"error": np.full((3, 2), INF)}, "error: found inf"),
        ({"predicted_uncertainty": np.ones(2)}, r"predicted_uncertainty: found shape \(2,\); allowed: \(3,\)"),
        ({"predicted_uncertainty": np.array([1, 0, 1])}, "predicted_uncertainty: found 0.0"),
        ({"predicted_uncertainty": np.array([1, INF, 1])}, "predicted_uncertainty: found inf"),
        ({"tolerance": 0.0}, "tolerance: found 0.0"),
        ({"scores": {"n": np.ones(4)}}, r"scores\['n'\]: found shape \(4,\)"),
        ({"scores": {"n": np.array([1, INF, 1])}}, r"scores\['n'\]: found inf"),
    ],
)
def test_what_cannot_be_is_refused_by_name(changes, said):
    fields = {"error": np.ones((3, 2)), "predicted_uncertainty": np.ones(3), "scores": {}} | changes
    with pytest.raises(InputError, match=said):
        CheckedViews("angle", "white", "mm", **fields)


def test_a_measurement_of_a_sample_can_be_there_once_only():
    with pytest.raises(InputError, match="angle, white twice"):
        score_rows([checked(rising(5)), checked(rising(5))])


errors = arrays(float, (12, 3), elements=st.one_of(st.just(NAN), st.floats(-1e3, 1e3)))
any_scores = arrays(float, 12, elements=st.one_of(st.sampled_from([NAN, -INF]), st.floats(-1e3, 1e3)))


@settings(max_examples=60)
@given(errors, any_scores)
def test_every_figure_is_in_its_range_or_not_defined(error, score):
    row = judge(checked(error, score=score, tolerance=1.0), "score")
    ranges = dict.fromkeys(FIGURES, (-1, 1)) | dict.fromkeys(("lost", "within", "roc_area"), (0, 1))
    ranges |= {"regret": (1, INF), "top_ratio": (0, INF)}
    for name, (low, high) in ranges.items():
        value = getattr(row, name)
        assert math.isnan(value) or low <= value <= high
    if np.isfinite(row.decile_ranks).all():
        assert row.decile_ranks.sum() == pytest.approx(55)


@settings(max_examples=30)
@given(errors, st.permutations(range(12)), st.integers(0, 2**16))
def test_neither_the_order_of_views_nor_the_scale_of_the_score_matters(error, order, seed):
    score = np.random.default_rng(seed).permutation(12.0 * np.arange(1, 13))  # without ties, which are broken by place
    score[:2] = NAN
    once = judge(checked(error, score=score, tolerance=1.0), "score")
    again = judge(checked(error[order], score=np.log(score)[order], tolerance=1.0), "score")
    for name in FIGURES:
        assert getattr(once, name) == pytest.approx(getattr(again, name), nan_ok=True)


@settings(max_examples=30)
@given(errors, any_scores, st.integers(-8, 8))
def test_the_unit_of_the_error_does_not_matter(error, score, power):
    """Scaled by powers of 2, so that the floating-point results are the same to the last bit."""
    error = np.where(np.abs(error) < 1e-200, 0.0, error)
    once, scaled = (judge(checked(values, score=score), "score") for values in (error, error * 2.0**power))
    for name in FIGURES:
        np.testing.assert_array_equal(getattr(once, name), getattr(scaled, name))


# ------------------------------------------------------------------------------------------------ calibration


def test_normal_errors_of_the_predicted_size_are_calibrated():
    z = np.random.default_rng(21).normal(size=(2000, 4))
    found = calibrate(z)
    assert (found.views, found.trials) == (2000, 8000)
    # 8000 independent trials: binomial; 1 / sqrt(2 n); 1 / sqrt(n); sqrt(6 / n); sqrt(24 / n); four of each
    assert abs(found.coverage - NORMAL_COVERAGE) < 4 * math.sqrt(NORMAL_COVERAGE * (1 - NORMAL_COVERAGE) / 8000)
    assert abs(found.z_rms - 1) < 4 / math.sqrt(16000)
    assert abs(found.z_mean) < 4 / math.sqrt(8000)
    assert abs(found.skewness) < 4 * math.sqrt(6 / 8000)
    assert abs(found.excess_kurtosis) < 4 * math.sqrt(24 / 8000)
    assert found.p_normal > 1e-4
    assert found.low < NORMAL_COVERAGE < found.high
    assert found.skewness == pytest.approx(stats.skew(z, axis=None))
    assert found.excess_kurtosis == pytest.approx(stats.kurtosis(z, axis=None))


def test_an_uncertainty_of_half_the_size_covers_as_much_as_one_sigma():
    found = calibrate(2 * np.random.default_rng(22).normal(size=(4000, 1)))
    inside = math.erf(1 / math.sqrt(2))
    assert abs(found.coverage - inside) < 4 * math.sqrt(inside * (1 - inside) / 4000)
    assert abs(found.z_rms - 2) < 4 * 2 / math.sqrt(8000)
    assert found.high < NORMAL_COVERAGE


def test_the_length_of_a_vector_is_covered_as_rayleigh_says_and_is_not_normal():
    z = np.linalg.norm(np.random.default_rng(23).normal(size=(4000, 1, 2)), axis=2)
    found = calibrate(z)
    inside = 1 - math.exp(-2)
    assert abs(found.coverage - inside) < 4 * math.sqrt(inside * (1 - inside) / 4000)
    assert found.p_normal < 1e-6


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


def test_missing_repeats_and_views_take_no_part_in_the_calibration():
    z = np.array([[0.5, NAN], [NAN, NAN], [-3.0, 1.0]])
    found = calibrate(z)
    assert (found.views, found.trials, found.coverage) == (2, 3, pytest.approx(2 / 3))
    assert found.z_rms == pytest.approx(math.sqrt((0.25 + 9 + 1) / 3))
    assert math.isnan(found.p_normal)
    nothing = calibrate(np.full((4, 2), NAN))
    assert (nothing.views, nothing.trials) == (0, 0) and math.isnan(nothing.coverage) and math.isnan(nothing.z_rms)


def test_z_that_never_vary_have_no_shape():
    found = calibrate(np.full((30, 2), 0.7))
    assert (found.coverage, found.z_rms, found.z_mean) == (1, pytest.approx(0.7), pytest.approx(0.7))
    assert math.isnan(found.skewness) and math.isnan(found.excess_kurtosis) and math.isnan(found.p_normal)


def test_by_decile_the_error_follows_a_right_uncertainty():
    draw = np.random.default_rng(9)
    u = np.exp(draw.normal(size=1000))
    error = u[:, None] * draw.normal(size=(1000, 4))
    u[5], error[6] = NAN, NAN
    found = calibrate_by_decile(error, u)
    assert found.views.sum() == 998 and np.ptp(found.views) == 1
    assert (np.diff(found.uncertainty) > 0).all()
    # the sum of n squares u^2 z^2 scatters by sqrt(2 sum u^4) about sum u^2, its root by half as much, relative
    known = np.sort(u[np.isfinite(u) & np.isfinite(error).any(axis=1)])
    bins = np.arange(998) * 10 // 998
    spread = [math.sqrt((known[bins == k] ** 4).sum() / 8) / (known[bins == k] ** 2).sum() for k in range(10)]
    assert (np.abs(found.error / found.uncertainty - 1) < 4 * np.array(spread)).all()
    # of ten 95 % intervals fewer than seven cover one time in a thousand
    assert ((found.low < NORMAL_COVERAGE) & (found.high > NORMAL_COVERAGE)).sum() >= 7


def test_few_views_leave_bins_of_the_calibration_empty():
    found = calibrate_by_decile(np.ones((3, 2)), np.array([1.0, 2.0, NAN]))
    assert found.views.tolist() == [1, 0, 0, 0, 0, 1, 0, 0, 0, 0]
    np.testing.assert_array_equal(found.uncertainty[[0, 5, 1]], [1, 2, NAN])
    assert calibrate_by_decile(np.full((3, 2), NAN), np.ones(3)).views.sum() == 0


@settings(max_examples=50)
@given(arrays(float, (25, 2), elements=st.one_of(st.just(NAN), st.integers(-9000, 9000).map(lambda k: k / 1000))))
def test_a_calibration_is_in_its_range_or_not_defined(z):
    found = calibrate(z)
    if found.trials:
        assert 0 <= found.low <= found.coverage <= found.high <= 1
        assert found.z_rms >= abs(found.z_mean) * (1 - 1e-12)
        assert math.isnan(found.p_normal) or 0 <= found.p_normal <= 1
    else:
        assert np.isnan(z).all()


# ------------------------------------------------------------------------------------------------- the table


def campaign():
    """Two measurements of two samples; V_m and the uncertainty take turns to be right, and one row has no truth."""
    right, random = -np.arange(100.0), np.random.default_rng(1).random(100)
    return [
        checked(rising(), np.arange(1, 101.0), "angle", "white", **{V_M: random}),
        checked(rising(100, 20), np.arange(1, 101.0), "angle", "shiny", **{V_M: random}),
        checked(rising(), random + 1, "radius", "white", **{V_M: right}),
        checked(np.full((100, 4), NAN), random + 1, "radius", "shiny", **{V_M: right}),
    ]


def test_rows_come_for_every_score_and_for_the_repeats():
    rows = score_rows(campaign())
    assert [(row.measurement, row.sample, row.score) for row in rows[:3]] == [
        ("angle", "white", V_M), ("angle", "white", UNCERTAINTY), ("angle", "white", REPEATS),
    ]  # fmt: skip
    assert len(rows) == 12


def test_the_mean_over_all_rows_leaves_out_and_counts_what_is_not_defined():
    rows = score_rows(campaign())
    totals = {total.score: total for total in overall(rows)}
    here = [row for row in rows if row.score == UNCERTAINTY]
    mine = totals[UNCERTAINTY]
    assert mine.rows == 4
    assert (mine.defined["roc_area"], mine.defined["view_spearman"], mine.defined["lost"]) == (1, 3, 4)
    assert mine.mean["roc_area"] == here[1].roc_area
    assert mine.mean["decile_spearman"] == pytest.approx(np.mean([row.decile_spearman for row in here[:3]]))
    assert mine.mean["regret"] == pytest.approx(np.prod([row.regret for row in here[:3]]) ** (1 / 3))
    assert mine.defined["within"] == 0 and math.isnan(mine.mean["within"])


def test_an_infinite_regret_stays_infinite_in_the_mean():
    lost = rising(20)
    lost[:2] = np.nan
    rows = score_rows([
        checked(lost, sample="shiny", score=-np.arange(20.0)), checked(rising(20), score=-np.arange(20.0)),
    ])  # fmt: skip
    assert next(total for total in overall(rows) if total.score == "score").mean["regret"] == INF


def test_mean_ranks_of_a_perfect_and_of_a_random_score():
    draw = np.random.default_rng(12)
    every = [checked(rising(), np.arange(1, 101.0), sample=str(k), random=draw.random(100)) for k in range(40)]
    every.append(checked(rising(5), np.arange(1, 6.0), sample="few", random=draw.random(5)))
    found = mean_ranks(score_rows(every))
    assert found[UNCERTAINTY][0].tolist() == list(range(1, 11))
    ranks, count = found["random"]
    assert count == 40
    # a rank of ten scatters by sqrt((100 - 1) / 12) = 2.87; four standard errors of 40, of each decile
    assert np.abs(ranks - 5.5).max() < 4 * 2.87 / math.sqrt(40)
    assert ranks.mean() == pytest.approx(5.5)


def test_contests_are_won_by_decile_spearman_and_then_by_regret():
    rows = score_rows(campaign())
    assert contests(rows) == [
        Contest("angle", ALL, UNCERTAINTY, "decile_spearman"), Contest("radius", ALL, V_M, "decile_spearman"),
    ]  # fmt: skip
    assert contests(rows, by="sample")[3] == Contest("radius", "shiny", "", "")
    assert [contest.winner for contest in contests(rows, V_M, UNCERTAINTY)] == [UNCERTAINTY, V_M]
    # alike by decile, and different within the first two
    score = -np.arange(100.0)
    score[[9, 10]] = score[[10, 9]]
    nearly = score_rows([checked(rising(), np.arange(1, 101.0), **{V_M: score})])
    assert contests(nearly) == [Contest("angle", ALL, UNCERTAINTY, "regret")]
    assert contests(nearly, challenger="nobody") == []


def test_a_contest_over_samples_uses_only_those_where_both_have_the_figure():
    nearly = -np.arange(100.0)
    nearly[:20] = np.roll(nearly[:20], 10)  # the first two deciles changed places: 1 - 6 (1 + 1) / 990
    few = np.where(np.arange(100) < 8, nearly, NAN)  # too few for deciles
    rows = score_rows([
        checked(rising(), np.arange(1, 101.0), sample="white", **{V_M: nearly}),
        checked(rising(), 101 - np.arange(1, 101.0), sample="shiny", **{V_M: few}),
    ])  # fmt: skip
    assert [row.decile_spearman for row in rows if row.score == UNCERTAINTY] == [1, -1]
    assert rows[0].decile_spearman == pytest.approx(1 - 12 / 990)
    assert contests(rows) == [Contest("angle", ALL, UNCERTAINTY, "decile_spearman")]  # 1 against 0.988, not 0


def test_the_table_is_written_with_a_row_over_all(tmp_path):
    rows = score_rows(campaign())
    write_score_rows(tmp_path / "validation.csv", rows)
    with (tmp_path / "validation.csv").open(newline="") as file:
        table = list(csv.DictReader(file))
    assert len(table) == 12 + 3
    assert {"measurement", "sample", "score", "rank_of_decile_1", "rank_of_decile_10", *FIGURES} <= set(table[0])
    assert [row["score"] for row in table[12:]] == [V_M, UNCERTAINTY, REPEATS]
    last = table[13]
    assert (last["measurement"], last["sample"], last["views"], last["measurable"]) == (ALL, ALL, "400", "280")
    assert float(last["regret"]) == overall(rows)[1].mean["regret"]
    assert last["view_spearman_low"] == "" and table[0]["view_spearman_low"] != ""
    assert float(table[1]["decile_spearman"]) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["validation.csv"]
    write_score_rows(tmp_path / "none.csv", [])
    assert (tmp_path / "none.csv").read_text().strip() == "measurement,sample,score"


def test_calibrations_are_pooled_over_measurements_of_any_number_of_repeats(tmp_path):
    draw = np.random.default_rng(14)
    u = np.exp(draw.normal(size=300))
    every = [checked(u[:, None] * draw.normal(size=(300, repeats)), u, sample=str(repeats)) for repeats in (1, 3, 5)]
    rows = calibrations(every)
    assert [(sample, found.trials) for _, sample, found in rows] == [("1", 300), ("3", 900), ("5", 1500), (ALL, 2700)]
    assert abs(rows[-1][2].z_rms - 1) < 4 / math.sqrt(2 * 2700)
    assert len(calibrations(every[:1])) == 1
    write_calibrations(tmp_path / "calibration.csv", rows)
    with (tmp_path / "calibration.csv").open(newline="") as file:
        table = list(csv.DictReader(file))
    assert [float(row["coverage"]) for row in table] == [found.coverage for _, _, found in rows]
