"""Screening judged by true risks: closed forms, and statistics with fixed seeds."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tests.proofs import screening_figures as screening
from tests.proofs.screening_figures import (
    Screened,
    ceiling,
    interval,
    measurable_area,
    rank_correlation,
    recall,
    reliability,
)


def drawn(spreads, worlds, seed=0):
    return np.asarray(spreads, float)[:, None] * np.random.default_rng(seed).standard_normal((len(spreads), worlds))


def test_recall_asks_for_a_view_within_a_tenth_of_the_best():
    errors = np.array([[1.0, -1.0], [1.09, -1.09], [2.0, -2.0], [0.5, np.nan]])
    errors[3] = np.nan  # best of all, if it could be measured
    assert recall(Screened(np.array([3.0, 1.0, 2.0, 0.0]), errors), 2) == 1
    assert recall(Screened(np.array([3.0, 4.0, 2.0, 0.0]), errors), 2) == 0
    assert recall(Screened(np.array([3.0, np.inf, 2.0, 0.0]), errors), 4) == 1
    assert recall(Screened(np.array([np.inf, np.inf, 2.0, 0.0]), errors), 4) == 0
    assert math.isnan(recall(Screened(np.zeros(4), np.full((4, 2), np.nan)), 4))


def test_rank_correlation_is_over_measurable_views_alone():
    errors = drawn(np.arange(1, 31), 400)
    errors[::2] = np.nan
    cost = np.where(np.arange(30) % 2, np.arange(30.0), -np.arange(30.0))
    assert rank_correlation(Screened(cost, errors)) > 0.97
    assert rank_correlation(Screened(-cost, errors)) < -0.97


def test_views_that_a_score_calls_impossible_are_tied_behind_the_others():
    errors = drawn(np.arange(1, 7), 4000)
    assert rank_correlation(Screened(np.array([1, 2, 3, np.inf, np.inf, np.inf]), errors)) == pytest.approx(
        np.corrcoef([1, 2, 3, 5, 5, 5], np.arange(6))[0, 1]
    )


@pytest.fixture
def few_halves(monkeypatch):
    """Split the worlds thirty times: their halves overlap, so more of them hardly change the ceiling."""
    monkeypatch.setattr(screening, "_HALVES", 30)


@pytest.mark.usefixtures("few_halves")
@pytest.mark.parametrize("worlds", [12, 30])
def test_ceiling_is_what_the_right_score_reaches(worlds):
    spreads = np.exp(np.random.default_rng(1).normal(0, 0.5, 40))
    told, reached = [], []
    for seed in range(40):
        errors = drawn(spreads, worlds, seed)
        told.append(ceiling(errors, seed))
        reached.append(rank_correlation(Screened(spreads, errors)))
    assert np.mean(told) == pytest.approx(np.mean(reached), abs=0.025)


@pytest.mark.usefixtures("few_halves")
def test_ceiling_of_views_that_are_all_alike_is_low():
    assert np.mean([ceiling(drawn(np.ones(40), 12, seed)) for seed in range(30)]) < 0.35


def test_area_counts_pairs_and_ties_as_half():
    errors = np.array([[1.0], [1.0], [np.nan], [np.nan]])
    assert measurable_area(Screened(np.array([1.0, np.inf, 2.0, np.inf]), errors)) == pytest.approx(
        (1 + 1 + 0 + 0.5) / 4
    )


def test_interval_covers_the_true_mean_area():
    hits, true = 0, 0.76025  # P(a > b) of normals one apart
    for seed in range(120):
        rng = np.random.default_rng(seed)
        able = np.arange(60) % 2 == 0
        cost = -(rng.standard_normal(60) + able)
        low, high = interval([[Screened(cost, np.where(able, 1.0, np.nan)[:, None])]], measurable_area, seed)
        hits += low <= true <= high
    assert 0.88 <= hits / 120 <= 0.99


def test_reliability_puts_chances_together():
    chance = np.array([0.01, 0.5, 0.55, 1.0, 1.0])
    errors = np.array([[np.nan] * 4, [1, 1, np.nan, np.nan], [1, 1, 1, np.nan], [1] * 4, [1, 1, 1, np.nan]], float)
    found = reliability(chance, errors)
    assert found.views.tolist() == [1, 0, 0, 2, 0, 0, 2]
    assert found.predicted[[0, 3, 6]] == pytest.approx([0.01, 0.525, 1.0])
    assert found.found[[0, 3, 6]] == pytest.approx([0.0, 0.625, 0.875])
