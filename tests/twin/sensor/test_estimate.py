"""Estimates of several captures combined: what they contain, and how often their intervals hold the truth."""

from __future__ import annotations

import pytest

from mitsim.twin.sensor.estimate import FittedKey, pooled


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
