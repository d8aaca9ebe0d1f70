"""Differences of clouds: closed forms of shifted, leaning and cut planes; curved surfaces."""

from functools import partial

import numpy as np
import pytest
from scipy.stats import norm

from characterisation.acceptance.cloud_difference import (
    difference_along_rays,
    difference_to_surface,
    distribution,
)
from characterisation.files.errors import InputError
from characterisation.point_cloud import PointCloud, Status, ViewGrid
from tests.seen_shapes import cloud_of, cylinder, sphere

GRID = ViewGrid(300.0, 300.0, 59.5, 49.5, 120, 100)


def plane_cloud(offset=0.0, lean=0.0, grid=GRID, kept=None):
    """A plane through (0, 0, 500 + offset) that leans by an angle [rad] about x."""
    normal = np.array([0, np.sin(lean), -np.cos(lean)])
    distance = np.array([0, 0, 500.0 + offset]) @ normal / (grid.rays() @ normal)
    if kept is not None:
        distance = np.where(kept, distance, np.nan)
    points = (grid.rays() * distance[..., None]).astype(np.float32)
    status = np.where(np.isfinite(distance), Status.VALID, Status.HIDDEN).astype(np.uint8)
    return PointCloud(points, status, grid, "known", "simulated")


def test_along_rays_a_shift_is_its_length_along_each_ray():
    found = difference_along_rays(plane_cloud(2.0), plane_cloud())
    assert found == pytest.approx(2.0 / GRID.rays()[..., 2], abs=1e-3)
    assert difference_along_rays(plane_cloud(), plane_cloud(2.0)) == pytest.approx(-found, abs=1e-9)


@pytest.mark.parametrize("lean", [0.0, 0.5, -0.9])
def test_to_the_surface_a_shift_is_its_part_along_the_normal(lean):
    """Wherever the reference's plane goes on beside the point."""
    found = difference_to_surface(plane_cloud(2.0, lean), plane_cloud(0.0, lean))
    assert found[10:-10, 10:-10] == pytest.approx(2.0 * np.cos(lean), abs=1e-3)


def test_to_the_surface_needs_no_shared_grid():
    other = ViewGrid(260.0, 260.0, 70.3, 61.1, 140, 120)
    found = difference_to_surface(plane_cloud(-1.5), plane_cloud(grid=other))
    assert np.isfinite(found).mean() > 0.95
    assert np.nanmax(np.abs(found + 1.5)) < 1e-3
    with pytest.raises(InputError, match="140 x 120 px"):
        difference_along_rays(plane_cloud(), plane_cloud(grid=other))
    assert not GRID.same_rays(other)


def test_points_beyond_the_edge_of_the_reference_have_no_difference():
    left = np.broadcast_to(np.arange(GRID.width) < 60, (GRID.height, GRID.width))
    along, to_surface = (
        take(plane_cloud(1.0), plane_cloud(kept=left)) for take in (difference_along_rays, difference_to_surface)
    )
    assert np.isnan(along[:, 60:]).all() and np.isfinite(along[:, :60]).all()
    assert np.isnan(to_surface[:, 62:]).all() and np.isfinite(to_surface[5:-5, :58]).all()


def test_points_far_from_the_reference_have_no_difference():
    assert np.isnan(difference_to_surface(plane_cloud(20.0), plane_cloud())).all()


def test_the_distribution_is_that_of_the_values_that_are_there(rng):
    values = np.full((100, 100), np.nan)
    values[:60] = rng.normal(0.3, 0.2, (60, 100))
    found = distribution(values, 8000)
    assert (found.count, found.points_given) == (6000, 8000)
    assert found.mean == pytest.approx(0.3, abs=4 * 0.2 / np.sqrt(6000))
    assert found.robust_deviation == pytest.approx(0.2, rel=0.06)
    assert (found.low, found.high) == pytest.approx((0.3 - 0.392, 0.3 + 0.392), abs=0.03)
    assert np.isnan(distribution(np.full((3, 3), np.nan), 9).mean)


@pytest.mark.parametrize("step", [1, 15])
def test_a_window_is_that_part_of_the_whole(step, rng):
    """Also with a reference so sparse that the neighbours of a point lie outside the window's surroundings."""
    rows, columns = np.ogrid[: GRID.height, : GRID.width]
    kept = (rows % step == 0) & (columns % step == 0)
    cloud, reference = plane_cloud(1.0, 0.3, kept=rng.random(kept.shape) < 0.9), plane_cloud(lean=0.3, kept=kept)
    window = slice(40, 60), slice(30, 55)
    whole = difference_to_surface(cloud, reference)
    assert np.isfinite(whole[window]).any()
    assert np.array_equal(difference_to_surface(cloud, reference, window), whole[window], equal_nan=True)
    along = difference_along_rays(cloud, reference, window)
    assert np.array_equal(along, difference_along_rays(cloud, reference)[window], equal_nan=True)


def test_the_difference_is_that_of_the_nearest_points_by_exhaustive_search(rng):
    rows, columns = np.ogrid[: GRID.height, : GRID.width]
    kept = (rows % 5 == 0) & (columns % 5 == 0)  # 12 neighbours of a point lie within 14 mm, its counterparts within 5
    cloud, reference = plane_cloud(1.0), plane_cloud(lean=0.02, kept=kept)
    surface = reference.points[reference.valid].astype(float)
    window = slice(50, 51), slice(20, 40)
    found = difference_to_surface(cloud, reference, window)[0]
    for point, value in zip(cloud.points[50, 20:40].astype(float), found, strict=True):
        patch = surface[np.argsort(np.linalg.norm(surface - point, axis=1))[:12]]
        normal = np.linalg.svd(patch - patch.mean(axis=0))[2][2]
        # the surface of second order through points of a plane is the plane, but for their rounding to 3e-5 mm
        assert value == pytest.approx((point - patch.mean(axis=0)) @ (normal * np.sign(normal @ point)), abs=1e-5)


@pytest.mark.parametrize("across", [sphere, partial(cylinder, axis=[1.0, 0.2, 0.0])])
def test_a_curved_surface_does_not_differ_from_itself(across):
    """Seen on two grids; planes through 12 points 2.5 mm apart would lie up to 0.2 mm inside."""
    coarse = ViewGrid(160.0, 160.0, 79.7, 59.2, 160, 120)
    ideal = {"centre": [10.0, 5.0, 400.0]} if across is sphere else {"point": [0.0, 0.0, 400.0]}
    seen, reference = (cloud_of(across(**ideal, radius=60.0, grid=grid), grid=grid) for grid in (GRID, coarse))
    found = difference_to_surface(seen, reference)
    found = found[np.isfinite(found)]
    assert len(found) > 4000
    assert abs(found.mean()) < 2e-3
    assert found.std() < 0.01


def test_progress_is_told_of_every_block_of_points():
    grid = ViewGrid(600.0, 600.0, 199.5, 149.5, 400, 300)
    told = []

    def progress(starts):
        told.append(list(starts))
        return starts

    difference_to_surface(plane_cloud(1.0, grid=grid), plane_cloud(grid=grid), progress=progress)
    assert len(told) == 1
    assert len(told[0]) > 3
    assert told[0][0] == 0
    assert max(told[0]) < grid.width * grid.height


@pytest.mark.parametrize("lean", [0.0, 0.5, 0.9])
@pytest.mark.parametrize("sigma", [0.3, 0.6])
def test_noise_of_the_reference_does_not_shrink_the_difference(lean, sigma, rng):
    """The nearest of noisy points err toward a point. Before, 0.29 and 0.12 mm in place of 0.4 mm at no lean."""
    fine = ViewGrid(2000.0, 2000.0, 119.5, 99.5, 240, 200)  # 0.25 mm at 500 mm
    rays = fine.rays()
    exact = plane_cloud(0.0, lean, fine)
    noise = sigma * rng.standard_normal((200, 240, 1)) * rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    noisy = PointCloud((exact.points + noise).astype(np.float32), exact.status, fine, "known", "simulated")
    grid = ViewGrid(1700.0, 1700.0, 49.5, 49.5, 100, 100)
    found = difference_to_surface(plane_cloud(0.4 / np.cos(lean), lean, grid), noisy)
    assert np.nanmean(found) == pytest.approx(0.4, abs=0.015)
    assert np.isfinite(found).mean() > 0.99


@pytest.mark.parametrize("lean", [0.0, 0.5])
@pytest.mark.parametrize("organised", [True, False])
def test_noise_does_not_shrink_the_difference_from_a_list_or_a_grid_with_holes(organised, lean, rng):
    """Before, 0.16 mm in place of 0.4 mm from either."""
    fine = ViewGrid(2000.0, 2000.0, 119.5, 99.5, 240, 200)
    exact, there = plane_cloud(0.0, lean, fine), rng.random((200, 240)) < 0.9
    noise = 0.5 * rng.standard_normal((200, 240, 1)) * fine.rays()
    points = np.where(there[..., None], exact.points + noise, np.nan).astype(np.float32)
    reference = PointCloud(
        points, np.where(there, Status.VALID, Status.HIDDEN).astype(np.uint8), fine, "known", "device"
    )
    if not organised:
        rows = rng.permutation(points[there])[None]
        listed = ViewGrid(1.0, 1.0, 0.0, 0.0, rows.shape[1], 1, normalised=rows[..., :2] / rows[..., 2:])
        reference = PointCloud(rows, np.zeros(rows.shape[:2], np.uint8), listed, "known", "device")
    grid = ViewGrid(1700.0, 1700.0, 49.5, 49.5, 100, 100)
    found = difference_to_surface(plane_cloud(0.4 / np.cos(lean), lean, grid), reference)
    assert np.nanmean(found) == pytest.approx(0.4, abs=0.02)
    assert np.isfinite(found).mean() > 0.99


def test_most_depths_that_are_the_same_by_rounding_leave_a_median_and_a_deviation(rng):
    """The mean of rounded normal noise with a mean of 0.3 steps, and its deviation, from the probabilities of steps."""
    steps = np.arange(-5, 6)
    share = norm.cdf(steps + 0.5, 0.3, 0.25) - norm.cdf(steps - 0.5, 0.3, 0.25)
    mean = share @ steps
    found = distribution(np.round(rng.normal(0.3, 0.25, 20_000)), 20_000)
    assert found.median == pytest.approx(mean, abs=0.01)
    assert found.robust_deviation == pytest.approx(np.sqrt(share @ (steps - mean) ** 2), rel=0.03)
    mostly_equal = np.where(rng.random(1000) < 0.7, 0.0, 1e-5 * rng.standard_normal(1000))
    assert distribution(mostly_equal, 1000).robust_deviation == 0
