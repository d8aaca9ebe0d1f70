"""Write poses of views to files, for a robot or a stage.

Signal chain: views -> ``poses.csv`` (one row each), ``poses.json`` (matrices, and the definition of every frame),
``stage.csv`` (angles of the axes), ``left_out.csv`` (impossible views, with the reason).

Rotations are given as a matrix, as a unit quaternion x, y, z, w with w >= 0, and as a rotation vector, the axis times
the angle, in degrees.
"""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from characterisation.files.atomic_io import write_folder
from characterisation.words.progress import say
from characterisation.words.version import __version__
from mitsim.sensor.transforms import Transform
from mitsim.views.candidates import Candidates, View
from mitsim.views.table import ViewsTable

#: files of the folder, of which a new set of views replaces all
_FILES = ("poses.csv", "poses.json", "stage.csv", "left_out.csv")

_FRAMES = {
    "part": "the world frame of the scene, as its author chose it",
    "sensor": "x right, y down, z forward; the frame of the sensor's cameras and of its clouds",
}

_STAGE = (
    "origin at the point that the reference camera looks at, z from there to the camera, x along the baseline, "
    "y = z cross x; a positive angle turns anticlockwise about the axis' direction, as seen from its tip"
)


def write_views(folder: str | Path, candidates: Candidates, table: ViewsTable, sensor: str) -> None:
    """Write the poses of all views into a folder, completely or not at all; its other files stay.

    Report on stderr which views were moved or are impossible.

    Parameters
    ----------
    folder, candidates, table, sensor
        Folder to write; the views, and those that were excluded; names the axes of the stage and defines the robot's
        flange; name of the sensor.
    """
    views, left_out = candidates.views, candidates.left_out
    files = {"poses.csv": _poses_csv(views, table), "poses.json": _poses_json(candidates, table, sensor)}
    if table.stage is not None:
        files["stage.csv"] = _stage_csv(views, table)
    if left_out:
        head = ["direction_x", "direction_y", "direction_z", "roll_deg", "standoff_mm", "reason"]
        rows = [[*_written([*out.direction, out.roll_deg, out.standoff]), out.reason] for out in left_out]
        files["left_out.csv"] = _csv(head, rows)
    write_folder(folder, {name: text.encode("utf-8") for name, text in files.items()}, overwrite=_FILES)
    if candidates.moved_out:
        say(f"{candidates.moved_out} of {len(views)} views are moved farther out, clear of the part")
    if left_out:
        whole = len(views) + len(left_out)
        say(f"{len(left_out)} of {whole} views are impossible: {Path(folder) / 'left_out.csv'}")


def part_from_flange(view: View, table: ViewsTable) -> Transform | None:
    """Return the pose of the robot's flange in the part frame; None if the table does not define the flange."""
    if table.flange_from_sensor is None:
        return None
    return view.world_from_sensor @ table.flange_from_sensor.transform().inverse()


def _poses_csv(views: Sequence[View], table: ViewsTable) -> str:
    head = ["view", *(f"direction_{axis}" for axis in "xyz"), "roll_deg", "standoff_mm", *_columns("")]
    head += [] if table.flange_from_sensor is None else _columns("flange_")
    rows = []
    for view in views:
        flange = part_from_flange(view, table)
        numbers = [*view.direction, view.roll_deg, view.standoff, *_numbers(view.world_from_sensor)]
        rows.append([str(view.number), *_written([*numbers, *([] if flange is None else _numbers(flange))])])
    return _csv(head, rows)


def _columns(prefix: str) -> list[str]:
    """Return the column names of a pose in the part frame."""
    position = [f"{prefix}position_{axis}_mm" for axis in "xyz"]
    quaternion = [f"{prefix}quaternion_{axis}" for axis in "xyzw"]
    return position + quaternion + [f"{prefix}rotation_vector_{axis}_deg" for axis in "xyz"]


def _numbers(pose: Transform) -> list[float]:
    turn = Rotation.from_matrix(pose.rotation)
    return [*pose.translation, *turn.as_quat(canonical=True), *np.degrees(turn.as_rotvec())]


def _stage_csv(views: Sequence[View], table: ViewsTable) -> str:
    assert table.stage is not None
    head = ["view", *(f"{axis.name}_deg" for axis in table.stage.axes), "camera_distance_mm"]
    rows = []
    for view in views:
        assert view.stage_angles is not None and view.stage_distance is not None  # views on a stage
        rows.append([str(view.number), *_written([*np.degrees(view.stage_angles), view.stage_distance])])
    return _csv(head, rows)


def _poses_json(candidates: Candidates, table: ViewsTable, sensor: str) -> str:
    frames = dict(_FRAMES)
    if table.flange_from_sensor is not None:
        frames["flange"] = "the robot's flange, as in the hand-eye calibration flange_from_sensor"
    if table.stage is not None:
        frames["stage"] = _STAGE
    document: dict[str, Any] = {
        "schema_version": 1,
        "software": f"mitsim {__version__}",
        "sensor": sensor,
        "units": {"length": "mm", "angle": "deg"},
        "convention": "a_from_b is a homogeneous matrix by rows that takes coordinates in frame b to coordinates in "
        "frame a: p_a = a_from_b p_b, columns. So part_from_sensor is the pose of the sensor in the part frame.",
        "frames": frames,
        "target_mm": candidates.target.tolist(),
    }
    if table.flange_from_sensor is not None:
        document["flange_from_sensor"] = table.flange_from_sensor.transform().matrix().tolist()
    document["views"] = [_view_json(view, table) for view in candidates.views]
    return json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def _view_json(view: View, table: ViewsTable) -> dict[str, Any]:
    out: dict[str, Any] = {
        "view": view.number,
        "direction": view.direction.tolist(),
        "roll_deg": view.roll_deg,
        "standoff_mm": view.standoff,
        "part_from_sensor": view.world_from_sensor.matrix().tolist(),
        "sensor_from_part": view.world_from_sensor.inverse().matrix().tolist(),
    }
    flange = part_from_flange(view, table)
    if flange is not None:
        out["part_from_flange"] = flange.matrix().tolist()
    if table.stage is not None and view.stage_angles is not None:
        degrees = np.degrees(view.stage_angles).tolist()
        out["stage_deg"] = {axis.name: angle for axis, angle in zip(table.stage.axes, degrees, strict=True)}
        out["camera_distance_mm"] = view.stage_distance
    return out


def _written(numbers: Iterable[float]) -> list[str]:
    """Return numbers with nine decimals and without negative zeros; NaN gives an empty text."""
    return ["" if math.isnan(number) else f"{round(float(number), 9) + 0.0:.9f}" for number in numbers]


def _csv(head: list[str], rows: Iterable[list[str]]) -> str:
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(head)
    writer.writerows(rows)
    return out.getvalue()
