"""Sets of views against all sets there are, and against what convexity says."""

from itertools import combinations

import numpy as np
import pytest

from characterisation.scores.view_sets import FeatureInformation, fewest_views, greedy_views, set_uncertainty


def problem(seed: int, views: int = 12, measurements: int = 4) -> list[FeatureInformation]:
    """Two features with random information, some of it missing; each measurement needs one or both."""
    rng = np.random.default_rng(seed)
    made = []
    for number, p in enumerate((3, 5)):
        root = rng.normal(size=(views, p, p)) * rng.lognormal(0, 1, (views, 1, 1))
        information = root @ root.swapaxes(1, 2) * (rng.random(views) < 0.8)[:, None, None]
        g = rng.normal(size=(measurements, p))
        g[number::3] = 0
        made.append(FeatureInformation(information, g[:, :, None] * g[:, None, :]))
    return made


def fewest_by_trying(features: list[FeatureInformation], limits: np.ndarray) -> int:
    count = len(features[0].information)
    for size in range(count + 1):
        for views in combinations(range(count), size):
            chosen = np.zeros(count)
            chosen[list(views)] = 1
            if (set_uncertainty(features, chosen) <= limits).all():
                return size
    raise AssertionError("no set keeps the limits")


@pytest.mark.parametrize("seed", range(8))
def test_the_exact_set_is_as_few_as_the_best_of_all_sets(seed: int) -> None:
    features = problem(seed)
    everything = set_uncertainty(features, np.ones(12))
    limits = everything * np.random.default_rng(seed).uniform(1.3, 2.5, len(everything))
    found, greedy = fewest_views(features, limits), greedy_views(features, limits)
    assert found.exact and found.feasible.all()
    assert (found.uncertainty <= limits).all() and (greedy.uncertainty <= limits).all()
    assert len(found.views) == fewest_by_trying(features, limits) <= len(greedy.views)


def test_two_views_of_one_plane_are_better_by_the_root_of_two() -> None:
    information = np.tile(np.eye(3), (4, 1, 1)) / 0.04
    plane = FeatureInformation(information, np.diag([1.0, 0.0, 0.0])[None])
    assert set_uncertainty([plane], np.array([1, 0, 0, 0]))[0] == pytest.approx(0.2)
    assert set_uncertainty([plane], np.array([1, 1, 0, 0]))[0] == pytest.approx(0.2 / np.sqrt(2))
    found = fewest_views([plane], np.array([0.2 / np.sqrt(3) * 1.001]))
    assert len(found.views) == 3 and found.exact


def test_features_that_no_view_sees_together_take_two_views() -> None:
    first = FeatureInformation(np.array([np.eye(2), np.zeros((2, 2))]), np.eye(2)[None])
    second = FeatureInformation(np.array([np.zeros((2, 2)), np.eye(2)]), np.eye(2)[None])
    found = fewest_views([first, second], np.array([3.0]))
    assert found.views == (0, 1)
    assert found.uncertainty[0] == pytest.approx(2.0, rel=1e-6)


def test_a_limit_that_all_views_together_miss_is_told_and_left_out() -> None:
    features = problem(3)
    limits = set_uncertainty(features, np.ones(12)) * np.array([1.5, 0.9, 1.5, 1.5])
    found = fewest_views(features, limits)
    assert found.feasible.tolist() == [True, False, True, True]
    assert (found.uncertainty <= limits)[found.feasible].all()


def test_uncertainty_is_convex_in_the_shares() -> None:
    features, rng = problem(5), np.random.default_rng(0)
    for _ in range(50):
        a, b, t = rng.random(12), rng.random(12), rng.random()
        between = set_uncertainty(features, t * a + (1 - t) * b) ** 2
        chord = t * set_uncertainty(features, a) ** 2 + (1 - t) * set_uncertainty(features, b) ** 2
        assert (between <= chord * (1 + 1e-9)).all()


def test_out_of_six_hundred_views_time_ends_the_search_with_a_set_that_keeps_the_limits() -> None:
    features = problem(11, views=642, measurements=7)
    limits = set_uncertainty(features, np.ones(642)) * 6
    found, greedy = fewest_views(features, limits, seconds=5), greedy_views(features, limits)
    assert (found.uncertainty <= limits).all()
    assert len(found.views) <= len(greedy.views)
