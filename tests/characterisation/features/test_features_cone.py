"""Cones, and what all surfaces have in common: derivatives, rigid motions, closed forms of the covariance, bias."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from characterisation.features.fits import fit_cone, fit_surface
from characterisation.features.fitted import with_covariance
from characterisation.features.robust_fit import FitError
from characterisation.features.surfaces import Cone, Cylinder, Plane, Sphere
from characterisation.features.vectors import tangents

EYE = np.zeros(3)
AXIS = np.array([0.1, -0.9, -0.4]) / np.linalg.norm([0.1, -0.9, -0.4])
CENTRE = np.array([30.0, 10.0, 600.0])


def sample(surface, count, rng, half_arc_deg=60.0, half_length=25.0):
    """Points on the side of a surface that faces the origin."""
    if isinstance(surface, Plane):
        return surface.point + rng.uniform(-30, 30, (count, 2)) @ tangents(surface.normal)
    if isinstance(surface, Sphere):
        toward = -surface.centre / np.linalg.norm(surface.centre)
        cosine, angle = rng.uniform(0.5, 1, count), rng.uniform(0, 2 * np.pi, count)
        sideways = np.column_stack([np.cos(angle), np.sin(angle)]) @ tangents(toward)
        return surface.centre + surface.radius * (np.outer(cosine, toward) + np.sqrt(1 - cosine**2)[:, None] * sideways)
    across = -surface.point + (surface.point @ surface.axis) * surface.axis
    across /= np.linalg.norm(across)
    angle = np.deg2rad(rng.uniform(-half_arc_deg, half_arc_deg, count))
    along = rng.uniform(-half_length, half_length, count)
    radius = surface.radius + along * np.tan(getattr(surface, "half_angle", 0.0))
    around = np.outer(np.cos(angle), across) + np.outer(np.sin(angle), np.cross(surface.axis, across))
    return surface.point + radius[:, None] * around + np.outer(along, surface.axis)


def unit_rays(points):
    return points / np.linalg.norm(points, axis=1, keepdims=True)


SURFACES = {
    "plane": Plane(np.array([20.0, -10, 600]), np.array([0.0, 0.6, -0.8])),
    "cylinder": Cylinder(CENTRE, AXIS, 20.0),
    "sphere": Sphere(CENTRE, 50.0),
    "cone": Cone(CENTRE, AXIS, 20.0, 0.3),
}
each_surface = pytest.mark.parametrize("kind", list(SURFACES))


def parameters_of(truth, fit):
    """The true surface in the parameters of a small change of the fit, to first order."""
    if isinstance(fit, Plane):
        normal = truth.normal * np.sign(fit.normal @ truth.normal)
        return np.array([(truth.point - fit.point) @ normal, *tangents(fit.normal) @ normal])
    if isinstance(fit, Sphere):
        return np.array([*truth.centre - fit.centre, truth.radius - fit.radius])
    basis, there = tangents(fit.axis), truth.at_foot_of(fit.point)
    tilts = basis @ truth.axis
    error = [*basis @ (there.point - fit.point), *tilts, there.radius - fit.radius]
    return np.array(error + ([truth.half_angle - fit.half_angle] if isinstance(fit, Cone) else []))


@pytest.mark.parametrize("viewpoint", [None, EYE])
@pytest.mark.parametrize("half_angle_deg", [3.0, 20.0, 60.0])
def test_exact_points_give_the_exact_cone(half_angle_deg, viewpoint):
    cone = Cone(CENTRE, -AXIS, 50.0, np.deg2rad(half_angle_deg))
    points = sample(cone, 400, np.random.default_rng(1), half_arc_deg=50.0)
    start = Cone(CENTRE + np.array([1.0, -2, 1]), -AXIS + np.array([0.03, 0.02, 0]), 46.0, cone.half_angle * 1.1)
    fit = fit_cone(points, start, viewpoint)
    assert np.abs(parameters_of(cone, fit)).max() < 1e-8
    assert np.abs(fit.apex - cone.apex).max() < 1e-6
    assert (fit.count, fit.covariance.shape) == (400, (6, 6))


@each_surface
def test_a_residual_is_the_way_along_the_ray_to_the_surface(kind):
    surface = SURFACES[kind]
    feet = sample(surface, 200, np.random.default_rng(2))
    moved = np.random.default_rng(3).normal(0, 0.5, 200)
    points = feet + moved[:, None] * unit_rays(feet)
    at = surface.meet(points, unit_rays(points))
    facing = np.abs(at.cosine) > 0.2
    assert facing.sum() > 100
    assert np.abs(at.residual - moved)[facing].max() < 1e-9
    assert np.abs(at.foot - feet)[facing].max() < 1e-9
    assert np.abs(np.linalg.norm(at.normal, axis=1) - 1).max() < 1e-12


@each_surface
@pytest.mark.parametrize("along_rays", [False, True])
def test_derivatives_are_those_of_the_residuals(kind, along_rays):
    """Also away from the given surface, where a fit takes its steps."""
    surface = SURFACES[kind]
    points = sample(surface, 100, np.random.default_rng(4)) + np.random.default_rng(5).normal(0, 0.3, (100, 3))
    rays = unit_rays(points) if along_rays else None
    at = 0.02 * np.random.default_rng(6).normal(size=surface.parameter_count)
    _, jacobian, cosine = surface.linearised(at, points, rays)
    clear = np.abs(cosine) > 0.2
    for column in range(surface.parameter_count):
        step = np.zeros(surface.parameter_count)
        step[column] = 1e-5
        ahead, behind = (surface.linearised(at + sign * step, points, rays)[0] for sign in (1, -1))
        # central differences are good to h^2 of the third derivative, which is below 1 here, and to 1e-13 / h
        assert np.abs((ahead - behind) / 2e-5 - jacobian[:, column])[clear].max() < 1e-6


@each_surface
def test_a_rigid_motion_of_everything_changes_no_residual(kind):
    motion = np.eye(4)
    motion[:3, :3] = Rotation.from_euler("xyz", [40, -70, 110], degrees=True).as_matrix()
    motion[:3, 3] = [100.0, -50, 30]
    points = sample(SURFACES[kind], 100, np.random.default_rng(7)) + 0.1
    rays = unit_rays(points)
    still = SURFACES[kind].meet(points, rays)
    moved = SURFACES[kind].placed(motion).meet(points @ motion[:3, :3].T + motion[:3, 3], rays @ motion[:3, :3].T)
    assert np.abs(still.residual - moved.residual).max() < 1e-9
    assert np.abs(still.normal @ motion[:3, :3].T - moved.normal).max() < 1e-9


def test_a_ray_that_meets_only_the_other_half_of_a_cone_misses():
    cone = Cone(np.array([0.0, 0, 500]), np.array([0.0, 0, 1]), 10.0, 0.5)
    beyond = cone.apex - [0, 5.0, 10]
    assert cone.meet(beyond[None], np.array([[0.0, 1, 0]])).cosine[0] == 0


def test_covariances_of_regular_samples_have_closed_forms():
    """Points all round and evenly along, orthogonal distances: J^T J is diagonal, its entries are means of squares.

    Plane: 1, x^2, y^2. Cylinder: 1/2 for shifts, z^2/2 for tilts, 1 for the radius. Cone: cos^2/2 for shifts, cos^2
    for the radius, z^2/cos^2 for the half-angle, (cos z + sin rho)^2 / 2 for tilts, which shifts are correlated with.
    """
    angle, along = (one.ravel() for one in np.meshgrid(np.arange(48) * np.pi / 24, np.linspace(-30, 30, 41)))
    ring = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(angle.size)])
    z, count, square = np.array([0.0, 0, 1]), angle.size, np.mean(along**2)
    flat = np.column_stack([along, np.random.default_rng(8).permutation(along), np.zeros(count)])

    def inverse(surface, points):
        _, jacobian, _ = surface.linearised(np.zeros(surface.parameter_count), points, None)
        return np.linalg.inv(jacobian.T @ jacobian) * count

    first = tangents(z)
    plane = inverse(Plane(np.zeros(3), z), flat)
    assert plane[0, 0] == pytest.approx(1)
    assert np.linalg.inv(plane)[1:, 1:] == pytest.approx((flat @ first.T).T @ (flat @ first.T) / count)
    cylinder = inverse(Cylinder(np.zeros(3), z, 20.0), 20 * ring + np.outer(along, z))
    assert np.diag(cylinder) == pytest.approx([2, 2, 2 / square, 2 / square, 1])
    alpha = 0.3
    radius = 40 + along * np.tan(alpha)
    cone = inverse(Cone(np.zeros(3), z, 40.0, alpha), radius[:, None] * ring + np.outer(along, z))
    assert cone[4, 4] == pytest.approx(1 / np.cos(alpha) ** 2)
    assert cone[5, 5] == pytest.approx(np.cos(alpha) ** 2 / square)
    lever = np.cos(alpha) * along + np.sin(alpha) * radius
    block = np.linalg.inv(
        [
            [np.cos(alpha) ** 2 / 2, np.cos(alpha) * lever.mean() / 2],
            [np.cos(alpha) * lever.mean() / 2, np.mean(lever**2) / 2],
        ]
    )
    assert np.diag(cone)[:4] == pytest.approx([block[0, 0], block[0, 0], block[1, 1], block[1, 1]])


@pytest.mark.parametrize("viewpoint", [None, EYE])
def test_the_covariance_of_a_cone_is_the_one_of_repeated_measurements(viewpoint):
    cone, runs, total = SURFACES["cone"], 40, 0.0
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        points = sample(cone, 400, rng)
        ways = cone.meet(points, None).normal if viewpoint is None else unit_rays(points)
        fit = fit_cone(points + rng.normal(0, 0.05, (400, 1)) * ways, cone, viewpoint)
        error = parameters_of(cone, fit)
        total += error @ np.linalg.solve(fit.covariance, error) / runs
    assert abs(total - 6) < 4 * np.sqrt(2 * 6 / runs)  # chi^2 with 6 degrees of freedom has variance 12


@each_surface
def test_the_bias_is_less_than_a_tenth_of_the_standard_uncertainty(kind):
    """Noise and its negative together leave only what is even in the noise: the bias, without the scatter."""
    surface, biases, uncertainties = SURFACES[kind], [], []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        feet = sample(surface, 500, rng)
        noise = rng.normal(0, 0.1, (500, 1)) * unit_rays(feet)
        fits = [fit_surface(feet + sign * noise, surface, EYE) for sign in (1, -1)]
        biases.append(np.mean([parameters_of(surface, fit) for fit in fits], axis=0))
        uncertainties.append(np.sqrt(np.diag(fits[0].covariance)))
    assert (np.abs(np.mean(biases, axis=0)) < 0.1 * np.mean(uncertainties, axis=0)).all()


@pytest.mark.parametrize("kind", ["plane", "cone"])
def test_intervals_of_95_per_cent_hold_the_truth_as_often(kind):
    """300 points leave the normal's 1.96; the last parameter of each run, so that runs are independent."""
    surface, runs, held = SURFACES[kind], 100, 0
    for seed in range(runs):
        rng = np.random.default_rng([1, seed])
        feet = sample(surface, 300, rng)
        fit = fit_surface(feet + rng.normal(0, 0.1, (300, 1)) * unit_rays(feet), surface, EYE)
        held += abs(parameters_of(surface, fit)[-1]) < 1.96 * np.sqrt(fit.covariance[-1, -1])
    assert abs(held / runs - 0.95) < 4 * np.sqrt(0.95 * 0.05 / runs)  # binomial


def test_a_cone_does_not_follow_stray_points():
    cone, rng = SURFACES["cone"], np.random.default_rng(9)
    points = sample(cone, 2000, rng)
    points = points + rng.normal(0, 0.1, (2000, 1)) * unit_rays(points)
    spoilt = points.copy()
    spoilt[:200] += rng.uniform(5, 30, (200, 1)) * np.array([0.2, 0.1, 1.0])
    clean, robust = fit_cone(points[200:], cone, EYE), fit_cone(spoilt, cone, EYE)
    assert robust.count == pytest.approx(1800, abs=10)
    assert abs(robust.half_angle - clean.half_angle) < 2 * np.sqrt(clean.covariance[5, 5])


ring = np.column_stack([20 * np.cos(np.linspace(0, 6, 50)), 20 * np.sin(np.linspace(0, 6, 50)), np.full(50, 600.0)])


@pytest.mark.parametrize(
    "points, said",
    [
        (ring[:6], "6 points, a cone needs at least 7"),
        (ring, "do not determine a cone"),
        (np.ones((20, 3)), "cone"),
        (sample(Cylinder(CENTRE, AXIS, 20.0), 300, np.random.default_rng(10)), "departs from the nominal cone"),
    ],
)
def test_points_that_make_no_cone_are_refused(points, said):
    nominal = (
        Cone(CENTRE, AXIS, 20.0, 0.3)
        if len(points) == 300
        else Cone(np.array([0.0, 0, 600]), np.array([0.0, 0, 1]), 20.0, 0.3)
    )
    with pytest.raises(FitError, match=said):
        fit_cone(points, nominal)


@settings(max_examples=40)
@given(st.integers(0, 30), st.sampled_from([0.0, 1e-9, 1.0, 1e4]), st.integers(0, 2**32 - 1), st.booleans())
def test_any_points_give_a_finite_cone_or_a_fit_error(count, spread, seed, seen):
    points = np.array([0.0, 0.0, 600.0]) + spread * np.random.default_rng(seed).normal(size=(count, 3))
    nominal = Cone(np.array([0.0, 0.0, 620.0]), np.array([0.0, 1.0, 0.0]), 20.0, 0.4)
    try:
        fit = fit_cone(points, nominal, EYE if seen else None)
    except FitError:
        return
    assert np.isfinite(fit.covariance).all() and np.isfinite(fit.apex).all()


@each_surface
def test_a_nominal_surface_can_be_given_a_covariance(kind):
    surface = SURFACES[kind]
    count = surface.parameter_count
    fit = with_covariance(surface, np.eye(count))
    assert isinstance(fit, type(surface)) and fit.kind == kind
    assert np.isnan(fit.residual_std) and fit.count == 0
    assert (fit.covariance == np.eye(count)).all()
    again = with_covariance(fit, 2 * np.eye(count), 0.1, 7)
    assert (again.residual_std, again.count, again.covariance[0, 0]) == (0.1, 7, 2.0)
    with pytest.raises(ValueError, match=f"{count} parameters"):
        with_covariance(surface, np.eye(count + 1))
