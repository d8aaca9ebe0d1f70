"""Robot targets against scipy's Rotation in each maker's documented convention, and against makers' own examples."""

import json
import re

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from characterisation.files.errors import InputError
from mitsim.report.export.robot_targets import ROBOT_FORMATS, RobotTarget, kuka_numbers, read_targets
from mitsim.sensor.transforms import Transform
from mitsim.study.run_files import digests_of
from mitsim.study.task_measurement import read_pose
from mitsim.views.candidates import Candidates, View
from mitsim.views.poses import write_views
from mitsim.views.table import FlangeFromSensor, ViewsTable
from tests.report.export.known_cloud import POSE
from tests.report.export.test_export_command import export
from tests.report.view_sphere_run import write_expecting_run

NUMBER = r"-?\d+(?:\.\d+)?(?:E\+\d+)?"


def numbers(text):
    return [float(one) for one in re.findall(NUMBER, text)]


def line_of(robot, pose):
    """The line that a controller's file has for one pose."""
    text = ROBOT_FORMATS[robot].write([RobotTarget("view_0001", pose)], "flange")
    (line,) = [line for line in text.splitlines() if "view_0001" in line]
    return line


def read_abb(line):
    values = numbers(line.partition(":=")[2])
    assert len(values) == 17 and values[11:] == [9e9] * 6
    x, y, z, q1, q2, q3, q4 = values[:7]
    return Rotation.from_quat([q2, q3, q4, q1]).as_matrix(), [x, y, z]


def read_kuka(line):
    named = dict(re.findall(rf"([XYZABC]) ({NUMBER})", line.partition("=")[2]))
    angles = [float(named[axis]) for axis in "ABC"]
    assert -90 <= angles[1] <= 90
    return Rotation.from_euler("ZYX", angles, degrees=True).as_matrix(), [float(named[axis]) for axis in "XYZ"]


def read_ur(line):
    x, y, z, *turn = numbers(line.partition("p[")[2])
    return Rotation.from_rotvec(turn).as_matrix(), [1000 * x, 1000 * y, 1000 * z]


def read_moveit(pose):
    text = ROBOT_FORMATS["moveit"].write([RobotTarget("view_0001", pose)], "flange")
    (said,) = yaml.safe_load(text)["poses"].values()
    assert said["header"]["frame_id"] == "part"
    place, turn = said["pose"]["position"], said["pose"]["orientation"]
    return Rotation.from_quat([turn[k] for k in "xyzw"]).as_matrix(), [1000 * place[k] for k in "xyz"]


READ = {
    "abb": lambda pose: read_abb(line_of("abb", pose)),
    "kuka": lambda pose: read_kuka(line_of("kuka", pose)),
    "ur": lambda pose: read_ur(line_of("ur", pose)),
    "moveit": read_moveit,
}

unit = st.floats(-1, 1)
turns = st.tuples(unit, unit, unit, unit).filter(lambda q: np.linalg.norm(q) > 0.1).map(Rotation.from_quat)
#: where Euler angles fail, half turns, and none
special = st.sampled_from(
    [
        Rotation.from_euler("ZYX", (a, b, c), degrees=True)
        for a in (0, 30, 180)
        for b in (-90, 0, 90, 89.999999)
        for c in (0, -75, 180)
    ]
)


@pytest.mark.parametrize("robot", sorted(READ))
@given(turn=turns | special, place=st.tuples(*[st.floats(-3000, 3000)] * 3))
def test_a_target_read_back_is_the_pose(robot, turn, place):
    turn_read, place_read = READ[robot](Transform(turn.as_matrix(), np.array(place)))
    np.testing.assert_allclose(turn_read, turn.as_matrix(), atol=1e-7)
    np.testing.assert_allclose(place_read, place, atol=1e-4)


def test_examples_of_the_makers():
    # RAPID reference manual, orient: turned by 30 deg about y, q1 = 0.965926, q3 = 0.258819
    tilted = Transform(Rotation.from_euler("y", 30, degrees=True).as_matrix(), np.array([600.0, 500.0, 225.3]))
    assert "[[600.0000, 500.0000, 225.3000], [0.965925826, 0.000000000, 0.258819045, 0.000000000]" in line_of(
        "abb", tilted
    )
    # KUKA: {A 30, B 90, C 0} is what the pad shows for a turn of 30 about z, then 90 about the new y
    turn = Rotation.from_euler("z", 30, degrees=True) * Rotation.from_euler("y", 90, degrees=True)
    shown = kuka_numbers(Transform(turn.as_matrix(), np.array([280.0, 0, -10])))
    np.testing.assert_allclose(shown, [280, 0, -10, 30, 90, 0], atol=1e-9)
    # UR: a tool that points down is turned half a turn about x: p[0, 0.4, 0.4, 3.14159, 0, 0]
    down = Transform(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 400.0, 400.0]))
    assert "p[0.000000000, 0.400000000, 0.400000000, 3.141592654, 0.000000000, 0.000000000]" in line_of("ur", down)


def test_targets_of_a_run_are_its_set_of_views(tmp_path):
    folder = write_expecting_run(tmp_path / "run")
    poses = {n: POSE @ Transform(np.eye(3), np.array([0.0, 0.0, float(n)])) for n in range(12)}
    (folder / "poses").mkdir()
    document = {"views": [{"view": n, "part_from_sensor": pose.matrix().tolist()} for n, pose in poses.items()]}
    (folder / "poses/poses.json").write_text(json.dumps(document))
    found, tool = read_targets(folder)
    assert ([one.name for one in found], tool) == (["view_0002", "view_0007"], "sensor")
    np.testing.assert_allclose(found[1].part_from_tool.matrix(), poses[7].matrix())
    about = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    stated = json.loads((folder / "statement.json").read_text(encoding="utf-8"))
    leaders = dict(zip(about["leaders"], (9, 4, 11), strict=True))
    (folder / "run.json").write_text(json.dumps(about | {"view_sets": [], "leaders": leaders}), encoding="utf-8")
    for view in (9, 11):  # the stated view comes first, the others by number
        (folder / "statement.json").write_text(json.dumps(stated | {"view": view}), encoding="utf-8")
        others = [number for number in (4, 9, 11) if number != view]
        assert [one.name for one in read_targets(folder)[0]] == [f"view_{number:04d}" for number in (view, *others)]
    said = export("targets", folder, "--robot", "ur", "--views", "11,3", "-o", tmp_path / "views.script")
    assert "2 poses of the sensor" in said and "flange_from_sensor" in said
    assert "1 pose of" in export("targets", folder, "--robot", "ur", "--views", "3", "-o", tmp_path / "view.script")
    document["flange_from_sensor"] = np.eye(4).tolist()
    for one in document["views"]:
        one["part_from_flange"] = one["part_from_sensor"]
    (folder / "poses/poses.json").write_text(json.dumps(document))
    assert "of the flange" in export("targets", folder, "--robot", "abb", "--views", "all", "-o", tmp_path / "v.mod")
    assert (tmp_path / "v.mod").read_text().count("CONST robtarget") == 12
    for options, message in (
        (["--robot", "fanuc", "-o", "v.ls"], "abb, kuka, ur, moveit"),
        (["--robot", "abb", "-o", tmp_path / "v.txt"], r"ends in \.mod"),
        (["--robot", "abb", "--views", "99", "-o", tmp_path / "w.mod"], "--views: found 99"),
    ):
        with pytest.raises(InputError, match=message):
            export("targets", folder, *options)
    for entries, views, message in (
        (document["views"][:5], "best", r"poses\.json: views: found no entry of view (9|11)"),
        ([], "best", r"poses\.json: views: found no entry of view"),
        ([], "all", r"poses\.json: views: found no view; "),
        ([], "3", "--views: found '3'; allowed: best or all: there are no views"),
        ([{"view": float("inf")}], "all", r"poses\.json: views: found entries that cannot be read"),
    ):
        (folder / "poses/poses.json").write_text(json.dumps({"views": entries}))
        with pytest.raises(InputError, match=message):
            read_targets(folder, views)
    with pytest.raises(InputError, match=r"poses\.json: found no such file"):
        export("targets", tmp_path, "--robot", "abb", "-o", tmp_path / "w.mod")


def changed(document, key, value, number=3):
    """The poses with one number of a view's matrix replaced, as an editor does it."""
    out = json.loads(json.dumps(document))
    out["views"][number][key][1][3] = value
    return out


@pytest.mark.parametrize("flange", [False, True])
def test_a_changed_pose_is_neither_exported_nor_read(tmp_path, flange):
    """Before, the robot went where the editor had sent it, and the report showed the pose that was scored."""
    hand_eye = FlangeFromSensor(position_mm=(0, 0, 50), quaternion_xyzw=(0, 0, 0.6, 0.8)) if flange else None
    poses = [POSE @ Transform(np.eye(3), np.arange(3.0) * n) for n in range(5)]
    views = [View(n, np.array([0.0, 0.0, 1.0]), 0.0, 500.0, pose) for n, pose in enumerate(poses)]
    table = ViewsTable(flange_from_sensor=hand_eye)
    path = tmp_path / "poses" / "poses.json"
    write_views(path.parent, Candidates(views, [], 0, np.zeros(3)), table, "ensenso-n10")
    written = path.read_text(encoding="utf-8")
    tool = "flange" if flange else "sensor"
    assert read_targets(tmp_path, "all")[1] == tool
    np.testing.assert_array_equal(read_pose(path, 3).matrix(), views[3].world_from_sensor.matrix())
    for key in ("part_from_sensor", "sensor_from_part", *(["part_from_flange"] if flange else [])):
        path.write_text(json.dumps(changed(json.loads(written), key, 123.0)), encoding="utf-8")
        with pytest.raises(InputError, match=r"poses\.json: views\.\w+ of view 3: found a pose that is off by .* mm"):
            read_targets(tmp_path, "all")
        with pytest.raises(InputError, match="of view 3: found a pose that is off"):
            read_pose(path, 3)
    path.write_text(json.dumps(changed(json.loads(written), "part_from_sensor", float("nan"))), encoding="utf-8")
    with pytest.raises(InputError, match=r"part_from_sensor of view 3: found a matrix that is not a rigid motion"):
        read_targets(tmp_path, "all")


def test_poses_of_another_run_are_not_exported(tmp_path):
    """``run.json`` has the digest of the poses of its run."""
    folder = write_expecting_run(tmp_path / "run")
    path = folder / "poses" / "poses.json"
    path.parent.mkdir()
    text = json.dumps({"views": [{"view": n, "part_from_sensor": POSE.matrix().tolist()} for n in range(12)]})
    path.write_text(text, encoding="utf-8")
    about = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    about["files"] = digests_of(folder, [*about.get("files", {}), "poses/poses.json"])
    (folder / "run.json").write_text(json.dumps(about), encoding="utf-8")
    assert len(read_targets(folder, "all")[0]) == 12
    path.write_text(text.replace("500", "501") + " ", encoding="utf-8")
    for views in ("best", "all", "3"):
        with pytest.raises(InputError, match=r"poses\.json: sha256: found a file of another run, or a changed one"):
            read_targets(folder, views)
