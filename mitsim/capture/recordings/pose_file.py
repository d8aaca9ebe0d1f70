"""Read the pose of a sensor, ``world_from_sensor``, 4 x 4 [mm], from a file.

The file is JSON, as ``pose.json`` of a capture, or a list of rows; or text, four rows of four numbers, as NumPy, MATLAB
and robots write them; or JSON or YAML with a position and a quaternion of known order, such as a pose or a transform of
ROS, which are in metres.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from characterisation.files.checked_files import read_bounded
from characterisation.files.documents import validate
from characterisation.files.errors import InputError
from mitsim.capture.calibration import EXACT, PoseDocument
from mitsim.capture.recordings.cloud_numbers import METRES_UNDER
from mitsim.capture.recordings.json_fields import nearest_rotation, parsed_json
from mitsim.sensor.calibration_numbers import vector
from mitsim.sensor.calibration_qualifiers import OF_FORMAT, UNIT_NAMES, unit_mm
from mitsim.sensor.calibration_quaternions import ORDERED, with_rotations
from mitsim.sensor.transforms import Transform, is_rotation
from mitsim.sensor.yaml_values import read_yaml

_WANTED = (
    "pose.json of a capture; four rows of four numbers: a rigid motion, mm; or a map of position, mm or with its unit, "
    f"and orientation: {ORDERED}"
)

#: largest error of a rotation that was rounded, as by a robot or a text of few decimals; chosen
_ROUNDED = 1e-3

#: messages of ROS in which a pose stands
_MESSAGES = ("pose", "transform")

#: names of a position
_POSITIONS = ("position", "translation")
#: endings of the names of an orientation
_TURNS = ("orientation", "rotation", "quaternion", "xyzw", "wxyz")


def read_pose(file: str | Path) -> Transform:
    """Return the pose of the sensor in the world [mm].

    Raises InputError if the file cannot be read, or contains no rigid motion.
    """
    file = Path(file)
    data = read_bounded(file, "a pose")
    text = data.decode("utf-8-sig", errors="replace").strip()
    lines = [line for whole in text.splitlines() if (line := whole.partition("#")[0]).strip()]
    if text.startswith(("{", "[")):
        table = parsed_json(data, file, _WANTED)
        table = {"world_from_sensor": table} if isinstance(table, list) else table
    elif any(":" in line for line in lines):
        table, *more = read_yaml(file, data, _WANTED)
        if more:
            raise InputError(file, "", f"{1 + len(more)} documents", "one pose")
    else:
        try:
            rows = [[float(word) for word in line.replace(",", " ").replace(";", " ").split()] for line in lines]
        except ValueError:
            rows = []
        if [len(row) for row in rows] != [4, 4, 4, 4]:
            raise InputError(file, "", "another text", _WANTED)
        table = {"world_from_sensor": rows}
    if "world_from_sensor" not in table:
        table = {"world_from_sensor": _rows_of(file, table)}
    if table["world_from_sensor"] is None:
        raise InputError(file, "world_from_sensor", "nothing", _WANTED)
    with suppress(ValueError, TypeError, OverflowError):  # other values are told below
        rows_given = np.array(table["world_from_sensor"], float)
        if rows_given.shape == (4, 4):
            table = table | {"world_from_sensor": with_exact_rotation(rows_given).tolist()}
    pose = validate(file, table, PoseDocument).transform()
    assert pose is not None  # checked above
    return pose


def unit_note(pose: Transform, where: str) -> str:
    """Return a warning about a pose so near to the origin that it is rather in metres; empty without doubt."""
    distance = float(np.linalg.norm(pose.translation))
    if not 0 < distance < METRES_UNDER:
        return ""
    return f"{where}: the sensor is {distance:.3g} mm from the origin: if the matrix is in metres, write it in mm"


def with_exact_rotation(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return rows (4, 4) with the nearest rotation in place of one that was rounded; others as they are."""
    turn = None if is_rotation(rows[:3, :3], EXACT) else nearest_rotation(rows[:3, :3], _ROUNDED)
    if turn is None:
        return rows
    out = rows.copy()
    out[:3, :3] = turn
    return out


def _rows_of(file: Path, table: dict[str, Any]) -> list[list[float]]:
    """Return the rows (4, 4) [mm] of a map with the position and the orientation of the sensor in the world."""
    while (name := next((key for key in _MESSAGES if isinstance(table.get(key), dict)), None)) is not None:
        table = table[name]
    table = with_rotations(table)
    names = [name for name in table if name not in (*UNIT_NAMES, OF_FORMAT)]
    positions = [name for name in names if name in _POSITIONS]
    turns = [name for name in names if name.lower().endswith(_TURNS)]
    T, R = (vector(table[keys[0]]) if len(keys) == 1 else None for keys in (positions, turns))
    if T is None or R is None or len(names) > 2 or len(T) != 3 or len(R) != 9:
        order = " of unknown order or length" if R is not None and len(R) == 4 else ""
        raise InputError(file, "", f"{', '.join(map(str, table))}{order}", _WANTED)
    rows = np.eye(4)
    rows[:3, :3], rows[:3, 3] = R.reshape(3, 3), T * (unit_mm(table, file) or 1.0)
    out: list[list[float]] = rows.tolist()
    return out
