"""What is measured: closed forms of every kind, joint propagation, and a part measured from its cloud."""

import tomllib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import maximum_filter, minimum_filter
from scipy.spatial.transform import Rotation

from characterisation.features.figures import Circle, EdgePoint, Point
from characterisation.features.fits import fit_plane
from characterisation.features.fitted import with_covariance
from characterisation.features.pose_fit import Pose
from characterisation.features.surfaces import Cylinder, Plane, Sphere
from characterisation.features.vectors import tangents
from characterisation.files.documents import validate
from characterisation.point_cloud import PointCloud, Status, ViewGrid
from characterisation.tasks.definitions import (
    DEFINITIONS,
    diameter,
    plane_angle,
    plane_distance,
    point_distance,
    point_plane_distance,
    pose_position,
    pose_rotation,
)
from characterisation.tasks.evaluation import measure
from characterisation.tasks.measurement_model import evaluate, measurement_model
from characterisation.tasks.places import intersection
from characterisation.tasks.task_file import Task
from characterisation.tasks.zones import datum_motion, least_width, parallelism, perpendicularity, position

X, Y, Z = np.eye(3)
ORIGIN = np.zeros(3)


def lean(angle, toward=X):
    """A unit vector that leans from z by a small angle."""
    return np.cos(angle) * Z + np.sin(angle) * toward


def moved(euler_deg=(40, -70, 110), shift=(100.0, -50, 30)):
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("xyz", euler_deg, degrees=True).as_matrix()
    matrix[:3, 3] = shift
    return matrix


def test_distances_of_points_and_planes():
    ball, spot = Sphere(np.array([1.0, 2, 3]), 4.0), Point(np.array([1.0, 2, 15]))
    edge = EdgePoint(np.array([1.0, 5, 7]), X, Z, 0.0, Z)
    assert point_distance(ball, spot) == 12
    assert point_distance(edge, ball) == 5
    assert point_plane_distance(ball, Plane(np.array([9.0, 9, 5]), Z)) == 2
    assert diameter(ball) == 8
    # planes that lean by 0.1 rad toward one another are 10 mm apart over the origin, and more where they open
    low, high = Plane(ORIGIN, -lean(0.05)), Plane(10 * Z, lean(-0.05))
    assert plane_distance(low, high, nominal=[Plane(ORIGIN, Z), Plane(10 * Z, Z)]) == pytest.approx(10)
    aside = [Plane(20 * X, Z), Plane(20 * X + 10 * Z, Z)]
    assert plane_distance(low, high, nominal=aside) == pytest.approx(10 + 40 * np.tan(0.05))
    assert plane_angle(low, high) == pytest.approx(0.1)
    assert plane_angle(Plane(ORIGIN, X), Plane(ORIGIN, lean(np.deg2rad(120)))) == pytest.approx(np.deg2rad(30))


def test_intersections_of_exact_geometry():
    axis = Cylinder(np.array([3.0, 4, 50]), Z, 2.0)
    assert intersection([axis, Plane(7 * Z, lean(0.1))]).place == pytest.approx([3, 4, 7 - 3 * np.tan(0.1)])
    corner = intersection([Plane(1 * X, X), Plane(2 * Y, -Y), Plane(3 * Z, Z)]).place
    assert corner == pytest.approx([1, 2, 3])
    skew = Cylinder(np.array([100.0, 6, 20]), X, 2.0)
    assert intersection([axis, skew]).place == pytest.approx([3, 5, 20])  # the middle of the common perpendicular
    for parallel in (
        [axis, Plane(ORIGIN, X)],
        [axis, Cylinder(ORIGIN, lean(1e-5), 1.0)],
        [Plane(ORIGIN, X), Plane(X, X), Plane(ORIGIN, Z)],
    ):
        assert np.isnan(intersection(parallel).place).all()
    with pytest.raises(ValueError, match="no point follows from plane and plane"):
        intersection([Plane(ORIGIN, X), Plane(ORIGIN, Y)])


FACE = np.array([[-40.0, -30, 0], [40, -30, 0], [40, 30, 0], [-40, 30, 0]])
POST = np.array([[0.0, 0, 0], [0, 0, 60.0]])


def test_orientation_zones_are_extent_times_lean():
    lay, stand = Plane(ORIGIN, lean(0.01)), Cylinder(ORIGIN, lean(0.01), 5.0)
    flat, upright = Plane(ORIGIN, Z), Cylinder(np.array([90.0, 0, 0]), Z, 5.0)
    assert parallelism(lay, flat, outline=FACE) == pytest.approx(80 * np.tan(0.01), rel=1e-4)
    assert parallelism(Plane(ORIGIN, lean(0.01, Y)), flat, outline=FACE) == pytest.approx(60 * np.tan(0.01), rel=1e-4)
    assert parallelism(stand, upright, outline=POST) == pytest.approx(60 * np.sin(0.01), rel=1e-4)
    along = Cylinder(ORIGIN, X, 5.0)
    # an axis that leans 0.01 out of a plane, and a face that leans 0.01 out of an axis
    assert parallelism(along, Plane(ORIGIN, lean(0.01)), outline=60 * np.outer([0, 1], X)) == pytest.approx(
        60 * np.sin(0.01), rel=1e-4
    )
    assert parallelism(lay, along, outline=FACE) == pytest.approx(80 * np.sin(0.01), rel=1e-4)
    assert perpendicularity(stand, flat, outline=POST) == pytest.approx(60 * np.sin(0.01), rel=1e-4)
    assert perpendicularity(lay, upright, outline=FACE) == pytest.approx(80 * np.sin(0.01), rel=1e-4)
    assert perpendicularity(stand, along, outline=POST) == pytest.approx(60 * np.sin(0.01), rel=1e-4)
    wall = np.array([[0.0, -30, 0], [0, 30, 0], [0, 30, 50], [0, -30, 50]])
    leaning = Plane(ORIGIN, np.cos(0.01) * X + np.sin(0.01) * Z)
    assert perpendicularity(leaning, flat, outline=wall) == pytest.approx(50 * np.sin(0.01), rel=1e-3)
    # turned about the datum's normal it is still at right angles
    assert perpendicularity(Plane(ORIGIN, np.cos(0.01) * X + np.sin(0.01) * Y), flat, outline=wall) < 1e-12


def test_the_least_width_of_a_square_and_of_places_on_a_line():
    square = np.array([[0.0, 0, 0], [3, 4, 0], [-1, 7, 0], [-4, 3, 0]])
    assert least_width(square, Z) == pytest.approx(5)
    assert least_width(np.outer([0, 1, 5], [3.0, 4, 0]), Z) == pytest.approx(0, abs=1e-12)
    rng = np.random.default_rng(1)
    places = np.column_stack([rng.normal(size=(12, 2)), np.zeros(12)])
    angles = np.linspace(0, np.pi, 20001)
    swept = np.ptp(places[:, :2] @ np.stack([np.cos(angles), np.sin(angles)]), axis=0).min()
    # a sweep in steps of 0.16 mrad finds the least width but for that times the extent
    assert least_width(places, Z) == pytest.approx(swept, abs=1e-3)


def test_position_is_twice_the_offset_in_the_zone_of_the_feature():
    none, nowhere = np.empty((0, 3)), ORIGIN
    ball = Sphere(np.array([0.3, 0.4, 1.2]), 5.0)
    assert position(ball, nominal=[Sphere(nowhere, 5.0)], outline=none) == pytest.approx(2 * 1.3)
    hole = Circle(np.array([0.3, 0.4, 1.2]), Z, 5.0, Z)
    assert position(hole, nominal=[Circle(nowhere, Z, 5.0, Z)], outline=none) == pytest.approx(2 * 0.5)
    edge = EdgePoint(np.array([0.3, 0.4, 1.2]), X, Z, 0.0, Z)
    assert position(edge, nominal=[EdgePoint(nowhere, X, Z, 0.0, Z)], outline=none) == pytest.approx(2 * 0.3)
    pin = Cylinder(0.1 * X, lean(0.01), 5.0)  # 0.1 mm off at the foot, 0.7 mm at the top
    assert position(pin, nominal=[Cylinder(nowhere, Z, 5.0)], outline=POST) == pytest.approx(
        2 * (0.1 + 60 * np.tan(0.01))
    )


def test_with_datums_an_error_of_the_pose_does_not_count():
    """The part lies elsewhere than its pose says; the hole is where it should be on the part."""
    error = moved((0.5, -0.3, 0.4), (1.0, 2, -1))
    planes = [Plane(ORIGIN, Z), Plane(-40 * X, -X), Plane(-30 * Y, -Y)]
    hole = Circle(np.array([10.0, 20, 0]), Z, 4.0, Z)
    measured = [one.placed(error) for one in (hole, *planes)]
    measured[1] = Plane(measured[1].point, -measured[1].normal)  # fitted normals face the sensor
    none = np.empty((0, 3))
    assert position(measured[0], nominal=[hole], outline=none) > 2
    assert position(*measured, nominal=[hole, *planes], outline=none) < 1e-9
    assert datum_motion(measured[1:], planes) == pytest.approx(error, abs=1e-9)
    # the primary datum holds fast where the others are not at right angles to it
    skew = [planes[0], Plane(-40 * X, -lean(np.pi / 2 - 0.01)), planes[2]]
    assert datum_motion(skew, planes)[:3, 2] == pytest.approx(Z)


def test_datum_planes_are_the_least_squares_ones_at_right_angles_to_those_before_them():
    """Walls that lean: ISO 5459 associates the secondary and tertiary datum with their angles fixed."""
    u, v = (grid.reshape(-1, 1) for grid in np.meshgrid(np.linspace(-1, 1, 15), np.linspace(-1, 1, 11)))
    top = 40 * u * X + 30 * v * Y
    left = -40 * X - 10 * Z + 30 * u * Y + 10 * v * (Z + 0.02 * X)
    front = 5 * Y - 30 * Y - 10 * Z + 40 * u * (X + 0.01 * Y) + 10 * v * (Z - 0.015 * Y)
    planes = [Plane(ORIGIN, Z), Plane(-40 * X, -X), Plane(-30 * Y, -Y)]
    # perpendicular to the top, the left wall is x = -40 in every height, and the front y = -25: 5 mm from nominal
    ball = Sphere(np.array([7.0, 8, 9]), 2.0)
    fits = [fit_plane(face) for face in (top, left, front)]
    assert position(ball, *fits, nominal=[ball, *planes], outline=np.empty((0, 3))) == pytest.approx(10.0, abs=1e-9)
    assert datum_motion(fits, planes) == pytest.approx(
        np.block([[np.eye(3), np.array([[0.0], [5.0], [0.0]])], [np.zeros(3), np.ones(1)]]), abs=1e-9
    )


def test_a_datum_plane_keeps_its_nominal_angle():
    """A third datum at 60 deg to the second, found 2 degrees off about the middle of its points, does not move."""
    oblique = np.array([np.sqrt(0.75), 0.5, 0.0])
    planes = [Plane(ORIGIN, Z), Plane(-40 * X, -X), Plane(30 * oblique, oblique)]
    turned = Rotation.from_rotvec([0.0, 0.0, np.deg2rad(2)]).apply(oblique)
    place = 30 * oblique + 15 * np.cross(Z, oblique)
    assert datum_motion([*planes[:2], Plane(place, turned)], planes) == pytest.approx(np.eye(4), abs=1e-9)


def test_a_pose_is_told_by_the_place_of_a_point_and_by_its_turn():
    true = moved()
    pose = Pose(true, true[:3, 3]).moved(np.array([0.0, 0, 0.01, 0.3, 0.4, 0]))
    assert pose_position(pose, sensor_from_part=true, point=ORIGIN) == pytest.approx(0.5)
    assert pose_rotation(pose, sensor_from_part=true, point=ORIGIN) == pytest.approx(0.01)
    at = np.linalg.inv(true) @ [*(true[:3, 3] + [100.0, 0, 0]), 1]  # 100 mm from the turn's axis, across it
    assert pose_position(pose, sensor_from_part=true, point=at[:3]) == pytest.approx(np.hypot(0.3, 0.4 + 1), abs=0.006)
    opposite = Pose(true, true[:3, 3]).moved(np.array([0, np.pi - 1e-3, 0, 0, 0, 0]))
    assert pose_rotation(opposite, sensor_from_part=true, point=ORIGIN) == pytest.approx(np.pi - 1e-3)


TASK = validate(
    "test",
    tomllib.loads("""
[features.top]
kind = "plane"
point_mm = [0, 0, 0]
direction = [0, 0, 1]
outline_mm = [[-40, -40, 0], [40, -40, 0], [40, 40, 0], [-40, 40, 0]]
[features.left]
kind = "plane"
point_mm = [-40, 0, -20]
direction = [-1, 0, 0]
outline_mm = [[-40, -40, 0], [-40, 40, 0], [-40, 40, -40], [-40, -40, -40]]
[features.front]
kind = "plane"
point_mm = [0, -40, -20]
direction = [0, -1, 0]
[features.hole]
kind = "circle"
of = ["top"]
point_mm = [10, 5, 0]
radius_mm = 12
[features.second]
kind = "circle"
of = ["top"]
point_mm = [-22, 20, 0]
radius_mm = 6
[features.brim]
kind = "edge_point"
of = ["top"]
point_mm = [40, 15, 0]
direction = [1, 0, 0]
reach_mm = 8
[features.corner]
kind = "intersection"
of = ["top", "left", "front"]

[measurements]
apart = {kind = "point_distance", features = ["hole", "second"], nominal = 35.341194, unit = "mm"}
from_corner = {kind = "point_distance", features = ["hole", "corner"], nominal = 67.268120, unit = "mm"}
from_left = {kind = "point_plane_distance", features = ["hole", "left"], nominal = 50, unit = "mm"}
from_top = {kind = "point_plane_distance", features = ["hole", "top"], nominal = 0, unit = "mm"}
size = {kind = "diameter", features = ["hole"], nominal = 24, unit = "mm"}
edge = {kind = "point_distance", features = ["brim", "second"], nominal = 62.201286, unit = "mm"}
square = {kind = "plane_angle", features = ["top", "left"], nominal = 90, unit = "deg"}
place = {kind = "position", features = ["hole", "top", "left", "front"], nominal = 0, unit = "mm"}
upright = {kind = "perpendicularity", features = ["left", "top"], nominal = 0, unit = "mm"}
flat = {kind = "flatness", features = ["top"], nominal = 0, unit = "mm"}
where = {kind = "pose_position", features = ["top", "left", "front"], nominal = 0, unit = "mm"}
turned = {kind = "pose_rotation", features = ["top", "left", "front"], nominal = 0, unit = "deg"}
"""),
    Task,
)


def view():
    """sensor_from_part of a sensor that sees the top, the left and the front of the block."""
    toward = np.array([-0.45, -0.5, 0.75])
    forward = -toward / np.linalg.norm(toward)
    right = np.cross(forward, Z)
    right /= np.linalg.norm(right)
    turn = np.stack([right, np.cross(forward, right), forward])
    matrix = np.eye(4)
    matrix[:3, :3] = turn
    matrix[:3, 3] = -turn @ (-400 * forward + np.array([-5.0, -5, -12]))
    return matrix


VIEW = view()
GRID = ViewGrid(600.0, 600.0, 79.7, 72.9, 160, 146)


def block_cloud(sigma=0.0, seed=0, fraction=1.0):
    """Ray-cast block of 80 x 80 x 40 mm with two holes in its top, through which nothing is seen."""
    part_from_sensor = np.linalg.inv(VIEW)
    rays = GRID.rays() @ part_from_sensor[:3, :3].T
    eye = part_from_sensor[:3, 3]
    low, high = np.array([-40.0, -40, -40]), np.array([40.0, 40, 0])
    near, far = np.sort(np.stack([(low - eye) / rays, (high - eye) / rays]), axis=0)
    enter, leave = near.max(axis=-1), far.min(axis=-1)
    side = near.argmax(axis=-1)
    face = np.array([1, 2, 0])[side].astype(np.int16)  # left, front, top
    face[enter >= leave] = -1
    places = eye + enter[..., None] * rays
    for name in ("hole", "second"):
        feature = TASK.features[name]
        inside = np.linalg.norm(places[..., :2] - feature.point_mm[:2], axis=-1) < feature.radius_mm
        face[(face == 0) & inside] = -1
    rng = np.random.default_rng(seed)
    distance = enter + rng.normal(0, sigma, enter.shape)
    seen = (face >= 0) & (rng.random(face.shape) < fraction)
    points = np.where(seen[..., None], distance[..., None] * GRID.rays(), np.nan).astype(np.float32)
    label = np.where(minimum_filter(face, 7) == maximum_filter(face, 7), face, -1).astype(np.int16)
    status = np.where(seen, Status.VALID, Status.NO_SURFACE).astype(np.uint8)
    return PointCloud(points, status, GRID, "ideal", "simulated", feature=label, feature_names=("top", "left", "front"))


def test_the_nominal_values_are_those_of_the_nominal_geometry():
    for name, measurement in TASK.measurements.items():
        model = measurement_model(TASK, name, VIEW)
        if DEFINITIONS[measurement.kind].of == "features":
            scale = 1.0 if measurement.unit == "mm" else np.rad2deg(1)
            value = model.value(*(TASK.nominal(one, VIEW) for one in TASK.fitted_for(name))) * scale
            assert value == pytest.approx(measurement.nominal, abs=1e-6), name


def test_an_ideal_sensor_measures_the_nominal_values():
    measured = measure(block_cloud(), TASK, VIEW)
    assert all(one.possible for one in measured.values()), {n: m.reason for n, m in measured.items() if not m.possible}
    for name, one in measured.items():
        # what hangs on pixels has their uncertainty, everything else that of float32 points
        sampled = {"apart", "from_corner", "from_left", "size", "edge", "place"}
        assert abs(one.error) < (4 * one.uncertainty if name in sampled else 2e-3), name
        assert one.uncertainty < (0.1 if name in sampled else 2e-3), name


def test_the_uncertainty_of_every_kind_is_the_scatter_of_repeated_measurements():
    """Noise moves no edge between pixels; lost points do, so F is 0.8."""
    runs = 10
    outcomes = [measure(block_cloud(0.1, seed, 0.8), TASK, VIEW) for seed in range(runs)]
    # a length of 3 or 2 components is as many chi^2 where its value is 0
    freedom = dict.fromkeys(TASK.measurements, 1) | {"where": 3, "turned": 3, "place": 2}
    for name, count in freedom.items():
        assert all(one[name].possible for one in outcomes), name
        error = np.array([one[name].error for one in outcomes])
        uncertainty = np.array([one[name].uncertainty for one in outcomes])
        chi = np.mean((error / uncertainty) ** 2)
        # the error of an edge is 1.2 times what is said of it in the worst case (see edges.py)
        assert chi < 1.2**2 * count + 4 * np.sqrt(2 * count / runs), name
        # of 10 runs with 1 degree of freedom one in a thousand has less; from_top is 0 by construction, and of a
        # flatness near 0 the uncertainty is a bound
        assert chi > 0.15 * count or name in ("from_top", "flat"), name


def test_a_figure_moves_with_its_plane_and_counts_it_once():
    """The distance of a hole from its own plane is 0 whatever the plane does; between holes the plane hardly counts."""
    fits = {
        name: with_covariance(TASK.nominal(name), np.diag(variance))
        for name, variance in {"top": [0.04, 1e-6, 1e-6], "hole": [0.0, 0, 0], "second": [0.0, 0, 0]}.items()
    }
    model = measurement_model(TASK, "from_top")
    assert evaluate(model.value, [fits[one] for one in TASK.fitted_for("from_top")]) == (
        0.0,
        pytest.approx(0, abs=1e-9),
    )
    model = measurement_model(TASK, "apart")
    _, uncertainty = evaluate(model.value, [fits[one] for one in TASK.fitted_for("apart")])
    # the common shift of 0.2 mm cancels; a tilt of 1 mrad over 35 mm makes heights differ, to second order
    assert uncertainty < 35.3 * (1e-3) ** 2
    # each for itself the two would have had 0.2 mm of height, and the distance its second-order share of it
    fits["hole"] = with_covariance(TASK.nominal("hole"), np.diag([0.01, 0.01, 0]))
    _, uncertainty = evaluate(model.value, [fits[one] for one in TASK.fitted_for("apart")])
    assert uncertainty == pytest.approx(0.1, rel=1e-3)


def test_points_that_share_a_parent_are_correlated():
    """Two feet of axes on one plane that leans: both heights change together, in opposite directions across it."""
    task = validate(
        "test",
        tomllib.loads("""
[features]
base = {kind = "plane", point_mm = [0, 0, 0], direction = [0, 0, 1]}
one = {kind = "cylinder", point_mm = [-20, 0, 0], direction = [0.6, 0, 0.8], radius_mm = 5}
two = {kind = "cylinder", point_mm = [20, 0, 0], direction = [0.6, 0, 0.8], radius_mm = 5}
first = {kind = "intersection", of = ["base", "one"]}
second = {kind = "intersection", of = ["base", "two"]}
[measurements]
apart = {kind = "point_distance", features = ["first", "second"], nominal = 40, unit = "mm"}
"""),
        Task,
    )
    sigma = {"base": [0.3, 0, 0], "one": np.zeros(5), "two": np.zeros(5)}
    fits = [with_covariance(task.nominal(name), np.diag(np.square(s))) for name, s in sigma.items()]
    model = measurement_model(task, "apart")
    # a shift of the plane by 0.3 mm moves each foot by 0.225 mm, and their distance not at all
    assert evaluate(model.value, fits) == (pytest.approx(40), pytest.approx(0, abs=1e-9))
    # a tilt moves them apart: 0.75 * 20 mm * tilt each, the other way
    base = with_covariance(fits[0], np.diag([0.0, *((tangents(Z) @ X) * 1e-3) ** 2]))
    assert evaluate(model.value, [base, *fits[1:]])[1] == pytest.approx(2 * 0.75 * 20 * 1e-3, rel=1e-2)


def test_a_joint_covariance_of_all_fits_is_propagated():
    """Two planes that rise and fall together keep their distance."""
    low, high = Plane(ORIGIN, Z), Plane(10 * Z, Z)
    fits = [with_covariance(one, np.diag([0.01, 0, 0])) for one in (low, high)]

    def value(first, second):
        return plane_distance(first, second, nominal=[low, high])

    assert evaluate(value, fits)[1] == pytest.approx(0.1 * np.sqrt(2))
    joint = np.zeros((6, 6))
    joint[np.ix_([0, 3], [0, 3])] = 0.01
    assert evaluate(value, fits, joint)[1] == pytest.approx(0, abs=1e-9)
    joint[0, 3] = joint[3, 0] = -0.01
    assert evaluate(value, fits, joint)[1] == pytest.approx(0.2)


def test_a_plane_that_was_not_found_takes_its_figures_with_it():
    cloud = block_cloud()
    label = np.where(cloud.feature == 0, -1, cloud.feature)
    blind = PointCloud(
        cloud.points, cloud.status, GRID, "ideal", "simulated", feature=label, feature_names=cloud.feature_names
    )
    measured = measure(blind, TASK, VIEW)
    assert {name for name, one in measured.items() if one.possible} == set()
    assert measured["size"].reason == "top: 0 points, at least 100 are required"
    assert measured["flat"].reason == measured["where"].reason == "top: 0 points, at least 100 are required"


def test_a_hole_that_is_not_there_is_told_of():
    cloud = block_cloud()
    filled = cloud.points.copy()
    missing = np.isnan(filled[..., 2])
    plane = fit_plane(cloud.of_feature("top"), ORIGIN)
    rays = GRID.rays()
    filled[missing] = (rays * (plane.point @ plane.normal / (rays @ plane.normal))[..., None])[missing]
    whole = PointCloud(
        filled, cloud.status, GRID, "ideal", "simulated", feature=cloud.feature, feature_names=cloud.feature_names
    )
    measured = measure(whole, TASK, VIEW)
    assert measured["size"].reason.startswith("hole: 0 crossings of the edge")
    assert measured["flat"].possible and not measured["apart"].possible


angles = st.floats(-180, 180)


@settings(max_examples=25)
@given(st.tuples(angles, angles, angles), st.tuples(*[st.floats(-500, 500)] * 3), st.sampled_from(list(DEFINITIONS)))
def test_no_value_hangs_on_the_frame(euler, shift, kind):
    """Features a little off nominal, everything moved rigidly: the same value."""
    definition = DEFINITIONS[kind]
    if definition.of != "features":
        return
    rng = np.random.default_rng(list(DEFINITIONS).index(kind))
    examples = {
        "plane": [Plane(X + Y, lean(0.3)), Plane(-40 * X, -X), Plane(-30 * Y, -Y), Plane(30 * Y - X, Y)],
        "cylinder": [
            Cylinder(X + 2 * Y, lean(0.2), 5.0),
            Cylinder(30 * X, lean(0.1, Y), 4.0),
            Cylinder(10 * Y, lean(0.15), 3.0),
        ],
        "sphere": [Sphere(X + 2 * Z, 4.0), Sphere(20 * Y, 3.0)],
    }
    examples["cone"] = []
    kinds = list(definition.kinds + definition.datums)
    nominal, used = [], {"plane": 0, "cylinder": 0, "sphere": 0}
    for allowed in kinds:
        one = next((name for name in ("cylinder", "plane", "sphere") if name in allowed), None)
        if one is None:
            return  # a cone's angle
        nominal.append(examples[one][used[one]])
        used[one] += 1
    found = [one.moved(0.01 * rng.normal(size=one.parameter_count)) for one in nominal]
    motion, outline = moved(euler, shift), np.array([[0.0, 0, 0], [0, 0, 20.0], [15, 0, 20]])
    still, turned = {}, {}
    if "nominal" in definition.needs:
        still["nominal"], turned["nominal"] = nominal, [one.placed(motion) for one in nominal]
    if "outline" in definition.needs:
        still["outline"], turned["outline"] = outline, outline @ motion[:3, :3].T + motion[:3, 3]
    assert definition.value(*(one.placed(motion) for one in found), **turned) == pytest.approx(
        definition.value(*found, **still), abs=1e-7
    )
