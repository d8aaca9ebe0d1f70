"""Replace quaternions in the maps of a file by rotation matrices, if the order of their numbers is known.

Camera matrices of 4 x 4, as of ScanNet, are reduced to 3 x 3.

The order is known of a map of ``x``, ``y``, ``z`` and ``w`` (ROS), with or without a ``q`` before each, and of four
numbers whose name ends in ``xyzw`` or ``wxyz``. Other quaternions remain four numbers, which no reader of rotations
takes.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mitsim.sensor.calibration_numbers import vector
from mitsim.sensor.calibration_qualifiers import OF_FORMAT

#: largest difference of the length of a quaternion from 1: that of three digits
_LENGTH_TOLERANCE = 1e-2

#: how to state the order of a quaternion, for messages
ORDERED = "a unit quaternion as a map of x, y, z and w, or under a name that ends in xyzw or wxyz"


def with_rotations(table: dict[str, Any]) -> dict[str, Any]:
    """Return a map, with quaternions of known order as matrices (3, 3), and maps of x, y, z as arrays, in all depths.

    If both are beside one another as maps, they are a message of ROS: its unit is the metre, unless the map states
    another one.
    """
    out = {name: _plain(str(name), value) for name, value in table.items()}
    of_ros = [
        len(value) for name, value in table.items() if isinstance(value, dict) and not isinstance(out[name], dict)
    ]
    if sorted(of_ros) == [3, 4]:
        out[OF_FORMAT] = "m"
    return out


def _plain(name: str, value: Any) -> Any:
    if (K := _padded(value)) is not None:
        return K
    if isinstance(value, list) and any(isinstance(item, dict) for item in value):
        return [_plain("", item) for item in value]
    if not isinstance(value, dict):
        order = name.lower()[-4:]
        numbers = vector(value, 4) if order in ("xyzw", "wxyz") else None
        return value if numbers is None else _matrix(numbers[[1, 2, 3, 0]] if order == "wxyz" else numbers)
    for names in ("xyz", "xyzw"):
        for before in ("", "q"):
            keys = [before + letter for letter in names]
            numbers = vector([value[key] for key in keys]) if set(keys) == set(value) else None
            if numbers is not None:
                return _matrix(numbers) if len(numbers) == 4 else numbers
    return with_rotations(value)


def _padded(value: Any) -> NDArray[np.float64] | None:
    """Return the camera matrix (3, 3) in the corner of a 4 x 4 matrix; None of anything else."""
    numbers = vector(value, 16) if isinstance(value, list | np.ndarray) and len(value) in (4, 16) else None
    if numbers is None or not min(numbers[[0, 5]]) > 1 or numbers[[3, 7, 8, 9, 11, 12, 13, 14]].any():
        return None
    return numbers.reshape(4, 4)[:3, :3] if (numbers[[10, 15]] == 1).all() else None


def _matrix(quaternion: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotation matrix (3, 3) of x, y, z, w; the four numbers as they are if their length is not 1."""
    if abs(np.linalg.norm(quaternion) - 1) > _LENGTH_TOLERANCE:
        return quaternion
    return np.asarray(Rotation.from_quat(quaternion).as_matrix())
