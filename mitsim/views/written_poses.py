"""Read the poses of views from ``poses.json``, and refuse one that was changed after mitsim wrote it.

The file has every pose in two or three forms: the sensor in the part frame, its inverse, and the robot's flange. They
must belong together, since a robot would move to one of them, and a report shows another.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from characterisation.files.errors import InputError
from mitsim.capture.calibration import EXACT
from mitsim.capture.recordings.pose_file import with_exact_rotation
from mitsim.sensor.calibration_poses import is_motion
from mitsim.sensor.transforms import Transform, is_rotation

#: largest difference [mm, or of a rotation matrix] of two forms of one pose; chosen: far above the rounding of doubles
_SAME = 1e-6


def written_poses(path: Path, table: Mapping[str, Any]) -> dict[int, dict[str, Transform]]:
    """Return ``part_from_sensor`` and, with a hand-eye calibration, ``part_from_flange`` of every view, by its number.

    ``table`` is the content of the ``poses.json`` at ``path``. Raises InputError if an entry cannot be read, a matrix
    is not a rigid motion, or the forms of a pose differ.
    """
    try:
        entries = {int(entry["view"]): dict(entry) for entry in table["views"]}
    except (KeyError, OverflowError, TypeError, ValueError) as error:
        fault = f"entries that cannot be read ({error!r})"
        raise InputError(path, "views", fault, "a list as mitsim run writes it") from None
    flange = table.get("flange_from_sensor")
    sensor_from_flange = None if flange is None else rigid_pose(path, "flange_from_sensor", flange).inverse()
    return {number: _poses_of(path, number, entry, sensor_from_flange) for number, entry in entries.items()}


def rigid_pose(path: Path, key: str, matrix: Any) -> Transform:
    """Return the pose of a 4 x 4 matrix [mm] in a file; raise InputError if it is not a rigid motion."""
    try:
        rows = np.array(matrix, float).reshape(4, 4)
    except (OverflowError, TypeError, ValueError):
        raise InputError(path, key, repr(matrix)[:60], "a 4 x 4 matrix, rows first [mm]") from None
    rows = with_exact_rotation(rows)
    if not is_motion(rows) or not is_rotation(rows[:3, :3], EXACT) or not np.isfinite(rows).all():
        raise InputError(path, key, "a matrix that is not a rigid motion", "a rotation, and a translation in mm")
    return Transform(rows[:3, :3], rows[:3, 3])


def _poses_of(
    path: Path, number: int, entry: dict[str, Any], sensor_from_flange: Transform | None
) -> dict[str, Transform]:
    def written(key: str) -> Transform:
        return rigid_pose(path, f"views.{key} of view {number}", entry.get(key))

    poses = {"part_from_sensor": written("part_from_sensor")}
    if sensor_from_flange is not None:
        poses["part_from_flange"] = written("part_from_flange")
        _check_same(path, number, "part_from_flange", poses, poses["part_from_sensor"] @ sensor_from_flange)
    if "sensor_from_part" in entry:
        inverse = {"sensor_from_part": written("sensor_from_part")}
        _check_same(path, number, "sensor_from_part", inverse, poses["part_from_sensor"].inverse())
    return poses


def _check_same(path: Path, number: int, key: str, poses: Mapping[str, Transform], expected: Transform) -> None:
    """Raise InputError if a form of a pose is not the one that follows from ``part_from_sensor``."""
    difference = np.abs(poses[key].matrix() - expected.matrix())
    if difference.max() > _SAME:
        off = f"{difference[:3, 3].max():.3g} mm and {difference[:3, :3].max():.3g} in its rotation"
        found = f"a pose that is off by {off} from the one that follows from part_from_sensor"
        hint = "run the command again that wrote them; for a pose of your own, give a pose.json"
        raise InputError(path, f"views.{key} of view {number}", found, "poses as mitsim wrote them", hint)
