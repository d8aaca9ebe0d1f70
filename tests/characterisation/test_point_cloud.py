"""Grids of pixels: pinholes, and rays that a lens bends."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from characterisation.point_cloud import ViewGrid

TURN = np.array([[0.96, -0.28, 0], [0.28, 0.96, 0], [0, 0, 1.0]])
PINHOLE = ViewGrid(120.0, 118.0, 40.5, 29.0, 80, 60, TURN, np.array([1.0, -2.0, 3.0]))


def bent(strength):
    """Rays of a lens with radial distortion, written as what each pixel shows."""
    columns, rows = np.meshgrid(np.arange(80), np.arange(60))
    x, y = (columns - 40.5) / 120, (rows - 29) / 118
    scale = 1 + strength * (x**2 + y**2)
    return replace(PINHOLE, normalised=np.stack([x * scale, y * scale], axis=-1).astype(np.float32))


def test_straight_rays_in_a_table_are_those_of_the_pinhole():
    table = bent(0.0)
    np.testing.assert_allclose(table.rays(), PINHOLE.rays(), atol=1e-7)
    points = PINHOLE.origin + 500 * PINHOLE.rays()
    np.testing.assert_allclose(table.project(points), PINHOLE.project(points), atol=1e-4)


@pytest.mark.parametrize("strength", [-0.4, 0.3])
def test_bent_rays_project_onto_their_own_pixels_and_beyond_the_edge_stay_outside(strength):
    grid = bent(strength)
    columns, rows = np.meshgrid(np.arange(80), np.arange(60))
    points = grid.origin + 500 * grid.rays()
    np.testing.assert_allclose(grid.project(points), np.stack([columns, rows], axis=-1), atol=1e-4)
    assert np.abs(PINHOLE.project(points) - np.stack([columns, rows], axis=-1)).max() > 2
    outside = grid.origin + np.array([[3.0, 0.1, 1], [-3, 0.1, 1]]) @ grid.rotation.T
    at = grid.project(outside)
    assert at[0, 0] > 79 and at[1, 0] < 0
    assert np.isnan(grid.project(grid.origin - [0, 0, 5.0])).all()


def test_rays_of_some_pixels_are_among_all():
    grid = bent(0.2)
    columns, rows = np.array([0, 79, 12]), np.array([59, 0, 30])
    np.testing.assert_array_equal(grid.rays_at(columns, rows), grid.rays()[rows, columns])


def test_a_table_of_another_size_is_refused():
    with pytest.raises(ValueError, match="normalised"):
        replace(PINHOLE, normalised=np.zeros((80, 60, 2), np.float32))


def test_grids_are_the_same_if_all_their_rays_are():
    """Distortion may differ in the middle alone; a pixel without a ray has none in either."""
    plain = ViewGrid(100.0, 100.0, 9.5, 7.5, 20, 16)
    columns, rows = np.meshgrid(np.arange(20), np.arange(16))
    table = (np.stack([columns - 9.5, rows - 7.5], axis=-1) / 100).astype(np.float32)
    table[0, 0] = np.nan
    bent = replace(plain, normalised=table)
    assert bent.same_rays(replace(plain, normalised=table.copy())) and plain.same_rays(replace(plain))
    other = table.copy()
    other[8, 10, 0] += 0.001
    assert not bent.same_rays(replace(plain, normalised=other))
    assert not bent.same_rays(plain)
    assert not plain.same_rays(replace(plain, cx=9.6))
    far = replace(plain, origin=np.array([0, 0, 1000.0]))
    assert not far.same_rays(replace(plain, origin=np.array([0, 0, 1000.002])))
