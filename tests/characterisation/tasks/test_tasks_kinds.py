"""The task reader on every kind of feature and measurement."""

import copy
import tomllib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from characterisation.features.figures import Circle, EdgePoint, Point
from characterisation.features.surfaces import Cone
from characterisation.files.documents import validate
from characterisation.files.errors import InputError
from characterisation.tasks.definitions import DEFINITIONS
from characterisation.tasks.measurement_model import measurement_model
from characterisation.tasks.task_file import KEYS, Task
from characterisation.tasks.task_reading import check_features, read_task

#: zones of which the nominal geometry may be outside: what is asked need not be so on the model
LOOSE = ("parallelism", "perpendicularity", "coaxiality", "symmetry")

TASK = """
[features.top]
kind = "plane"
point_mm = [0, 0, 0]
direction = [0, 0, 1]
outline_mm = [[-40, -30, 0], [40, -30, 0], [40, 30, 0], [-40, 30, 0]]
[features.left]
kind = "plane"
point_mm = [-40, 0, -10]
direction = [-1, 0, 0]
[features.front]
kind = "plane"
point_mm = [0, -30, -10]
direction = [0, -1, 0]
[features.right]
kind = "plane"
point_mm = [40, 0, -10]
direction = [1, 0, 0]
[features.pin]
kind = "cylinder"
point_mm = [20, 0, 0]
direction = [0, 0, 1]
radius_mm = 6
outline_mm = [[20, 0, 0], [20, 0, 30]]
[features.bar]
kind = "cylinder"
point_mm = [0, 0, 20]
direction = [1, 0, 0]
radius_mm = 4
[features.ball]
kind = "sphere"
point_mm = [0, 20, 8]
radius_mm = 5
[features.taper]
kind = "cone"
point_mm = [-20, 0, 10]
direction = [0, 0, -2]
radius_mm = 7
half_angle_deg = 20
[features.hole]
kind = "circle"
of = ["top"]
point_mm = [10, 20, 0]
radius_mm = 4
[features.edge]
kind = "edge_point"
of = ["top"]
point_mm = [40, 0, 0]
direction = [3, 0, 0]
reach_mm = 5
[features.corner]
kind = "intersection"
of = ["top", "left", "front"]
[features.middle]
kind = "mid_plane"
of = ["left", "right"]
outline_mm = [[0, -30, 0], [0, 30, 0], [0, 0, -20]]
[features.foot]
kind = "intersection"
of = ["pin", "top"]
[features.crossing]
kind = "intersection"
of = ["pin", "bar"]

[measurements.distance]
kind = "point_distance"
features = ["hole", "corner"]
nominal = 70.7
unit = "mm"
tolerance = 0.1
[measurements.flat]
kind = "flatness"
features = ["top"]
nominal = 0
unit = "mm"
tolerance = 0.05
[measurements.place]
kind = "position"
features = ["hole", "top", "left", "front"]
nominal = 0
unit = "mm"
[measurements.upright]
kind = "perpendicularity"
features = ["pin", "top"]
nominal = 0
unit = "mm"
[measurements.pose]
kind = "pose_position"
features = ["top", "left", "front"]
point_mm = [1, 2, 3]
nominal = 0
unit = "mm"
"""


def read(tmp_path, text):
    path = tmp_path / "task.toml"
    path.write_text(text, encoding="utf-8")
    return read_task(path)


def test_every_kind_of_feature_has_its_nominal_geometry(tmp_path):
    task = read(tmp_path, TASK)
    assert task.shapes == ("top", "left", "front", "right", "pin", "bar", "ball", "taper")
    cone, hole, edge = (task.nominal(name) for name in ("taper", "hole", "edge"))
    assert isinstance(cone, Cone) and cone.half_angle == pytest.approx(np.deg2rad(20))
    assert cone.apex == pytest.approx([-20, 0, 10 + 7 / np.tan(np.deg2rad(20))])
    assert isinstance(hole, Circle) and list(hole.normal) == [0, 0, 1] and hole.radius == 4
    assert isinstance(edge, EdgePoint) and list(edge.direction) == [1, 0, 0] and edge.slope == 0
    places = {name: task.nominal(name) for name in ("corner", "foot", "crossing")}
    assert all(isinstance(place, Point) for place in places.values())
    assert places["corner"].place == pytest.approx([-40, -30, 0], abs=1e-9)
    assert places["foot"].place == pytest.approx([20, 0, 0], abs=1e-9)
    assert list(task.nominal("middle").normal) == [-1, 0, 0] and task.nominal("middle").point[0] == 0
    assert places["crossing"].place == pytest.approx([20, 0, 20], abs=1e-9)
    motion = np.array([[0.0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])
    assert task.nominal("hole", motion).centre == pytest.approx([-19, 12, 3])
    assert task.nominal("corner", motion).place == pytest.approx([31, -38, 3], abs=1e-9)
    with pytest.raises(ValueError, match=r"use Task\.nominal"):
        task.features["hole"].nominal()


def test_a_measurement_rests_on_what_is_fitted_for_it(tmp_path):
    task = read(tmp_path, TASK)
    assert task.fitted_for("distance") == ("top", "hole", "left", "front")
    assert task.shapes_for("distance") == ("top", "left", "front")
    inputs = measurement_model(task, "distance").inputs
    assert [(one.kind, one.features) for one in inputs] == [
        ("feature", (name,)) for name in task.fitted_for("distance")
    ]
    assert [(one.kind, one.features) for one in measurement_model(task, "flat").inputs] == [("form", ("top",))]
    (pose,) = measurement_model(task, "pose").inputs
    assert (pose.kind, pose.features) == ("pose", ("top", "left", "front"))


def test_only_shapes_need_be_in_the_scene(tmp_path):
    task = read(tmp_path, TASK)
    check_features(task, "task.toml", task.shapes)
    with pytest.raises(InputError, match=r"features\.taper"):
        check_features(task, "task.toml", task.shapes[:-1])


def test_a_tolerance_is_half_the_width_for_a_size_and_the_width_of_a_zone(tmp_path):
    task = read(tmp_path, TASK)
    assert task.measurements["distance"].limits == pytest.approx((70.6, 70.8))
    assert task.measurements["flat"].limits == (0.0, 0.05)
    assert task.measurements["place"].limits == (-np.inf, np.inf)


@pytest.mark.parametrize(
    "old, new, field, said",
    [
        ('of = ["top"]\npoint_mm = [10', 'of = ["tp"]\npoint_mm = [10', "features.hole.of", "did you mean 'top'"),
        ('of = ["top"]\npoint_mm = [10', 'of = ["pin"]\npoint_mm = [10', "features.hole.of", "[plane] for circle"),
        ('of = ["top"]\npoint_mm = [10', 'of = ["top", "left"]\npoint_mm = [10', "features.hole.of", "[plane]"),
        ('of = ["top"]\npoint_mm = [10', "point_mm = [10", "features.hole.of", "required"),
        ("point_mm = [10, 20, 0]", "point_mm = [10, 20, 1]", "features.hole.point_mm", "1 mm off top"),
        ("point_mm = [10, 20, 0]\n", "", "features.hole.point_mm", "required"),
        ("direction = [3, 0, 0]", "direction = [3, 0, 1]", "features.edge.direction", "a direction in top"),
        ("reach_mm = 5\n", "", "features.edge.reach_mm", "required"),
        ("reach_mm = 5", "reach_mm = 0", "features.edge.reach_mm", "greater than 0"),
        ("half_angle_deg = 20\n", "", "features.taper.half_angle_deg", "required"),
        ("half_angle_deg = 20", "half_angle_deg = 90", "features.taper.half_angle_deg", "less than 90"),
        (
            "radius_mm = 5",
            "radius_mm = 5\nhalf_angle_deg = 3",
            "features.ball.half_angle_deg",
            "no such key for a sphere",
        ),
        (
            "radius_mm = 5",
            "radius_mm = 5\noutline_mm = [[0, 0, 0]]",
            "features.ball.outline_mm",
            "no such key for a sphere",
        ),
        (
            'of = ["pin", "top"]',
            'of = ["pin", "top"]\nradius_mm = 1',
            "features.foot.radius_mm",
            "no such key for an intersection",
        ),
        ('of = ["pin", "top"]', 'of = ["pin"]', "features.foot.of", "[axis, plane], [plane, plane, plane] or"),
        ('of = ["pin", "top"]', 'of = ["pin", "ball"]', "features.foot.of", "pin (cylinder), ball (sphere)"),
        ('of = ["pin", "top"]', 'of = ["pin", "corner"]', "features.foot.of", "corner (intersection)"),
        ('of = ["pin", "top"]', 'of = ["pin", "left"]', "features.foot.of", "which are parallel"),
        ('of = ["pin", "bar"]', 'of = ["pin", "taper"]', "features.crossing.of", "which are parallel"),
        ('of = ["top", "left", "front"]', 'of = ["top", "left", "top"]', "features.corner.of", "which are parallel"),
        ("[20, 0, 0], [20, 0, 30]", "[20, 0, 0]", "features.pin.outline_mm", "2 or more ends of the axis"),
        ("[20, 0, 0], [20, 0, 30]", "[20, 0, 0], [20, 1, 30]", "features.pin.outline_mm", "1 mm off"),
        ("[-40, 30, 0]]", "[-40, 30, 1]]", "features.top.outline_mm", "corners of the face, on the feature"),
        ("[40, -30, 0], [40, 30, 0], [-40, 30, 0]]", "]", "features.top.outline_mm", "3 or more corners"),
        ("\noutline_mm = [[20, 0, 0], [20, 0, 30]]", "", "features.pin.outline_mm", "ends of the axis"),
        (
            'features = ["hole", "top", "left", "front"]',
            'features = ["hole", "top"]',
            "measurements.place.features",
            "or these and the datums [plane or mid_plane, plane or",
        ),
        (
            'features = ["hole", "top", "left", "front"]',
            'features = ["hole", "top", "left", "pin"]',
            "measurements.place.features",
            "datums",
        ),
        ('features = ["top"]', 'features = ["pin"]', "measurements.flat.features", "[plane] for flatness"),
        ('features = ["top", "left", "front"]', "features = []", "measurements.pose.features", "any number of plane"),
        ('features = ["top", "left", "front"]', 'features = ["hole"]', "measurements.pose.features", "hole (circle)"),
        ("nominal = 0\nunit", "nominal = 0.1\nunit", "measurements.flat.nominal", "flatness is a zone"),
        (
            "nominal = 70.7",
            "point_mm = [0, 0, 0]\nnominal = 70.7",
            "measurements.distance.point_mm",
            "only pose_position has point_mm",
        ),
    ],
)
def test_faults_are_told_with_file_and_field(tmp_path, old, new, field, said):
    assert TASK.count(old) >= 1
    with pytest.raises(InputError) as caught:
        read(tmp_path, TASK.replace(old, new, 1))
    assert caught.value.field == field
    assert said in str(caught.value)


def test_datum_planes_must_meet_in_a_point(tmp_path):
    back = TASK.replace(
        "[features.pin]\n",
        '[features.back]\nkind = "plane"\npoint_mm = [0, 30, 0]\ndirection = [0, 1, 0]\n[features.pin]\n',
        1,
    )
    text = back.replace('"hole", "top", "left", "front"]', '"hole", "top", "back", "front"]')
    with pytest.raises(InputError, match="three datum planes that meet in one point"):
        read(tmp_path, text)


good = st.sampled_from([1.0, 4.0, 30.0])
numbers = st.one_of(good, good, st.floats(-100, 100), st.sampled_from([0.0, 1e-12, 1e9]))
plain = st.sampled_from([[1.0, 0.0, 0.0], [0.0, 5.0, 0.0], [3.0, 4.0, 0.0]])
vectors = st.one_of(plain, plain, st.lists(numbers, min_size=3, max_size=3))
names = st.sampled_from(["top", "left", "front", "pin", "bar", "ball", "taper", "hole", "edge", "corner", "nobody"])
parents = st.one_of(
    st.just(["top"]), st.sampled_from([["pin", "top"], ["top", "left", "front"]]), st.lists(names, max_size=4)
)
values = {
    "point_mm": vectors,
    "direction": vectors,
    "radius_mm": numbers,
    "half_angle_deg": numbers,
    "reach_mm": numbers,
    "of": parents,
    "outline_mm": st.lists(vectors, min_size=1, max_size=4),
}


@st.composite
def features(draw):
    """Mostly the keys of the kind; one in four with some others, or without one that it needs."""
    kind = draw(st.sampled_from(list(KEYS)))
    required, optional = KEYS[kind]
    chosen = [*required, *(key for key in optional if draw(st.integers(0, 3)) == 0)]
    if draw(st.integers(0, 3)) == 0:
        chosen = draw(st.lists(st.sampled_from(list(values)), unique=True))
    return {"kind": kind} | {key: draw(values[key]) for key in chosen}


@st.composite
def measurements(draw):
    """Mostly features of the kinds in question, the new one among them."""
    kind = draw(st.sampled_from(list(DEFINITIONS)))
    examples = {
        "plane": ["top", "left", "front"],
        "cylinder": ["pin", "bar"],
        "sphere": ["ball"],
        "cone": ["taper"],
        "circle": ["hole"],
        "edge_point": ["edge"],
        "intersection": ["corner", "foot"],
        "mid_plane": ["middle"],
    }
    definition = DEFINITIONS[kind]
    wanted = definition.kinds + (definition.datums if draw(st.booleans()) else ())
    named = [draw(st.sampled_from(["new"] + [name for one in kinds for name in examples[one]])) for kinds in wanted]
    if draw(st.integers(0, 3)) == 0:
        named = draw(st.lists(names, max_size=4))
    entry = {"kind": kind, "features": named, "unit": definition.unit}
    entry["nominal"] = draw(st.sampled_from([0, 0, 0, 0, 1.5, -1]))
    extra = {"tolerance": numbers, "point_mm": vectors}
    return entry | {key: draw(one) for key, one in extra.items() if draw(st.integers(0, 7)) == 0}


@settings(max_examples=250)
@given(features(), measurements())
def test_any_feature_and_measurement_is_read_or_answered_with_an_input_error(tmp_path_factory, feature, measurement):
    """What is read is whole: the nominal geometry is finite, and the measurement has a value on it."""
    table = copy.deepcopy(tomllib.loads(TASK))
    table["features"]["new"] = feature
    table["measurements"]["new"] = measurement
    path = tmp_path_factory.mktemp("task") / "task.toml"
    path.write_text(_toml(table), encoding="utf-8")
    try:
        task = read_task(path)
    except InputError as error:
        assert str(path) == error.where and error.field
        return
    nominal = task.nominal("new")
    assert all(np.isfinite(value).all() for value in vars(nominal).values() if not isinstance(value, str))
    model = measurement_model(task, "new")
    if all(one.kind == "feature" for one in model.inputs):
        value = model.value(*(task.nominal(name) for name in task.fitted_for("new")))
        kind = task.measurements["new"].kind
        assert not DEFINITIONS[kind].zone or kind in LOOSE or value < 1e-6


def _toml(table):
    lines = []
    for group in ("features", "measurements"):
        for name, entry in table[group].items():
            lines.append(f"[{group}.{name}]")
            lines += [f"{key} = {value!r}".replace("'", '"') for key, value in entry.items()]
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize("kind", list(DEFINITIONS))
def test_every_kind_of_measurement_can_be_read_and_has_its_nominal_value(tmp_path, kind):
    """Of perfect geometry: 0 for a zone."""
    features, value = {
        "intersection_distance": (["top", "pin", "taper"], 40.0),
        "axis_distance": (["pin", "taper"], 40.0),
        "point_distance": (["ball", "foot"], 29.393876913398138),
        "point_plane_distance": (["ball", "top"], 8.0),
        "plane_distance": (["left", "far"], 80.0),
        "plane_axis_angle": (["top", "taper"], 0.0),
        "axis_angle": (["pin", "bar"], 90.0),
        "plane_angle": (["top", "left"], 90.0),
        "cone_angle": (["taper"], 40.0),
        "radius": (["hole"], 4.0),
        "diameter": (["ball"], 10.0),
        "position": (["pin"], 0.0),
        "parallelism": (["pin", "taper"], 0.0),
        "perpendicularity": (["top", "left"], 0.0),
        "angularity": (["top", "taper"], 0.0),
        "coaxiality": (["pin", "over"], 0.0),
        "symmetry": (["middle", "far"], 0.0),
        "flatness": (["top"], 0.0),
        "cylindricity": (["pin"], 0.0),
        "pose_position": (["ball"], 0.0),
        "pose_rotation": (["ball", "taper"], 0.0),
    }[kind]
    definition = DEFINITIONS[kind]
    entry = {"kind": kind, "features": features, "nominal": value, "unit": definition.unit}
    table = tomllib.loads(TASK) | {"measurements": {"new": entry}}
    table["features"]["far"] = {"kind": "plane", "point_mm": [40, 5, -10], "direction": [1, 0, 0]}
    table["features"]["over"] = {"kind": "cylinder", "point_mm": [20, 0, 50], "direction": [0, 0, -1], "radius_mm": 9}
    if kind == "symmetry":
        table["features"]["far"]["point_mm"][0] = 0
    path = tmp_path / "task.toml"
    path.write_text(_toml(table), encoding="utf-8")
    task = read_task(path)
    assert validate("test", tomllib.loads(_toml(table)), Task) == task
    model = measurement_model(task, "new")
    if definition.of != "features":
        assert [one.kind for one in model.inputs] == [definition.of]
        return
    scale = 1.0 if definition.unit == "mm" else np.rad2deg(1.0)
    assert model.value(*(task.nominal(name) for name in task.fitted_for("new"))) * scale == pytest.approx(value)
