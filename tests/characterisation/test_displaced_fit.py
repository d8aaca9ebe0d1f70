"""Fits to points that lie far off: against surfaces that they lie on exactly, and against fits to drawn points."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from characterisation.features.displaced_fit import displaced_fit
from characterisation.features.surfaces import Cylinder, Sphere

RADIUS = 20.0
CYLINDER = Cylinder(np.array([0.0, 0.0, 520.0]), np.array([0.0, 1.0, 0.0]), RADIUS)
SPHERE = Sphere(np.array([5.0, -3.0, 520.0]), RADIUS)


def seen(surface):
    """Points (n, 3) of a surface and their rays from the origin, and the sine of the angle from its nearest line."""
    x, y = np.meshgrid(np.linspace(-17, 17, 30), np.linspace(-12, 12, 16))
    ray = np.stack([x.ravel(), y.ravel(), np.full(x.size, 500.0)], axis=1)
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    start = 400.0 * ray
    residual, _, cosine = surface.linearised(np.zeros(surface.parameter_count), start, ray)
    hit = np.abs(cosine) > 0.4
    return (start - residual[:, None] * ray)[hit], ray[hit], x.ravel()[hit] / RADIUS


def fitted(surface, point, ray, displaced, weight):
    """The same fit by an independent least-squares program."""
    places = point + displaced[:, None] * ray

    def residual(parameters):
        return np.sqrt(weight) * surface.linearised(parameters, places, ray)[0]

    return least_squares(residual, np.zeros(surface.parameter_count), xtol=1e-14, ftol=1e-14, gtol=1e-14).x


@pytest.mark.parametrize("surface", [CYLINDER, SPHERE], ids=["cylinder", "sphere"])
def test_without_displacement_a_fit_is_linear(surface):
    point, ray, _ = seen(surface)
    found = displaced_fit(surface, point, ray, np.zeros(len(point)), np.ones(len(point)))
    assert np.abs(found.change).max() < 1e-6
    np.testing.assert_allclose(found.gain, np.eye(surface.parameter_count), atol=1e-5)


@pytest.mark.parametrize("surface", [CYLINDER, SPHERE], ids=["cylinder", "sphere"])
def test_points_of_another_surface_are_fitted_by_that(surface):
    """All of them lie on one that is 3 mm larger and 1 mm aside."""
    point, ray, _ = seen(surface)
    other = np.zeros(surface.parameter_count)
    other[[0, -1]] = 1.0, 3.0
    found = displaced_fit(surface, point, ray, -surface.linearised(other, point, ray)[0], np.ones(len(point)))
    np.testing.assert_allclose(found.change, other, atol=1e-4)


@pytest.mark.parametrize("depth", [0.5, 1.5, 2.5, -1.5])
def test_a_pillar_with_a_hollow_middle_is_fitted_as_an_independent_program_does(depth):
    point, ray, sine = seen(CYLINDER)
    weight = np.random.default_rng(3).uniform(0.2, 2.0, len(point))
    hollow = depth * np.exp(-((sine / 0.4) ** 2))
    found = displaced_fit(CYLINDER, point, ray, hollow, weight)
    exact = fitted(CYLINDER, point, ray, hollow, weight)
    np.testing.assert_allclose(found.change, exact, atol=2e-3)
    first_order = 1e3 * displaced_fit(CYLINDER, point, ray, 1e-3 * hollow, weight).change[4]
    assert found.change[4] - first_order > 0.1 * depth**2  # a hollow one is softer, and one that bulges is firmer

    # what moves the points beside moves that fit, and not the first-order one
    rng = np.random.default_rng(5)
    moves = []
    for _ in range(20):
        by = 0.01 * rng.normal(size=len(point))
        first = np.linalg.solve((found.g * weight[:, None]).T @ found.g, -(found.g * weight[:, None]).T @ by)
        turned = fitted(CYLINDER, point, ray, hollow + by, weight) - fitted(CYLINDER, point, ray, hollow - by, weight)
        moves.append((turned[4] / 2, (found.gain @ first)[4]))
    exact, foretold = np.array(moves).T
    np.testing.assert_allclose(foretold, exact, atol=0.02 * np.abs(exact).max())


def test_the_gain_is_the_spread_of_fits_to_drawn_points():
    point, ray, sine = seen(CYLINDER)
    many, rng = np.ones(len(point)), np.random.default_rng(2)
    hollow = 2.5 * np.exp(-((sine / 0.4) ** 2))
    draws = [fitted(CYLINDER, point, ray, hollow + rng.normal(0.0, 0.1, len(point)), many)[4] for _ in range(150)]
    found, flat = (displaced_fit(CYLINDER, point, ray, off, many) for off in (hollow, 0 * hollow))
    first, plain = (0.1**2 * np.linalg.inv(one.g.T @ one.g) for one in (found, flat))
    foretold = np.sqrt((found.gain @ first @ found.gain.T)[4, 4])
    assert foretold > 1.5 * np.sqrt(plain[4, 4])
    assert np.std(draws) == pytest.approx(foretold, rel=0.2)  # good to 6 %


def test_a_fit_that_nothing_holds_is_none():
    """The middle lies deeper than the limbs: that is no pillar seen from outside."""
    point, ray, sine = seen(CYLINDER)
    assert displaced_fit(CYLINDER, point, ray, 40.0 * (1 - sine**2), np.ones(len(point))) is None
