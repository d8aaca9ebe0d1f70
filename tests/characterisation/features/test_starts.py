"""Points that are hard to fit: rounded coordinates, thin rods."""

import numpy as np
import pytest
from scipy.stats import norm

from characterisation.features.best_fit import best_fit
from characterisation.features.fits import fit_cylinder, fit_plane
from characterisation.features.form import fit_form
from characterisation.features.pose_fit import fit_pose
from characterisation.features.robust_fit import scatter_of
from characterisation.features.starts import cylinder_start, rounding_scale, rounding_step
from characterisation.features.surfaces import Plane

EYE = np.zeros(3)


def face(across, rng, count=5000):
    """A face perpendicular to the view, 500 mm away, whose depths are ``across`` (count,) farther."""
    return np.column_stack([rng.uniform(-40, 40, (count, 2)), 500 + across])


@pytest.mark.parametrize("step", [0.1, 1.0])
@pytest.mark.parametrize(("offset", "sigma"), [(0.0, 0.3), (0.0, 0.5), (0.0, 0.7), (0.3, 0.1), (0.3, 0.4), (0.5, 0.1)])
def test_rounded_depths_have_the_mean_and_the_noise_of_rounded_noise(step, offset, sigma, rng):
    """Offset and sigma are in steps; most points have one depth, and the median of the residuals is 0."""
    depths = step * np.round(offset + sigma * rng.standard_normal(5000))
    fit = fit_plane(face(depths, rng), EYE)
    steps = np.arange(-8, 9)
    share = norm.cdf(steps + 0.5, offset, sigma) - norm.cdf(steps - 0.5, offset, sigma)
    mean = share @ steps
    noise = np.sqrt(share @ (steps - mean) ** 2)
    assert -fit.normal @ fit.point == pytest.approx(500 + step * mean, abs=step * (4 * noise / np.sqrt(5000) + 0.005))
    assert fit.residual_std == pytest.approx(step * noise, rel=0.1)


@pytest.mark.parametrize("step", [0.1, 1.0])
def test_form_pose_and_joined_views_use_all_rounded_depths(step, rng):
    """Three quarters and more of the depths are the same; their noise and their means are those of rounded noise."""
    means, clouds = [], []
    for offset in (0.0, 0.3):
        steps = np.arange(-8, 9)
        share = norm.cdf(steps + 0.5, offset, 0.3) - norm.cdf(steps - 0.5, offset, 0.3)
        means.append(step * share @ steps)
        noise = step * np.sqrt(share @ (steps - share @ steps) ** 2)
        points = face(step * np.round(offset + 0.3 * rng.standard_normal(5000)), rng)
        form = fit_form(points, fit_plane(points, EYE), EYE)
        assert form.residual_std == pytest.approx(noise, rel=0.1)
        wall = np.column_stack([40 + 0.02 * rng.standard_normal(800), rng.uniform([-40, 500], [40, 540], (800, 2))])
        clouds.append({"face": points, "wall": wall, "other": wall[:, [1, 0, 2]]})
    shapes = {
        name: Plane(np.array(point), np.array(normal))
        for name, point, normal in [
            ("face", [0.0, 0, 500], [0.0, 0, -1]),
            ("wall", [40.0, 0, 0], [1.0, 0, 0]),
            ("other", [0, 40.0, 0], [0, 1.0, 0]),
        ]
    }
    close = step * 4 * 0.5 / np.sqrt(5000) + 0.005
    for mean, cloud in zip(means, clouds, strict=True):
        assert fit_pose(cloud, shapes, np.eye(4)).sensor_from_part[2, 3] == pytest.approx(mean, abs=close)
    expected = np.diag([1e-3, 1e-3, 1e-3, 1.0, 1.0, 1.0]) ** 2
    scales = [{"face": rounding_scale(cloud["face"], shapes["face"])} for cloud in clouds]
    first, second = best_fit(clouds, shapes, np.array([0, 0, 500.0]), expected, least_scales=scales)
    joined = second @ [0, 0, 500, 1] - first @ [0, 0, 500, 1]
    assert joined[2] == pytest.approx(means[0] - means[1], abs=2 * close)


@pytest.mark.parametrize("tilt", [0.0, 0.05])
def test_rounded_depths_have_a_step_and_a_scatter(tilt, rng):
    """The step is found of any tilt, that of depths that are not rounded is 0, and the scatter is that of rounding."""
    noise = 0.2 * rng.standard_normal(5000)
    points, normal = face(noise, rng), np.array([0.0, 0.0, -1.0])
    points[:, 2] += tilt * points[:, 0]
    assert rounding_step(points, normal) == 0
    points[:, 2] = np.round(points[:, 2])
    assert rounding_step(points, normal) == 1
    if not tilt:
        expected = np.sqrt(2 * norm.sf(0.5, 0, 0.2))  # of the points at -1 and +1
        scale = rounding_scale(points, Plane(np.array([0.0, 0, 500]), normal))
        assert scatter_of(points[:, 2] - 500, scale) == pytest.approx(expected, rel=0.15)


def test_a_step_of_a_part_is_no_rounding(rng):
    """Two faces without noise lie apart, so the larger one is the plane."""
    points = face(np.zeros(5000), rng)
    points[points[:, 0] > 15, 2] += 1.0
    points = points[np.argsort(points[:, 0])]
    assert -fit_plane(points, EYE).normal @ fit_plane(points, EYE).point == pytest.approx(500, abs=1e-6)


@pytest.mark.parametrize("share", [0.3, 0.4, 0.45])
@pytest.mark.parametrize("turned", [0.0, 0.3])
def test_the_larger_of_two_parallel_faces_side_by_side_is_the_plane(share, turned, rng):
    """50 mm apart, noise of 2 mm. Before, the plane of most lay across both, at 42 deg, with a noise of 13 mm."""
    for _ in range(10):
        points = face(2 * rng.standard_normal(5000), rng)
        behind = points[:, 0] < np.quantile(points[:, 0], share)
        points[:, 2] += 50 * behind + turned * points[:, 1]
        fit = fit_plane(points, EYE)
        true = np.array([0, turned, -1]) / np.hypot(turned, 1)
        assert fit.normal @ true > np.cos(np.radians(1)) and fit.residual_std < 2.5
        assert fit.count == pytest.approx(5000 * (1 - share), rel=0.02)


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize(("radius", "length", "count"), [(3.0, 400.0, 3000), (1.0, 100.0, 500)])
def test_a_rod_much_longer_than_wide_is_found(radius, length, count, seed):
    """The neighbours of a point, 3 % of all, span the whole width of the rod."""
    rng = np.random.default_rng(seed)
    axis = np.array([np.cos(seed), np.sin(seed), 0.2]) / np.sqrt(1.04)
    toward = np.array([0, 0, -1.0]) + axis[2] * axis
    toward /= np.linalg.norm(toward)
    angle = np.deg2rad(rng.uniform(-75, 75, count))
    around = np.outer(np.cos(angle), toward) + np.outer(np.sin(angle), np.cross(axis, toward))
    points = [0, 0, 600] + radius * around + np.outer(rng.uniform(-length / 2, length / 2, count), axis)
    points += rng.normal(0, 0.05, (count, 1)) * points / np.linalg.norm(points, axis=1, keepdims=True)
    fit = fit_cylinder(points, cylinder_start(points), EYE)
    assert fit.radius == pytest.approx(radius, abs=5 * np.sqrt(fit.covariance[4, 4]))
    assert np.linalg.norm(np.cross(fit.axis, axis)) < 1e-3
