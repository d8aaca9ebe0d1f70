"""Makers' figures of a flat target: known offset, noise, gaps and warp come back as their definitions say."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from characterisation.acceptance.depth_quality import (
    global_planarity_trueness,
    local_planarity_precision,
    mean_depth_error,
    plane_quality,
    temporal_noise,
    typical_temporal_noise,
)
from characterisation.coupon.patches import Coupon
from characterisation.files.errors import InputError
from characterisation.point_cloud import PointCloud, Status, ViewGrid

GRID = ViewGrid(600.0, 600.0, 99.5, 74.5, 200, 150)


def wall(distance=600.0, tilt_deg=0.0):
    turn = np.radians(tilt_deg)
    return Coupon(np.array([0, 0, distance]), np.array([np.sin(turn), 0, -np.cos(turn)]), np.eye(3)[1], 1e3, 1e3)


def seen(target, along_ray=0.0, keep=None):
    """Cloud of a wall; ``along_ray`` (H, W) [mm] is added to each distance, ``keep`` (H, W) says what is there."""
    rays = GRID.rays()
    points = rays * ((target.centre @ target.normal) / (rays @ target.normal) + along_ray)[..., None]
    there = np.ones(points.shape[:2], bool) if keep is None else keep
    points = np.where(there[..., None], points, np.nan).astype(np.float32)
    return PointCloud(points, np.where(there, Status.VALID, Status.AMBIGUOUS).astype(np.uint8), GRID, "t", "simulated")


def test_fill_rate_counts_the_pixels_of_the_region():
    keep = np.zeros((150, 200), bool)
    keep[:, :50] = True
    region = np.zeros((150, 200), bool)
    region[:, 25:75] = True
    assert plane_quality(seen(wall(), keep=keep)).fill_rate == 25
    assert plane_quality(seen(wall(), keep=keep), region).fill_rate == 50


@pytest.mark.parametrize("tilt", [0, 20])
def test_z_accuracy_is_the_offset_of_the_plane_in_percent(tilt):
    """A wall 6 mm too far at 600 mm: +1 %; of the distance across the plane where it is tilted."""
    true, found = wall(600, tilt), seen(wall(606, tilt))
    assert np.isclose(plane_quality(found, ground_truth=true).z_accuracy, 1.0, rtol=1e-4)
    assert np.isclose(mean_depth_error([found, found], true), 1.0, rtol=1e-4)
    assert np.isnan(plane_quality(found).z_accuracy)


def test_spatial_noise_is_that_across_the_plane_in_mm_percent_and_pixels(rng):
    noise = rng.normal(0, 0.5, (150, 200))
    found = plane_quality(seen(wall(), noise), baseline_mm=50.0)
    # 1 % of the points is cut off at the ends of z: a normal between +-2.576 has the standard deviation 0.962. 30 000
    # points give 0.4 %; across the plane is along z here
    cosine = np.sqrt(np.mean(GRID.rays()[..., 2] ** 2))
    assert np.isclose(found.plane_fit_rms, 0.5 * 0.962 * cosine, rtol=0.015)
    assert np.isclose(found.plane_fit_rms_percent, found.plane_fit_rms / 6, rtol=1e-3)
    # d(b f / r) = b f / r^2 dr, over lengths r of rays
    inverse = GRID.rays()[..., 2] ** 2 / 600**2
    assert np.isclose(found.subpixel_rms, 50 * 600 * 0.5 * 0.962 * np.sqrt(np.mean(inverse**2)), rtol=0.02)
    assert np.isnan(plane_quality(seen(wall(), noise)).subpixel_rms)
    assert found.points == 30000 - 2 * 150


def test_extreme_points_do_not_count_in_the_noise():
    error = np.zeros((150, 200))
    error.flat[::300] = 80.0  # 100 of 30 000, under the 150 that are cut
    assert plane_quality(seen(wall(), error)).plane_fit_rms < 1e-3
    assert plane_quality(seen(wall(), error), trimmed_share=0.0).plane_fit_rms > 3


def test_too_few_points_say_only_how_few():
    found = plane_quality(seen(wall(), keep=np.zeros((150, 200), bool)), ground_truth=wall(), baseline_mm=50)
    assert found.fill_rate == 0
    assert np.isnan([found.z_accuracy, found.plane_fit_rms, found.plane_fit_rms_percent, found.subpixel_rms]).all()


def test_temporal_noise_holds_no_warp_and_no_fixed_pattern(rng):
    fixed = rng.normal(0, 2.0, (150, 200))
    clouds = [seen(wall(), fixed + rng.normal(0, 0.3, (150, 200))) for _ in range(20)]
    noise = temporal_noise(clouds)
    # 30 000 pixels of 19 degrees of freedom: sqrt(2 / 570000) = 0.2 % of the variance
    assert np.isclose(np.mean(noise**2), 0.09, rtol=0.01)
    assert local_planarity_precision(clouds[0]) > 1.5  # which does hold the pattern


@pytest.mark.parametrize("sigma", [0.05, 0.3, 0.6, 3.0])
@pytest.mark.parametrize("count", [2, 4, 40])
def test_temporal_noise_of_depths_in_whole_mm(rng, sigma, count):
    """The median of four captures was 0 for 0.05 mm, and for 0.6 mm of two captures 1.05 mm."""
    true = 700 + np.linspace(0, 40, 30_000).reshape(150, 200)  # over many steps
    rays = GRID.rays() / GRID.rays()[..., 2:]
    depths = np.rint(true + sigma * rng.standard_normal((count, 150, 200)))
    status = np.full((150, 200), Status.VALID, np.uint8)
    clouds = [PointCloud((depth[..., None] * rays).astype(np.float32), status, GRID, "t", "device") for depth in depths]
    # two depths d apart, at any place between steps, are rounded to n or n + 1 steps apart, by the fraction of d
    whole, part = np.divmod(np.abs(sigma * np.sqrt(2) * rng.standard_normal(1_000_000)), 1)
    expected = np.sqrt(np.mean(whole**2 * (1 - part) + (whole + 1) ** 2 * part) / 2)
    found = typical_temporal_noise(clouds, np.ones((150, 200), bool))
    assert found == pytest.approx(expected * np.linalg.norm(rays, axis=-1).mean(), rel=0.03)


def test_temporal_noise_of_a_window_needs_its_pixels_alone(rng, monkeypatch):
    """Before, each of several planes took the distances of the whole grid."""
    clouds = [seen(wall(), rng.normal(0, 0.3, (150, 200))) for _ in range(3)]
    region = np.zeros((150, 200), bool)
    region[20:30, 40:60] = True
    expected = np.median(temporal_noise(clouds)[region] / np.sqrt(chi2.median(2) / 2))
    norm, taken = np.linalg.norm, []
    monkeypatch.setattr(
        np.linalg, "norm", lambda x, **more: taken.append(len(np.reshape(x, (-1, 3)))) or norm(x, **more)
    )
    assert typical_temporal_noise(clouds, region) == expected
    assert taken == [200] * 3


def test_temporal_noise_of_pixels_seen_less_than_twice_is_missing(rng):
    keep = np.ones((150, 200), bool)
    keep[:10] = False
    clouds = [seen(wall(), rng.normal(0, 0.3, keep.shape)), seen(wall(), rng.normal(0, 0.3, keep.shape), keep)]
    noise = temporal_noise(clouds)
    assert np.isnan(noise[:10]).all()
    assert np.isfinite(noise[10:]).all()


def test_local_planarity_sees_noise_and_not_warp_and_global_planarity_the_reverse(rng):
    column = np.arange(200.0) * np.ones((150, 1))
    bend = 1.5 * ((column - 99.5) / 99.5) ** 2 - 0.5
    clouds = [seen(wall(), bend + rng.normal(0, 0.2, bend.shape)) for _ in range(25)]
    # 352 patches of 78 degrees of freedom: their median is 0.2 to 0.5 %, and cos(off-axis) takes 1 %
    assert np.isclose(local_planarity_precision(clouds[0]), 0.2, rtol=0.03)
    # of x^2 - 1/3 with x uniform in 0..1 the 95th percentile of the absolute value is 0.95^2 - 1/3 = 0.569; noise of
    # 0.2 / sqrt(25) = 0.04 is left in it
    assert np.isclose(global_planarity_trueness(clouds), 1.5 * 0.569, rtol=0.04)
    assert global_planarity_trueness([seen(wall())]) < 1e-3


def test_a_patch_with_a_gap_is_left_out():
    keep = np.ones((150, 200), bool)
    keep[4::9, 4::9] = False  # the middle of every patch of 9 px
    assert np.isnan(local_planarity_precision(seen(wall(), keep=keep)))


@pytest.mark.parametrize(
    ("call", "field"),
    [
        (lambda: plane_quality(seen(wall()), np.ones((3, 3), bool)), "region"),
        (lambda: plane_quality(seen(wall()), np.zeros((150, 200), bool)), "region"),
        (lambda: plane_quality(seen(wall()), trimmed_share=0.5), "trimmed_share"),
        (lambda: plane_quality(seen(wall()), baseline_mm=0.0), "baseline_mm"),
        (lambda: mean_depth_error([], wall()), "clouds"),
        (lambda: temporal_noise([seen(wall())]), "clouds"),
        (lambda: global_planarity_trueness([]), "clouds"),
    ],
)
def test_what_cannot_be_measured_is_refused_by_name(call, field):
    with pytest.raises(InputError) as raised:
        call()
    assert raised.value.field == field
