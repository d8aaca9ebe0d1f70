"""Filters that makers apply: speckles, medians, and means of distances; none fills a pixel."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from characterisation.point_cloud import PointCloud, Status, ViewGrid
from mitsim.decoding.input_clouds import margin_of
from mitsim.decoding.matching.disparity_filters import median_of_neighbours, without_speckles
from mitsim.decoding.structured_light.smoothing import smoothed_along_rays
from mitsim.sensor.matcher import MatcherSettings
from tests.decoding.matching.test_stereo import SETTINGS, decode, ideal_rig, pair, plane


def field() -> np.ndarray:
    rows, columns = np.mgrid[0:60, 0:80]
    return (30 + 0.05 * columns - 0.02 * rows).astype(np.float32)


def test_small_regions_that_stand_apart_are_removed_and_no_others():
    disparity = field()
    disparity[10:14, 10:15] += 9  # 20 px
    disparity[30:40, 30:50] += 9  # 200 px
    disparity[50:52, 60:62] = np.nan
    kept = without_speckles(disparity, 50, 1.0)
    assert np.isnan(kept[10:14, 10:15]).all()
    assert np.isnan(kept).sum() == 20 + 4
    same = np.isfinite(kept)
    np.testing.assert_array_equal(kept[same], disparity[same])
    assert np.isnan(without_speckles(disparity, 200, 1.0)).sum() == 20 + 200 + 4
    assert without_speckles(disparity, 0, 1.0) is disparity
    assert np.isnan(without_speckles(np.full((5, 5), np.nan, np.float32), 9, 1.0)).all()


@pytest.mark.parametrize("side", [3, 5, 7])
def test_a_median_keeps_a_plane_removes_an_outlier_and_fills_nothing(side):
    disparity = field()
    clean = median_of_neighbours(disparity, side)
    inner = np.s_[side:-side, side:-side]
    np.testing.assert_allclose(clean[inner], disparity[inner], atol=1e-5)
    noisy = disparity.copy()
    noisy[20, 20] += 5
    noisy[40:43, 40:43] = np.nan
    smooth = median_of_neighbours(noisy, side)
    assert abs(smooth[20, 20] - disparity[20, 20]) < 0.2
    np.testing.assert_array_equal(np.isnan(smooth), np.isnan(noisy))


def test_a_matcher_applies_its_filters_to_the_points_it_accepts():
    rig, surface = ideal_rig(), plane([0.2, -0.1, 1], 487.3)
    images = pair(rig, surface)
    images[0][100:108, 150:158] = np.random.default_rng(3).integers(0, 255, (8, 8))
    plain = decode(rig, images, SETTINGS.model_copy(update={"uniqueness_percent": 0, "p1": 0.1, "p2": 0.2}))
    filtered = decode(
        rig,
        images,
        SETTINGS.model_copy(update={"uniqueness_percent": 0, "p1": 0.1, "p2": 0.2, "median_px": 5, "speckle_px": 60}),
    )
    assert not (filtered.valid & ~plain.valid).any()
    assert filtered.valid.sum() > 0.9 * plain.valid.sum()
    both = filtered.valid
    n, c = surface
    off = [np.abs(each.points[both] @ n - c) for each in (plain, filtered)]
    assert off[1].mean() < 0.9 * off[0].mean()
    assert np.isnan(filtered.points[~filtered.valid]).all()


def noisy_plane(noise: float):
    grid = ViewGrid(fx=300.0, fy=300.0, cx=40.0, cy=30.0, width=80, height=60, rotation=np.eye(3), origin=np.zeros(3))
    n, c = plane([0.4, -0.2, 1], 500.0)
    rays = grid.rays()
    true = rays * (c / (rays @ n))[..., None]
    length = np.linalg.norm(true, axis=-1, keepdims=True)
    points = true * (1 + noise * np.random.default_rng(2).standard_normal(length.shape) / length)
    status = np.full(length.shape[:2], Status.VALID, np.uint8)
    status[:5], status[20:24, 30:34] = Status.LOW_MODULATION, Status.LOW_MODULATION
    points[status != Status.VALID] = np.nan
    sigma = np.where(status == Status.VALID, noise, np.nan).astype(np.float32)
    return PointCloud(points.astype(np.float32), status, grid, "s", "simulated", sigma=sigma), n, c


def test_a_mean_of_distances_keeps_a_plane_and_states_its_noise():
    exact, n, c = noisy_plane(0.0)
    smooth = smoothed_along_rays(exact, 1.5)
    # also beside pixels without a point, where one-sided neighbours would pull
    np.testing.assert_allclose(smooth.points[smooth.valid] @ n, c, atol=2e-3)
    np.testing.assert_array_equal(np.isnan(smooth.points), np.isnan(exact.points))
    assert smoothed_along_rays(exact, 0.0) is exact

    noisy, n, c = noisy_plane(0.1)
    smooth = smoothed_along_rays(noisy, 1.5)
    inner = np.zeros(noisy.valid.shape, bool)
    inner[10:18, 6:-6] = inner[30:-6, 6:-6] = True
    error = (smooth.points[inner] @ n - c) / (np.abs(noisy.grid.rays()[inner] @ n) / 1.0)
    lengths = np.linalg.norm(noisy.grid.rays()[inner], axis=-1)
    spread = (error * lengths).std()
    told = smooth.sigma[inner].mean()
    # weights exp(-d^2 / 2 s^2): sqrt(sum w^2) / sum w is 1 / (2 sqrt(pi) s) for a wide filter, and s is shorter down a
    # slope of 24 deg, where neighbours are farther in space
    assert told == pytest.approx(0.1 / (2 * np.sqrt(np.pi) * 1.5) / np.sqrt(np.cos(np.radians(24.1))), rel=0.03)
    # 200 independent patches of the filter: 5 % of their standard deviation
    assert spread == pytest.approx(told, rel=0.2)


@pytest.mark.parametrize("step_px", [6.0, 12.0])
def test_surfaces_a_step_apart_do_not_mix(step_px):
    """Steps of 2 and 4 % of the distance; of the filter before, steps under 1 % of it mixed, 7 mm for a Zivid."""
    cloud, n, c = noisy_plane(0.0)
    points, further = cloud.points.copy(), 1 + step_px / cloud.grid.fx
    points[:, 40:] *= further
    smooth = smoothed_along_rays(replace(cloud, points=points), 1.0)
    heights = smooth.points @ n
    np.testing.assert_allclose(heights[30:50, 10:40], c, atol=2e-3)
    np.testing.assert_allclose(heights[30:50, 40:70], further * c, atol=2e-3)


@pytest.mark.parametrize("noise_px", [0.2, 1.0])
def test_sigma_of_a_mean_holds_where_noise_is_as_large_as_a_pixel(noise_px):
    """Weights by distances alone made it 1.8 times as large as told."""
    pixel = 500.0 / 300.0
    exact, _, _ = noisy_plane(0.0)
    noisy, _, _ = noisy_plane(noise_px * pixel)
    inner = np.zeros(noisy.valid.shape, bool)
    inner[10:18, 6:-6] = inner[30:-6, 6:-6] = True
    smooth = smoothed_along_rays(noisy, 1.5)
    lengths = np.linalg.norm(smooth.points[inner], axis=-1) - np.linalg.norm(exact.points[inner], axis=-1)
    assert lengths.std() == pytest.approx(smooth.sigma[inner].mean(), rel=0.2)


def test_the_margin_beside_an_edge_holds_the_window_of_a_census_code():
    """Before, 3 px for codes of 9 x 9 px summed over 5 x 5 px."""
    census = MatcherSettings(near_mm=300, far_mm=900, method="census", block_size=5, census_window_px=9)
    assert margin_of(census) == 4 + 2 + 1
    assert margin_of(MatcherSettings(near_mm=300, far_mm=900, block_size=5)) == 2 + 1
