"""Zones about middle planes, at angles, about axes and in frames of a plane and two bores; tolerances of two limits."""

import tomllib

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from characterisation.features.fitted import with_covariance
from characterisation.features.surfaces import Cylinder, Plane
from characterisation.features.vectors import tangents
from characterisation.files.documents import validate
from characterisation.files.errors import InputError
from characterisation.statements.decision import decide
from characterisation.statements.tolerance import tolerance_of
from characterisation.tasks.measurement_model import evaluate, measurement_model
from characterisation.tasks.places import mid_plane
from characterisation.tasks.task_file import Measurement, Task
from characterisation.tasks.task_reading import read_task
from characterisation.tasks.zones import angularity, coaxiality, datum_motion, perpendicularity, position, symmetry

X, Y, Z = np.eye(3)
ORIGIN = np.zeros(3)
WALL = np.array([[0.0, -30, 0], [0, 30, 0], [0, 30, 50], [0, -30, 50]])
POST = np.array([[0.0, 0, 0], [0, 0, 60]])

SLOT = """
features.top = { kind = "plane", point_mm = [0, 0, 0], direction = [0, 0, 1] }
features.first = { kind = "cylinder", point_mm = [-40, 0, 0], direction = [0, 0, 1], radius_mm = 5 }
features.second = { kind = "cylinder", point_mm = [40, 0, -7], direction = [0, 0, -1], radius_mm = 5 }
features.left = { kind = "plane", point_mm = [-10, 0, -5], direction = [1, 0, 0] }
features.right = { kind = "plane", point_mm = [10, 0, -5], direction = [-1, 0, 0] }
features.slot = { kind = "mid_plane", of = ["left", "right"], outline_mm = [[0, -20, 0], [0, 20, 0], [0, 20, -10]] }
[measurements.place]
kind = "position"
features = ["slot", "top", "first", "second"]
nominal = 0
unit = "mm"
tolerance = 0.75
[measurements.width]
kind = "plane_distance"
features = ["left", "right"]
nominal = 20
unit = "mm"
tolerance = [-0.2, 0]
"""


def slot(text=SLOT):
    return validate("task.toml", tomllib.loads(text), Task)


@pytest.mark.parametrize("kind", ["plane_distance", "axis_distance"])
def test_features_that_are_not_parallel_have_no_one_distance(tmp_path, kind):
    surface, more = ("plane", "") if kind == "plane_distance" else ("cylinder", ", radius_mm = 5")
    features = (
        f'features.{name} = {{ kind = "{surface}", point_mm = [{x}, 0, 0], direction = [{x}, 0, 30]{more} }}\n'
        for name, x in (("one", -10), ("other", 10))
    )
    measured = f'kind = "{kind}"\nfeatures = ["one", "other"]\nnominal = 20\nunit = "mm"\n'
    (tmp_path / "task.toml").write_text("".join(features) + "[measurements.width]\n" + measured)
    with pytest.raises(InputError, match=r"37 deg apart; allowed: nearly parallel features"):
        read_task(tmp_path / "task.toml")


def lean(angle, toward=X):
    return np.cos(angle) * Z + np.sin(angle) * toward


def test_a_middle_plane_is_as_far_from_both():
    first = Plane(np.array([-9.0, 3, 1]), Rotation.from_euler("y", 1.5, degrees=True).apply(X))
    second = Plane(np.array([11.0, -8, 5]), Rotation.from_euler("z", -2.0, degrees=True).apply(-X))
    middle = mid_plane(first, second)
    across = np.random.default_rng(1).normal(0, 20, (50, 3))
    on_it = across - np.outer((across - middle.point) @ middle.normal, middle.normal)
    distances = [np.abs((on_it - one.point) @ one.normal) for one in (first, second)]
    assert distances[0] == pytest.approx(distances[1], abs=1e-12)
    assert middle.normal @ first.normal > 0.99
    assert np.ptp(distances[0]) > 1  # the planes are not parallel


def test_position_of_a_plane_is_twice_its_largest_offset_over_the_outline():
    nominal = Plane(ORIGIN, X)
    leaning = Plane(0.1 * X, np.cos(0.01) * X - np.sin(0.01) * Z)  # 0.1 mm off at the foot, 0.6 mm at the top
    wanted = 2 * (0.1 + 50 * np.tan(0.01))
    assert position(leaning, nominal=[nominal], outline=WALL) == pytest.approx(wanted)
    assert position(Plane(leaning.point, -leaning.normal), nominal=[nominal], outline=WALL) == pytest.approx(wanted)
    assert symmetry(leaning, nominal, outline=WALL) == pytest.approx(wanted, rel=1e-4)


def test_coaxiality_is_twice_the_largest_distance_from_the_datum_axis():
    pin = Cylinder(0.1 * X, lean(0.01), 5.0)
    assert coaxiality(pin, Cylinder(99 * Z, -Z, 9.0), outline=POST) == pytest.approx(
        2 * (0.1 + 60 * np.sin(0.01)), 1e-3
    )


@pytest.mark.parametrize("angle", [30.0, 60.0, 90.0])
def test_angularity_is_extent_times_lean_and_free_about_the_datum(angle):
    """A plane at an angle to the base, over a square whose one edge runs along the base."""
    nominal, tilt = Plane(ORIGIN, Rotation.from_euler("y", angle, degrees=True).apply(Z)), np.deg2rad(0.4)
    up = Rotation.from_euler("y", angle, degrees=True).apply(-X)
    outline = np.array([[0.0, -20, 0], [0, 20, 0], 50 * up + 20 * Y, 50 * up - 20 * Y])
    base, post = Plane(ORIGIN, -Z), Cylinder(ORIGIN, Z, 3.0)
    steeper = Plane(ORIGIN, Rotation.from_rotvec(tilt * Y).apply(nominal.normal))
    turned = Plane(ORIGIN, Rotation.from_rotvec(0.3 * Z).apply(nominal.normal))
    both = Plane(ORIGIN, Rotation.from_rotvec(0.02 * Z).apply(steeper.normal))
    for datum in (base, post):
        meant = [nominal, datum]
        assert angularity(nominal, datum, nominal=meant, outline=outline) < 1e-12
        assert angularity(steeper, datum, nominal=meant, outline=outline) == pytest.approx(
            50 * np.sin(tilt) * np.cos(tilt)
        )
        assert angularity(turned, datum, nominal=meant, outline=outline) < 1e-12
        found = angularity(both, datum, nominal=meant, outline=outline)
        on_plane = outline - np.outer((outline - both.point) @ both.normal, both.normal)
        normals = Rotation.from_rotvec(np.outer(np.linspace(-0.05, 0.08, 13001), Z)).apply(nominal.normal)
        swept = np.ptp(on_plane @ normals.T, axis=0).min()
        assert found == pytest.approx(swept, abs=1e-3)
    if angle == 90:
        upright = perpendicularity(both, base, outline=outline)
        assert angularity(both, base, nominal=[nominal, base], outline=outline) == pytest.approx(upright, rel=1e-3)


def test_a_plane_and_two_bores_take_an_error_of_the_pose_away():
    task = slot()
    error = np.eye(4)
    error[:3, :3] = Rotation.from_euler("xyz", [0.5, -0.3, 0.4], degrees=True).as_matrix()
    error[:3, 3] = (1.0, 2, -1)
    fitted = task.fitted_for("place")
    assert fitted == ("left", "right", "top", "first", "second")
    model = measurement_model(task, "place")
    moved = {name: task.nominal(name).placed(error) for name in fitted}
    assert model.value(*moved.values()) < 1e-9
    datums = ("top", "first", "second")
    assert datum_motion([moved[one] for one in datums], [task.nominal(one) for one in datums]) == pytest.approx(
        error, abs=1e-9
    )
    # a slot that stands 0.1 mm off along x, and bores of which one stands 0.08 mm off along y: turned by a milliradian
    moved["left"], moved["right"] = (Plane(moved[n].point + 0.1 * error[:3, 0], moved[n].normal) for n in fitted[:2])
    assert model.value(*moved.values()) == pytest.approx(0.2, abs=1e-6)
    off = moved["second"]
    moved["second"] = Cylinder(off.point + 0.08 * error[:3, 1], off.axis, off.radius)
    assert model.value(*moved.values()) == pytest.approx(2 * (0.1 + 20 * 1e-3), abs=1e-3)
    # a third datum plane turns the part where it has an axis as its second
    walls = [task.nominal("top"), task.nominal("first"), Plane(30 * Y, Y)]
    assert datum_motion([one.placed(error) for one in walls], walls) == pytest.approx(error, abs=1e-9)


def test_the_uncertainty_of_a_slots_position_is_the_scatter_of_drawn_fits():
    task, rng = slot(), np.random.default_rng(3)
    model, fitted = measurement_model(task, "place"), task.fitted_for("place")
    fits = []
    for name in fitted:
        nominal = task.nominal(name)
        spread = np.array([0.02, 1e-3, 1e-3, 0.02, 0.02][: nominal.parameter_count])
        if isinstance(nominal, Cylinder):
            spread = np.array([0.02, 0.02, 1e-4, 1e-4, 0.01])
        # the left side stands off by 1 mm and leans, so that one corner of the outline is clearly the farthest
        shifted = nominal if name != "left" else Plane(nominal.point + 1.0 * X, np.cos(0.2) * X + np.sin(0.2) * Y)
        fits.append(with_covariance(shifted, np.diag(spread**2)))
    value, uncertainty = evaluate(model.value, fits)
    drawn = [
        model.value(
            *(one.moved(rng.normal(size=len(one.covariance)) * np.sqrt(np.diag(one.covariance))) for one in fits)
        )
        for _ in range(4000)
    ]
    assert value > 2
    assert np.std(drawn) == pytest.approx(uncertainty, rel=0.05)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("[-0.2, 0]", "[0.1, -0.1]"), "increasing order"),
        (("[-0.2, 0]", "[0.1]"), "two|increasing order"),
        (("[-0.2, 0]", "-3"), "greater than 0"),
        (("[-0.2, 0]", "true"), "greater than 0"),
        (("= 0.75", "= [-0.1, 0.1]"), "width of a zone"),
        (('"top", "first", "second"', '"first", "top", "second"'), "plane"),
        (('"top", "first", "second"', '"top", "left", "second"'), "plane, axis, axis"),
        (("[-1, 0, 0]", "[0, 1, 0]"), "nearly parallel"),
        ((", outline_mm = [[0, -20, 0], [0, 20, 0], [0, 20, -10]]", ""), "corners of the face"),
        (('of = ["left", "right"]', 'of = ["left", "left"]'), "found ['left', 'left']; allowed: different features"),
        (("[40, 0, -7]", "[-40, 0.5, -7]"), "1 mm apart"),
        (("[0, 0, -1], radius", "[1, 0, 0], radius"), "perpendicular"),
    ],
)
def test_what_a_task_gets_wrong_is_told(tmp_path, change, said):
    assert change[0] in SLOT
    path = tmp_path / "task.toml"
    path.write_text(SLOT.replace(*change))
    with pytest.raises(InputError) as caught:
        read_task(path)
    assert any(one in str(caught.value) for one in said.split("|")), caught.value


def test_two_limits_are_judged_as_the_interval_that_they_are(tmp_path):
    (tmp_path / "task.toml").write_text(SLOT)
    task = read_task(tmp_path / "task.toml")
    width = task.measurements["width"]
    assert width.limits == pytest.approx((19.8, 20.0))
    assert (width.tolerance_size, width.one_sided) == (pytest.approx(0.1), False)
    lopsided = tolerance_of(task, "width")
    even = tolerance_of(slot(SLOT.replace("[-0.2, 0]", "0.1").replace("nominal = 20", "nominal = 19.9")), "width")
    assert (lopsided.lower, lopsided.upper) == pytest.approx((even.lower, even.upper))
    errors = np.random.default_rng(1).normal(0.002, 0.004, 400)
    assert decide(errors, lopsided).accepted == pytest.approx(decide(errors, even).accepted)
    assert decide(errors, lopsided).verdict == decide(errors, even).verdict == "fits"
    small = slot(SLOT.replace("nominal = 20", "nominal = 0.1").replace("[-0.2, 0]", "[-0.2, 0.3]"))
    one_sided = tolerance_of(small, "width")
    assert (one_sided.lower, one_sided.upper) == (-np.inf, pytest.approx(0.4))


def test_a_number_keeps_what_a_trial_is_named_by():
    """Kept trials are named by a digest of the task: a plain tolerance and its features are written as they were."""
    told = slot().model_dump(mode="json")["measurements"]
    assert told["place"]["tolerance"] == 0.75
    assert told["width"]["tolerance"] == [-0.2, 0.0]
    whole = slot(SLOT.replace("= 0.75", "= 1")).model_dump_json()
    assert '"tolerance":1.0' in whole


@pytest.mark.parametrize(
    ("kind", "unit", "nominal", "tolerances", "size"),
    [
        ("axis_distance", "mm", 0, [0.3, (0, 0.3), (-0.5, 0.3)], 0.3),
        ("plane_axis_angle", "deg", 90, [0.5, (-0.5, 0), (-0.5, 2)], 0.5),
        ("axis_distance", "mm", 50, [0.3, (-0.4, 0.2)], 0.3),
        ("plane_axis_angle", "deg", 30, [0.5, (-0.25, 0.75)], 0.5),
    ],
)
def test_tolerances_that_the_same_values_meet_have_one_size(kind, unit, nominal, tolerances, size):
    """Half the interval was taken where a limit has no effect: [0, 0.3] had 0.15, which asks for twice as much."""
    table = {"kind": kind, "features": ("a", "b"), "nominal": nominal, "unit": unit}
    sizes = [Measurement.model_validate(table | {"tolerance": tolerance}).tolerance_size for tolerance in tolerances]
    assert sizes == pytest.approx([size] * len(tolerances))


@pytest.mark.parametrize(
    ("kind", "unit", "nominal", "tolerance", "limits"),
    [
        ("plane_angle", "deg", 90.0, [0.1, 0.5], "90.1 and 90.5 deg"),
        ("axis_angle", "deg", 95.0, 1.0, "94 and 96 deg"),
        ("point_distance", "mm", 0.1, [-0.5, -0.2], "-0.4 and -0.1 mm"),
    ],
)
def test_limits_that_no_value_can_keep_are_refused(kind, unit, nominal, tolerance, limits):
    """An angle of planes is at most 90 deg and a distance never negative: every part would be rejected."""
    asked = {"kind": kind, "features": ("a", "b"), "nominal": nominal, "unit": unit}
    with pytest.raises(ValidationError, match=limits):
        Measurement.model_validate(asked | {"tolerance": tolerance})
    assert Measurement.model_validate(asked | {"nominal": 90.0, "tolerance": [-0.5, 0.5]}).tolerance == (-0.5, 0.5)


@pytest.mark.parametrize("correlation", [0.0, 1e-4, 0.6])
def test_the_uncertainty_of_a_zone_of_0_is_the_root_mean_square_of_those_that_noise_makes(correlation):
    """Heights of the corners of a square over drawn planes; a tilt of no preferred direction has no preferred axes."""
    outline = np.array([[-30.0, -30, 0], [30, -30, 0], [30, 30, 0], [-30, 30, 0]])
    covariance = np.diag([1e-4, 1e-8, 1e-8])
    covariance[1, 2] = covariance[2, 1] = correlation * 1e-8
    drawn = np.random.default_rng(1).multivariate_normal(np.zeros(3), covariance, 100_000)
    base, post = Plane(np.zeros(3), Z), Cylinder(np.zeros(3), Z, 1.0)
    fit = with_covariance(base, covariance)
    heights = drawn @ np.column_stack([np.ones(4), outline @ tangents(Z).T]).T
    for function, zones in (
        (lambda plane: perpendicularity(plane, post, outline=outline), np.ptp(heights, axis=1)),
        (lambda plane: symmetry(plane, base, outline=outline), 2 * np.abs(heights).max(axis=1)),
    ):
        assert evaluate(function, [fit])[1] == pytest.approx(np.sqrt((zones**2).mean()), rel=0.04)
