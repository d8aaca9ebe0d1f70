"""F and sigma recover what was put in: at any tilt, with known noise and known loss."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import least_squares
from scipy.stats import beta

from characterisation.coupon.discs import disc_offsets
from characterisation.coupon.metrics import (
    clipped,
    density_fraction,
    ray_noise_std,
    recovered_fraction,
    reference_fraction,
)


def tilted(tilt_deg, azimuth_deg):
    tilt, azimuth = np.radians([tilt_deg, azimuth_deg])
    return np.array([np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), -np.cos(tilt)])


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


def test_without_the_cosine_an_ideal_sensor_would_score_too_high():
    count = density_fraction(100, 900, 600, 1.0, 1 / 626)
    corrected = density_fraction(100, 900, 600, 1.0, 1 / 626, np.cos(np.radians(20)))
    assert np.isclose(count / corrected, 1.21, atol=0.01)


@given(st.integers(0, 500), st.integers(1, 500))
def test_the_interval_holds_the_fraction(count, possible):
    if count > possible:
        with pytest.raises(ValueError, match="between 0 and possible"):
            recovered_fraction(count, possible)
        return
    fraction, low, high = recovered_fraction(count, possible)
    assert 0 <= low <= fraction <= high <= 1


def test_the_interval_covers(rng):
    counts = rng.binomial(113, 0.8, 4000)
    _, low, high = recovered_fraction(counts, 113)
    assert ((low <= 0.8) & (high >= 0.8)).mean() >= 0.95


def test_the_fit_is_that_of_least_squares_along_the_rays(rng):
    """Against an iterative fit of the distance along each ray, with gaps, off the axis and steep."""
    normal = tilted(65, 20)
    rays = np.concatenate(
        [rng.uniform(0.30, 0.32, (3, 90, 1)), rng.uniform(-0.21, -0.19, (3, 90, 1)), np.ones((3, 90, 1))], axis=-1
    )
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    middle = rays.mean((0, 1)) / np.linalg.norm(rays.mean((0, 1))) * 700
    points = rays * ((middle @ normal) / (rays @ normal) + rng.normal(0, 0.2, (3, 90)))[..., None]
    points[0, 10:40] = np.nan
    noise = ray_noise_std(points)
    for i, patch in enumerate(points):
        there = patch[np.isfinite(patch[:, 0])]
        t = np.linalg.norm(there, axis=1)
        start = normal / (middle @ normal)
        fit = least_squares(lambda a, d=there, t=t: t - t / (d @ a), start, x_scale=1e-3, xtol=1e-14, ftol=1e-14)
        # theirs minimises t - t / (a.p), ours t (1 - a.p): the same but for the noise over the distance, 3e-4
        assert np.isclose(noise.sigma[i], np.sqrt(2 * fit.cost / (len(there) - 3)), rtol=1e-6)
        assert np.degrees(np.arccos(abs(noise.normal[i] @ fit.x) / np.linalg.norm(fit.x))) < 0.05
        assert np.isclose(np.nanstd(noise.inlier_residual[i]), np.std(fit.fun), rtol=1e-5)


def test_points_on_a_line_have_no_plane(rng):
    points = np.linspace([-10, -5, 600], [10, 5, 620], 50) * rng.uniform(1, 1.001, (50, 1))
    assert np.isnan(ray_noise_std(points).sigma)


def test_residuals_are_missing_where_points_are_and_where_they_are_outliers(rng):
    rays = np.concatenate([rng.uniform(-0.013, 0.013, (200, 2)), np.ones((200, 1))], axis=-1)
    points = rays * (600 + rng.normal(0, 0.2, (200, 1)))
    points[:7] *= 1.02
    points[7:10] = np.nan
    residual = ray_noise_std(points).inlier_residual
    assert np.isnan(residual[:10]).all()
    assert np.isfinite(residual[10:]).all()


@given(st.integers(0, 300), st.integers(1, 300), st.sampled_from([0.5, 0.9, 0.95]))
def test_the_interval_is_clopper_and_pearsons(count, possible, confidence):
    count = min(count, possible)
    _, low, high = recovered_fraction(count, possible, confidence)
    tail = (1 - confidence) / 2
    assert np.isclose(low, beta.ppf(tail, count, possible - count + 1) if count else 0, rtol=1e-9)
    assert np.isclose(high, beta.ppf(1 - tail, count + 1, possible - count) if count < possible else 1, rtol=1e-9)


def test_what_is_over_one_is_brought_down_and_told():
    fraction, excess = clipped([0.5, 1.0, 1.3, np.nan])
    assert np.array_equal(fraction, [0.5, 1.0, 1.0, np.nan], equal_nan=True)
    assert np.allclose(excess, [0, 0, 0.3, np.nan], equal_nan=True)


@pytest.mark.parametrize("white", [0.6, 0.95, 1.0])
@pytest.mark.parametrize("fraction", [0.02, 0.5, 0.97])
def test_the_interval_of_the_ratio_to_a_reference_covers(fraction, white, rng):
    trials = 4000
    reference, count = rng.binomial(113, white, trials), rng.binomial(113, fraction * white, trials)
    found, low, high, _ = reference_fraction(count, reference, 113)
    # the intervals it is made of cover at least as often as they claim; 0.95 is known to 0.0034, 3 of these
    assert ((low <= fraction) & (high >= fraction)).mean() > 0.95 - 3 * 0.0034
    assert ((low <= found) & (found <= high)).all()


@given(st.integers(0, 113), st.integers(0, 113))
def test_a_ratio_to_a_reference_stays_in_order(count, reference):
    found, low, high, excess = reference_fraction(count, reference, 113)
    if reference == 0:
        assert np.isnan([found, low, high, excess]).all()
        return
    assert 0 <= low <= found <= high <= 1
    assert np.isclose(found + excess, count / reference)


@pytest.mark.parametrize("noise", [0.25, 0.3, 0.5])
@pytest.mark.parametrize("place", [0.0, 0.3])
def test_depths_in_steps_keep_their_noise(rng, noise, place):
    """A square coupon of a device with steps of 1 mm, wider than its noise: most points have one depth."""
    rows, columns = (disc_offsets(6.0) + np.array([-80, 100])).T / 500
    depth = np.rint(600 + place + noise * rng.standard_normal((300, len(rows))))
    patch = np.stack([columns * depth, rows * depth, depth], axis=-1)
    patch[0, :5] *= 1.02  # real outliers
    measured = ray_noise_std(patch)
    stretch = np.sqrt(1 + np.mean(rows) ** 2 + np.mean(columns) ** 2)
    pooled = np.sqrt(np.mean(measured.inlier_sigma**2))
    assert pooled == pytest.approx(stretch * np.sqrt(depth[1:].var(axis=1).mean()), rel=0.03)
    assert measured.outlier_share[0] == pytest.approx(5 / len(rows))
    assert not measured.outlier_share[1:].any()
