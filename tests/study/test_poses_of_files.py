"""Poses in files that ``measure`` and ``import`` read, and what of a study's calibration other sensors get."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from mitsim.capture.recordings.pose_file import read_pose as imported_pose
from mitsim.sensor.preset import load_sensor
from mitsim.sensor.preset_covariance import preset_covariance
from mitsim.sensor.rig_covariance import write_rig_covariance
from mitsim.sensor.transforms import Transform
from mitsim.study.choose import read_candidates
from mitsim.study.task_measurement import read_pose
from mitsim.study.virtual.plan import trial_digest
from mitsim.study.virtual.study_unknowns import study_unknowns
from tests.small_study import few_measurements, small_study

POSE = Transform.from_degrees([170, 12, -30], [10, -20, 700])


@pytest.mark.parametrize("decimals", [3, 4, 12])
@pytest.mark.parametrize("name", ["pose.json", "pose.txt"])
def test_a_rounded_pose_is_the_nearest_motion_wherever_it_is_read(tmp_path, decimals, name):
    """With four decimals 300 mm became 299.985 mm, with three the file was refused; ``import`` took both."""
    rows = POSE.matrix().round(decimals)
    text = json.dumps({"world_from_sensor": rows.tolist()}) if name.endswith("json") else ""
    path = tmp_path / name
    path.write_text(text or "\n".join(" ".join(f"{value:g}" for value in row) for row in rows.tolist()))
    pose = read_pose(path)
    np.testing.assert_allclose(pose.matrix(), imported_pose(path).matrix(), atol=1e-12)
    np.testing.assert_allclose(
        pose.rotation @ pose.rotation.T, np.eye(3), atol=3e-6
    )  # a text of six digits is taken as it is


@pytest.mark.parametrize("name", ["pose.json", "pose.txt"])
def test_a_pose_with_the_mark_of_an_editor_of_windows_is_read(tmp_path, name):
    """A byte order mark made the first number "another text"."""
    rows = POSE.matrix().tolist()
    text = "\n".join(" ".join(map(repr, row)) for row in rows) if name.endswith("txt") else json.dumps(rows)
    (tmp_path / name).write_text(text, encoding="utf-8-sig")
    np.testing.assert_allclose(imported_pose(tmp_path / name).matrix(), POSE.matrix(), atol=1e-9)


CALIBRATED = """
[views.flange_from_sensor]
position_mm = [1, 2, 3]
quaternion_xyzw = [0, 0, 0, 1]
[views.sensor_body]
size_mm = [175, 50, 52]
[unknowns.calibration]
covariance = "n10.toml"
"""


@pytest.fixture
def calibrated(tmp_path):
    """A study of an N10 with its own covariance, hand-eye calibration and housing."""
    sensor = load_sensor("ensenso-n10")
    write_rig_covariance(tmp_path / "n10.toml", preset_covariance(sensor), sensor.rig)
    (tmp_path / "task.toml").write_text(few_measurements())
    (tmp_path / "study.toml").write_text(small_study("{ }", task="task.toml") + CALIBRATED)
    return tmp_path


def test_other_sensors_do_not_get_the_calibration_of_the_study_s_own(calibrated):
    """They got its hand-eye calibration and its housing; its covariance ended the whole comparison."""
    (own, other), excluded = read_candidates(calibrated / "study.toml", ["ensenso-n10,photoneo-phoxi-s"])
    assert not excluded
    assert own.study.file.views.flange_from_sensor is not None and own.study.file.views.sensor_body.size_mm is not None
    assert other.study.file.views.flange_from_sensor is None and other.study.file.views.sensor_body.size_mm is None
    assert study_unknowns(other.study).calibration.source != "" and len(study_unknowns(own.study).calibration.names)


def test_trials_of_a_moved_project_are_known(calibrated, tmp_path_factory):
    """The digest had the path of the covariance's file."""
    (own,), _ = read_candidates(calibrated / "study.toml", ["ensenso-n10"])
    unknowns = study_unknowns(own.study)
    moved = unknowns.table.model_copy(
        update={"calibration": unknowns.table.calibration.model_copy(update={"covariance": "/elsewhere/n10.toml"})}
    )
    there = replace(unknowns, table=moved)
    assert trial_digest(own.study, there, "render") == trial_digest(own.study, unknowns, "render")
    fewer = unknowns.calibration
    other = replace(fewer, names=fewer.names[::-1])
    assert trial_digest(own.study, replace(unknowns, calibration=other), "render") != trial_digest(
        own.study, unknowns, "render"
    )
