"""Read the geometry of cameras and projector from calibrations of OpenCV and other programs.

Signal chain: one or several files -> value of a name (:mod:`mitsim.sensor.calibration_tree`) -> K, distortion, size, R
and T of each camera and of the projector -> the tables ``[cameras.NAME]`` and ``[projector]`` of a sensor file.

R and T are those of ``cv2.stereoCalibrate``: a point X in the frame of the first camera is R X + T in the frame of the
other eye (camera or projector). The other eye's pose in the sensor frame is therefore R^T, -R^T T. R may be a rotation
vector. Numbers may be matrices of OpenCV or plain lists. A pair of ROS has neither: they follow from the rectifications
of the two cameras. Values that qualify these numbers are those of :mod:`mitsim.sensor.calibration_qualifiers`.
"""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from characterisation.files.documents import Document, validate
from characterisation.files.errors import InputError, nearest
from mitsim.sensor.calibration_doubts import board_unit_note, check_unit, facing_note, matrix_notes, unnamed_lens
from mitsim.sensor.calibration_eyes import size_of
from mitsim.sensor.calibration_formats import beside
from mitsim.sensor.calibration_lenses import in_opencvs_order, lens_in
from mitsim.sensor.calibration_names import USUAL_NAMES, Names
from mitsim.sensor.calibration_numbers import by_rows, checked_matrix, numbers_of, rotation_matrix, skew_beside
from mitsim.sensor.calibration_poses import is_motion
from mitsim.sensor.calibration_qualifiers import OF_FORMAT, of_images, read_out_of, rectified_pair, unit_mm
from mitsim.sensor.calibration_quaternions import ORDERED
from mitsim.sensor.calibration_table import CalibrationTable, EyeKeys
from mitsim.sensor.calibration_tree import CalibrationTree, Found, read_tree
from mitsim.sensor.camera import Camera
from mitsim.sensor.lens_models import is_fisheye, lens_model, of_single_numbers


def with_calibration(
    path: Path, table: dict[str, Any], size: tuple[int, int] | None = None, tree: CalibrationTree | None = None
) -> tuple[dict[str, Any], list[str]]:
    """Return a sensor file's table completed with the optics of its ``[calibration]`` files, and warnings.

    Keys that the sensor file itself gives for a camera or the projector, such as its width, take precedence. The
    warnings name values that look like optics and were not read, and what was made of a part of the imager. Raises
    InputError if a file cannot be read, or values are missing or invalid; the error names the file and the keys.

    Parameters
    ----------
    path
        Path of the sensor file.
    table
        Its content.
    size
        (width, height) [px] of the cameras' images, if known; cameras without a size get it.
    tree
        Values of the files, if they have been read.
    """
    if "calibration" not in table:
        return _sized(table, size), []
    calibration_table = validate(path, {"calibration": table["calibration"]}, _Calibrated).calibration
    eyes = [*calibration_table.cameras, *(["projector"] if calibration_table.projector else [])]
    for name in calibration_table.keys:
        if name not in eyes:
            raise InputError(path, f"calibration.keys.{name}", "an unknown name", ", ".join(eyes), nearest(name, eyes))
    named = [calibration_table.file] if isinstance(calibration_table.file, str) else calibration_table.file
    for name, keys in calibration_table.keys.items():
        if keys.file is not None and keys.file not in named:
            raise InputError(path, f"calibration.keys.{name}.file", repr(keys.file), " | ".join(named))
    files = [path.parent / name for name in named]
    absent = [name for name, file in zip(named, files, strict=True) if not file.exists()]
    if tree is None and absent:
        file, hint = path.parent / absent[0], "or copy this file beside your calibration, and write its name in it"
        near = beside(file)
        hint = f"{near}; {hint}" if near else hint.removeprefix("or ")
        raise InputError(file, "", "no such file", f"the calibration that {path.name} names", hint)
    own = size_of(_own(table, "cameras", calibration_table.cameras[0]))
    tree = tree or read_tree(files, size or (None if own is None else (int(own[0]), int(own[1]))))
    values = _Values(tree, _with_files_of_ros(calibration_table, named, tree), size)
    out = dict(table)
    out["cameras"] = {}
    for index, name in enumerate(calibration_table.cameras):
        sensor_keys = _own(table, "cameras", name)
        out["cameras"][name] = _eye(values, name, min(index, 1), sensor_keys) | sensor_keys
    if calibration_table.projector:
        sensor_keys = _own(table, "projector")
        out["projector"] = _eye(values, "projector", 2, sensor_keys) | sensor_keys
    if values.missing:
        raise values.all_missing()
    straight = [
        name
        for name in eyes
        if not (out["projector"] if name == "projector" else out["cameras"][name]).get("distortion")
    ]
    return _sized(out, size), [*values.notes, *_notes(values.tree, straight)]


def _sized(table: dict[str, Any], size: tuple[int, int] | None) -> dict[str, Any]:
    """Return the table with an image size for cameras that have none."""
    cameras = table.get("cameras")
    if size is None or not isinstance(cameras, dict):
        return table
    width_height = {"width": size[0], "height": size[1]}
    sized = {name: width_height | camera if isinstance(camera, dict) else camera for name, camera in cameras.items()}
    return table | {"cameras": sized}


def has_pair(tree: CalibrationTree) -> bool:
    """Return whether calibration files have matrices of two cameras, and the pose of the second.

    Raises InputError if the files contradict one another.
    """
    return all(
        any(tree.find(key) for key in USUAL_NAMES[quantity][1]) for quantity in ("matrix", "rotation", "translation")
    )


def _with_files_of_ros(
    calibration_table: CalibrationTable, named: list[str], tree: CalibrationTree
) -> CalibrationTable:
    """Return the table; files of one camera each, as of ROS, are given to the cameras in their order."""
    cameras = calibration_table.cameras
    alone = [{"camera_matrix", "projection_matrix"} <= set(values) or "+K" in values for values in tree.values]
    if calibration_table.keys or not len(cameras) == len(named) == len(alone) == 2 or not all(alone):
        return calibration_table
    keys = {name: EyeKeys(file=file) for name, file in zip(cameras, named, strict=True)}
    return calibration_table.model_copy(update={"keys": keys})


def _notes(tree: CalibrationTree, straight: list[str]) -> list[str]:
    """Return the warnings about a calibration: the values that were not read."""
    unread = tree.unread()
    if not unread:
        return []
    without = f"; {' and '.join(straight)} without distortion" if straight else ""
    files = ", ".join(dict.fromkeys(file.name for file in tree.files))
    return [
        f"calibration {files}: values not read: {', '.join(unread)}{without}. "
        "If it belongs to the rig, name it in [calibration.keys.NAME] of the sensor file"
    ]


class _Calibrated(Document):
    calibration: CalibrationTable


def _own(table: dict[str, Any], *names: str) -> dict[str, Any]:
    """Return a table of the sensor file itself; empty if there is none."""
    inner: Any = table
    for name in names:
        inner = inner.get(name, {}) if isinstance(inner, dict) else {}
    return inner if isinstance(inner, dict) else {}


class _Values:
    """Values of a calibration by request; missing values are collected and reported together.

    ``matrices`` and ``tables`` that qualify them, by eye; ``size`` of the images, if known; ``by_columns``: whether a
    matrix is written so.
    """

    def __init__(
        self, tree: CalibrationTree, calibration_table: CalibrationTable, size: tuple[int, int] | None
    ) -> None:
        self.tree, self.calibration_table, self.size = tree, calibration_table, size
        self.missing: list[tuple[str, str, Names]] = []
        self.matrices: list[Found | None] = []
        self.tables: list[dict[str, Any]] = []
        self.notes: list[str] = []
        self.by_columns = False

    def find(
        self, name: str, index: int, quantity: str, shapes: tuple[tuple[int, ...], ...], needed: bool = True
    ) -> Found | None:
        """Return one value of an eye as an array of one of the shapes; None if it is missing."""
        keys = self.calibration_table.keys.get(name, EyeKeys())
        stated_name = getattr(keys, quantity)
        names = (stated_name,) if stated_name else USUAL_NAMES[quantity][index]
        posed = None
        if quantity in ("rotation", "translation") and not stated_name:
            chosen = any(each.matrix for each in self.calibration_table.keys.values())
            posed = self.tree.relative(self.matrices[0], self.matrices[-1]) if chosen else None
        if posed is not None:
            names = tuple(key for key in names if "+" not in key)
        elif keys.matrix and (quantity == "matrix" or not stated_name):
            names = (
                *(f"+{quantity} of {map_name}" for map_name in (keys.matrix, keys.matrix.rpartition(".")[0])),
                *names,
            )
        if keys.file and quantity in ("matrix", "distortion", "size"):
            # a file of one eye uses the names of a single camera
            names = tuple(
                f"{keys.file}:{key}" for key in ((stated_name,) if stated_name else names + USUAL_NAMES[quantity][0])
            )
        elif index == 2 and len(self.calibration_table.cameras) == 2 and not stated_name:
            # R and T are those of the second camera
            names = tuple(key for key in names if key not in USUAL_NAMES[quantity][1])
        for key in ("", *names):
            match = self.tree.find(key) if key else (posed or {}).get(quantity)
            if match is not None and quantity == "distortion" and isinstance(match.value, dict):
                lens = lens_in([(match.name, match.value)], self._is_fisheye(match.table))
                match = None if lens is None else replace(match, value=lens.value, name=", ".join(lens.sources))
            if match is not None and (key == stated_name or quantity == "size" or not isinstance(match.value, dict)):
                value = size_of(match.value) if quantity == "size" and isinstance(match.value, dict) else match.value
                if quantity == "distortion":
                    fisheye = self._is_fisheye(match.table)
                    if "," in match.name:
                        value = of_single_numbers(value, match.name, fisheye, match.file)
                    else:
                        value = in_opencvs_order(value, match.table, fisheye, match.file)
                return replace(match, value=numbers_of(value, match.file, match.name, shapes))
        if needed or stated_name:
            self.missing.append((name, quantity, names))
        return None

    def _is_fisheye(self, table: dict[str, Any]) -> bool:
        """Return whether the sensor file, or the table of a lens or that of its matrix, states a fisheye lens."""
        around = self.tables[-1] if self.tables else {}
        return self.calibration_table.model == "fisheye" or is_fisheye(around | table)

    def all_missing(self) -> InputError:
        """Return one error that names all missing values."""
        files = ", ".join(dict.fromkeys(str(file) for file in self.tree.files))
        missing = "; ".join(_some([key for key in names if "+" not in key]) for _, _, names in self.missing)
        allowed = ", ".join(f"the {quantity} of {name}" for name, quantity, _ in self.missing)
        keys = "; ".join(f"in [calibration.keys.{name}], as {quantity}" for name, quantity, _ in self.missing)
        candidates = ", ".join(self.tree.names()[:20])
        return InputError(files, missing, "nothing", allowed, f"the file has {candidates}: give the name to use {keys}")


def _some(names: list[str]) -> str:
    """Return the first of many names, for a message."""
    return " or ".join([*names[:4], *(["another usual name"] if len(names) > 4 else [])])


def _eye(values: _Values, name: str, index: int, sensor_keys: dict[str, Any]) -> dict[str, Any]:
    """Return the keys of an ``OpticsTable``; ``index`` 0 is the first camera, 1 the second, 2 the projector.

    Keys in ``sensor_keys``, of the sensor file, may be missing in the calibration.
    """
    calibration_table, file = values.calibration_table, ", ".join(dict.fromkeys(map(str, values.tree.files)))
    matrices = ((3, 3), (9,), (4,), (4, 1), (1, 4))
    matrix = values.find(name, index, "matrix", matrices, needed="focal_px" not in sensor_keys)
    table = {} if matrix is None else matrix.table
    values.matrices.append(matrix)
    values.tables.append(table)
    match = values.find(name, index, "distortion", ((0,), (4,), (5,), (8,), (12,), (14,)), needed=False)
    distortion = np.empty(0) if match is None else match.value
    model = None
    if index < 2:
        stating = file if matrix is None else matrix.file
        model = lens_model(table, stating, calibration_table.model, not distortion.any()) or calibration_table.model
    unnamed, model = match is not None and index < 2 and model is None, model or "perspective"
    if model == "fisheye" and not distortion[4:].any():
        distortion = distortion[:4]  # librealsense has five numbers of any lens
    if model == "fisheye" and len(distortion) not in (0, 4):
        raise InputError(file, f"distortion of {name}", f"{len(distortion)} numbers", "4, as of a fisheye lens")
    size = _size(values, name, index, table)
    out: dict[str, Any] = {"model": model, "distortion": distortion.tolist()}
    if matrix is not None:
        K, by_columns = by_rows(matrix.value)
        K = checked_matrix(K, name, file, skew_beside(table, K[0, 0]))
        values.by_columns |= by_columns
        if by_columns:
            values.notes.append(f"calibration {matrix.file.name}: {name}: its matrix is written by columns")
        read_out = read_out_of(table, matrix.file)
        width, height = sensor_keys.get("width"), sensor_keys.get("height")
        stated = (width, height) if isinstance(width, int) and isinstance(height, int) else None
        if read_out is not None:
            K, size, note = of_images(K, size, read_out, stated or values.size)
            if note:
                values.notes.append(f"calibration {matrix.file.name}: {name}: {note}")
        if index < 2:
            seen = None if read_out is not None else stated or size or values.size
            values.notes += [f"calibration {matrix.file.name}: {note}" for note in matrix_notes(name, K, seen)]
        if match is not None and unnamed:
            side = size or stated or values.size or 2 * K[:2, 2]
            words = f"{matrix.file.stem} {matrix.name} {match.file.stem} {match.name}"
            out["model"], note = unnamed_lens(
                name, Camera(K, distortion, int(side[0]), int(side[1])), words, match.file
            )
            values.notes += [f"calibration {matrix.file.name}: {note}"] if note else []
        out |= {"focal_px": [float(K[0, 0]), float(K[1, 1])], "principal_px": [float(K[0, 2]), float(K[1, 2])]}
    if size is not None:
        out |= {"width": size[0], "height": size[1]}
    return out | (_pose(values, name, index, sensor_keys) if index > 0 else {})


def _size(values: _Values, name: str, index: int, table: dict[str, Any]) -> tuple[int, int] | None:
    """Return the image size (width, height) [px] of an eye that the files state; None without one.

    ``table`` has the matrix of the eye; a width and height beside the matrix come first.
    """
    size = values.find(name, index, "size", ((2,),), needed=False)
    if size is not None:
        return int(size.value[0]), int(size.value[1])
    beside = size_of(table)
    own_file = values.calibration_table.keys.get(name, EyeKeys()).file
    if beside is not None and (index < 2 or own_file or table is not values.tables[0]):
        return int(beside[0]), int(beside[1])
    if index == 2 and not own_file:
        return None
    sides = [values.tree.find(f"{own_file}:{key}" if own_file else key) for key in ("image_width", "image_height")]
    if sides[0] is None or sides[1] is None:
        return None
    width, height = (numbers_of([side.value], side.file, "image_width", ((1,),)) for side in sides if side)
    return int(width[0]), int(height[0])


def _pose(values: _Values, name: str, index: int, sensor_keys: dict[str, Any]) -> dict[str, Any]:
    """Return the keys of the pose of a second eye: of R and T, or of the rectifications of a pair of ROS."""
    file = ", ".join(dict.fromkeys(map(str, values.tree.files)))
    pair = rectified_pair(values.tables[0], values.tables[-1])
    needed = pair is None
    motions = ((4, 4), (3, 4))
    shapes = ((3, 3), (9,), (3,), (3, 1), (1, 3), (4,), (4, 1), (1, 4), *motions)
    rotation = values.find(name, index, "rotation", shapes, needed and "rotation_deg" not in sensor_keys)
    translation = values.find(name, index, "translation", ((3,), *motions), needed and "position_mm" not in sensor_keys)
    if rotation is not None and translation is not None:
        R, T = rotation.value, translation.value
        for motion in (rotation, translation):
            if not is_motion(motion.value):
                hint = "write it by rows, the translation in the last column"
                raise InputError(
                    motion.file, motion.name, motion.value.tolist(), "4 x 4 with the last row 0 0 0 1", hint
                )
        if R.size == 4:
            allowed = f"a rotation matrix or vector, or {ORDERED}"
            raise InputError(rotation.file, rotation.name, f"four numbers, {R.ravel().tolist()}", allowed)
        R, T = R[:3, :3] if R.shape in motions else R, T[:3, 3] if T.shape in motions else T
        table = translation.table
    elif pair is not None:
        (R, T), table = pair, {OF_FORMAT: "m"}
    else:
        return {}
    R = rotation_matrix(R, name, file, values.by_columns and rotation is not None)
    to_mm, stated = values.calibration_table.to_mm, unit_mm(table, file)
    if to_mm is None and "position_mm" not in sensor_keys and unit_mm(table | {OF_FORMAT: ""}, file) is None:
        check_unit(file, name, float(np.linalg.norm(T)), stated)
    T = T * (to_mm or stated or 1.0)
    if to_mm is not None and stated is not None and to_mm != stated:
        values.notes.append(f"calibration: to_mm = {to_mm:g} is used, though the file states {stated:g} mm")
    of_mc_calib = translation is not None and to_mm is stated is None and "camera_pose_matrix" in translation.name
    doubts = [board_unit_note(name, float(np.linalg.norm(T))) if of_mc_calib else "", facing_note(name, R)]
    values.notes += [f"calibration: {note}" for note in doubts if note]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # at 90 deg about y the angles are not unique; any solution is valid
        turn = Rotation.from_matrix(R.T)
        angles = turn.as_euler("xyz", degrees=True).tolist()
    return {"rotation_deg": angles, "position_mm": (-turn.apply(T)).tolist()}
