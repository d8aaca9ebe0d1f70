"""Poses written for robots and stages: read back by nothing but the files."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from characterisation.files.documents import validate
from characterisation.files.errors import InputError
from mitsim.views import ViewsTable, candidate_views, write_views

STAGE = {
    "axes": [
        {"name": "cradle", "direction": [1, 0, 0], "limits_deg": [-40, 40], "point_mm": [0, 0, -20]},
        {"name": "turn, slow", "direction": [0, 0, 1], "limits_deg": [0, 360]},
    ],
    "part_rotation_deg": [0, 10, 0],
    "part_position_mm": [1, 2, 3],
}
TURN = Rotation.from_euler("xyz", [12, -35, 80], degrees=True)
FLANGE = {"position_mm": [12.5, -40, 88], "quaternion_xyzw": TURN.as_quat().round(7).tolist()}


def views(n10, triangles=(), **changes):
    table = validate("views", {"subdivisions": 1, "lowest_elevation_deg": 30, **changes}, ViewsTable)
    part = np.reshape(triangles, (-1, 3, 3)).astype(float)
    return candidate_views(table, n10, [500], np.array([0, 0, 10.0]), part), table


def rows(path):
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def pose_of(row, prefix=""):
    """Pose (4, 4) in the part frame of a row, its rotation from the quaternion and again from the rotation vector."""
    out = np.eye(4)
    out[:3, 3] = [float(row[f"{prefix}position_{axis}_mm"]) for axis in "xyz"]
    out[:3, :3] = Rotation.from_quat([float(row[f"{prefix}quaternion_{axis}"]) for axis in "xyzw"]).as_matrix()
    vector = np.radians([float(row[f"{prefix}rotation_vector_{axis}_deg"]) for axis in "xyz"])
    assert np.allclose(Rotation.from_rotvec(vector).as_matrix(), out[:3, :3], atol=1e-8)
    return out


def test_a_pose_is_the_same_in_every_file(n10, tmp_path):
    found, table = views(n10, rolls_deg=[0, 200], flange_from_sensor=FLANGE)
    write_views(tmp_path / "poses", found, table, n10.name)
    assert sorted(p.name for p in tmp_path.rglob("*")) == ["poses", "poses.csv", "poses.json"]
    told = json.loads((tmp_path / "poses/poses.json").read_text(encoding="utf-8"))
    assert told["schema_version"] == 1 and told["units"] == {"length": "mm", "angle": "deg"}
    assert told["sensor"] == "ensenso-n10" and told["target_mm"] == [0, 0, 10]
    assert set(told["frames"]) == {"part", "sensor", "flange"}
    listed = rows(tmp_path / "poses/poses.csv")
    assert len(listed) == len(told["views"]) == len(found.views) > 20
    flange_from_sensor = np.eye(4)
    flange_from_sensor[:3, :3], flange_from_sensor[:3, 3] = TURN.as_matrix(), FLANGE["position_mm"]
    for view, row, entry in zip(found.views, listed, told["views"], strict=True):
        pose = view.world_from_sensor.matrix()
        assert int(row["view"]) == entry["view"] == view.number
        # nine decimals of a quaternion and 500 mm
        assert np.abs(pose_of(row) - pose).max() < 5e-9
        assert np.array_equal(entry["part_from_sensor"], pose)
        assert np.allclose(np.array(entry["sensor_from_part"]) @ pose, np.eye(4), atol=1e-9)
        # the flange carries the sensor to where it shall stand; seven digits of a quaternion
        assert np.abs(np.array(entry["part_from_flange"]) @ flange_from_sensor - pose).max() < 2e-4
        assert np.abs(pose_of(row, "flange_") - entry["part_from_flange"]).max() < 5e-9
        assert float(row["quaternion_w"]) >= 0
        assert [float(row[f"direction_{axis}"]) for axis in "xyz"] == pytest.approx(view.direction.tolist(), abs=1e-9)
        assert (float(row["roll_deg"]), float(row["standoff_mm"])) == (view.roll_deg, 500)
    assert "-0.000000000" not in (tmp_path / "poses/poses.csv").read_text(encoding="utf-8")


def test_a_matrix_and_a_quaternion_say_the_same_of_a_flange(n10):
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = TURN.as_matrix().round(6), FLANGE["position_mm"]
    by_matrix = views(n10, flange_from_sensor={"matrix": matrix.tolist()})[1].flange_from_sensor.transform()
    by_quaternion = views(n10, flange_from_sensor=FLANGE)[1].flange_from_sensor.transform()
    assert np.allclose(by_matrix.matrix(), by_quaternion.matrix(), atol=2e-6)
    for one in (by_matrix, by_quaternion):
        assert np.allclose(one.rotation @ one.rotation.T, np.eye(3), atol=1e-14)  # exact again


def test_the_angles_of_a_stage_give_the_pose_that_is_written(n10, tmp_path):
    """Only by the words of poses.json: turn the part about each axis, and look at it from the z axis."""
    found, table = views(n10, stage=STAGE)
    folder = tmp_path / "poses"
    write_views(folder, found, table, n10.name)
    told = json.loads((folder / "poses.json").read_text(encoding="utf-8"))
    assert "anticlockwise" in told["frames"]["stage"]
    angles = rows(folder / "stage.csv")
    assert list(angles[0]) == ["view", "cradle_deg", "turn, slow_deg", "camera_distance_mm"]
    baseline = n10.rig.baseline_direction * [1, 0, 0]
    x = baseline / np.linalg.norm(baseline)
    camera = np.stack([x, [0, -1, 0], [0, 0, -1]])  # rows: axes of the stage frame in the sensor frame
    for row, entry in zip(angles, told["views"], strict=True):
        turned = [float(row["cradle_deg"]), float(row["turn, slow_deg"])]
        assert list(entry["stage_deg"].values()) == pytest.approx(turned, abs=1e-9)
        place = np.eye(4)
        place[:3, :3] = Rotation.from_euler("xyz", STAGE["part_rotation_deg"], degrees=True).as_matrix()
        place[:3, 3] = STAGE["part_position_mm"]
        for axis, angle in reversed(list(zip(STAGE["axes"], np.radians(turned), strict=True))):
            turn = Rotation.from_rotvec(angle * np.array(axis["direction"])).as_matrix()
            point = np.array(axis.get("point_mm", [0, 0, 0]), float)
            step = np.eye(4)
            step[:3, :3], step[:3, 3] = turn, point - turn @ point
            place = step @ place
        sensor = np.eye(4)
        sensor[:3, :3], sensor[:3, 3] = camera, [0, 0, float(row["camera_distance_mm"])]
        assert np.abs(np.linalg.inv(place) @ sensor - entry["part_from_sensor"]).max() < 1e-8


def test_what_cannot_be_had_is_listed_and_counted(n10, tmp_path, capsys):
    folder = tmp_path / "poses"
    blocked = np.array([[[-400, 300, 0], [400, 300, 0], [0, 300, 600]]], float)
    found, table = views(n10, triangles=blocked, stage=STAGE)
    write_views(folder, found, table, n10.name)
    listed = rows(folder / "left_out.csv")
    assert len(listed) == len(found.left_out) > 0
    assert {row["reason"].partition(":")[0] for row in listed} == {"stage"}
    assert all(row["roll_deg"] == "" for row in listed)
    whole = len(found.views) + len(found.left_out)
    assert (
        f"{len(found.left_out)} of {whole} views are impossible: {folder / 'left_out.csv'}" in capsys.readouterr().err
    )
    # a run with another table leaves nothing of the former one
    found, table = views(n10)
    write_views(folder, found, table, n10.name)
    assert sorted(p.name for p in folder.iterdir()) == ["poses.csv", "poses.json"]
    assert not capsys.readouterr().err


def test_views_that_stand_farther_out_are_counted(n10, tmp_path, capsys):
    wall = np.array([[[-900, 380, -900], [900, 380, -900], [0, 380, 900]]], float)
    found, table = views(n10, triangles=wall, lowest_elevation_deg=20)
    write_views(tmp_path / "poses", found, table, n10.name)
    assert found.moved_out > 0
    assert f"{found.moved_out} of {len(found.views)} views are moved farther out" in capsys.readouterr().err


@pytest.mark.parametrize("axes", [2, 3])
def test_a_stage_without_a_direction_above_the_horizon_says_so(n10, axes):
    tilt = {"name": "tilt", "direction": [0, 1, 0], "limits_deg": [-30, 30]}
    stage = {**STAGE, "axes": [*STAGE["axes"], tilt][:axes]}
    with pytest.raises(InputError, match="no direction above it"):
        views(n10, subdivisions=0, lowest_elevation_deg=89, up=[1, 2, 3], stage=stage)
