"""Expected covariances against the scatter of fits to drawn points."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.optimize import brentq
from scipy.stats import norm

from characterisation.coupon.offsets import own_area
from characterisation.features.robust_fit import FitError
from characterisation.features.surfaces import Cylinder, Plane
from characterisation.features.vectors import tangents
from characterisation.tasks.covariance import ExpectedPoints, expected_fit

ROWS, COLUMNS = 60, 80
PITCH = 2e-3


def seen(surface: Plane | Cylinder, fraction: float, sigma: float, area: float, persistent: float) -> ExpectedPoints:
    """A surface some 500 mm away that fills a small pinhole image, the sensor at the origin."""
    row, column = np.mgrid[0:ROWS, 0:COLUMNS].reshape(2, -1)
    ray = np.stack([(column - COLUMNS / 2) * PITCH, (row - ROWS / 2) * PITCH, np.ones(row.size)], axis=1)
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    start = 400.0 * ray
    residual, _, cosine = surface.linearised(np.zeros(surface.parameter_count), start, ray)
    hit = np.abs(cosine) > 0.3
    point = (start - residual[:, None] * ray)[hit]
    many = np.ones(len(point))
    return ExpectedPoints(
        point,
        ray[hit],
        np.stack([row, column], axis=1)[hit],
        np.tile([0.0, 0.0, 1.0], (len(point), 1)),
        fraction * many,
        0 * many,
        sigma * many,
        area * many,
        persistent * many,
        0 * many,
        500 * many,
    )


SURFACES = {
    "plane": Plane(np.array([0.0, 0.0, 500.0]), np.array([0.3, 0.1, -1.0]) / np.linalg.norm([0.3, 0.1, -1.0])),
    "cylinder": Cylinder(
        np.array([5.0, 0.0, 520.0]), np.array([0.1, 1.0, 0.1]) / np.linalg.norm([0.1, 1.0, 0.1]), 20.0
    ),
}


def errors(surface: Plane | Cylinder, points: ExpectedPoints, fields: list[np.ndarray], keep: np.ndarray) -> np.ndarray:
    """First-order errors (n, p) of unweighted least squares, for noise (ROWS, COLUMNS) along the rays."""
    _, g, _ = surface.linearised(np.zeros(surface.parameter_count), points.point, points.ray)
    place = tuple(points.pixel.T)
    return np.array(
        [
            -np.linalg.solve((g * there[:, None]).T @ g, g.T @ (field[place] * there))
            for field, there in zip(fields, keep, strict=True)
        ]
    )


@pytest.mark.parametrize("name", SURFACES)
@pytest.mark.parametrize(("fraction", "spread"), [(1.0, 0.0), (0.5, 0.0), (1.0, 1.5)])
def test_covariance_is_that_of_many_fits(name: str, fraction: float, spread: float) -> None:
    surface, rng, repeats, sigma = SURFACES[name], np.random.default_rng(1), 600, 0.3
    shape = (ROWS + 40, COLUMNS + 40)
    fields = [rng.normal(size=shape) for _ in range(repeats)]
    if spread:
        fields = [gaussian_filter(f, spread, mode="wrap") for f in fields]
    scale = sigma / np.sqrt(np.mean([f.var() for f in fields]))
    fields = [scale * f[20:-20, 20:-20] for f in fields]
    # the map's sigma is that about planes through discs, which keep a share kappa of a correlated field
    a = max(4 * np.pi * spread**2, 1.0)
    noise_area = np.exp(brentq(lambda x: np.log(own_area(np.exp(x), 6.0) / a), 0.0, 7.0)) if spread else 1.0
    points = seen(surface, fraction, sigma * np.sqrt(a / noise_area), noise_area / fraction, 0.0)
    found = expected_fit(surface, points, 100)
    keep = rng.random((repeats, len(points.point))) < fraction
    scatter = np.cov(errors(surface, points, fields, keep).T)
    ratio = np.sqrt(np.diag(scatter) / np.diag(found.covariance))
    # a standard deviation of 600 draws is known to 3 %
    assert ratio == pytest.approx(np.ones(len(ratio)), abs=0.10)
    assert found.count == pytest.approx(fraction * len(points.point))


def test_offsets_that_last_do_not_average_out() -> None:
    surface = SURFACES["plane"]
    without, with_it = (expected_fit(surface, seen(surface, 1.0, 0.1, 1.0, p), 100) for p in (0.0, 0.05))
    height = surface.parameter_count * [0.0]
    height[0] = 1.0
    along = abs(surface.normal[2])  # an offset along the rays moves the plane by its part along the normal
    p = np.sqrt(with_it.covariance[0, 0] - without.covariance[0, 0]) / along
    # alike within 60 px of an image of 60 x 80: most of it is left, 0.87 by the integral over this image
    assert 0.8 < p / 0.05 < 1.0
    assert without.covariance[0, 0] == pytest.approx((0.1 * along) ** 2 / (ROWS * COLUMNS), rel=0.1)


def test_offsets_of_surfaces_turned_apart_are_independent() -> None:
    surface, points = SURFACES["plane"], seen(SURFACES["plane"], 1.0, 0.1, 1.0, 0.05)
    normal = np.zeros((len(points.point), 3))
    turned = np.radians(30.0 * (points.pixel[:, 1] >= COLUMNS / 2))
    normal[:, 0], normal[:, 2] = np.sin(turned), np.cos(turned)
    halves = ExpectedPoints(**{**vars(points), "normal": normal})
    alike, apart = (expected_fit(surface, each, 100).covariance[0, 0] for each in (points, halves))
    assert apart < 0.75 * alike


def test_thinned_points_say_the_same() -> None:
    surface = SURFACES["cylinder"]
    full = seen(surface, 0.8, 0.2, 20.0, 0.03)
    every = (full.pixel % 2 == 0).all(1)
    rows = {name: value[every] for name, value in vars(full).items() if isinstance(value, np.ndarray)}
    thin = replace(full, **rows, thinning=4)
    a, b = (expected_fit(surface, each, 100) for each in (full, thin))
    assert np.sqrt(np.diag(a.covariance)) == pytest.approx(np.sqrt(np.diag(b.covariance)), rel=0.05)
    assert (b.count, b.chance) == pytest.approx((a.count, a.chance), rel=0.05)


def test_the_chance_of_enough_points_is_that_of_a_binomial_if_losses_are_independent() -> None:
    surface, fraction = SURFACES["plane"], 0.02
    points = seen(surface, fraction, 0.1, 1.0, 0.0)
    n = len(points.point)
    spread = np.sqrt(n * fraction * (1 - fraction))
    assert expected_fit(surface, points, n * fraction - spread).chance == pytest.approx(norm.cdf(1.0), abs=1e-6)
    clumped = ExpectedPoints(**{**vars(points), "area": points.area + 7 + 1 / fraction})  # 1 / F of random losses
    assert expected_fit(surface, clumped, n * fraction - spread).chance == pytest.approx(norm.cdf(1 / 3), abs=1e-6)
    doubtful = ExpectedPoints(**{**vars(points), "fraction_error": np.full(n, 0.01)})
    assert expected_fit(surface, doubtful, n * fraction - spread).chance == pytest.approx(
        norm.cdf(spread / np.hypot(spread, 0.01 * n)), abs=1e-6
    )


def test_a_displacement_goes_in_as_the_bias_that_it_gives() -> None:
    """All points of a plane 0.2 mm too far along their rays: the fit moves by that and does not turn."""
    surface = Plane(np.array([0.0, 0.0, 500.0]), np.array([0.0, 0.0, -1.0]))
    points = seen(surface, 0.5, 0.1, 2.0, 0.0)
    along = points.ray[:, 2]
    moved = replace(points, displaced=0.2 / along)  # parallel to the plane
    before, after = (expected_fit(surface, each, 100).covariance for each in (points, moved))
    gained = after - before
    place = np.argmax(np.diag(gained))
    assert gained[place, place] == pytest.approx(0.2**2, rel=1e-9)
    gained[place, place] = 0.0
    assert np.abs(gained).max() < 1e-9


def test_what_is_displaced_by_more_than_a_hundredth_of_the_way_is_no_point() -> None:
    """Half of a plane's points 8 mm too far, at 500 mm: the fit is that of the other half, and is not moved."""
    surface = Plane(np.array([0.0, 0.0, 500.0]), np.array([0.0, 0.0, -1.0]))
    points = seen(surface, 1.0, 0.1, 1.0, 0.0)
    half = np.arange(len(points.point)) % 2 == 0
    rows = {name: value[~half] for name, value in vars(points).items() if isinstance(value, np.ndarray)}
    found = expected_fit(surface, replace(points, displaced=np.where(half, 8.0, 0.0)), 100)
    alone = expected_fit(surface, replace(points, **rows), 100)
    assert found.count == pytest.approx(alone.count)
    assert found.covariance == pytest.approx(alone.covariance, rel=1e-6, abs=1e-12)
    mostly = np.arange(len(points.point)) % 5 > 0
    with pytest.raises(FitError, match="less than 25 %"):
        expected_fit(surface, replace(points, displaced=np.where(mostly, 8.0, 0.0)), 100)


def test_a_radius_that_the_points_do_not_determine_has_no_chance() -> None:
    surface = SURFACES["cylinder"]
    points = seen(surface, 1.0, 1e-6, 1.0, 0.01)
    sure = expected_fit(surface, points, 100)
    assert sure.chance == 1.0
    for radius_uncertainty, chance in ((0.1, 1.0), (10.0, 0.0)):  # 10 mm is half the radius
        scale = radius_uncertainty / np.sqrt(sure.covariance[4, 4])
        noisy = expected_fit(surface, replace(points, persistent=points.persistent * scale), 100)
        assert np.sqrt(noisy.covariance[4, 4]) == pytest.approx(radius_uncertainty)
        assert noisy.chance == pytest.approx(chance, abs=1e-9)
    plane = SURFACES["plane"]
    without_radius = expected_fit(plane, seen(plane, 1.0, 0.1, 1.0, 50.0), 100)
    assert without_radius.chance == 1.0


def test_points_that_determine_nothing_are_refused() -> None:
    surface, points = SURFACES["plane"], seen(SURFACES["plane"], 1.0, 0.1, 1.0, 0.0)
    e1 = tangents(surface.normal)[0]
    line = surface.point + np.linspace(-10, 10, len(points.point))[:, None] * e1
    along = np.tile([0.0, 0.0, 1.0], (len(line), 1))
    on_a_line = ExpectedPoints(**{**vars(points), "point": line, "ray": along})
    with pytest.raises(FitError, match="do not determine a plane"):
        expected_fit(surface, on_a_line, 100)
    none = {name: value[:0] for name, value in vars(points).items() if isinstance(value, np.ndarray)}
    with pytest.raises(FitError, match="no points"):
        expected_fit(surface, replace(points, **none), 100)
