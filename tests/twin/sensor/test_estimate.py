"""Estimates of several captures combined: what they contain, and how often their intervals hold the truth."""

from __future__ import annotations

import numpy as np
import pytest

from mitsim.twin.sensor.estimate import FittedKey, combined, pooled


def estimates(values, uncertainties, determined):
    return [
        FittedKey("room.gradient[0]", value, u, "1", (f"sheet_{number}",), "dots", determined=known)
        for number, (value, u, known) in enumerate(zip(values, uncertainties, determined, strict=True))
    ]


def test_captures_that_do_not_determine_a_number_do_not_pull_it_to_the_file():
    """One of ten determines it: 3.0 +- 0.3. Before, 0.4 +- 0.6, as nine others had the file's 0 +- 0.9."""
    [found] = pooled(estimates([3.0] + 9 * [0.0], [0.3] + 9 * [0.9], [True] + 9 * [False]))
    assert (found.value, found.uncertainty) == pytest.approx((3.0, 0.3))
    assert found.captures == ("sheet_0",) and found.determined
    [kept] = pooled(estimates([0.1, -0.1], [0.9, 0.9], [False, False]))
    assert not kept.determined and kept.value == pytest.approx(0.0)


@pytest.mark.parametrize(("count", "least"), [(2, 0.84), (3, 0.9), (6, 0.93)])
def test_intervals_of_captures_that_differ_hold_the_truth(count, least):
    """Poses add ten times the captures' own uncertainty. Before, intervals of 95 % held it in 71, 82 and 89 %."""
    rng = np.random.default_rng(0)
    u = rng.uniform(0.7, 1.4, (3000, count))
    drawn = [combined(rng.normal(0.0, np.hypot(own, 10.0)), own) for own in u]
    assert least < np.mean([abs(value) < 1.96 * spread for value, spread in drawn]) < 0.96
    alike = [combined(rng.normal(0.0, own), own) for own in u]
    assert 0.94 < np.mean([abs(value) < 1.96 * spread for value, spread in alike]) < 0.98


@pytest.mark.parametrize("poses", [0.0, 10.0])
def test_captures_of_the_same_dots_share_their_error(poses):
    """Before, intervals of 95 % of three captures with one common error held the truth in 74 %."""
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(0.7, 1.4, (3000, 1)), 3, axis=1)
    errors = u * rng.normal(size=(3000, 1)) + rng.normal(0.0, poses, u.shape)
    drawn = [combined(x, own, common=True) for x, own in zip(errors, u, strict=True)]
    assert 0.9 < np.mean([abs(value) < 1.96 * spread for value, spread in drawn]) < 0.96
