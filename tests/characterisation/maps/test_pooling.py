"""Pooling gives back what a sensor is, with errors that hold, where something was measured and nowhere else."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from characterisation.coupon.orientations import cap_directions
from characterisation.lambert_projection import inverse_lambert_projection, lambert_projection
from characterisation.maps.local_regression import Observations, Slopes, local_fit
from characterisation.maps.pooling import patch_normals, pool
from tests.characterisation.maps.known_sensor import (
    LOBE,
    NOMINAL,
    Campaign,
    known_fraction,
    known_sigma,
    shown,
    uneven_plan,
)

LARGEST = math.radians(60)
NORMALS = cap_directions(4, math.radians(52))[::2]  # at captures and between them
PLACES = lambert_projection(NORMALS)
PLANS = {"even": cap_directions(3, LARGEST), "uneven": uneven_plan()}


@pytest.mark.parametrize("effects", [(0.0, 0.0), (0.03, 0.1)], ids=["patches alone", "captures too"])
@pytest.mark.parametrize("plan", PLANS)
def test_intervals_hold_what_the_sensor_is(plan, effects):
    """95 % intervals hold the truth at 90 to 98 % of the places, over four campaigns."""
    inside = {"fraction": [], "sigma": []}
    for seed in range(100, 104):
        found = pool(shown(Campaign(PLANS[plan]), np.random.default_rng(seed), *effects), NOMINAL, PLACES)
        away = np.abs(found.fraction - known_fraction(NORMALS, NOMINAL)) / found.fraction_error
        inside["fraction"].append(away < 1.96)
        away = np.abs(np.log(found.sigma / known_sigma(NORMALS, NOMINAL))) * found.sigma / found.sigma_error
        inside["sigma"].append(away < 1.96)
    for name, hits in inside.items():
        assert 0.90 <= np.mean(hits) <= 0.98, (name, np.mean(hits, axis=1))


def test_noise_common_to_captures_widens_the_errors():
    """One capture weighs at most as much as its effect: 100 captures of 0.1 each cannot tell sigma better than 1 %."""
    errors = []
    for effect in (0.0, 0.1):
        found = pool(shown(Campaign(PLANS["even"]), np.random.default_rng(3), 0, effect), NOMINAL, PLACES)
        errors.append(np.median(found.sigma_error / found.sigma))
    # a kernel of 6 to 10 captures averages 0.1 to about 0.035; patches alone leave under 0.02
    assert errors[0] < 0.02 < 0.03 < errors[1] < 0.1


def test_a_lobe_of_three_degrees_is_followed():
    """Within a patch's width of the lobe's middle F is 0.27; a kernel of 5 deg would show 0.5."""
    found = pool(shown(Campaign(PLANS["uneven"]), np.random.default_rng(5)), NOMINAL, LOBE[None])
    truth = known_fraction(inverse_lambert_projection(LOBE[None]), NOMINAL)
    assert abs(found.fraction - truth)[0] < 3 * found.fraction_error[0]
    assert found.fraction_error[0] < 0.05


def test_distances_that_go_with_the_tilt_leave_no_bias():
    """Sigma as |V|^2, the same along every normal, known without noise: a mean over patches 10 % nearer and farther
    would be off by 1 to 20 %.
    """

    def steady(normals, distance):
        return 1e-6 * distance**2 / normals[..., 2]

    table = shown(Campaign(PLANS["even"], reach=math.radians(8)), np.random.default_rng(0), sigma=steady)
    table["ray_noise_inliers"] = ("patch", steady(patch_normals(table), table["distance"].values))
    found = pool(table, NOMINAL, PLACES)
    assert np.allclose(found.sigma * NORMALS[:, 2], 0.36, rtol=2e-3)


@pytest.mark.parametrize("power", [0.7, 1.0, 1.35])
def test_a_rise_toward_the_rim_is_followed_where_normals_are_far_apart(power):
    """Sigma as a power of 1/cos, normals 17 deg apart to 80 deg: fitted as it is, it would be up to 13 % off."""

    def rising(normals, distance):
        return 1e-6 * distance**2 / normals[..., 2] ** power

    plan = Campaign(cap_directions(2, math.radians(80)), reach=math.radians(5))
    table = shown(plan, np.random.default_rng(1), fraction=lambda normals, distance: 1.0 + 0 * distance, sigma=rising)
    table["ray_noise_inliers"] = ("patch", rising(patch_normals(table), table["distance"].values))
    normals = cap_directions(4, math.radians(68))
    found = pool(table, NOMINAL, lambert_projection(normals))
    np.testing.assert_allclose(found.sigma, rising(normals, NOMINAL), rtol=0.05)


def test_the_error_grows_with_the_distance_from_data():
    """Captures 8.6 deg apart but for a hole 18 deg about a normal: the farther into it, the less is known."""
    middle = np.array([0.0, -0.4])
    normals = PLANS["even"][np.linalg.norm(lambert_projection(PLANS["even"]) - middle, axis=1) > math.radians(18)]
    turn = np.linspace(0, 2 * math.pi, 12, endpoint=False)
    ring = np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    errors = []
    for seed in range(3):
        table = shown(Campaign(normals, reach=math.radians(4)), np.random.default_rng(seed))
        rings = np.concatenate([middle + math.radians(r) * ring for r in (22, 12, 8, 0.1)])
        found = pool(table, NOMINAL, rings)
        both = np.stack([found.fraction_error, found.sigma_error / found.sigma], axis=1)
        errors.append(np.median(both.reshape(4, 12, 2), axis=1))
    outside, brim, within, centre = np.mean(errors, axis=0)
    elsewhere = np.maximum.reduce([outside, brim, within])
    assert centre[0] > 2 * elsewhere[0] and centre[1] > 1.2 * elsewhere[1]  # sigma along the normal hardly bends there
    assert outside[0] < brim[0] < within[0]


def test_nothing_is_said_outside_the_hull_and_everything_inside():
    """Captures at three corners only: whatever lies between them has an answer, whatever does not has none."""
    corners = inverse_lambert_projection(np.array([[0.0, 0.5], [-0.45, -0.3], [0.45, -0.3], [0.0, 0.0]]))
    table = shown(Campaign(corners), np.random.default_rng(2))
    grid = np.linspace(-0.9, 0.9, 61)
    places = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)
    known = np.isfinite(pool(table, NOMINAL, places).fraction)
    normals = np.stack([table["normal_x"].values, table["normal_y"].values], axis=-1)
    z = np.sqrt(1 - (normals**2).sum(1))
    hull = ConvexHull(lambert_projection(np.column_stack([normals, z])))
    level = (places @ hull.equations[:, :2].T + hull.equations[:, 2]).max(axis=1)
    assert known[level < -1e-6].all() and (level < -1e-6).sum() > 500
    assert not known[level > 1e-6].any()


@pytest.mark.parametrize("count", [0, 2, 5])
def test_patches_on_a_line_say_nothing(count):
    table = shown(Campaign(np.array([[0.0, 0.0, 1.0]])), np.random.default_rng(0)).isel(patch=slice(0, count))
    table["normal_x"], table["normal_y"] = ("patch", np.linspace(0, 0.1, count)), ("patch", np.zeros(count))
    assert np.isnan(pool(table, NOMINAL, PLACES).fraction).all()


def test_where_nothing_comes_back_f_is_zero_and_sigma_unknown():
    """A hole of F = 0 and 12 deg about the axis."""

    def holed(normals, distance):
        return np.where(normals[..., 2] > math.cos(math.radians(12)), 0.0, 0.9)

    table = shown(Campaign(PLANS["even"]), np.random.default_rng(4), fraction=holed)
    normals = cap_directions(4, math.radians(52))
    found = pool(table, NOMINAL, lambert_projection(normals))
    incidence = np.degrees(np.arccos(normals[:, 2]))
    assert (found.fraction[incidence < 8] < 0.01).all() and np.median(found.fraction[incidence < 8]) == 0
    assert np.array_equal(np.isnan(found.sigma), found.fraction <= 1e-6)
    assert np.isfinite(found.sigma[incidence > 20]).all()
    assert np.allclose(found.fraction[incidence > 20], 0.9, atol=0.06)
    assert (found.sigma[np.isfinite(found.sigma)] > 0.2).all()  # 0.36 and up: no wild extrapolation at the brim


def observations(place, value, weight):
    ones = np.ones(len(place))
    return Observations(place, value[:, None], weight, ones, np.arange(len(place)), 0 * ones)


@given(st.lists(st.floats(-3, 3), min_size=7, max_size=7), st.integers(0, 1000))
@settings(deadline=None, max_examples=25)
def test_a_polynomial_of_second_order_comes_back_exactly(coefficients, seed):
    rng = np.random.default_rng(seed)
    place = rng.uniform(-0.09, 0.09, (60, 3))
    a, b, x = place.T
    value = np.stack([np.ones(60), a, b, x, a * a, a * b, b * b]).T @ coefficients
    data = observations(place, value, rng.uniform(0.5, 2, 60))
    fit = local_fit(data, np.zeros((1, 3)), np.array([[0.0999]]), Slopes((0, 0, 0), (1e-12,) * 3, 1e-12))
    assert fit.estimate[0, 0, 0] == pytest.approx(coefficients[0], abs=1e-6)


def test_the_fit_is_that_of_weighted_least_squares():
    """Against numpy's lstsq on rows scaled by the root of their weights."""
    rng = np.random.default_rng(8)
    place, value, weight = rng.uniform(-0.09, 0.09, (80, 3)), rng.standard_normal(80), rng.uniform(0.5, 2, 80)
    radius, at = 0.0999, np.array([[0.02, -0.01, 0.0]])
    fit = local_fit(observations(place, value, weight), at, np.array([[radius]]), Slopes((0,) * 3, (1e-12,) * 3, 1e-12))
    a, b, x = (place - at).T
    kernel = np.maximum(1 - (a**2 + b**2) / radius**2, 0) ** 2 * weight
    design = np.stack([np.ones(80), a, b, x, a * a, a * b, b * b], axis=1) * np.sqrt(kernel)[:, None]
    expected = np.linalg.lstsq(design, value * np.sqrt(kernel), rcond=None)[0][0]
    assert fit.estimate[0, 0, 0] == pytest.approx(expected, abs=1e-6)
    # the weights l_i of the estimate are the first row of the pseudo-inverse
    row = np.linalg.pinv(design)[0] * np.sqrt(kernel)
    assert fit.independent[0, 0] == pytest.approx((row**2).sum(), rel=1e-5)


@pytest.mark.parametrize("radius", [0.0999, 0.3])
def test_overlapping_discs_count_as_often_as_they_are_independent(radius):
    """Every row twice, half as independent each, is the same; with wide kernels, whose rows are joined, too."""
    rng = np.random.default_rng(8)
    place, value, ones = rng.uniform(-radius, radius, (300, 3)), rng.standard_normal((300, 1)), np.ones(300)
    cluster = np.sort(rng.integers(0, 9, 300))
    once = Observations(place, value, ones, ones, cluster, 0 * ones)
    twice = Observations(*(np.repeat(column, 2, axis=0) for column in vars(once).values()))
    halved = Observations(twice.position, twice.value, twice.weight / 2, twice.share / 2, twice.cluster, twice.within)
    slopes = Slopes((0, 0, 0), (0.1, 0.1, 1), 0.1)
    first, second = (local_fit(data, np.zeros((1, 3)), np.array([[radius]]), slopes) for data in (once, halved))
    for name, expected in vars(first).items():
        assert np.allclose(getattr(second, name), expected, rtol=1e-9), name


def test_a_variance_is_a_mean_and_not_a_geometric_mean():
    """2000 variances with 10 degrees of freedom: their mean is 4, within three standard errors; exp(mean log), 3.6."""
    rng = np.random.default_rng(9)
    place = np.column_stack([rng.uniform(-0.09, 0.09, (2000, 2)), np.zeros(2000)])
    data = observations(place, 4.0 * rng.chisquare(10, 2000) / 10, np.full(2000, 10.0))
    fit = local_fit(data, np.zeros((1, 3)), np.array([[0.0999]]), Slopes((0, 0, 4), (0.1, 0.1, 1), 1.0), "log")
    assert math.exp(fit.estimate[0, 0, 0]) == pytest.approx(
        4.0, abs=3 * 4 * math.sqrt(fit.scatter[0, 0] * fit.independent[0, 0])
    )
    assert fit.scatter[0, 0] == pytest.approx(0.2, rel=0.15)
