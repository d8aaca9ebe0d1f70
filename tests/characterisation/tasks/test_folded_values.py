"""Values that fold at 0 or 90 deg are the sizes of deviations, which add up with those of a part."""

import tomllib

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from characterisation.features.fits import fit_plane
from characterisation.features.form import fit_form, zone
from characterisation.features.pose_fit import Pose
from characterisation.files.documents import validate
from characterisation.tasks.covariance import ExpectedFit
from characterisation.tasks.deviations import form_size
from characterisation.tasks.folded import folded_value
from characterisation.tasks.measurement_model import measurement_model
from characterisation.tasks.prediction import ExpectedInput, joint_quadratic_form
from characterisation.tasks.task_file import Task

FEATURES = """
top.kind = "plane"
top.point_mm = [0, 0, 0]
top.direction = [0, 0, 1]
top.outline_mm = [[-40, -30, 0], [40, -30, 0], [40, 30, 0], [-40, 30, 0]]
step.kind = "plane"
step.point_mm = [0, 0, 0]
step.direction = [0, 0, -1]
step.outline_mm = [[-40, -30, 0], [40, -30, 0], [40, 30, 0]]
wall.kind = "plane"
wall.point_mm = [40, 0, -20]
wall.direction = [1, 0, 0]
wall.outline_mm = [[40, -30, 0], [40, 30, 0], [40, 30, -50], [40, -30, -50]]
back = { kind = "plane", point_mm = [0, 30, -20], direction = [0, 1, 0] }
ramp.kind = "plane"
ramp.point_mm = [0, 0, -60]
ramp.direction = [1, 0, 1]
ramp.outline_mm = [[-10, -20, -50], [-10, 20, -50], [10, 20, -70], [10, -20, -70]]
pin.kind = "cylinder"
pin.point_mm = [20, 0, 0]
pin.direction = [0, 0, 1]
pin.radius_mm = 6
pin.outline_mm = [[20, 0, 0], [20, 0, 30]]
bore = { kind = "cylinder", point_mm = [20, 0, -40], direction = [0, 0, -1], radius_mm = 5 }
bar.kind = "cylinder"
bar.point_mm = [0, 0, 20]
bar.direction = [1, 0, 0]
bar.radius_mm = 4
bar.outline_mm = [[-30, 0, 20], [30, 0, 20]]
other = { kind = "cylinder", point_mm = [-20, 0, 0], direction = [0, 0, 1], radius_mm = 6 }
ball = { kind = "sphere", point_mm = [0, 20, 0], radius_mm = 5 }
hole = { kind = "circle", of = ["top"], point_mm = [0, 20, 0], radius_mm = 3 }
edge = { kind = "edge_point", of = ["top"], point_mm = [40, 0, 0], direction = [1, 0, 0], reach_mm = 5 }
left = { kind = "plane", point_mm = [-10, 0, -5], direction = [1, 0, 0] }
right = { kind = "plane", point_mm = [10, 0, -5], direction = [-1, 0, 0] }
slot = { kind = "mid_plane", of = ["left", "right"], outline_mm = [[0, -20, 0], [0, 20, 0], [0, 20, -10]] }
foot = { kind = "intersection", of = ["top", "pin"] }
"""

#: kind, features, unit, and the degrees of freedom of its deviations
CASES = {
    "ball": ("position", ["ball"], "mm", 3),
    "ball in datums": ("position", ["ball", "top", "wall", "back"], "mm", 3),
    "hole": ("position", ["hole"], "mm", 2),
    "edge": ("position", ["edge"], "mm", 1),
    "foot": ("position", ["foot"], "mm", 3),
    "face": ("position", ["top"], "mm", 3),
    "pin": ("position", ["pin"], "mm", 4),
    "slot": ("position", ["slot", "top", "pin", "other"], "mm", 3),
    "step to top": ("parallelism", ["step", "top"], "mm", 2),
    "bar to top": ("parallelism", ["bar", "top"], "mm", 1),
    "wall to pin": ("parallelism", ["wall", "pin"], "mm", 1),
    "pin to bore": ("parallelism", ["pin", "bore"], "mm", 2),
    "top to pin": ("perpendicularity", ["top", "pin"], "mm", 2),
    "bar to pin": ("perpendicularity", ["bar", "pin"], "mm", 1),
    "wall to top": ("perpendicularity", ["wall", "top"], "mm", 1),
    "pin to top": ("perpendicularity", ["pin", "top"], "mm", 2),
    "ramp to top": ("angularity", ["ramp", "top"], "mm", 1),
    "pin about bore": ("coaxiality", ["pin", "bore"], "mm", 4),
    "slot about left": ("symmetry", ["slot", "slot"], "mm", 0),
    "shift": ("pose_position", ["top", "wall", "back"], "mm", 3),
    "turn": ("pose_rotation", ["top", "wall", "back"], "deg", 3),
    "ball and hole": ("point_distance", ["ball", "hole"], "mm", 3),
    "axes": ("axis_distance", ["pin", "bore"], "mm", 2),
    "ball over top": ("point_plane_distance", ["ball", "top"], "mm", 1),
    "faces": ("plane_distance", ["top", "step"], "mm", 1),
    "lean": ("plane_axis_angle", ["top", "pin"], "deg", 2),
    "askew": ("axis_angle", ["pin", "bore"], "deg", 2),
    "tilt": ("plane_angle", ["top", "step"], "deg", 2),
}
del CASES["slot about left"]  # a plane about itself does not deviate

RIGHT = {
    "upright": ("plane_axis_angle", ["wall", "pin"], "deg", 1),
    "crossed": ("axis_angle", ["pin", "bar"], "deg", 1),
    "corner": ("plane_angle", ["wall", "top"], "deg", 1),
}


def task(cases, nominal, **more):
    measurements = {
        name: {"kind": kind, "features": features, "nominal": nominal, "unit": unit, **more}
        for name, (kind, features, unit, _) in cases.items()
    }
    return validate("task.toml", {"features": tomllib.loads(FEATURES), "measurements": measurements}, Task)


def motion():
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("xyz", (40, -70, 110), degrees=True).as_matrix()
    matrix[:3, 3] = (100.0, -50, 300)
    return matrix


def measured(some, name, rng, scale=1.0):
    """The value and the deviations from nominal of features that were fitted a little off, in another frame."""
    sensor_from_part = motion()
    model = measurement_model(some, name, sensor_from_part)
    if model.inputs[0].kind == "pose":
        fits = [Pose(sensor_from_part, sensor_from_part[:3, 3])]
    else:
        fits = [some.nominal(one, sensor_from_part) for one in some.fitted_for(name)]
    spread = [np.full(one.parameter_count, 1e-4 * scale) for one in fits]
    moved = [one.moved(size * rng.standard_normal(len(size))) for one, size in zip(fits, spread, strict=True)]
    return model.value(*moved), model.deviations(*moved)


@pytest.mark.parametrize(
    ("nominal", "more", "size"),
    [
        (89.99999, {}, None),
        (89.99999, {"tolerance": 0.1}, 0.1),
        (89.95, {"tolerance": (-0.1, 0.04999999)}, 0.15),
        (90 + 4e-6, {"tolerance": (-0.1, -2e-6)}, 0.1),
    ],
)
def test_an_angle_that_rounding_moved_from_90_deg_folds_there(nominal, more, size):
    """No measured angle of lines exceeds 90 deg, however the model was rounded."""
    some = task({"corner": RIGHT["corner"]}, nominal, **more)
    folded = folded_value(some, "corner")
    assert folded is not None and folded.fold == 90
    assert some.measurements["corner"].tolerance_size == (size if size is None else pytest.approx(size, abs=1e-4))
    assert folded.limit == (size if size is None else pytest.approx(size, abs=1e-4))
    rng = np.random.default_rng(5)
    assert max(folded.value(rng.normal(0, 0.01, (1000, 1, 1)))) <= 90


@pytest.mark.parametrize(("nominal", "tolerance"), [(1e-6, None), (0.1 + 0.2, (-0.3, 0.3))])
def test_a_distance_that_rounding_moved_from_0_folds_there(nominal, tolerance):
    some = task({"axes": CASES["axes"]}, nominal, tolerance=tolerance)
    assert folded_value(some, "axes").fold == 0
    assert some.measurements["axes"].one_sided == (tolerance is not None)


@pytest.mark.parametrize("name", [*CASES, *RIGHT])
def test_a_value_is_the_size_of_its_deviations(name):
    right = name in RIGHT
    some = task(RIGHT if right else CASES, 90 if right else 0)
    folded = folded_value(some, name)
    scale = np.rad2deg(1.0) if folded is not None and some.measurements[name].unit == "deg" else 1.0
    assert len(folded.basis) == (RIGHT | CASES)[name][3]
    rng = np.random.default_rng(3)
    for _ in range(5):
        value, rows = measured(some, name, rng)
        rows = scale * rows
        size = float(folded.size(rows))
        assert float(folded.value(rows)) == pytest.approx(scale * value, abs=2e-3 * size)
        assert size > 1e-6
        # and the deviations are among those that the features can have
        flat = folded.basis.reshape(len(folded.basis), -1)
        left = rows.ravel() - flat.T @ (flat @ rows.ravel())
        assert np.abs(left).max() < 2e-3 * size


def test_deviations_are_in_the_part_frame():
    some, sensor_from_part = task(CASES, 0), motion()
    shift = np.array([0.3, -0.2, 0.1])
    for name, seen in (("ball", shift), ("hole", [0.3, -0.2, 0]), ("edge", [0.3, 0, 0])):
        model = measurement_model(some, name, sensor_from_part)
        fits = [some.nominal(one) for one in some.fitted_for(name)]
        off = np.eye(4)
        off[:3, 3] = shift
        moved = [one.placed(sensor_from_part @ off) for one in fits]
        if len(moved) > 1:  # the plane of a figure stays
            moved[0] = fits[0].placed(sensor_from_part)
        assert model.deviations(*moved)[0] == pytest.approx(seen, abs=1e-9)


def test_values_that_do_not_fold_have_no_deviations():
    apart, angle = ("point_distance", ["ball", "foot"], "mm", 0), ("plane_angle", ["ramp", "top"], "deg", 0)
    cases = {"apart": apart, "angle": angle}
    some = task(cases, 45)
    for name in cases:
        assert folded_value(some, name) is None and measurement_model(some, name).deviations is None
    near = task(cases, 45, tolerance=50)  # its lower limit is below 0
    assert folded_value(near, "apart").limit == 95


def test_directions_of_a_point_and_of_a_hole_are_isotropic():
    some = task(CASES, 0)
    for name, dimensions in (("ball", 3), ("hole", 2)):
        drawn = np.array([folded_value(some, name).direction(day) for day in range(4000)])[:, 0]
        drawn /= np.linalg.norm(drawn, axis=1, keepdims=True)
        second = np.linalg.eigvalsh(drawn.T @ drawn / len(drawn))[::-1][:dimensions]
        assert second == pytest.approx(1 / dimensions, abs=4 / np.sqrt(4000))
        assert np.linalg.norm(drawn.mean(axis=0)) < 4 / np.sqrt(4000)


@pytest.mark.parametrize("noise", [0.001, 0.02])
def test_the_heights_at_the_nodes_give_the_zone_of_the_form(noise):
    """A saddle of 0.2 mm with noise: nodes have the points nearest to them, so the corners are seen."""
    rng = np.random.default_rng(5)
    x, y = rng.uniform(-30, 30, 20000), rng.uniform(-20, 20, 20000)
    height = 0.1 * (x / 30) * (y / 20) + noise * rng.standard_normal(len(x))
    points = np.column_stack([x, y, height])
    form = fit_form(points, fit_plane(points))
    flat = task({"flat": ("flatness", ["top"], "mm", 0)}, 0)
    rows = measurement_model(flat, "flat").deviations(form)
    assert float(form_size(rows)) == pytest.approx(zone(form), rel=0.03)
    assert rows.shape == folded_value(flat, "flat").shape


def test_a_form_adds_up_with_that_of_a_part():
    """Two fits, of noise alone and of the same noise on a saddle, differ by the saddle."""
    rng = np.random.default_rng(6)
    x, y = rng.uniform(-30, 30, 20000), rng.uniform(-20, 20, 20000)
    noise = 0.1 * rng.standard_normal(len(x))
    flat = measurement_model(task({"flat": ("flatness", ["top"], "mm", 0)}, 0), "flat").deviations
    rows, values = [], []
    for saddle in (0.0, 0.1):
        points = np.column_stack([x, y, saddle * (x / 30) * (y / 20) + noise])
        form = fit_form(points, fit_plane(points))
        rows.append(flat(form))
        values.append(zone(form))
    nodes = np.linspace(-1, 1, 7)
    part = np.append(np.multiply.outer(nodes, nodes).ravel() * 0.1, 0.0)[:, None]
    assert float(form_size(rows[0] + part)) == pytest.approx(values[1], rel=0.03)


def test_far_from_nominal_only_the_component_of_an_error_counts():
    some = task(CASES, 0)
    for name, dimensions in (("edge", 1), ("hole", 2), ("ball", 3)):
        assert folded_value(some, name).far_share() == pytest.approx(dimensions**-0.5, rel=0.1)


def test_an_added_deviation_has_its_size_and_a_direction_of_its_own():
    folded = folded_value(task(CASES, 0), "ball")
    moved = [folded.moved(np.zeros((1, 3)), -0.5, seed) for seed in (1, 1, 2)]
    assert [folded.error(one) for one in moved] == pytest.approx([0.5] * 3)
    assert np.array_equal(moved[0], moved[1]) and not np.allclose(moved[0], moved[2])


@pytest.mark.parametrize(
    "name", ["pin", "face", "slot", "step to top", "pin about bore", "wall to top", "foot", "shift"]
)
def test_the_quadratic_form_of_a_zone_has_no_negative_squares(name):
    """A set of views was predicted to know a position exactly, because its form had a negative square."""
    some = task(CASES, 0)
    model = measurement_model(some, name)
    if model.inputs[0].kind == "pose":
        nominal = [Pose(np.eye(4), np.zeros(3))]
    else:
        nominal = [some.nominal(one) for one in some.fitted_for(name)]
    rng = np.random.default_rng(20261128)
    spreads = [1e-4 * np.exp(rng.uniform(-1, 1, one.parameter_count)) for one in nominal]
    inputs = {}
    for quantity, one, spread in zip(model.inputs, nominal, spreads, strict=True):
        middle, nothing = getattr(one, "point", np.zeros(3)), np.zeros((len(spread), 1))
        inputs[quantity] = ExpectedInput(ExpectedFit(np.diag(spread**2), nothing, 100.0, 1.0, middle, 0.1), one)
    form = joint_quadratic_form(some, name, inputs)
    scale = np.concatenate(spreads)
    squares = np.linalg.eigvalsh(form * np.outer(scale, scale))
    assert squares[-1] > 0 and squares[0] > -1e-3 * squares[-1]
    # independent parameters, and errors that they share: against measuring
    for shared, low, high in ((0.0, 0.9, 1.1), (3.0, 0.6, 1.4)):
        cause = shared * scale * rng.standard_normal(len(scale))
        drawn = scale * rng.standard_normal((2000, len(scale))) + cause * rng.standard_normal((2000, 1))
        ends = np.cumsum([one.parameter_count for one in nominal])[:-1]
        values = [
            model.value(*[one.moved(part) for one, part in zip(nominal, np.split(draw, ends), strict=True)])
            for draw in drawn
        ]
        expected = np.sqrt(np.trace(form @ (np.diag(scale**2) + np.outer(cause, cause))))
        assert low < np.sqrt(np.mean(np.square(values))) / expected < high, (shared, expected)
