"""The rule that tells credible fits from failures, on synthetic points of known surfaces."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from characterisation.features.credibility import check_surface, places_seen
from characterisation.features.fits import belonging, fit_surface
from characterisation.features.robust_fit import FitError, UndeterminedError
from characterisation.features.surfaces import Cone, Cylinder, Plane, Sphere
from characterisation.features.vectors import unit
from characterisation.point_cloud import PointCloud, Status, ViewGrid
from characterisation.tasks.evaluation import measure, measure_points
from characterisation.tasks.task_file import Task

GRID = ViewGrid(1500.0, 1500.0, 54.5, 54.5, 110, 110)
RAYS = GRID.rays().reshape(-1, 3)
EYE = np.zeros(3)
BALL = Sphere(np.array([0.0, 0.0, 500.0]), 12.0)
SHIFTED_BALL = Sphere(np.array([0.2, 0.1, 500.3]), 12.05)
BAR = Cylinder(np.array([0.0, 0.0, 520.0]), np.array([0.0, 1.0, 0.0]), 20.0)
TURNED_BAR = Cylinder(np.array([0.3, 0.0, 522.0]), unit(np.array([0.02, 1.0, 0.005])), 20.05)
FACE = Plane(np.array([0.0, 0.0, 500.0]), unit(np.array([0.0, 0.5, -0.866])))
TILTED_FACE = Plane(np.array([0.0, 0.0, 501.0]), unit(np.array([0.0, 0.51, -0.86])))


def seen(surface):
    """The pixels (n,) that show a surface, away from its silhouette, and the feet (n, 3) of their rays."""
    at = surface.meet(np.zeros_like(RAYS), RAYS)
    return (np.abs(at.cosine) > 0.2) & (np.abs(at.foot[:, 1]) < 15.0), at


def taken(nominal, true, seed, sigma=0.1, share=1.0, cap_deg=90.0, blur=0.0, form=0.0):
    """Points (n, 3) of a part that differs from nominal, and the rays (m, 3) of all pixels that show it."""
    rng = np.random.default_rng(seed)
    shown, at = seen(true)
    shown &= seen(nominal)[0]
    noise = rng.standard_normal((GRID.height, GRID.width))
    if blur:
        noise = gaussian_filter(noise, blur)
        noise /= noise.std()
    bump = form * np.cos(2 * np.pi * at.foot[:, 0] / 20.0) * np.cos(2 * np.pi * at.foot[:, 1] / 30.0)
    points = at.foot + (sigma * noise.ravel() + bump)[:, None] * RAYS
    incidence = np.degrees(np.arccos(np.clip(-at.cosine, -1.0, 1.0)))
    kept = shown & (incidence < cap_deg) & (rng.random(len(RAYS)) < share)
    return points[kept], RAYS[shown]


def checked(nominal, points, rays):
    """The fit to the points that belong to the nominal surface; an error unless it is credible."""
    near = points[belonging(points, nominal, EYE)]
    fit = fit_surface(near, nominal, EYE)
    check_surface(fit, nominal, near, places_seen(nominal, rays, EYE, near), EYE)
    return fit


def inside(kind):
    """Places (n, 3) on the far wall of a bore, a socket or a countersink in a plate that is seen at 45 degrees."""
    angle, depth = (grid.ravel() for grid in np.meshgrid(np.radians(np.linspace(-40, 40, 25)), np.linspace(0, 5, 9)))
    radius = {"bore": 10.0, "socket": np.sqrt(12.0**2 - depth**2), "countersink": 10.0 - 0.5 * depth}[kind]
    places = np.column_stack([radius * np.sin(angle), radius * np.cos(angle), depth])  # the plate faces -z
    turn = np.array([[1, 0, 0], [0, 0.5**0.5, -(0.5**0.5)], [0, 0.5**0.5, 0.5**0.5]])
    about, axis = np.array([0.0, 0.0, 500.0]), turn @ [0.0, 0.0, 1.0]
    surfaces = {
        "bore": Cylinder(about, axis, 10.0),
        "socket": Sphere(about, 12.0),
        "countersink": Cone(about, -axis, 10.0, np.arctan(0.5)),
    }
    return surfaces[kind], places @ turn.T + about


@pytest.mark.parametrize("kind", ["bore", "socket", "countersink"])
def test_the_wall_of_a_bore_is_seen_from_inside(kind):
    """Before, a bore was compared with nominal on the wall nearer to the sensor, which it does not see."""
    nominal, places = inside(kind)
    rays = places / np.linalg.norm(places, axis=1, keepdims=True)
    noisy = places + 0.05 * np.random.default_rng(0).standard_normal((len(places), 1)) * rays
    np.testing.assert_allclose(places_seen(nominal, rays, EYE, noisy), places, rtol=0, atol=1e-6)
    checked(nominal, noisy, rays)


@pytest.mark.parametrize("nominal, true", [(BALL, SHIFTED_BALL), (BAR, TURNED_BAR), (FACE, TILTED_FACE)])
@pytest.mark.parametrize(
    "sigma, share, blur, form",
    [(0.02, 1.0, 0.0, 0.1), (0.1, 0.3, 2.5, 0.0), (0.3, 0.2, 0.0, 0.0), (0.3, 1.0, 2.5, 0.0)],
)
def test_healthy_fits_of_a_displaced_part_are_credible(nominal, true, sigma, share, blur, form):
    for seed in range(12):
        checked(nominal, *taken(nominal, true, seed, sigma, share, blur=blur, form=form))


def test_fewer_than_one_in_a_hundred_healthy_balls_is_refused():
    for seed in range(300):  # none of 300: below 1 % with 95 % confidence
        checked(BALL, *taken(BALL, SHIFTED_BALL, 100 + seed, 0.2, 0.4))


@pytest.mark.parametrize("sigma, blur", [(0.1, 0.0), (0.3, 0.0), (0.1, 2.5)])
def test_a_glint_on_a_ball_does_not_determine_it(sigma, blur):
    for seed in range(12):
        with pytest.raises(FitError):
            checked(BALL, *taken(BALL, SHIFTED_BALL, seed, sigma, cap_deg=12.0, blur=blur))


def test_a_strip_along_a_bar_does_not_determine_its_radius():
    points, rays = taken(BAR, TURNED_BAR, 1, 0.2, cap_deg=8.0)
    with pytest.raises(UndeterminedError, match="do not determine the cylinder"):
        checked(BAR, points, rays)


def test_a_sharp_glint_that_is_known_well_enough_is_credible():
    fit = checked(BALL, *taken(BALL, SHIFTED_BALL, 1, 0.01, cap_deg=30.0))
    assert abs(fit.radius - SHIFTED_BALL.radius) < 0.1


def test_a_cap_of_another_curvature_is_refused_where_it_would_leave_the_ball():
    _, rays = taken(BALL, BALL, 1)
    other = Sphere(np.array([0.0, 0.0, 508.0]), 20.0)  # touches the ball, and fits the cap within the gate
    points, _ = taken(BALL, other, 1, 0.01, cap_deg=25.0)
    with pytest.raises(FitError, match=r"lies up to .* mm from the nominal sphere"):
        checked(BALL, points, rays)
    full, _ = taken(BALL, Sphere(np.array([0.0, 0.0, 500.0]), 12.6), 1, 0.05)  # a part far out of tolerance
    assert checked(BALL, full, rays).radius == pytest.approx(12.6, abs=0.02)


def task_of_ball():
    return Task.model_validate(
        {
            "features": {"ball": {"kind": "sphere", "point_mm": [0, 0, 0], "radius_mm": 12}},
            "measurements": {"radius": {"kind": "radius", "features": ["ball"], "nominal": 12, "unit": "mm"}},
        }
    )


def cloud_of(cap_deg):
    shown, at = seen(BALL)
    incidence = np.degrees(np.arccos(np.clip(-at.cosine, -1.0, 1.0)))
    noise = 0.1 * np.random.default_rng(3).standard_normal(len(RAYS))
    valid = shown & (incidence < cap_deg)
    shape = (GRID.height, GRID.width)
    points = np.where(valid[:, None], at.foot + noise[:, None] * RAYS, np.nan).reshape(*shape, 3)
    status = np.where(valid, Status.VALID, Status.NO_SURFACE).astype(np.uint8).reshape(shape)
    label = np.where(shown, 0, -1).astype(np.int16).reshape(shape)
    return PointCloud(
        points.astype(np.float32), status, GRID, "sensor", "device", feature=label, feature_names=("ball",)
    )


def test_a_measurement_of_a_cap_has_a_reason_in_place_of_a_value():
    matrix = np.eye(4)
    matrix[2, 3] = 500.0
    whole = measure(cloud_of(90.0), task_of_ball(), matrix)["radius"]
    assert whole.possible and abs(whole.error) < 0.05
    cap = measure(cloud_of(12.0), task_of_ball(), matrix)["radius"]
    assert not cap.possible and cap.points_given >= 100 and "ball: the points do not determine the sphere" in cap.reason


def test_points_of_several_views_obey_the_same_rule():
    points, _ = taken(BALL, BALL, 5, 0.3, cap_deg=12.0)
    assert measure_points({"ball": taken(BALL, BALL, 5, 0.1)[0] - BALL.centre}, task_of_ball())["radius"].possible
    found = measure_points({"ball": points - BALL.centre}, task_of_ball())["radius"]
    assert not found.possible and "ball: the points do not determine the sphere" in found.reason
