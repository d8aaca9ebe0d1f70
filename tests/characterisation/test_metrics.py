"""F and sigma recover what was put in: at any tilt, over the whole field, with known noise and known loss."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from characterisation.metrics import density_fraction, ray_noise_std, recovered_fraction
from characterisation.patches import Coupon, disc_offsets, in_view_frame, measure_patches, view_frame
from characterisation.point_cloud import PointCloud, Status, ViewGrid

GRID = ViewGrid(626.0, 626.0, 375.5, 239.5, 752, 480)
BASELINE = np.array([1.0, 0.0, 0.0])


def tilted(tilt_deg, azimuth_deg):
    tilt, azimuth = np.radians([tilt_deg, azimuth_deg])
    return np.array([np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), -np.cos(tilt)])


def coupon_at(centre, normal, width=120.0, height=120.0):
    across = np.cross([0.0, 1.0, 0.0], normal)
    return Coupon(np.asarray(centre, float), normal, across / np.linalg.norm(across), width, height)


def ideal_cloud(coupon, sigma=0.0, keep=1.0, rng=None, grid=GRID):
    """What a perfect sensor sees of a coupon, with noise along its rays and random loss."""
    rays = grid.rays()
    with np.errstate(divide="ignore"):
        distance = (coupon.centre @ coupon.normal) / (rays @ coupon.normal)
    along = np.cross(coupon.normal, coupon.across)
    offset = rays * distance[..., None] - coupon.centre
    on = (distance > 0) & (np.abs(offset @ coupon.across) <= coupon.width / 2)
    on &= np.abs(offset @ along) <= coupon.height / 2
    if rng is not None:
        distance = distance + rng.normal(0, 1, distance.shape) * sigma
        on &= rng.random(distance.shape) < keep
    points = np.where(on[..., None], rays * distance[..., None], np.nan).astype(np.float32)
    status = np.where(on, Status.VALID, Status.NO_SURFACE).astype(np.uint8)
    return PointCloud(points, status, grid, "ideal", "simulated", BASELINE)


@pytest.mark.parametrize("tilt", [0, 25, 50, 70])
@pytest.mark.parametrize("sigma", [0.02, 0.5])
def test_injected_sigma_is_recovered_at_any_tilt(tilt, sigma, rng):
    normal = tilted(tilt, 30)
    xy = rng.uniform(-0.013, 0.013, (400, 200, 2))
    rays = np.concatenate([xy, np.ones((400, 200, 1))], axis=-1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    distance = (np.array([0, 0, 600.0]) @ normal) / (rays @ normal) + rng.normal(0, sigma, (400, 200))
    noise = ray_noise_std(rays * distance[..., None])
    # pooled over 400 patches of 197 degrees of freedom, variance is known to sqrt(2 / 78800) = 0.5 %
    assert np.isclose(np.mean(noise.sigma**2), sigma**2, rtol=0.025)
    assert np.isclose(noise.robust.mean(), sigma, rtol=0.03)
    assert np.isclose(noise.sigma.std() / noise.standard_error.mean(), 1, atol=0.15)
    mean_ray = rays.mean(axis=1)
    mean_ray /= np.linalg.norm(mean_ray, axis=-1, keepdims=True)
    error = noise.distance - 600 * normal[2] / (mean_ray @ normal)
    assert np.isclose(error.std(), sigma / np.sqrt(200), rtol=0.15)
    assert noise.outlier_share.max() <= 1 / 200


def test_noise_along_the_normal_would_be_understated(rng):
    """The same points, fitted along the ray and looked at along the normal: a factor cos(incidence)."""
    normal = tilted(60, 0)
    rays = np.concatenate([rng.uniform(-0.01, 0.01, (5000, 2)), np.ones((5000, 1))], axis=-1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    points = rays * ((600 * normal[2]) / (rays @ normal) + rng.normal(0, 0.4, 5000))[:, None]
    along_normal = ((points - [0, 0, 600]) @ normal).std()
    assert np.isclose(ray_noise_std(points).sigma, 0.4, rtol=0.05)
    assert np.isclose(along_normal, 0.4 * np.cos(np.radians(60)), rtol=0.05)


def test_outliers_are_counted_and_left_out_of_the_inlier_sigma(rng):
    rays = np.concatenate([rng.uniform(-0.013, 0.013, (1000, 2)), np.ones((1000, 1))], axis=-1)
    distance = 600 + rng.normal(0, 0.2, 1000)
    distance[:30] += 20
    noise = ray_noise_std(rays * distance[:, None])
    assert np.isclose(noise.outlier_share, 0.03, atol=0.002)
    assert np.isclose(noise.inlier_sigma, 0.2, rtol=0.08)
    assert noise.sigma > 2


@pytest.mark.parametrize("count", [0, 1, 3])
def test_too_few_points_have_no_sigma(count):
    points = np.full((20, 3), np.nan)
    points[:count] = np.array([[0, 0, 600], [10, 0, 600], [0, 10, 600]])[:count]
    noise = ray_noise_std(points)
    assert noise.count == count
    assert np.isnan(noise.sigma)
    assert np.isnan(noise.outlier_share)


@pytest.mark.parametrize("angle", [0, 10, 18, 24])
@pytest.mark.parametrize("tilt", [0, 40, 60])
def test_an_ideal_sensor_recovers_everything_over_the_whole_field(angle, tilt):
    """F of the patches is 1; so is the talk's rho, counted on a known area, once it has its cos^3."""
    direction = np.array([np.sin(np.radians(angle)), 0.1, np.cos(np.radians(angle))])
    centre = direction / np.linalg.norm(direction) * 600
    normal = -centre / 600
    turn = np.radians(tilt)
    normal = np.cos(turn) * normal + np.sin(turn) * np.array([0, 1, 0]) * np.sign(-normal[1])
    coupon = coupon_at(centre, normal / np.linalg.norm(normal))
    cloud = ideal_cloud(coupon)
    patches = measure_patches(cloud, coupon)
    assert patches.sizes["patch"] > 5
    assert (patches.recovered_fraction == 1).all()
    assert (patches.false_fraction == 0).all()

    # the talk's rho: points on the whole coupon, of known area, cell by cell
    points = cloud.points[cloud.valid].astype(float)
    along = np.cross(coupon.normal, coupon.across)
    s, t = (points - coupon.centre) @ coupon.across, (points - coupon.centre) @ along
    cells = []
    for s0 in np.arange(-60, 60, 30):
        for t0 in np.arange(-60, 60, 30):
            middle = coupon.centre + (s0 + 15) * coupon.across + (t0 + 15) * along
            count = ((s >= s0) & (s < s0 + 30) & (t >= t0) & (t < t0 + 30)).sum()
            view = middle / np.linalg.norm(middle)
            cells.append(density_fraction(count, 900.0, np.linalg.norm(middle), -view @ coupon.normal,
                                          GRID.angular_pitch, GRID.cos_off_axis(middle)))  # fmt: skip
    assert np.isclose(np.mean(cells), 1.0, atol=0.02)


def test_without_the_cosine_an_ideal_sensor_would_score_too_high():
    count = density_fraction(100, 900, 600, 1.0, 1 / 626)
    corrected = density_fraction(100, 900, 600, 1.0, 1 / 626, np.cos(np.radians(20)))
    assert np.isclose(count / corrected, 1.21, atol=0.01)


def test_loss_and_noise_of_a_coupon_come_back(rng):
    coupon = coupon_at([20, 10, 600], tilted(35, 60))
    patches = measure_patches(ideal_cloud(coupon, sigma=0.3, keep=0.7, rng=rng), coupon)
    possible = patches.points_possible.values.sum()
    assert np.isclose(patches.points.sum() / possible, 0.7, atol=4 * np.sqrt(0.21 / possible))
    assert np.isclose(np.sqrt((patches.ray_noise_std**2).mean()), 0.3, rtol=0.05)
    inside = (patches.fraction_low <= 0.7) & (patches.fraction_high >= 0.7)
    assert inside.mean() > 0.85


def test_normal_and_distance_of_a_patch_are_those_of_its_place():
    coupon = coupon_at([0, 0, 500], tilted(30, 0))
    patches = measure_patches(ideal_cloud(coupon), coupon)
    assert np.isclose(patches.normal_x.mean(), np.sin(np.radians(30)), atol=0.02)
    assert np.isclose(np.degrees(patches.incidence.mean()), 30, atol=1)
    assert np.isclose(patches.distance.mean(), 500, rtol=0.01)
    assert patches.incidence.std() > np.radians(1)  # every patch has its own view of the coupon


def test_false_points_count_neither_as_recovered_nor_as_noise(rng):
    coupon = coupon_at([0, 0, 600], tilted(10, 0))
    cloud = ideal_cloud(coupon, sigma=0.2, keep=1.0, rng=rng)
    astray = cloud.valid & (rng.random(cloud.status.shape) < 0.25)
    points = cloud.points.copy()
    points[astray] *= 1.05
    wrong = PointCloud(points, cloud.status, GRID, "ideal", "simulated", BASELINE)
    patches = measure_patches(wrong, coupon)
    assert np.isclose(patches.recovered_fraction.mean(), 0.75, atol=0.02)
    assert np.isclose(patches.false_fraction.mean(), 0.25, atol=0.02)
    assert np.isclose(patches.ray_noise_std.mean(), 0.2, rtol=0.05)


def test_a_coupon_behind_the_sensor_has_no_patches():
    coupon = coupon_at([0, 0, -600], np.array([0.0, 0.0, 1.0]))
    cloud = ideal_cloud(coupon_at([0, 0, 600], tilted(0, 0)))
    assert measure_patches(cloud, coupon).sizes["patch"] == 0


def test_a_disc_holds_its_area():
    for radius in (3, 6, 8, 12):
        assert np.isclose(len(disc_offsets(radius)), np.pi * radius**2, rtol=0.08)


unit = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1)


@given(unit, unit)
def test_the_view_frame_is_right_handed_and_faces_the_sensor(view, baseline):
    view, baseline = np.array(view), np.array(baseline)
    view, baseline = view / np.linalg.norm(view), baseline / np.linalg.norm(baseline)
    if abs(view @ baseline) > 0.99:
        return
    frame = view_frame(view, baseline)
    assert np.allclose(frame @ frame.T, np.eye(3), atol=1e-9)
    assert np.isclose(np.linalg.det(frame), 1)
    assert np.allclose(in_view_frame(-view, view, baseline), [0, 0, 1])
    assert frame[0] @ baseline > 0


@given(st.integers(0, 500), st.integers(1, 500))
def test_the_interval_holds_the_fraction(count, possible):
    if count > possible:
        with pytest.raises(ValueError, match="more points"):
            recovered_fraction(count, possible)
        return
    fraction, low, high = recovered_fraction(count, possible)
    assert 0 <= low <= fraction <= high <= 1


def test_the_interval_covers(rng):
    counts = rng.binomial(113, 0.8, 4000)
    _, low, high = recovered_fraction(counts, 113)
    assert ((low <= 0.8) & (high >= 0.8)).mean() >= 0.95
