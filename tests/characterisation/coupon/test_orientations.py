"""Where a campaign adds orientations: on tables whose answer is known."""

import math

import numpy as np
import pytest

from characterisation.coupon.orientations import Refinement, cap_directions, refine

LARGEST = math.radians(60)


@pytest.fixture
def known():
    """Normals 17 deg apart, at which F = 1 and sigma = 0.1 mm, well known."""
    normals = cap_directions(2, LARGEST)
    ones = np.ones(len(normals))
    return normals, {
        "fraction": ones.copy(),
        "fraction_error": 0.01 * ones,
        "sigma": 0.1 * ones,
        "sigma_error": 0.002 * ones,
    }


def added(known, **settings):
    normals, seen = known
    return refine(normals, **seen, refinement=Refinement(**settings), largest_angle=LARGEST)


def beside(normals, number):
    """Its neighbours in the icosahedron of 17 deg."""
    angle = np.degrees(np.arccos(np.clip(normals @ normals[number], -1, 1)))
    return np.flatnonzero((angle > 1) & (angle < 22))


def test_nothing_is_added_where_nothing_changes_and_all_is_known(known):
    assert len(added(known, sigma_error=0.1).normals) == 0


def test_between_normals_that_differ_another_is_added(known):
    normals, seen = known
    seen["fraction"][0] = 0.5  # the one that faces the sensor
    new = added(known).normals
    assert len(new) >= len(beside(normals, 0))
    assert np.degrees(np.arccos(new[:, 2])).max() < 30


def test_where_sigma_is_hardly_known_the_ways_to_its_neighbours_are_halved(known):
    normals, seen = known
    seen["sigma_error"][0] = 0.02  # 20 % of sigma
    assert len(added(known).normals) == 0  # nobody asked
    new = added(known, sigma_error=0.1).normals
    near = beside(normals, 0)
    middles = normals[near] + normals[0]
    middles /= np.linalg.norm(middles, axis=1, keepdims=True)
    assert len(new) == len(near)
    assert np.abs(new[:, None] - middles).max(axis=2).min(axis=1).max() < 1e-9
    assert len(added(known, sigma_error=0.3).normals) == 0


def test_where_hardly_anything_comes_back_sigma_need_not_be_known(known):
    _, seen = known
    seen["fraction"][:] = 0.01
    seen["sigma_error"][:] = 0.05
    assert len(added(known, sigma_error=0.1).normals) == 0


def test_nothing_is_looked_for_on_the_way_to_where_nothing_comes_back(known):
    normals, seen = known
    seen["sigma_error"][0] = 0.02
    near = beside(normals, 0)
    seen["sigma"][near[:2]] = np.nan
    assert len(added(known, sigma_error=0.1).normals) == len(near) - 2


def test_it_ends_at_the_finest_icosahedron(known):
    normals, seen = known
    seen["sigma_error"][:] = 0.05
    assert len(added(known, sigma_error=0.1, subdivisions=2).normals) == 0
    assert len(added(known, sigma_error=0.1, subdivisions=3).normals) > 2 * len(normals)
