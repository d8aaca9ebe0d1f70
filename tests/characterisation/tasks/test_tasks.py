import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from characterisation.features.fits import fit_surface
from characterisation.features.fitted import CylinderFit, PlaneFit
from characterisation.features.surfaces import Cylinder, Plane
from characterisation.files.errors import InputError
from characterisation.point_cloud import PointCloud, Status, ViewGrid
from characterisation.tasks import evaluation
from characterisation.tasks.definitions import (
    axis_angle,
    axis_distance,
    intersection_distance,
    plane_axis_angle,
    radius,
)
from characterisation.tasks.evaluation import measure
from characterisation.tasks.measurement_model import evaluate
from characterisation.tasks.task_file import Feature
from characterisation.tasks.task_reading import check_features, check_nominal_values, read_task
from mitsim.sensor.transforms import Transform
from mitsim.study import task_measurement

TASK = Path(__file__).parents[3] / "scenes" / "two_pillars" / "task.toml"
Z = np.array([0.0, 0.0, 1.0])


def pose(tilt_deg, spin_deg=0.0, distance=500.0):
    """sensor_from_part (4, 4) of a sensor that looks down on the part, tilted from its normal."""
    tilt, spin = np.deg2rad([tilt_deg, spin_deg])
    about_z = np.array([[np.cos(spin), -np.sin(spin), 0], [np.sin(spin), np.cos(spin), 0], [0, 0, 1]])
    about_x = np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
    matrix = np.eye(4)
    matrix[:3, :3] = np.diag([1.0, -1.0, -1.0]) @ about_x @ about_z  # the part's +z faces the sensor
    matrix[:3, 3] = [0.0, 0.0, distance]
    return matrix


def part_cloud(sensor_from_part, sigma=0.0, seed=0):
    """Ray-cast the plane and the sides of the two pillars; noise along the rays."""
    grid = ViewGrid(400.0, 400.0, 119.5, 89.5, 240, 180)
    part_from_sensor = np.linalg.inv(sensor_from_part)
    rays = grid.rays() @ part_from_sensor[:3, :3].T
    eye = part_from_sensor[:3, 3]
    label = np.full(rays.shape[:2], -1, np.int16)
    with np.errstate(divide="ignore", invalid="ignore"):
        nearest = -eye[2] / rays[..., 2]
        hit = eye + nearest[..., None] * rays
        nearest[~((nearest > 0) & (np.abs(hit[..., :2]) < [90, 60]).all(axis=-1))] = np.inf
        label[np.isfinite(nearest)] = 0
        for index, x in ((1, -35.0), (2, 35.0)):
            q, v = eye[:2] - [x, 0.0], rays[..., :2]
            a, b, c = (v**2).sum(axis=-1), v @ q, q @ q - 400.0
            reach = (-b - np.sqrt(b**2 - a * c)) / a
            height = eye[2] + reach * rays[..., 2]
            to_top = (60.0 - eye[2]) / rays[..., 2]
            on_top = (((q + to_top[..., None] * v) ** 2).sum(axis=-1) < 400.0) & (to_top > 0)
            on_side = (reach > 0) & (height > 0) & (height < 60)
            for mask, at, name in ((on_top, to_top, -1), (on_side, reach, index)):
                front = mask & (at < nearest)
                nearest[front], label[front] = at[front], name
    seen = label >= 0
    nearest = nearest + np.random.default_rng(seed).normal(0, sigma, nearest.shape)
    points = np.where(seen[..., None], nearest[..., None] * grid.rays(), np.nan).astype(np.float32)
    status = np.where(seen, Status.VALID, Status.NO_SURFACE).astype(np.uint8)
    return PointCloud(
        points, status, grid, "ideal", "simulated", feature=label, feature_names=("plane", "pillar1", "pillar2")
    )


def test_the_talks_seven_measurements():
    task = read_task(TASK)
    assert {name: (m.nominal, m.unit) for name, m in task.measurements.items()} == {
        "point1_point2_distance": (70.0, "mm"),
        "plane_pillar1_angle": (0.0, "deg"),
        "plane_pillar2_angle": (0.0, "deg"),
        "pillar1_pillar2_angle": (0.0, "deg"),
        "pillar1_pillar2_distance": (70.0, "mm"),
        "pillar1_radius": (20.0, "mm"),
        "pillar2_radius": (20.0, "mm"),
    }


@pytest.mark.parametrize("tilt, spin", [(35, 0), (50, 30), (60, 75)])
def test_an_ideal_sensor_measures_the_nominal_values(tilt, spin):
    matrix = pose(tilt, spin)
    measured = measure(part_cloud(matrix), read_task(TASK), matrix, minimum_points=30)
    assert all(m.possible and m.reason == "" for m in measured.values())
    for name, outcome in measured.items():  # the cloud is float32: points are rounded by up to 3e-5 mm
        assert abs(outcome.error) < 1e-3, name
        assert outcome.uncertainty < 1e-3


def test_each_feature_is_fitted_once_for_all_measurements_and_their_counts(monkeypatch):
    fitted, matrix = [], pose(50, 20)
    cloud, task = part_cloud(matrix), read_task(TASK)

    def counted(points, surface, viewpoint):
        fitted.append(len(points))
        return fit_surface(points, surface, viewpoint)

    monkeypatch.setattr(evaluation, "fit_surface", counted)
    pose_of_part = Transform.from_matrix(np.linalg.inv(matrix))
    results = task_measurement.measure(cloud, task, pose_of_part)
    assert len(fitted) == len(task.shapes)
    seen = {name: int((cloud.feature == k).sum()) for k, name in enumerate(cloud.feature_names)}
    radius = results["pillar1_radius"]
    assert 0 < radius.points <= radius.points_given == seen["pillar1"] and radius.origin == "fit"
    apart = results["point1_point2_distance"]
    assert apart.points_given == sum(seen.values()) and apart.points > results["pillar1_pillar2_distance"].points


def test_features_without_a_measurement_are_not_fitted(monkeypatch):
    """A drawing has a hundred faces and a dozen dimensions."""
    fitted, matrix = [], pose(50, 20)
    task = read_task(TASK)
    radius = task.model_copy(update={"measurements": {"pillar1_radius": task.measurements["pillar1_radius"]}})
    cloud = part_cloud(matrix)
    labels = ("a face of the scene", "pillar1", "another face")
    without = PointCloud(cloud.points, cloud.status, cloud.grid, "", "", feature=cloud.feature, feature_names=labels)

    def counted(points, surface, viewpoint):
        fitted.append(surface.kind)
        return fit_surface(points, surface, viewpoint)

    monkeypatch.setattr(evaluation, "fit_surface", counted)
    assert radius.with_measured_features().shapes == ("pillar1",)
    results = measure(without, radius, matrix)
    assert fitted == ["cylinder"] and list(results) == ["pillar1_radius"]
    assert results["pillar1_radius"].value == measure(cloud, task, matrix)["pillar1_radius"].value


def test_the_standard_uncertainty_is_the_scatter_of_repeated_measurements():
    task, matrix, runs = read_task(TASK), pose(50, 20), 30
    outcomes = [measure(part_cloud(matrix, 0.2, seed), task, matrix) for seed in range(runs)]
    for name, measurement in task.measurements.items():
        error = np.array([outcome[name].error for outcome in outcomes])
        uncertainty = np.array([outcome[name].uncertainty for outcome in outcomes])
        chi = np.mean((error / uncertainty) ** 2)
        if measurement.unit == "mm":
            assert abs(chi - 1.0) < 4 * np.sqrt(2.0 / runs), name
        else:  # an angle of 0 is measured as the length of a vector of 2 components, each of variance 1 (see evaluate)
            assert abs(chi - 2.0) < 4 * np.sqrt(4.0 / runs), name


def test_a_feature_that_is_hardly_seen_makes_its_measurements_impossible():
    matrix = pose(50, 20)
    cloud = part_cloud(matrix)
    points = cloud.points.copy()
    rows, columns = np.nonzero(cloud.feature == 1)
    points[rows[3:], columns[3:]] = np.nan
    hidden = PointCloud(
        points, cloud.status, cloud.grid, "ideal", "simulated", feature=cloud.feature, feature_names=cloud.feature_names
    )
    measured = measure(hidden, read_task(TASK), matrix)
    possible = {name for name, outcome in measured.items() if outcome.possible}
    assert possible == {"plane_pillar2_angle", "pillar2_radius"}
    outcome = measured["pillar1_radius"]
    assert np.isnan([outcome.value, outcome.error, outcome.uncertainty]).all()
    assert outcome.reason == "pillar1: 3 points, at least 100 are required"
    assert "needs at least 6" in measure(hidden, read_task(TASK), matrix, minimum_points=0)["pillar1_radius"].reason


@pytest.mark.parametrize("true, possible", [(0.5, True), (0.3, True), (0.2, False), (0.0, False)])
def test_a_surface_most_of_whose_points_are_false_is_not_measured(true, possible):
    """The others lie in one sheet, 3 % of the way before the pillar: more points than the pillar has of its own."""
    matrix, rng = pose(50, 20), np.random.default_rng(7)
    cloud = part_cloud(matrix, 0.02)
    points = cloud.points.copy()
    false = (cloud.feature == 1) & (rng.random(cloud.feature.shape) >= true)
    points[false] *= 0.97
    outcome = measure(replace(cloud, points=points), read_task(TASK), matrix)["pillar1_radius"]
    assert outcome.possible == possible
    if possible:
        assert abs(outcome.error) < 4 * outcome.uncertainty
    elif true:
        assert re.fullmatch(
            r"pillar1: only (19|20|21) % of \d+ points lie near the nominal surface, at least 25 % are required",
            outcome.reason,
        )
    else:
        assert outcome.reason == "pillar1: 0 points, at least 100 are required"


def test_a_cloud_without_the_feature_is_refused():
    cloud = part_cloud(pose(50))
    renamed = PointCloud(
        cloud.points,
        cloud.status,
        cloud.grid,
        "ideal",
        "simulated",
        feature=cloud.feature,
        feature_names=("plane", "pillar_1", "pillar2"),
    )
    with pytest.raises(InputError, match=r"features\.pillar1.*did you mean 'pillar_1'"):
        measure(renamed, read_task(TASK), pose(50))


def test_measurements_of_exact_geometry():
    plane = Plane(np.array([3.0, 1.0, 5.0]), Z)
    tilted = np.array([np.sin(0.01), 0.0, np.cos(0.01)])
    first, second = Cylinder(np.array([0.0, 0, 35]), Z, 20.0), Cylinder(np.array([70.0, 0, 35]), tilted, 21.0)
    assert intersection_distance(plane, first, second) == pytest.approx(70 - 30 * np.tan(0.01))
    assert plane_axis_angle(plane, second) == pytest.approx(0.01, rel=1e-12)
    assert axis_angle(first, Cylinder(second.point, -tilted, 1.0)) == pytest.approx(0.01, rel=1e-12)
    assert radius(second) == 21.0
    # both axes make 0.005 rad with their mean, through whose middle the measuring plane goes
    assert axis_distance(first, second) == pytest.approx(70 * np.cos(0.005) + 0.0, abs=1e-3)
    reversed_axis = Cylinder(second.point, -tilted, 1.0)
    assert axis_distance(first, reversed_axis) == pytest.approx(axis_distance(first, second), rel=1e-12)
    lying = Cylinder(np.zeros(3), np.array([1.0, 0, 0]), 1.0)
    assert np.isnan(intersection_distance(plane, lying, second))


def test_the_axis_distance_does_not_run_away_where_the_skew_line_distance_does():
    """Two axes that cross when prolonged: the lines are 0 mm apart there, the pillars stay 70 mm apart."""
    lean = np.array([np.sin(0.001), 0.0, np.cos(0.001)])
    first, second = Cylinder(np.zeros(3), lean, 20.0), Cylinder(np.array([70.0, 0, 0]), Z, 20.0)
    assert axis_distance(first, second) == pytest.approx(70.0, abs=1e-3)


def fitted(kind, tilt, sigma):
    """A fit whose axis is tilted by ``tilt`` and whose tilts have standard deviation ``sigma``."""
    direction = np.array([np.sin(tilt), 0.0, np.cos(tilt)])
    if kind == "plane":
        return PlaneFit(np.zeros(3), direction, np.diag([0.0, sigma**2, sigma**2]), 0.1, 100)
    return CylinderFit(np.zeros(3), direction, 20.0, np.diag([0.0, 0.0, sigma**2, sigma**2, 0.0]), 0.1, 100)


def test_uncertainty_of_an_angle_far_from_zero_and_at_zero():
    value, uncertainty = evaluate(plane_axis_angle, [fitted("plane", 0.0, 3e-4), fitted("cylinder", 0.1, 4e-4)])
    assert (value, uncertainty) == (pytest.approx(0.1), pytest.approx(5e-4, rel=1e-3))
    value, uncertainty = evaluate(plane_axis_angle, [fitted("plane", 0.0, 3e-4), fitted("cylinder", 0.0, 4e-4)])
    assert value == 0.0
    assert uncertainty == pytest.approx(5e-4 * np.sqrt(2), rel=1e-6)  # the root mean square of two tilts


def test_uncertainty_of_a_radius_is_that_of_the_fit():
    fit = CylinderFit(np.zeros(3), Z, 20.0, np.diag([0.0, 0.0, 0.0, 0.0, 0.04]), 0.1, 100)
    assert evaluate(radius, [fit]) == (20.0, pytest.approx(0.2))


GOOD = TASK.read_text(encoding="utf-8")


def changed(tmp_path, old, new):
    assert old in GOOD
    path = tmp_path / "task.toml"
    path.write_text(GOOD.replace(old, new, 1), encoding="utf-8")
    return path


@pytest.mark.parametrize(
    "old, new, field, said",
    [
        (
            '"pillar1", "pillar2"]',
            '"pilar1", "pillar2"]',
            "measurements.point1_point2_distance.features",
            "did you mean 'pillar1'",
        ),
        (
            '["plane", "pillar1", "pillar2"]',
            '["plane", "pillar1"]',
            "measurements.point1_point2_distance.features",
            "[plane, cylinder or cone, cylinder or cone]",
        ),
        (
            '["plane", "pillar1", "pillar2"]',
            '["pillar1", "plane", "pillar2"]',
            "measurements.point1_point2_distance.features",
            "pillar1 (cylinder), plane (plane)",
        ),
        ('["plane", "pillar1", "pillar2"]', "[]", "measurements.point1_point2_distance.features", "none"),
        (
            '["plane", "pillar1", "pillar2"]',
            '["plane", "pillar1", "pillar1"]',
            "measurements.point1_point2_distance.features",
            "different features",
        ),
        ("radius_mm = 20.0\n", "", "features.pillar1.radius_mm", "required"),
        ("radius_mm = 20.0", "radius_mm = 0.0", "features.pillar1.radius_mm", "greater than 0"),
        ("radius_mm = 20.0", "radius_mm = -3", "features.pillar1.radius_mm", "greater than 0"),
        ("radius_mm = 20.0", "radius = 20.0", "features.pillar1.radius", "did you mean 'radius_mm'"),
        ("direction = [0.0, 0.0, 1.0]", "direction = [0, 0, 0]", "features.plane.direction", "not all 0"),
        ("direction = [0.0, 0.0, 1.0]", "", "features.plane.direction", "required"),
        (
            "direction = [0.0, 0.0, 1.0]",
            "direction = [0.0, 0.0, 1.0]\nradius_mm = 3",
            "features.plane.radius_mm",
            "no such key for a plane",
        ),
        ("direction = [0.0, 0.0, 1.0]", "direction = [nan, 0.0, 1.0]", "features.plane.direction.0", "finite"),
        ('kind = "plane"', 'kind = "disk"', "features.plane.kind", "'plane', 'cylinder', 'sphere', 'cone'"),
        ('kind = "radius"', 'kind = "roundness"', "measurements.pillar1_radius.kind", "'axis_distance'"),
        ('unit = "mm"', 'unit = "deg"', "measurements.point1_point2_distance.unit", "'mm'"),
        ("nominal = 70.0", "nominal = -70.0", "measurements.point1_point2_distance.nominal", "greater than"),
        ("nominal = 70.0", "nominal = 70.0\ntolerance = 0", "measurements.point1_point2_distance.tolerance", "greater"),
        (
            "nominal = 70.0",
            'nominal = 70.0\ntolerance = "±0.3"',
            "measurements.point1_point2_distance.tolerance",
            "±0.1 is 0.1",
        ),
        (
            "nominal = 70.0",
            'nominal = 70.0\ntolerance = "H7"',
            "measurements.point1_point2_distance.tolerance",
            "H7 is its two deviations",
        ),
        (
            "nominal = 70.0",
            "nominal = 70.0\ntolerance = [69.9, 70.2]",
            "measurements.point1_point2_distance.tolerance",
            "as the limits of the value, they are [-0.1, 0.2]",
        ),
        (
            "nominal = 70.0",
            "nominal = 70.0\ntolerance = [70.01, 70.03]",
            "measurements.point1_point2_distance.tolerance",
            "as the limits of the value, they are [0.01, 0.03]",
        ),
        ("nominal = 70.0", "nominale = 70.0", "measurements.point1_point2_distance.nominale", "did you mean 'nominal'"),
    ],
)
def test_faults_are_told_with_file_and_field(tmp_path, old, new, field, said):
    path = changed(tmp_path, old, new)
    with pytest.raises(InputError) as caught:
        read_task(path)
    assert caught.value.where == str(path)
    assert caught.value.field == field
    assert said in str(caught.value)


@pytest.mark.parametrize("text", ["", "[features]\n[measurements]\n"])
def test_an_empty_task_is_refused(tmp_path, text):
    path = tmp_path / "task.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match="features"):
        read_task(path)


@pytest.mark.parametrize(
    "old, new, said",
    [
        ("nominal = 70.0", "nominal = 35.0\ntolerance = 1", "found 35; allowed: 70 mm, from the geometry of plane, "),
        ("nominal = 70.0", "nominal = 70.1\ntolerance = [-0.3, 0]", r"nominal = 70, tolerance = \[-0.2, 0.1\]"),
        ("nominal = 70.0", "nominal = 70.006", "errors are counted from the model"),
        ('kind = "radius"', 'kind = "diameter"', "measurements.pillar1_radius.nominal: found 20; allowed: 40 mm"),
    ],
)
def test_a_nominal_value_is_that_of_the_geometry_from_which_simulated_errors_are_counted(tmp_path, old, new, said):
    path = changed(tmp_path, old, new)
    with pytest.raises(InputError, match=said):
        check_nominal_values(read_task(path), path)


def test_a_nominal_value_that_the_geometry_does_not_have_is_refused_in_words(tmp_path):
    """Pillars that lie along the plane do not meet it: the allowed value was nan."""
    path = tmp_path / "task.toml"
    path.write_text(GOOD.replace("[0.0, 0.0, 1.0]\nradius", "[1.0, 0.0, 0.0]\nradius"), encoding="utf-8")
    with pytest.raises(InputError, match=r"that of plane, pillar1, pillar2 has none\. correct their directions"):
        check_nominal_values(read_task(path), path)


def test_a_zone_of_features_that_do_not_have_its_place_in_the_model_is_refused(tmp_path):
    path = tmp_path / "task.toml"
    outlined = GOOD.replace("[features.plane]", "[features.plane]\noutline_mm = [[0, 0, 0], [50, 0, 0], [0, 50, 0]]")
    zone = '[measurements.flat]\nkind = "parallelism"\nfeatures = ["plane", "pillar1"]\nnominal = 0\nunit = "mm"\n'
    path.write_text(f"{outlined}\n{zone}", encoding="utf-8")
    with pytest.raises(InputError, match=r"found 0; allowed: features whose parallelism is 0 in the model"):
        check_nominal_values(read_task(path), path)


def test_nominal_values_within_the_rounding_of_a_file_pass(tmp_path):
    path = changed(tmp_path, "nominal = 70.0", "nominal = 70.004")
    check_nominal_values(read_task(path), path)


def test_features_must_be_shapes_of_the_scene():
    task = read_task(TASK)
    check_features(task, TASK, ["table", "plane", "pillar1", "pillar2"])
    with pytest.raises(InputError) as caught:
        check_features(task, TASK, ["plane", "pillar_1", "pillar2"])
    assert caught.value.field == "features.pillar1"
    assert "plane, pillar_1, pillar2" in str(caught.value)
    assert "did you mean 'pillar_1'?" in str(caught.value)


@settings(max_examples=50)
@given(st.tuples(*[st.floats(-1e3, 1e3)] * 3).filter(lambda v: np.linalg.norm(v) > 1e-6))
def test_directions_come_out_as_unit_vectors(direction):
    feature = Feature(kind="plane", point_mm=(0, 0, 0), direction=direction)
    assert np.linalg.norm(feature.direction) == pytest.approx(1.0, rel=1e-12)
    assert np.dot(feature.direction, direction) == pytest.approx(np.linalg.norm(direction), rel=1e-9)


def test_nominal_geometry_moves_with_the_part():
    feature = Feature(kind="cylinder", point_mm=(-35, 0, 0), direction=(0, 0, 2), radius_mm=20)
    matrix = pose(0, 90)
    cylinder = feature.nominal(matrix)
    assert np.allclose(cylinder.point, [0.0, 35.0, 500.0])
    assert np.allclose(cylinder.axis, [0.0, 0.0, -1.0])
    sphere = Feature(kind="sphere", point_mm=(1, 2, 3), radius_mm=4).nominal()
    assert (list(sphere.centre), sphere.radius) == ([1.0, 2.0, 3.0], 4.0)
