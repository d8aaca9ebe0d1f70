"""Deciles of a score against true errors, by closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest

from characterisation.files.errors import InputError
from characterisation.scores.deciles import bin_ranks, bins_of, deciles, mean_interval, mean_ranks


def test_bins_hold_equal_shares_of_the_views_from_the_lowest_score_to_the_highest() -> None:
    score = np.random.default_rng(1).permutation(50.0 * np.arange(30) - 7)
    found = bins_of(score)
    assert np.bincount(found).tolist() == [0] + [3] * 10
    assert (np.diff(found[np.argsort(score)]) >= 0).all()


@pytest.mark.parametrize(
    ("score", "bins"),
    [
        ([5.0] * 4, [6] * 4),  # mean rank 2.5 of 4: floor(10 * 2 / 4) + 1
        ([1, 2, 2, 3], [2, 6, 6, 9]),  # ranks 1, 2.5, 2.5, 4
        ([0.5], [6]),
        (list(range(10)), list(range(1, 11))),
    ],
)
def test_equal_scores_share_the_bin_of_their_mean_rank(score: list[float], bins: list[int]) -> None:
    assert bins_of(score).tolist() == bins


def test_ties_across_the_edge_of_a_bin_are_not_split() -> None:
    score = np.arange(40.0)
    score[2:7] = 4.0  # bins 1 and 2 meet at 4 views
    assert len(set(bins_of(score)[2:7].tolist())) == 1


def test_impossible_views_are_a_bin_of_their_own_and_change_no_other() -> None:
    score = np.array([3.0, np.nan, 1.0, np.inf, 2.0, -np.inf])
    assert bins_of(score).tolist() == [9, 0, 2, 0, 6, 0]
    found = deciles(score, np.array([1.0, 9.0, 3.0, np.nan, 2.0, np.nan]))
    assert found["views"].values[0] == 3
    assert found["measured"].values[0] == 1
    assert found["error"].values[0] == 9.0
    assert math.isnan(found["error_rank"].values[0])


def test_a_bin_with_more_values_ranks_before_one_with_fewer() -> None:
    error = np.ones((10, 20))
    for view in range(10):
        error[view, 10 + view :] = np.nan
    found = deciles(np.arange(10.0), error)
    assert found["share"].values[1:].tolist() == [(10 + view) / 20 for view in range(10)]
    assert found["share_rank"].values[1:].tolist() == list(range(10, 0, -1))
    assert found.attrs["share_correlation"] == pytest.approx(-1)
    assert mean_ranks([found], "share")["rank"].values.tolist() == list(range(10, 0, -1))


def test_a_bin_is_the_mean_over_its_views_of_mean_absolute_error_and_standard_deviation() -> None:
    score = np.repeat(np.arange(10.0), 2)
    error = np.zeros((20, 4))
    error[0] = [1, -1, 1, -1]  # mean absolute 1, standard deviation sqrt(4/3)
    error[1] = [3, 3, np.nan, 3]  # 3 and 0
    found = deciles(score, error)
    assert found["error"].values[1] == pytest.approx(2.0)
    assert found["deviation"].values[1] == pytest.approx(math.sqrt(4 / 3) / 2)
    assert found["share"].values[1] == pytest.approx(7 / 8)
    # Student's t with 1 degree of freedom: 12.7062 standard errors, here 1; a mean of sizes is not below 0
    assert found["error_high"].values[1] == pytest.approx(2 + 12.7062, abs=1e-3)
    assert found["error_low"].values[1] == 0.0


def test_the_interval_of_a_mean_covers_it_in_95_per_cent_of_samples() -> None:
    rng = np.random.default_rng(2)
    inside = 0
    for _ in range(2000):
        mean, low, high = mean_interval(10 + rng.standard_normal(5))
        assert low < mean < high
        inside += low <= 10 <= high
    assert abs(inside / 2000 - 0.95) < 4 * math.sqrt(0.95 * 0.05 / 2000)


def test_a_perfect_score_has_the_ranks_10_to_1_and_the_correlation_minus_1() -> None:
    score = np.arange(100.0)
    found = deciles(score, 200 - score)
    assert found["error_rank"].values[1:].tolist() == list(range(10, 0, -1))
    assert found.attrs["error_correlation"] == -1.0
    assert deciles(score, score + 1).attrs["error_correlation"] == 1.0


def test_a_bin_without_any_value_ranks_last_and_one_without_views_has_no_rank() -> None:
    assert bin_ranks([9, np.nan, 4, 3], [5, 2, 2, 2]).tolist()[1:] == pytest.approx(
        [10 * 2.5 / 3 + 0.5, 10 * 1.5 / 3 + 0.5, 10 * 0.5 / 3 + 0.5]
    )
    ranks = bin_ranks([np.nan] * 11, [0, 0, *[1] * 9])
    assert np.isnan(ranks[:2]).all()
    assert np.ptp(ranks[2:]) == 0
    assert ranks[2] == pytest.approx(5.5)  # all nine share the middle


def test_mean_ranks_average_cells_of_any_number_of_views() -> None:
    good, bad = deciles(np.arange(100.0), 200 - np.arange(100.0)), deciles(np.arange(100.0), 1 + np.arange(100.0))
    few = deciles([1.0, 2.0], [5.0, 4.0])  # two bins: 3 and 8, stretched to 8 and 3
    mean = mean_ranks([good, bad])
    assert mean["rank"].values.tolist() == [5.5] * 10
    assert mean.attrs["correlation"] == 0.0
    with_few = mean_ranks([good, few])
    assert with_few["cells"].values.tolist() == [1, 1, 2, 1, 1, 1, 1, 2, 1, 1]
    assert with_few["rank"].values[[2, 7]].tolist() == pytest.approx([8.0, 3.0])
    assert with_few.attrs["correlated"] == 1  # two bins have no rank correlation


def test_a_score_without_information_has_ranks_near_the_middle() -> None:
    rng = np.random.default_rng(3)
    cells = [deciles(rng.random(60), rng.random((60, 10))) for _ in range(60)]
    found = mean_ranks(cells)
    sigma = math.sqrt((100 - 1) / 12 / 60)  # of the mean of 60 ranks 1 to 10
    assert np.abs(found["rank"].values - 5.5).max() < 4 * sigma
    assert abs(found.attrs["correlation"]) < 4 / math.sqrt(9 * 60)


def test_errors_of_another_number_of_views_are_rejected() -> None:
    with pytest.raises(InputError, match=r"the shape \(1,\) for scores of \(2,\)"):
        deciles([1.0, 2.0], [1.0])


def test_trials_that_were_not_made_are_not_trials_without_value() -> None:
    errors = [[0.1, math.nan, math.nan], [0.1, 0.2, math.nan]]
    assert deciles([1.0, 1.0], errors)["share"].sel(bin=6).item() == pytest.approx(3 / 6)
    assert deciles([1.0, 1.0], errors, [1, 3])["share"].sel(bin=6).item() == pytest.approx(3 / 4)
