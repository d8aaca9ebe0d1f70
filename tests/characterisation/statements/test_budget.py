"""The budget from the trials of a statement, against variances that are known."""

import numpy as np
import pytest
from scipy.stats import binom

from characterisation.statements.budget import INTERACTION, NOISE, budget
from characterisation.statements.one_sided import OneSidedErrors
from characterisation.statements.variance_components import AT_ONCE
from tests.proofs.budgets import NUMBERS, KnownStudy, design

#: variances by group; temperature and light cause none
TRUTH = {
    "calibration": 0.30, "finish": 0.20, "light": 0.0, "temperature": 0.0, "pose": 0.15, "unit": 0.15,
    INTERACTION: 0.05, NOISE: 0.15,
}  # fmt: skip


def drawn(seed, count, truth=TRUTH, rare=False):
    """Errors, numbers and seeds of the trials of a statement whose variances are known."""
    return KnownStudy(truth, np.random.default_rng(seed), rare).statement(count)


def test_shares_are_right_on_average_and_as_often_inside_their_intervals_as_is_said():
    rounds = 24
    found = {name: [] for name in TRUTH}
    inside = 0
    for number in range(rounds):
        errors, numbers, seeds = drawn(number, 200)
        lines = budget(errors, numbers, seeds)
        assert sum(line.share for line in lines) == pytest.approx(1)
        assert sum(line.variance for line in lines) == pytest.approx(errors.var(ddof=1))
        assert [line.variance for line in lines] == sorted((line.variance for line in lines), reverse=True)
        for line in lines:
            found[line.group].append(line.share)
            low, high = line.share_interval
            inside += low - 1e-9 <= TRUTH[line.group] <= high + 1e-9
    for name, shares in found.items():
        error = max(np.std(shares, ddof=1), 0.01) / np.sqrt(rounds)
        assert abs(np.mean(shares) - TRUTH[name]) < 4 * error + 0.01, name
    cells = rounds * len(TRUTH)
    assert binom.ppf(0.001, cells, 0.90) <= inside <= binom.ppf(0.999, cells, 0.985)


def test_many_trials_find_the_truth():
    errors, numbers, seeds = drawn(2, 8 * AT_ONCE)
    for line in budget(errors, numbers, seeds):
        assert line.share == pytest.approx(TRUTH[line.group], abs=0.03), line.group
        assert line.settled


def test_rare_large_errors_of_the_noise_are_charged_to_no_group_that_drew_numbers():
    truth = dict.fromkeys(TRUTH, 0.0) | {"calibration": 0.3, NOISE: 0.7}
    several = [budget(*drawn(number, 200, truth, rare=True)) for number in range(12)]
    shares = {name: [one.share for lines in several for one in lines if one.group == name] for name in TRUTH}
    assert np.mean(shares["calibration"]) == pytest.approx(0.3, abs=0.12)
    for name in ("finish", "temperature", "pose"):
        assert np.mean(shares[name]) < 0.05, name


def test_lines_are_open_where_trials_are_too_few():
    errors, numbers, seeds = drawn(4, 40)
    lines = {line.group: line for line in budget(errors, numbers, seeds)}
    assert not lines["calibration"].settled  # 39 numbers, 40 trials
    assert budget(errors[:29], {}, {}) == ()
    assert budget(np.zeros(50), {}, {}) == ()


def test_trials_without_a_value_are_left_out():
    errors, numbers, seeds = drawn(5, 200)
    errors[::7] = np.nan
    known = np.isfinite(errors)
    less = budget(errors[known], *({k: v[known] for k, v in one.items()} for one in (numbers, seeds)))
    assert budget(errors, numbers, seeds) == less


def test_numbers_that_do_not_vary_and_seeds_that_all_differ_have_no_line():
    errors, numbers, seeds = drawn(6, 60)
    constant = numbers | {"constant": np.full((60, 3), 0.7), "none": np.empty((60, 0))}
    groups = {line.group for line in budget(errors, constant, seeds | {"form": np.arange(60)})}
    assert groups == set(TRUTH)
    single = {line.group for line in budget(errors, numbers, {INTERACTION: np.arange(60)})}
    assert single == {*NUMBERS, NOISE}


def test_errors_of_a_position_are_divided_by_their_vectors():
    # parts at the limit deviate in random directions: the error of the value is linear in no drawn number
    rng, count = np.random.default_rng(8), 400
    day, _ = design(count)
    numbers = rng.standard_normal((day.max() + 1, 3))[day]
    vectors = 0.8 * numbers + 0.6 * rng.standard_normal((count, 3))
    directions = rng.standard_normal((day.max() + 1, 3))[day]
    errors = OneSidedErrors(
        vectors[:, None], directions[:, None], lambda rows: np.linalg.norm(rows, axis=(-2, -1)), 50.0
    )
    lines = {line.group: line for line in budget(errors, {"calibration": numbers}, {INTERACTION: day})}
    assert lines["calibration"].share == pytest.approx(0.64, abs=0.1)
    plain = {line.group: line for line in budget(errors.stated, {"calibration": numbers}, {INTERACTION: day})}
    assert plain["calibration"].share < 0.2
