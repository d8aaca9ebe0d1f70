"""The random pattern: run lengths as Rice says, half of the area bright, blobs and not cells."""

from __future__ import annotations

import numpy as np
import pytest

from mitsim.sensor.pattern import random_blobs
from tests.figures_of_surfaces import mean_run_length


@pytest.mark.parametrize("run_length", [5.0, 7.0, 12.0])
def test_run_length_follows_from_the_filter(run_length):
    pattern = random_blobs(1500, 1000, run_length, 0.5, 0.0, seed=4)
    assert np.isclose(mean_run_length(pattern, 0.5), run_length, rtol=0.03)
    assert np.isclose(mean_run_length(pattern.T, 0.5), run_length, rtol=0.03)


@pytest.mark.parametrize("share", [0.3, 0.5, 0.8])
def test_share_of_bright_area(share):
    assert np.isclose(random_blobs(800, 600, 7, share, 0.9, seed=1).mean(), share, atol=0.002)


def test_same_seed_same_pattern_and_another_seed_another():
    a, b, c = (random_blobs(300, 200, 7, 0.5, 0.9, seed) for seed in (1, 1, 2))
    assert np.array_equal(a, b)
    assert abs(np.corrcoef(a.ravel(), c.ravel())[0, 1]) < 0.05


def test_run_length_of_stripes():
    stripes = np.tile(np.repeat([0.0, 1.0], 5), 10)[None].repeat(20, axis=0)
    assert mean_run_length(stripes, 0.5) == 5
