"""F and sigma of clouds whose F and sigma are known, through the functions for people with clouds of their own."""

import dataclasses

import numpy as np
import pytest

import characterisation as ch

WIDTH, HEIGHT, FOCAL = 320, 240, 400.0
SIGMA, FRACTION = 0.2, 0.8


def made(rng, tilt_deg=30.0, fraction=FRACTION, sigma=SIGMA, eye=(0.0, 0.0, 0.0), sign=1):
    """Points (H, W, 3) of a plane 500 mm off, tilted about y, with noise along the rays and pixels lost at random."""
    columns, rows = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    rays = np.stack([(columns - 159.5) / FOCAL, (rows - 119.5) / FOCAL, np.ones(columns.shape)], axis=-1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    tilt = np.deg2rad(tilt_deg)
    normal = np.array([np.sin(tilt), 0.0, -np.cos(tilt)])
    distance = (np.array([0.0, 0.0, 500.0]) @ normal) / (rays @ normal) + sigma * rng.standard_normal(rays.shape[:2])
    points = rays * distance[..., None] + eye
    points[rng.random(distance.shape) > fraction] = np.nan
    return points


@pytest.mark.parametrize("tilt", [0.0, 30.0, 55.0])
def test_coverage_and_sigma_are_those_that_the_cloud_was_made_with(rng, tilt):
    coverage, sigma = ch.patch_metrics(made(rng, tilt))
    pixels = 113 * len(coverage)
    assert len(coverage) > 200
    # four standard errors of a binomial share, and of a standard deviation
    assert coverage.mean() == pytest.approx(FRACTION, abs=4 * np.sqrt(FRACTION * (1 - FRACTION) / pixels))
    rms = np.sqrt(np.mean(sigma**2))
    assert rms == pytest.approx(SIGMA, rel=4 / np.sqrt(2 * FRACTION * pixels) + 1e-3)


def test_the_table_knows_distance_and_incidence(rng):
    patches = ch.measure_coupon(made(rng, 30.0))
    middle = np.argmin(np.hypot(patches["row"] - 119.5, patches["column"] - 159.5).values)
    here = patches.isel(patch=middle)
    assert float(here["distance"]) == pytest.approx(500, rel=0.02)
    assert np.rad2deg(float(here["incidence"])) == pytest.approx(30, abs=2)
    assert "ray_offset" not in patches


def test_the_sensor_may_stand_anywhere(rng):
    eye = (120.0, -40.0, 300.0)
    here = ch.patch_metrics(made(np.random.default_rng(3)))
    there = ch.patch_metrics(made(np.random.default_rng(3), eye=eye), viewpoint=eye)
    assert there[0] == pytest.approx(here[0], abs=1e-12)
    assert there[1] == pytest.approx(here[1], rel=1e-3)


def test_a_window_keeps_the_background_out(rng):
    points = made(rng, 0.0, fraction=1.0)
    points[:, 200:] = np.nan
    whole, _ = ch.patch_metrics(points)
    part, _ = ch.patch_metrics(points, window=(20, 30, 170, 180))
    assert whole.min() == 0
    assert part.min() == 1
    table = ch.measure_coupon(points, window=(20, 30, 170, 180))
    assert 20 + 6 <= table["column"].min() <= table["column"].max() < 190 - 6
    assert 30 + 6 <= table["row"].min() <= table["row"].max() < 210 - 6


def test_a_window_of_a_grid_with_a_ray_for_each_pixel_is_cut_alike(rng):
    """Before, the grid was resized before its rays were cut: ``ValueError: grid: normalised is ...``."""
    points, pinhole = made(rng), ch.ViewGrid(FOCAL, FOCAL, 159.5, 119.5, WIDTH, HEIGHT)
    rays = pinhole.rays()
    traced = dataclasses.replace(pinhole, normalised=(rays[..., :2] / rays[..., 2:]).astype(np.float32))
    of_pinhole, of_traced = (
        ch.patch_metrics(points, grid=grid, window=(20, 30, 170, 180)) for grid in (pinhole, traced)
    )
    assert len(of_pinhole[0]) > 50
    np.testing.assert_allclose(of_traced, of_pinhole, rtol=1e-3)


def test_false_points_are_lost_points(rng):
    points = made(rng, 0.0, fraction=1.0)
    false = rng.random(points.shape[:2]) < 0.1
    points[false] *= 1.1  # 50 mm behind
    patches = ch.measure_coupon(points)
    assert float(patches["recovered_fraction"].mean()) == pytest.approx(0.9, abs=0.01)
    assert float(patches["false_fraction"].mean()) == pytest.approx(0.1, abs=0.01)


def test_a_known_coupon_gives_the_offset_from_it(rng):
    points = made(rng, 0.0, fraction=1.0, sigma=0.05)
    coupon = ch.Coupon(np.array([0, 0, 499.0]), np.array([0, 0, -1.0]), np.array([1.0, 0, 0]), 200.0, 150.0)
    patches = ch.measure_coupon(points, coupon=coupon)
    # the cloud lies 1 mm behind the coupon: along a ray, 1 mm / cos of the ray
    away = 1 / np.cos(patches["off_axis"].values)
    assert np.abs(patches["ray_offset"].values) == pytest.approx(away, abs=0.05)


def test_a_cloud_and_its_points_say_the_same(rng):
    points = made(rng).astype(np.float32)
    grid = ch.ViewGrid(FOCAL, FOCAL, 159.5, 119.5, WIDTH, HEIGHT)
    status = np.where(np.isfinite(points[..., 2]), ch.Status.VALID, ch.Status.AMBIGUOUS).astype(np.uint8)
    of_cloud = ch.patch_metrics(ch.PointCloud(points, status, grid, "mine", "device"))
    of_points = ch.patch_metrics(points, grid=grid)
    assert np.array_equal(of_cloud, of_points)


@pytest.mark.parametrize(
    ("points", "options", "match"),
    [
        (np.zeros((50, 3)), {}, r"\(H, W, 3\)"),
        (np.full((50, 50, 3), np.nan), {}, "match no pinhole"),
        (np.zeros((50, 50, 3)), {"viewpoint": (0, 0)}, "three numbers"),
        ([["a", "b"]], {}, "arrays of numbers"),
        (np.zeros((50, 50, 3)), {"viewpoint": (0, 0, 9), "grid": ch.ViewGrid(9.0, 9.0, 0.0, 0.0, 50, 50)}, "origin"),
    ],
)
def test_what_is_no_organised_cloud_is_refused(points, options, match):
    with pytest.raises(ch.InputError, match=match):
        ch.patch_metrics(points, **options)


def test_points_that_no_pinhole_saw_are_refused(rng):
    points = made(rng)
    points[..., 0] += 5e-6 * points[..., 0] ** 3  # as of a lens that bends rays by 25 px at the edge
    with pytest.raises(ch.InputError, match="points that miss the best pinhole by"):
        ch.patch_metrics(points)


@pytest.mark.parametrize("options", [{"viewpoint": (0, 0, 100.0)}, {"grid": ch.ViewGrid(9.0, 9.0, 0.0, 0.0, 50, 50)}])
def test_a_cloud_has_its_own_viewpoint_and_grid(rng, options):
    """They were ignored without a word."""
    points = made(rng).astype(np.float32)
    status = np.where(np.isfinite(points[..., 2]), ch.Status.VALID, ch.Status.AMBIGUOUS).astype(np.uint8)
    grid = ch.ViewGrid(FOCAL, FOCAL, 159.5, 119.5, WIDTH, HEIGHT)
    with pytest.raises(ch.InputError, match="it has both"):
        ch.measure_coupon(ch.PointCloud(points, status, grid, "mine", "device"), **options)


@pytest.mark.parametrize(
    "window", [(-1, 0, 50, 50), (300, 0, 50, 50), (0, 0, 0, 5), (0, 0, 50), (0.5, 0, 50, 50), (0, np.nan, 50, 50), "no"]
)
def test_a_window_outside_the_image_is_refused(rng, window):
    with pytest.raises(ch.InputError, match="within 320 x 240 px"):
        ch.patch_metrics(made(rng), window=window)


def test_a_window_without_a_disc_is_refused(rng):
    with pytest.raises(ch.InputError, match="no disc in it"):
        ch.patch_metrics(made(rng), window=(100, 100, 12, 12))
