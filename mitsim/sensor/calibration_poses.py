"""Find the pose of a camera in the maps of a calibration, and take R and T of a second camera from two poses.

Signal chain: maps -> a rigid motion under one of the names below, or a rotation and a translation -> pose from the
common frame to the camera -> R and T from the first camera to the second.

A rotation and a translation in the map of each camera take coordinates of one common frame to the camera; ``position``
and ``orientation`` are those of the camera in that frame, as in a pose of ROS. Nine numbers of a rotation are by rows;
those of librealsense (``rs2_extrinsics``) are by columns, and its lengths in metres. Quaternions of a known order are
rotation matrices here (:mod:`mitsim.sensor.calibration_quaternions`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mitsim.sensor.calibration_numbers import Composed, dotted, vector
from mitsim.sensor.calibration_qualifiers import OF_FORMAT

#: name of Kalibr for the motion from the camera before
_STEP = "T_cn_cnm1"

#: rigid motions, 4 x 4: the unit of length, if known, and whether they take coordinates of the camera to the common
#: frame; of Kalibr, EuRoC, OKVIS and MC-Calib
_MOTIONS = {
    _STEP: ("m", False),
    "T_cam_imu": ("m", False),
    "T_imu_cam": ("m", True),
    "T_BS": ("m", True),
    "T_SC": ("m", True),
    "camera_pose_matrix": ("", True),
}

#: names of the rotation and the translation from the common frame to the camera, and of those of its pose in that frame
_TO_CAMERA = ("R", "rotation", "rotation_matrix", "quaternion"), ("T", "t", "translation")
_OF_CAMERA = ("orientation",), ("position",)


def pose_in(maps: Sequence[tuple[str, dict[str, Any]]]) -> dict[str, Composed]:
    """Return ``rotation`` and ``translation``, common frame to camera, from maps by dotted name; empty without any."""
    of_librealsense = any("ppx" in table for _, table in maps)
    for name, table in maps:
        for key, (unit, of_camera) in _MOTIONS.items():
            numbers = vector(table.get(key), 16)
            if numbers is not None:
                motion = inverse(numbers.reshape(4, 4)) if of_camera else numbers.reshape(4, 4)
                posed = Composed(motion, (dotted(name, key),), ({OF_FORMAT: unit} if unit else {}) | table)
                return {"rotation": posed, "translation": posed}
        for turns, shifts in (_TO_CAMERA, _OF_CAMERA) if name else ():
            ordered = [spelling for spelling in table if spelling.lower().endswith(("xyzw", "wxyz"))]
            turn = next((spelling for spelling in (*turns, *ordered) if spelling in table), "")
            shift = next((spelling for spelling in shifts if spelling in table), "")
            R, T = vector(table.get(turn)), vector(table.get(shift), 3)
            if T is None or R is None or len(R) not in (3, 4, 9):
                continue
            rotation = R.reshape(3, 3) if len(R) == 9 else R
            if of_librealsense and len(R) == 9 and np.ndim(table[turn]) == 1:
                rotation, table = rotation.T, {OF_FORMAT: "m"} | table
            if shifts is _OF_CAMERA[1] and len(R) != 4:
                rotation = Rotation.from_rotvec(R).as_matrix() if len(R) == 3 else rotation
                rotation, T = rotation.T, -rotation.T @ T
            return {
                "rotation": Composed(rotation, (dotted(name, turn),), table),
                "translation": Composed(T, (dotted(name, shift),), table),
            }
    return {}


def second_from_first(first: Mapping[str, Composed], second: Mapping[str, Composed]) -> dict[str, Composed]:
    """Return R and T from the first camera to the second under their usual names; empty if the poses do not tell.

    ``first`` and ``second`` have the values of :func:`pose_in`. The second alone may be posed from the first; poses in
    a common frame need both. MC-Calib poses each group of cameras in a frame of its own.
    """
    (R1, T1), (R2, T2) = ((eye.get("rotation"), eye.get("translation")) for eye in (first, second))
    if R2 is None or T2 is None:
        return {}
    stated = R2.sources[-1].rpartition(".")[2]
    if stated == _STEP or ((R1 is None or T1 is None) and stated not in (*_MOTIONS, *_OF_CAMERA[0])):
        return {"+R": R2, "+T": T2}
    if R1 is None or T1 is None or R1.table.get("camera_group") != R2.table.get("camera_group"):
        return {}
    for R in (R1, R2):
        if R.value.size == 4 or not is_motion(R.value):  # its reader refuses it
            return {"+R": R, "+T": T2}
    turn = _turn(R2) @ _turn(R1).T
    return {
        "+R": Composed(turn, (*R1.sources, *R2.sources), R2.table),
        "+T": Composed(_shift(T2) - turn @ _shift(T1), (*T1.sources, *T2.sources), T2.table),
    }


def is_motion(values: NDArray[np.float64]) -> bool:
    """Return whether a matrix, if it is 4 x 4, has the last row of a rigid motion that acts on columns."""
    return values.shape != (4, 4) or bool(np.abs(values[3] - (0, 0, 0, 1)).max() < 1e-9)


def inverse(motion: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the inverse of a rigid motion (4, 4); a matrix with another last row as it is, to be refused."""
    out = motion.copy()
    if is_motion(motion):
        out[:3, :3] = motion[:3, :3].T
        out[:3, 3] = -motion[:3, :3].T @ motion[:3, 3]
    return out


def _turn(rotation: Composed) -> NDArray[np.float64]:
    values = rotation.value
    return np.asarray(Rotation.from_rotvec(values).as_matrix()) if values.size == 3 else values[:3, :3]


def _shift(translation: Composed) -> NDArray[np.float64]:
    return translation.value[:3, 3] if translation.value.ndim == 2 else translation.value
