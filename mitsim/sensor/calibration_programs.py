"""Compose the usual values of a calibration from those that other programs than OpenCV store.

Signal chain: names and values of one file -> values in OpenCV's form under names that begin with a plus, each with its
sources and the table that qualifies it (:mod:`mitsim.sensor.calibration_qualifiers`).

- Camera calibration toolbox of MATLAB (Bouguet; ``Calib_Results.mat``, ``Calib_Results_stereo.mat``): K is composed of
  ``fc``, ``cc`` and ``alpha_c``, ``kc`` is in OpenCV's order, ``om`` is a rotation vector, and pixels count from 0.
- Computer Vision Toolbox of MATLAB: a structure made by ``toStruct``. Pixels count from 1, and sizes are (rows,
  columns). ``IntrinsicMatrix``, ``RotationOfCamera2`` and ``TranslationOfCamera2`` act on row vectors, so the matrices
  are transposed; ``K`` and ``PoseCamera2`` (R2022b and later) act on column vectors.
- Settings of ORB-SLAM3: ``Stereo.T_c1_c2`` takes coordinates of the second camera to the first. Older ones, and those
  of ORB-SLAM2, call it ``Tlr``, or state ``Camera.bf``, focal length times baseline of rectified images; ``LEFT.K`` and
  so on are the cameras before rectification, as in ROS.
- Kalibr, librealsense and others, whose values stand in maps: :mod:`mitsim.sensor.calibration_eyes`.
- ROS: a message ``sensor_msgs/CameraInfo`` has the values of a calibration file as flat lists, under one letter each.
"""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mitsim.sensor.calibration_eyes import CalibratedEye, eyes_of, paths_of, usual_values
from mitsim.sensor.calibration_lenses import lens_in
from mitsim.sensor.calibration_names import USUAL_NAMES
from mitsim.sensor.calibration_numbers import Composed, dotted, vector
from mitsim.sensor.calibration_poses import inverse, pose_in
from mitsim.sensor.calibration_qualifiers import OF_FORMAT, rectified_pair
from mitsim.sensor.calibration_quaternions import with_rotations
from mitsim.sensor.lens_models import is_fisheye

#: endings of names in MATLAB's toolbox and similar programs: one camera, the cameras of a pair, camera and projector
_ENDINGS = ("", "_left", "_right", "_cam", "_proj", "_camera", "_projector")

#: names of the distortion of a camera or projector
_DISTORTIONS = [name for names in USUAL_NAMES["distortion"] for name in names if "+" not in name]

#: names of maps with the pose of the second camera from the first, or of the projector from the camera
_BETWEEN = re.compile(r"stereo\w*|extrinsics?|extrinsic_parameters", re.IGNORECASE)

#: number of maps around a structure of MATLAB, beyond the first, that are searched; chosen
_DEEPEST = 3

#: fields of a message of ROS, their shapes, and the names in a calibration file of ROS
_MESSAGE = {
    "k": ((3, 3), "camera_matrix"),
    "d": ((-1,), "distortion_coefficients"),
    "r": ((3, 3), "rectification_matrix"),
    "p": ((3, 4), "projection_matrix"),
}


def with_usual_names(tree: dict[str, Any]) -> dict[str, Any]:
    """Return the tree of one file, with composed values under names that begin with a plus."""
    tree = _of_old_orb_slam(_of_camodocal(with_rotations(tree)))
    out = _of_message(_with_lenses(tree))
    eyes = eyes_of(out)
    out |= usual_values(eyes) | _bouguet(out)
    out = _between(out, eyes) | out | _orb_slam(out)
    if "+D1" not in out and (lens := _lens_beside_matrix(tree)) is not None:
        out["+D1"] = lens
    return out | _toolbox(tree, out)


def _between(tree: dict[str, Any], eyes: list[CalibratedEye]) -> dict[str, Any]:
    """Return R and T of two eyes of one file from a map of their own, or from vectors beside the matrices.

    A file of one eye may have the pose of a board under these names.
    """
    others = {name for names in USUAL_NAMES["matrix"][1:] for name in names}
    if len(eyes) < 2 and not others & set(tree):
        return {}
    own = tuple(f"{eye.name}." for eye in eyes if eye.name)
    for *_, (name, table) in paths_of(tree):
        if name.startswith(own) or not _BETWEEN.fullmatch(name.rpartition(".")[2]):
            continue
        if pose := pose_in([(name, table)]):
            return {"+R": pose["rotation"], "+T": pose["translation"]}
    turn, shift = vector(tree.get("rvec"), 3), vector(tree.get("tvec"), 3)
    if turn is None or shift is None:
        return {}
    return {"+R": Composed(turn, ("rvec",), tree), "+T": Composed(shift, ("tvec",), tree)}


def _with_lenses(tree: dict[str, Any]) -> dict[str, Any]:
    """Return the tree; coefficients in a map under a usual name, such as ``distortion``, are a list.

    Eight with k4 may be those of a fisheye lens, which only their names tell: such a map stays.
    """
    fisheye = is_fisheye(tree)
    lenses = {name: lens_in([("", tree[name])], fisheye) for name in _DISTORTIONS if isinstance(tree.get(name), dict)}
    return tree | {name: lens.value for name, lens in lenses.items() if lens is not None and len(lens.value) != 8}


def _lens_beside_matrix(tree: dict[str, Any]) -> Composed | None:
    """Return the distortion that stands in single numbers or two lists, in no map, beside a matrix."""
    if not any(vector(tree.get(name), 9) is not None for name in USUAL_NAMES["matrix"][0]):
        return None
    lens = lens_in([("", tree)], is_fisheye(tree))
    return lens if lens is not None and len(lens.sources) > 1 else None


def _toolbox(tree: dict[str, Any], out: dict[str, Any]) -> dict[str, Any]:
    """Return the values of the Computer Vision Toolbox: of the pair, or else of the camera, that a file has.

    Those of several cameras are found by the name of their structure alone. ``out`` loses a K whose pixels count from
    1, and a size of rows and columns, which are none of OpenCV's.
    """
    pairs: list[dict[str, Any]] = []
    cameras: dict[str, dict[str, Any]] = {}
    maps: list[tuple[str, dict[str, Any]]] = [("", tree)]
    for name, holder in maps:  # which grows
        if isinstance(holder.get("CameraParameters1"), dict):
            pairs.append(_toolbox_pair(holder, name))
        elif values := _toolbox_camera(holder, name, "1", {}):
            cameras[name] = values
            continue
        if name.count(".") < _DEEPEST:
            maps += [(dotted(name, key), value) for key, value in holder.items() if isinstance(value, dict)]
    if "" in cameras:
        for name in ("K", "ImageSize"):
            out.pop(name, None)
    quantities = {"+K1": "matrix", "+D1": "distortion", "+size": "size"}
    named = {
        f"+{quantities[key]} of {name}": value
        for name, values in cameras.items()
        for key, value in values.items()
        if name
    }
    alone = pairs or list(cameras.values())
    return named | (alone[0] if len(alone) == 1 else {})


def _of_message(tree: dict[str, Any]) -> dict[str, Any]:
    """Return the tree; the fields of a message of ROS are renamed, since its R is no rotation between two cameras."""
    letters = {name.lower(): name for name in tree if name.lower() in _MESSAGE}
    if not {"k", "d", "p"} <= set(letters) or not {"width", "height", "distortion_model"} <= set(tree):
        return dict(tree)
    out = {name: value for name, value in tree.items() if name not in letters.values()}
    for letter, name in letters.items():
        shape, usual = _MESSAGE[letter]
        numbers = vector(tree[name], None if letter == "d" else math.prod(shape))
        out[usual] = tree[name] if numbers is None else numbers.reshape(shape)
    return out | {"image_width": tree["width"], "image_height": tree["height"]}


def _of_camodocal(tree: dict[str, Any]) -> dict[str, Any]:
    """Return the tree; an equidistant lens of camodocal (VINS) counts its coefficients from k2."""
    names = {"mu": "fx", "mv": "fy", "u0": "cx", "v0": "cy", "k2": "k1", "k3": "k2", "k4": "k3", "k5": "k4"}
    inner = tree.get("projection_parameters")
    if not isinstance(inner, dict) or not set(names) <= set(inner):
        return tree
    return tree | {"projection_parameters": {names.get(name, name): value for name, value in inner.items()}}


def _of_old_orb_slam(tree: dict[str, Any]) -> dict[str, Any]:
    """Return the tree; cameras before rectification replace the rectified one, and the first of two gets its number."""
    sides = [
        {"rectification_matrix": tree.get(f"{side}.R"), "projection_matrix": tree.get(f"{side}.P")}
        for side in ("LEFT", "RIGHT")
    ]
    pair = rectified_pair(sides[0], sides[1]) if {"LEFT.K", "RIGHT.K"} <= set(tree) else None
    if pair is not None:
        sources = ("LEFT.R", "LEFT.P", "RIGHT.R", "RIGHT.P")
        rotation, translation = (Composed(value, sources, {OF_FORMAT: "m"}) for value in pair)
        kept = {name: value for name, value in tree.items() if not name.startswith("Camera.")}
        return kept | {"+R": rotation, "+T": translation}
    if "Tlr" in tree:
        return {re.sub(r"^Camera\.(?=f[xy]$|c[xy]$|[kp]\d$)", "Camera1.", name): value for name, value in tree.items()}
    return tree


def _orb_slam(tree: dict[str, Any]) -> dict[str, Any]:
    """Return the values that settings of ORB-SLAM3 state once for two cameras [m]; a rectified pair has one matrix."""
    metres = {OF_FORMAT: "m"}
    for name in ("Stereo.T_c1_c2", "Tlr"):
        step = vector(tree.get(name))
        if step is not None and len(step) in (12, 16):
            posed = Composed(inverse(np.array([*step.reshape(-1, 4), (0, 0, 0, 1)])[:4]), (name,), metres)
            return {"+R": posed, "+T": posed}
    baseline, bf = vector(tree.get("Stereo.b"), 1), vector(tree.get("Camera.bf"), 1)
    is_rectified, source = str(tree.get("Camera.type")).lower() == "rectified", "Stereo.b"
    if bf is not None and not is_rectified and "+K" in tree and "DepthMapFactor" not in tree:  # not of a depth camera
        baseline, is_rectified, source = bf / tree["+K"].value[0, 0], True, "Camera.bf"
    if not is_rectified or baseline is None or "+K" not in tree:
        return {}
    out = {"+K2": tree["+K"], "+T": Composed(np.array([-baseline[0], 0, 0]), (source,), metres)}
    out |= {"+D2": tree["+D1"]} if "+D1" in tree else {}
    return out | {"+R": Composed(np.eye(3), (source,), metres)}


def _bouguet(tree: dict[str, Any]) -> dict[str, Any]:
    out: dict[str, Any] = {}
    for ending in _ENDINGS:
        fc, cc = (vector(tree.get(f"{name}{ending}"), 2) for name in ("fc", "cc"))
        if fc is None or cc is None:
            continue
        alpha = np.ravel(tree.get(f"alpha_c{ending}", 0.0))
        skew = float(alpha[0]) * fc[0] if alpha.size == 1 and alpha.dtype.kind in "fiu" else math.nan
        sources = tuple(f"{part}{ending}" for part in ("fc", "cc", "alpha_c", "KK"))
        out[f"+K{ending}"] = Composed(np.array([[fc[0], skew, cc[0]], [0, fc[1], cc[1]], [0, 0, 1]]), sources, tree)
    width, height = (vector(tree.get(name), 1) for name in ("nx", "ny"))
    if width is not None and height is not None:
        out["+size"] = Composed(np.concatenate([width, height]), ("nx", "ny"), tree)
    return out


def _toolbox_pair(pair: dict[str, Any], name: str) -> dict[str, Any]:
    """Return the values of a stereo structure of the Computer Vision Toolbox."""
    out: dict[str, Any] = {}
    cameras = [pair.get(f"CameraParameters{number}") for number in "12"]
    stated = [part.get("WorldUnits") for part in (*cameras, pair) if isinstance(part, dict)]
    units = next(({"unit": unit} for unit in stated if isinstance(unit, str) and unit), {})
    for number, camera in zip("12", cameras, strict=True):
        if isinstance(camera, dict):
            out |= _toolbox_camera(camera, dotted(name, f"CameraParameters{number}"), number, units)
    motion, sources = _toolbox_pose(pair)
    if motion is not None:
        names = tuple(dotted(name, source) for source in sources)
        out |= {"+R": Composed(motion[0], names, units), "+T": Composed(motion[1], names, units)}
    return out


def _toolbox_pose(
    pair: dict[str, Any],
) -> tuple[tuple[NDArray[np.float64], NDArray[np.float64]] | None, tuple[str, ...]]:
    """Return R and T from the first to the second camera, and the names of their sources; None without a pose."""
    pose = pair.get("PoseCamera2")
    if isinstance(pose, dict):
        turn, shift = vector(pose.get("R"), 9), vector(pose.get("Translation"), 3)
        if turn is not None and shift is not None:
            return (turn.reshape(3, 3), shift), ("PoseCamera2",)
        pose = pose.get("A")
    motion = vector(pose, 16)
    if motion is not None:
        return (motion.reshape(4, 4)[:3, :3], motion.reshape(4, 4)[:3, 3]), ("PoseCamera2",)
    names = "RotationOfCamera2", "TranslationOfCamera2"
    turn, shift = vector(pair.get(names[0]), 9), vector(pair.get(names[1]), 3)
    return (None if turn is None or shift is None else (turn.reshape(3, 3).T, shift)), names


def _toolbox_camera(camera: dict[str, Any], name: str, number: str, units: dict[str, Any]) -> dict[str, Any]:
    """Return the values of one camera of the Computer Vision Toolbox; empty if the table is no such camera."""
    inner = camera.get("Intrinsics")
    camera = camera | inner if isinstance(inner, dict) else camera
    radial, tangential = (vector(camera.get(f"{kind}Distortion")) for kind in ("Radial", "Tangential"))
    if radial is None or not 2 <= len(radial) <= 3:
        return {}
    columns, rows = vector(camera.get("K"), 9), vector(camera.get("IntrinsicMatrix"), 9)
    focal, centre = (vector(camera.get(part), 2) for part in ("FocalLength", "PrincipalPoint"))
    if columns is not None:
        K = columns.reshape(3, 3)
    elif rows is not None:
        K = rows.reshape(3, 3).T
    elif focal is not None and centre is not None:
        skew = vector(camera.get("Skew", 0.0), 1)
        aslant = math.nan if skew is None else skew[0]
        K = np.array([[focal[0], aslant, centre[0]], [0, focal[1], centre[1]], [0, 0, 1]])
    else:
        return {}
    straight = np.zeros(2) if tangential is None or len(tangential) != 2 else tangential
    bent = np.concatenate([radial[:2], straight, radial[2:], np.zeros(3 - len(radial))])
    matrix = K - [[0, 0, 1], [0, 0, 1], [0, 0, 0]]
    sources = (name,) if name else tuple(camera)
    out = {f"+K{number}": Composed(matrix, sources, units), f"+D{number}": Composed(bent, sources, units)}
    size = vector(camera.get("ImageSize"), 2)
    if size is not None:
        out["+size2" if number == "2" else "+size"] = Composed(size[::-1], sources, units)
    return out
