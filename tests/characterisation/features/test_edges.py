"""Circles of holes and points of edges in organised clouds."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import maximum_filter, minimum_filter

from characterisation.features.edges import _straight_covariance, fit_circle, fit_edge_point
from characterisation.features.figures import Circle, EdgePoint, crossings, edge_covariance
from characterisation.features.fits import fit_plane
from characterisation.features.fitted import with_covariance
from characterisation.features.robust_fit import FitError
from characterisation.features.surfaces import Cylinder, Plane
from characterisation.features.vectors import tangents
from characterisation.point_cloud import PointCloud, Status, ViewGrid

FOCAL, DISTANCE = 600.0, 400.0
PITCH = DISTANCE / FOCAL
GRID = ViewGrid(FOCAL, FOCAL, 79.5, 59.5, 160, 120)


def normal_of(tilt_deg, turn_deg):
    tilt, turn = np.deg2rad([tilt_deg, turn_deg])
    return np.array([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), -np.cos(tilt)])


def plate(shown, centre, normal, rng, fraction=1.0, sigma=0.05, deep=15.0, grid=GRID):
    """Cloud of a plate through ``centre``; ``shown`` says which places (..., 2) along its tangents are the face.

    Elsewhere a parallel floor is seen. Points are lost at random, noise runs along the rays, and labels keep 3 px away
    from edges.
    """
    rays = grid.rays()

    def on(point):
        return rays * (point @ normal / (rays @ normal))[..., None]

    face = shown((on(centre) - centre) @ tangents(normal).T)
    points = np.where(face[..., None], on(centre), on(centre - deep * normal))
    points = points + rng.normal(0, sigma, face.shape)[..., None] * rays
    points[rng.random(face.shape) > fraction] = np.nan
    valid = np.isfinite(points[..., 2])
    clear = minimum_filter(face, 7) == maximum_filter(face, 7)
    label = np.where(clear & face, 0, -1).astype(np.int16)
    status = np.where(valid, Status.VALID, Status.NO_SURFACE).astype(np.uint8)
    return PointCloud(
        points.astype(np.float32), status, grid, "ideal", "simulated", feature=label, feature_names=("t",)
    )


def holed(radius, tilt_deg, rng, fraction=1.0, **more):
    """A plate with a hole at a random place within a pixel, turned at random; its true circle."""
    centre = np.array([*rng.uniform(-1, 1, 2), DISTANCE])
    normal = normal_of(tilt_deg, rng.uniform(0, 360))
    cloud = plate(lambda at: np.linalg.norm(at, axis=-1) > radius, centre, normal, rng, fraction, **more)
    return cloud, Circle(centre, normal, radius, normal)


def known_plane(truth, sigma=0.05):
    """The true plane as a fit: these tests are about the edge."""
    point = truth.centre if isinstance(truth, Circle) else truth.point
    return with_covariance(Plane(point, truth.normal), np.zeros((3, 3)), sigma, 1000)


def circle_error(fit, truth):
    return np.array([*tangents(fit.normal) @ (fit.centre - truth.centre), fit.radius - truth.radius])


@pytest.mark.parametrize("fraction, tilt_deg", [(1.0, 0), (1.0, 50), (0.8, 30)])
def test_a_hole_is_found_where_it_is_with_the_scatter_that_its_covariance_says(fraction, tilt_deg):
    radius, runs, errors, covariances, counts = 6.0, 60, [], [], []
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        cloud, truth = holed(radius, tilt_deg, rng, fraction)
        start = replace(truth, centre=truth.centre + rng.uniform(-1, 1, 3), radius=radius + rng.uniform(-1, 1))
        fit = fit_circle(cloud, known_plane(truth), start)
        errors.append(circle_error(fit, truth))
        covariances.append(fit.covariance)
        counts.append(fit.count)
    errors = np.array(errors)
    chi = np.mean([error @ np.linalg.solve(one, error) for error, one in zip(errors, covariances, strict=True)])
    assert abs(chi - 3) < 4 * np.sqrt(6 / runs)  # chi^2 with 3 degrees of freedom has variance 6
    # what is predicted from the pitch alone, a fourth root for the two directions of a tilted face
    pitch = PITCH / np.cos(np.deg2rad(tilt_deg)) ** 0.5
    expected = edge_covariance(truth, pitch, crossings(2 * np.pi * radius, pitch), fraction)
    assert np.mean(counts) == pytest.approx(crossings(2 * np.pi * radius, pitch), rel=0.15)
    ratio = np.sqrt(np.mean(errors**2, axis=0) / np.diag(expected))
    # the standard error of a standard deviation from 60 runs is 9 per cent; loss at random also loses F, in the radius
    assert (ratio > 1 - 4 * 0.09).all() and (ratio < (1 + 4 * 0.09) * (1.0 if fraction == 1 else 1.3)).all()
    # 60 runs leave the mean a standard error of 0.13 of one run's
    assert (np.abs(errors.mean(axis=0)) < 4 * np.sqrt(np.mean([np.diag(one) for one in covariances], 0) / runs)).all()


def test_the_plane_is_fitted_to_the_labelled_points_and_the_edge_to_those_without():
    cloud, truth = holed(8.0, 30, np.random.default_rng(1))
    plane = fit_plane(cloud.of_feature("t"), cloud.grid.origin)
    fit = fit_circle(cloud, plane, truth)
    assert np.abs(circle_error(fit, truth)).max() < 4 * np.sqrt(np.diag(fit.covariance).max())
    assert abs((fit.centre - plane.point) @ plane.normal) < 1e-9
    assert fit.normal @ plane.normal == pytest.approx(1.0)
    assert np.linalg.norm(np.cross(fit.ray, fit.centre)) < 1e-9  # seen from the origin


def test_a_bent_grid_shows_the_same_hole():
    """A lens's distortion is in the rays, so the hole must come out where it is."""
    columns, rows = np.meshgrid(np.arange(160), np.arange(120))
    x, y = (columns - 79.5) / FOCAL, (rows - 59.5) / FOCAL
    bent = 1 + 2.0 * (x**2 + y**2)
    grid = replace(GRID, normalised=np.stack([bent * x, bent * y], -1).astype(np.float32))
    cloud, truth = holed(8.0, 30, np.random.default_rng(2), grid=grid)
    fit = fit_circle(cloud, known_plane(truth), truth)
    assert np.abs(circle_error(fit, truth)).max() < 4 * np.sqrt(np.diag(fit.covariance).max())


def test_a_wall_that_is_seen_moves_its_side_of_the_edge_by_the_named_bias():
    """Of the rim half is shifted by m: on average m/pi of the radius, and m/2 of the centre."""
    radius, near, tilt_deg, errors = 10.0, 1.5, 50, []
    m = near * np.sin(np.deg2rad(tilt_deg))
    for seed in range(10):
        cloud, truth = holed(radius, tilt_deg, np.random.default_rng(seed), sigma=0.0, deep=30.0)
        rays = cloud.grid.rays()
        # where the rays that pass the rim meet the wall, the cylinder below it
        wall = Cylinder(truth.centre, truth.normal, radius)
        inside = np.linalg.norm(cloud.points - truth.centre, axis=-1) > 25  # the floor
        rows, columns = np.nonzero(inside)
        at = wall.meet(cloud.points[inside].astype(float), rays[inside])
        below = (at.foot - truth.centre) @ -truth.normal
        hit = (np.abs(at.cosine) > 0.05) & (below > 0) & (at.residual > 0) & (below < 30)
        points = cloud.points.copy()
        points[rows[hit], columns[hit]] = at.foot[hit]
        fit = fit_circle(replace(cloud, points=points), known_plane(truth, 0.0), truth, near=near)
        onward = rays[59, 79] - (rays[59, 79] @ truth.normal) * truth.normal
        errors.append([(fit.centre - truth.centre) @ onward / np.linalg.norm(onward), fit.radius - radius])
    # 0.1 px of scatter over 10 runs, and the rays' own spread of 2 deg in the incidence
    assert np.mean(errors, axis=0) == pytest.approx([-m / 2, -m / np.pi], abs=0.06)


@pytest.mark.parametrize("fraction", [1.0, 0.8])
def test_a_straight_edge_is_found_at_any_angle_to_the_pixels(fraction):
    runs, errors, variances = 60, [], []
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        centre, normal = np.array([*rng.uniform(-1, 1, 2), DISTANCE]), normal_of(30, rng.uniform(0, 360))
        turn = rng.uniform(0, 2 * np.pi)
        first, second = tangents(normal)
        direction = np.cos(turn) * first + np.sin(turn) * second
        lean = rng.uniform(-0.3, 0.3)  # the edge need not be at right angles to the line
        sideways = np.cross(normal, direction)

        def shown(at, first=first, second=second, direction=direction, sideways=sideways, lean=lean):
            places = at[..., :1] * first + at[..., 1:] * second
            return places @ direction < lean * (places @ sideways)

        cloud = plate(shown, centre, normal, rng, fraction)
        truth = EdgePoint(centre, direction, normal, lean, normal)
        start = EdgePoint(centre + rng.uniform(-1, 1) * direction, direction, normal, 0.0, normal)
        fit = fit_edge_point(cloud, known_plane(truth), start, 10.0)
        errors.append((fit.point - centre) @ direction)
        variances.append(fit.covariance[0, 0])
        assert np.abs(np.cross(fit.point - centre, direction)).max() < 0.05  # on the line, where its ray was seen
        assert abs(fit.slope - lean) < 0.1
    chi = np.mean(np.square(errors) / variances)
    # no more than said; less where the edge crosses the pixels so evenly that the errors cancel
    assert 0.4 < chi < 1 + 4 * np.sqrt(2 / runs)
    assert abs(np.mean(errors)) < 4 * np.sqrt(np.mean(variances) / runs)


def test_an_edge_along_a_row_of_pixels_is_no_surer_for_being_long():
    """All crossings err alike, within half a pixel: their scatter is 0, and their error is not."""
    errors, uncertainties = [], []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        centre, normal = np.array([rng.uniform(-PITCH, PITCH), 0.0, DISTANCE]), np.array([0.0, 0.0, -1.0])
        first = tangents(normal)[0]
        along = np.array([1.0, 0, 0])
        cloud = plate(lambda at, first=first: (at @ tangents([0, 0, -1.0]) @ [1.0, 0, 0]) < 0, centre, normal, rng)
        fit = fit_edge_point(
            cloud,
            known_plane(EdgePoint(centre, along, normal, 0, normal)),
            EdgePoint(centre, along, normal, 0.0, normal),
            10.0,
            near=1.0,
        )
        errors.append((fit.point - centre) @ along)
        uncertainties.append(np.sqrt(fit.covariance[0, 0]))
        assert fit.residual_std < 1e-5
    assert uncertainties == pytest.approx(np.full(40, PITCH / np.sqrt(12)), rel=1e-3)
    assert np.std(errors) == pytest.approx(PITCH / np.sqrt(12), rel=4 * 0.11)  # 1 / sqrt(2 * 40)


@pytest.mark.parametrize("turn_deg", [10, 20, 45])
def test_the_errors_of_a_straight_edge_scatter_as_its_angle_to_the_pixels_lets_them(turn_deg):
    """Aslant they nearly cancel; at 45 deg all rows and columns err alike, though no pixel edge runs along the edge."""
    runs, errors, variances = 80, [], []
    across = np.array([np.cos(np.deg2rad(turn_deg)), np.sin(np.deg2rad(turn_deg)), 0.0])
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        centre, normal = np.array([*rng.uniform(-1, 1, 2), DISTANCE]), np.array([0.0, 0.0, -1.0])
        cloud = plate(lambda at, normal=normal: at @ tangents(normal) @ across < 0, centre, normal, rng)
        truth = EdgePoint(centre, across, normal, 0.0, normal)
        fit = fit_edge_point(cloud, known_plane(truth), truth, 10.0)
        errors.append((fit.point - centre) @ across)
        variances.append(fit.covariance[0, 0])
    # the scatter of 80 errors is known to 8 per cent
    assert np.sqrt(np.mean(variances) / np.mean(np.square(errors))) == pytest.approx(1.0, abs=4 * 0.08)


@pytest.mark.parametrize("noise_px, turn_deg", [(0.0, 0), (0.2, 20), (0.4, 0), (0.4, 20)])
def test_noise_dithers_the_ends_of_pixels(noise_px, turn_deg):
    """Of crossings with 0.4 px of noise along a row u was 2.6 times the scatter; with 0.2 px at 20 deg, 0.65 of it."""
    rng, runs, columns = np.random.default_rng(7), 300, np.arange(30.0)
    jacobian, slope = np.column_stack([np.ones(30), columns - columns.mean()]), np.tan(np.deg2rad(turn_deg))
    errors, variances = [], []
    for _ in range(runs):
        edge = jacobian @ [rng.uniform(), slope]
        places = np.floor(edge + rng.normal(0, noise_px, 30)) + 0.5
        fit = np.linalg.lstsq(jacobian, places, rcond=None)[0]
        errors.append((fit - np.linalg.lstsq(jacobian, edge, rcond=None)[0])[0])
        variances.append(_straight_covariance(places - jacobian @ fit, jacobian, np.ones(30), 1.0)[0, 0])
    # the scatter of 300 errors is known to 4 per cent
    assert np.sqrt(np.mean(variances) / np.mean(np.square(errors))) == pytest.approx(1.0, abs=4 * 0.04)


def test_edge_covariances_are_closed_forms():
    z = np.array([0.0, 0, 1])
    circle = Circle(np.zeros(3), z, 5.0, z)
    # F = 1: 5/6 of pitch^2 / 12 for a crossing
    assert np.diag(edge_covariance(circle, 0.6, 50)) == pytest.approx(0.36 * 5 / 72 / 50 * np.array([2, 2, 1]))
    edge = EdgePoint(np.zeros(3), np.eye(3)[0], z, 0.0, z)
    assert np.diag(edge_covariance(edge, 0.6, 50, 0.5, reach=3.0)) == pytest.approx(
        5 / 6 * 0.36 * (1 / 12 + 2) / 50 * np.array([1, 1 / 3])
    )
    assert crossings(10.0, 0.5) == pytest.approx(20 * 0.9003, rel=1e-3)
    with pytest.raises(ValueError, match="reach"):
        edge_covariance(edge, 0.6, 50)


def test_a_figure_slides_along_its_ray_when_its_plane_moves():
    z = np.array([0.0, 0, 1])
    ray = np.array([0.6, 0, -0.8])
    up = Plane(np.array([0.0, 0, 1]), z)
    circle = Circle(np.array([3.0, 4, 0]), z, 5.0, ray).on_moved_plane(up)
    assert circle.centre == pytest.approx([3 - 0.75, 4, 1])
    edge = EdgePoint(np.array([3.0, 4, 0]), np.eye(3)[0], z, 0.1, ray)
    assert edge.on_moved_plane(up).point == pytest.approx([2.25, 4, 1])
    leaning = edge.on_moved_plane(Plane(np.zeros(3), -np.array([0.6, 0, 0.8])))
    assert leaning.direction == pytest.approx([0.8, 0, -0.6])
    assert leaning.normal == pytest.approx([0.6, 0, 0.8])  # toward the side it faced before


@pytest.mark.parametrize(
    "case, said",
    [
        ("none", "crossings of the edge"),
        ("outside", "crossings of the edge"),
        ("small", "crossings of the edge"),
        ("sparse", "crossings|% of the points"),
        ("larger", "leads away|crossings|do not determine"),
    ],
)
def test_an_edge_that_is_not_there_is_refused(case, said):
    rng = np.random.default_rng(4)
    radius = {"none": 0.0, "small": 0.8, "larger": 12.0}.get(case, 6.0)
    cloud, truth = holed(radius, 20, rng, 0.1 if case == "sparse" else 1.0)
    nominal = replace(truth, radius=0.8 if case == "small" else 6.0)
    if case == "outside":
        nominal = replace(nominal, centre=nominal.centre + np.array([500.0, 0, 0]))
    with pytest.raises(FitError, match=said):
        fit_circle(cloud, known_plane(truth), nominal)


def test_the_edge_of_a_cover_is_not_the_edge_of_the_hole():
    rng, errors = np.random.default_rng(1), []
    for turn in rng.uniform(0, 2 * np.pi, 40):
        cloud, truth = holed(10.0, 30.0, rng)
        rays, away = cloud.grid.rays(), np.array([np.cos(turn), np.sin(turn)])
        across, cover = (
            rays * (point @ truth.normal / (rays @ truth.normal))[..., None]
            for point in (truth.centre, truth.centre + 40.0 * truth.normal)
        )
        hidden = (across - truth.centre) @ tangents(truth.normal).T @ away > -5.0  # four fifths of the hole
        points = np.where(hidden[..., None], cover, cloud.points).astype(np.float32)
        covered = replace(cloud, points=points, feature=np.where(hidden, -1, cloud.feature).astype(np.int16))
        fit = fit_circle(covered, known_plane(truth), truth)
        off = tangents(truth.normal) @ (fit.centre - truth.centre)
        errors.append(off @ np.linalg.inv(fit.covariance[:2, :2]) @ off)
    assert np.mean(errors) == pytest.approx(2.0, abs=3 * np.sqrt(4 / 40))  # chi-square of two degrees of freedom
