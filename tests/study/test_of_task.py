"""Poses and statements that a task is measured with: what is read, and what is refused."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from characterisation.files.errors import InputError
from characterisation.tasks.result import Result
from characterisation.tasks.task_file import Task
from mitsim.sensor.transforms import Transform, look_at
from mitsim.study.task_measurement import corrected, measure_task, read_pose, read_view_statement

POSE = look_at([0, -450, 250], [0, 0, 0], [0, 0, 1])


@pytest.fixture
def statement(tmp_path):
    """A statement with one measurement."""
    path = tmp_path / "statement.json"
    measurements = {"gap": {"unit": "mm", "bias": -0.3, "bias_uncertainty": 0.03, "standard_uncertainty": 0.04}}
    table = {"sensor": "ensenso-n10", "world_from_sensor": POSE.matrix().tolist(), "measurements": measurements}
    path.write_text(json.dumps(table), encoding="utf-8")
    return path


def test_the_bias_is_taken_off_and_the_uncertainty_is_the_statements(statement):
    loaded = read_view_statement(statement)
    loaded.check("ensenso-n10", POSE)
    one = corrected(Result("gap", "mm", 69.7, 0.01, "fit", nominal=70.0), loaded)
    assert (one.value, one.bias, one.origin) == (pytest.approx(70.0), -0.3, "statement")
    assert one.uncertainty == pytest.approx(0.05)


def test_a_corrected_zone_is_not_negative(statement):
    table = json.loads(statement.read_text())
    table["measurements"]["gap"]["bias"] = 0.3
    statement.write_text(json.dumps(table))
    one = corrected(Result("gap", "mm", 0.1, deviations=np.zeros((1, 3))), read_view_statement(statement))
    assert one.value == 0 and one.bias == 0.3
    assert corrected(Result("gap", "mm", 0.1), read_view_statement(statement)).value == pytest.approx(-0.2)


def test_a_corrected_angle_of_lines_is_at_most_90_deg(statement, monkeypatch):
    """Two planes that read 89.98 deg, with a bias of -0.05 deg, are no 90.03 deg apart; a cone's angle can be."""
    table = json.loads(statement.read_text())
    table["measurements"] = {
        name: {"unit": "deg", "bias": -0.05, "bias_uncertainty": 0.01, "standard_uncertainty": 0.02}
        for name in ("corner", "cone")
    }
    statement.write_text(json.dumps(table))
    plane = {"kind": "plane", "point_mm": [0, 0, 0]}
    cone = {"kind": "cone", "point_mm": [0, 0, 0], "direction": [0, 0, 1], "radius_mm": 5, "half_angle_deg": 45}
    asked = {"nominal": 90, "unit": "deg"}
    task = Task.model_validate(
        {
            "features": {"a": plane | {"direction": [1, 0, 0]}, "b": plane | {"direction": [0, 1, 0]}, "c": cone},
            "measurements": {
                "corner": asked | {"kind": "plane_angle", "features": ("a", "b")},
                "cone": asked | {"kind": "cone_angle", "features": ("c",)},
            },
        }
    )
    read = {name: Result(name, "deg", 89.98, 0.01, "fit") for name in ("corner", "cone")}
    monkeypatch.setattr("mitsim.study.task_measurement._labelled", lambda *_: None)
    monkeypatch.setattr("characterisation.tasks.evaluation.measure", lambda *_: read)
    cloud = SimpleNamespace(sensor="ensenso-n10")
    values = [one.value for one in measure_task(cloud, task, None, POSE, read_view_statement(statement))]
    assert values == [90.0, pytest.approx(90.03)]


def test_a_statement_of_another_sensor_or_view_is_refused(statement):
    loaded = read_view_statement(statement)
    with pytest.raises(InputError, match="ensenso-n35, the sensor of the cloud"):
        loaded.check("ensenso-n35", POSE)
    loaded.check("ensenso-n10", POSE @ Transform.from_degrees([0.5, 0, 0], [0, 3, 0]))
    for moved in (Transform.from_degrees([0, 0, 5], [0, 0, 0]), Transform.from_degrees([0, 0, 0], [0, 0, 30])):
        with pytest.raises(InputError, match="a bias holds only for its view"):
            loaded.check("ensenso-n10", POSE @ moved)


def test_a_statement_without_the_measurement_or_in_another_unit_is_refused(statement):
    loaded = read_view_statement(statement)
    with pytest.raises(InputError, match="a statement with width, a measurement of the task"):
        corrected(Result("width", "mm", 1.0), loaded)
    with pytest.raises(InputError, match="a bias in deg"):
        corrected(Result("gap", "deg", 1.0), loaded)


def test_poses_of_every_kind_of_file(statement, tmp_path):
    assert read_pose(statement).matrix() == pytest.approx(POSE.matrix())
    poses = tmp_path / "poses.json"
    poses.write_text(json.dumps({"views": [{"view": 3, "part_from_sensor": POSE.matrix().tolist()}]}), encoding="utf-8")
    assert read_pose(poses, 3).matrix() == pytest.approx(POSE.matrix())
    with pytest.raises(InputError, match=r"found none; allowed: a view of .*: 3 to 3"):
        read_pose(poses)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("{", "not JSON"),
        ("[]", "a JSON object"),
        ('{"world_from_sensor": null}', "4 x 4 matrix"),
        (json.dumps({"world_from_sensor": (2 * np.eye(4)).tolist()}), "not a rigid motion"),
        (
            json.dumps({"world_from_sensor": (np.eye(4) + np.eye(4, k=-1) * [0, 0, 500, 0]).tolist()}),
            "not a rigid motion",
        ),
        (json.dumps({"world_from_sensor": [10**400] * 16}), "4 x 4 matrix"),
        ('{"views": [{"no": 1}]}', "entries that cannot be read"),
        ('{"views": [{"view": 1e999, "part_from_sensor": 1}]}', "entries that cannot be read"),
    ],
)
def test_files_without_a_pose_are_refused(text, match, tmp_path):
    path = tmp_path / "pose.json"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=match):
        read_pose(path)


@pytest.mark.parametrize("matrix", [[1, 2], (2 * np.eye(4)).tolist()])
def test_a_wrong_pose_of_a_run_is_named_by_its_key_and_view(matrix, tmp_path):
    """Before, the message named world_from_sensor, a key that such a file does not have."""
    poses = tmp_path / "poses.json"
    poses.write_text(json.dumps({"views": [{"view": 3, "part_from_sensor": matrix}]}), encoding="utf-8")
    with pytest.raises(InputError) as caught:
        read_pose(poses, 3)
    assert caught.value.field == "views.part_from_sensor of view 3"


def test_a_run_without_views_has_no_pose(tmp_path):
    """Before, the views 0 to 0 were allowed."""
    (tmp_path / "poses.json").write_text('{"views": []}', encoding="utf-8")
    with pytest.raises(InputError, match="found no view") as caught:
        read_pose(tmp_path / "poses.json", 0)
    assert caught.value.field == "views"


def test_a_file_that_is_no_statement_is_refused(tmp_path):
    path = tmp_path / "statement.json"
    path.write_text('{"sensor": "x"}', encoding="utf-8")
    with pytest.raises(InputError, match="a value for each"):
        read_view_statement(path)
