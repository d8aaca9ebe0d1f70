"""Read the pose of a sensor, ``world_from_sensor``, 4 x 4 [mm], from a file.

The file is JSON, as ``pose.json`` of a capture, optionally with the covariance, or a list of rows; or text, four rows
of four numbers, as NumPy, MATLAB and robots write them.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from characterisation.files.checked_files import read_bounded
from characterisation.files.documents import validate
from characterisation.files.errors import InputError
from mitsim.capture.calibration import PoseDocument
from mitsim.sensor.transforms import Transform

_WANTED = "pose.json of a capture, or four rows of four numbers: a rigid motion, mm"


def read_pose(file: str | Path) -> tuple[Transform, NDArray[np.float64] | None]:
    """Return the pose of the sensor in the world [mm] and its covariance (6, 6), None if the file has none.

    Raises
    ------
    InputError
        If the file cannot be read, or contains no rigid motion.
    """
    file = Path(file)
    text = read_bounded(file, "a pose").decode("utf-8", errors="replace").strip()
    if text.startswith(("{", "[")):
        try:
            table = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise InputError(file, "", f"text that is not JSON ({error})", _WANTED) from None
        table = {"world_from_sensor": table} if isinstance(table, list) else table
    else:
        try:
            rows = [
                [float(word) for word in line.replace(",", " ").replace(";", " ").split()]
                for line in text.splitlines()
                if line.strip() and not line.lstrip().startswith("#")
            ]
        except ValueError:
            rows = []
        if [len(row) for row in rows] != [4, 4, 4, 4]:
            raise InputError(file, "", "another text", _WANTED)
        table = {"world_from_sensor": rows}
    if not isinstance(table, dict) or table.get("world_from_sensor") is None:
        raise InputError(file, "world_from_sensor", "nothing", _WANTED)
    document = validate(file, table, PoseDocument)
    pose = document.transform()
    assert pose is not None  # checked above
    return pose, None if document.covariance is None else np.array(document.covariance)
