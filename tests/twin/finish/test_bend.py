"""The bend of a sheet: polynomials come back, noise and stray cells do not make one."""

from __future__ import annotations

import numpy as np
import pytest

from mitsim.twin.finish.specimen import fit_bend


def points(rng, heights, sigma):
    xy = rng.uniform([-60, -40], [60, 40], (60_000, 2))
    return np.column_stack([xy, heights(xy / [60, 40]) + rng.normal(0, sigma, len(xy))])


@pytest.mark.parametrize("degree", [2, 3, 4])
def test_a_polynomial_comes_back_within_its_noise(rng, degree):
    def shape(u):
        return 3.0 * u[:, 0] ** degree - 2.0 * u[:, 0] * u[:, 1]

    bend = fit_bend(points(rng, shape, 0.3))
    assert bend is not None and bend.degree >= degree
    u = rng.uniform(-0.95, 0.95, (500, 2))
    # medians of some 100 points a cell in 500 cells, for up to 28 terms
    assert np.abs(bend.heights(u * [60, 40]) - shape(u)).max() < 0.06


def test_a_flat_plate_stays_flat(rng):
    bend = fit_bend(points(rng, lambda u: np.zeros(len(u)), 0.3))
    assert bend is not None and bend.rms < 0.02


def test_stray_points_of_a_matcher_do_not_bend_a_sheet(rng):
    seen = points(rng, lambda u: 2.0 * u[:, 0] ** 2, 0.2)
    stray = rng.random(len(seen)) < 0.2
    seen[stray, 2] += rng.normal(0, 8, stray.sum())
    bend = fit_bend(seen)
    u = rng.uniform(-0.9, 0.9, (500, 2))
    assert np.abs(bend.heights(u * [60, 40]) - 2.0 * u[:, 0] ** 2).max() < 0.25


@pytest.mark.parametrize("height", [0.3, 1.0, 3.0])
def test_depths_in_whole_mm_give_the_bend_that_they_dither(height, rng):
    """The expected value of a depth with noise of half a step, once rounded, is the depth to 0.5 % of the step."""

    def shape(u):
        return height * u[:, 0] ** 2

    seen = points(rng, shape, 0.5)
    seen[:, 2] = np.round(seen[:, 2] + 0.3) - 0.3
    bend = fit_bend(seen, 1.0)
    u = rng.uniform(-0.95, 0.95, (500, 2))
    assert np.abs(bend.heights(u * [60, 40]) - shape(u)).max() < 0.08


def test_too_few_points_have_no_bend(rng):
    assert fit_bend(rng.normal(size=(50, 3))) is None
