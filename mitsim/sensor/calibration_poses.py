"""Find the pose of a camera in the maps of a calibration, and take R and T of a second camera from two poses.

Signal chain: maps -> a rigid motion under one of the names below, or a rotation and a translation -> pose from some
frame to the camera, and the name of that frame -> R and T from the first camera to the second.

A rotation and a translation in the map of each camera take coordinates of one common frame to the camera; ``position``
and ``orientation`` are those of the camera in that frame, as in a pose of ROS. ``T_a_b`` takes coordinates of b to a
(Kalibr, wiki "yaml formats"), wherever it stands. Nine numbers of a rotation are by rows; those of librealsense
(``rs2_extrinsics``) are by columns, and its lengths in metres. Quaternions of a known order are rotation matrices here
(:mod:`mitsim.sensor.calibration_quaternions`).
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mitsim.sensor.calibration_numbers import Composed, dotted, vector
from mitsim.sensor.calibration_qualifiers import OF_FORMAT

#: key of the frame from which a pose leads to its camera, in the table of the pose; without it a common frame, or the
#: first camera
_FRAME = "frame of the pose"

#: the frame of a pose in a chain of Kalibr
_BEFORE = "the camera before"

#: rigid motions, 4 x 4: the unit of length, if known, whether they take coordinates of the camera to the other frame,
#: and that frame; of Kalibr, EuRoC, OKVIS and MC-Calib
MOTIONS = {
    "T_cn_cnm1": ("m", False, _BEFORE),
    "T_cam_imu": ("m", False, "imu"),
    "T_imu_cam": ("m", True, "imu"),
    "T_BS": ("m", True, "body"),
    "T_SC": ("m", True, "sensor"),
    "camera_pose_matrix": ("", True, "group"),
}

#: names of the rotation and the translation from the common frame to the camera, and of those of its pose in that frame
_TO_CAMERA = ("R", "rotation", "rotation_matrix", "quaternion", "rvec"), ("T", "t", "translation", "tvec")
_OF_CAMERA = ("orientation",), ("position",)


def pose_in(maps: Sequence[tuple[str, dict[str, Any]]]) -> dict[str, Composed]:
    """Return ``rotation`` and ``translation``, common frame to camera, from maps by dotted name; empty without any."""
    of_librealsense = any("ppx" in table for _, table in maps)
    for name, table in maps:
        for key, (unit, of_camera, frame) in MOTIONS.items():
            numbers = vector(table.get(key), 16)
            if numbers is not None:
                motion = inverse(numbers.reshape(4, 4)) if of_camera else numbers.reshape(4, 4)
                frame += str(table.get("camera_group", ""))  # MC-Calib poses each group in a frame of its own
                stated = {_FRAME: frame} | ({OF_FORMAT: unit} if unit else {})
                posed = Composed(motion, (dotted(name, key),), stated | table)
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
            if shifts is _OF_CAMERA[1]:
                table = {_FRAME: "world"} | table
            return {
                "rotation": Composed(rotation, (dotted(name, turn),), table),
                "translation": Composed(T, (dotted(name, shift),), table),
            }
    return {}


def named_poses(maps: Iterable[tuple[str, dict[str, Any]]], names: Sequence[str]) -> dict[str, dict[str, Composed]]:
    """Return the poses of cameras by name, as of :func:`pose_in`, that motions ``T_a_b`` in any map state.

    ``names``: the dotted names of the cameras; a or b is the last part of one. One between two cameras comes first.
    """
    cameras = {_alias(name.rpartition(".")[2]): name for name in names}
    out: dict[str, dict[str, Composed]] = {}
    for holder, table in maps:
        for key, value in table.items():
            words = key.split("_")
            numbers = (
                vector(value) if words[0] == "T" and key not in MOTIONS and not {"to", "from"} & {*words} else None
            )
            if numbers is None or len(numbers) not in (12, 16):
                continue
            motion = np.array([*numbers.reshape(-1, 4), (0, 0, 0, 1)])[:4]
            for at in range(2, len(words)):
                ends = [_alias("".join(part)) for part in (words[1:at], words[at:])]
                to, of = (cameras.get(end) for end in ends)
                name = to or of
                if name is None or (name in out and not (to and of)):
                    continue
                frame = (of or ends[1]) if to else ends[0]
                posed = Composed(motion if to else inverse(motion), (dotted(holder, key),), {_FRAME: frame} | table)
                out[name] = {"rotation": posed, "translation": posed}
    return out


def _alias(name: str) -> str:
    """Return the name of a camera in small letters, without underscores: cam1 of camera_1 and c1, left of l."""
    plain = re.sub(r"^c(?=\d)|camera", "cam", name.lower().replace("_", ""))
    return {"l": "left", "r": "right"}.get(plain, plain)


def second_from_first(poses: Mapping[str, Mapping[str, Composed]], first: str, second: str) -> dict[str, Composed]:
    """Return R and T from the first camera to the second under their usual names; empty if the poses do not tell.

    ``poses`` has the values of :func:`pose_in` of all cameras by name, in their order. The second alone may be posed
    from the first, in steps over other cameras (Kalibr) too; poses in a common frame need both.
    """
    (root1, links1), (root2, links2) = _chain(poses, first, second), _chain(poses, second, first)
    if root2 == first:
        links1 = []
    elif root1 == second:
        links2 = []
    elif not links2 or (root1 != root2 and (links1 or root2)):
        return {}
    links = [*links2, *links1]
    for R, T in links:
        if R.value.size == 4 or not is_motion(R.value):  # its reader refuses it
            return {"+R": R, "+T": T}
    if len(links) == 1 and links2:
        return {"+R": links[0][0], "+T": links[0][1]}
    table = links[0][1].table
    if any(T.table.get(OF_FORMAT) != table.get(OF_FORMAT) for _, T in links):
        return {}
    motion = _product(links2) @ inverse(_product(links1))
    rotations, translations = (tuple(source for link in links for source in link[at].sources) for at in (0, 1))
    return {
        "+R": Composed(motion[:3, :3], rotations, table),
        "+T": Composed(motion[:3, 3], translations, table),
    }


def _chain(
    poses: Mapping[str, Mapping[str, Composed]], name: str, until: str
) -> tuple[str, list[tuple[Composed, Composed]]]:
    """Return the frame to which the poses of a camera lead back, at the latest ``until``, and these, its own first."""
    links: list[tuple[Composed, Composed]] = []
    names = list(poses)
    while name != until and {"rotation", "translation"} <= set(poses.get(name, {})) and len(links) < len(names):
        links.append((poses[name]["rotation"], poses[name]["translation"]))
        frame = links[-1][0].table.get(_FRAME, "")
        name = frame if frame != _BEFORE else (["", *names])[names.index(name)]
    return name, links


def _product(links: Sequence[tuple[Composed, Composed]]) -> NDArray[np.float64]:
    """Return the motion (4, 4) of poses one after the other; the unit matrix of none."""
    out = np.eye(4)
    for R, T in links:
        step = np.eye(4)
        step[:3, :3] = Rotation.from_rotvec(R.value).as_matrix() if R.value.size == 3 else R.value[:3, :3]
        step[:3, 3] = T.value[:3, 3] if T.value.ndim == 2 else T.value
        out = out @ step
    return out


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
