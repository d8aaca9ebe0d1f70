"""Read the geometry of cameras and projector from calibrations of OpenCV and other programs.

Signal chain: one or several files -> value of a name (:mod:`mitsim.sensor.calibration_tree`) -> K, distortion, size, R
and T of each camera and of the projector -> the tables ``[cameras.NAME]`` and ``[projector]`` of a sensor file.

R and T are those of ``cv2.stereoCalibrate``: a point X in the frame of the first camera is R X + T in the frame of the
other eye (camera or projector). The other eye's pose in the sensor frame is therefore R^T, -R^T T. R may be a rotation
vector. Numbers may be matrices of OpenCV or plain lists.
"""

from __future__ import annotations

import math
import warnings
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.spatial.transform import Rotation

from characterisation.files.documents import Document, validate
from characterisation.files.errors import InputError, nearest
from mitsim.sensor.calibration_names import USUAL_NAMES, Names
from mitsim.sensor.calibration_tree import CalibrationTree, read_tree


class EyeKeys(Document):
    """Names of one camera's or the projector's values in the file; dots step into maps: ``stereo.R``.

    ``file``: the one of several files that contains matrix, distortion and size of this eye alone.
    """

    file: str | None = None
    matrix: str | None = None
    distortion: str | None = None
    size: str | None = None
    rotation: str | None = None
    translation: str | None = None


class CalibrationTable(Document):
    """Source of the geometry of cameras and projector, in place of their own keys.

    - ``file``: one or several, beside the sensor file.
    - ``to_mm``: their unit of length in mm.
    - ``cameras``: names, the reference camera first.
    - ``projector``: whether the files also calibrate it.
    - ``model`` of the cameras' lenses.
    - ``keys`` of each camera, and of ``projector``, if the file does not use the usual names.
    """

    file: str | Annotated[list[str], Field(min_length=1, max_length=8)]
    to_mm: Annotated[float, Field(gt=0, le=1e6)] = 1.0
    cameras: list[str] = Field(default=["camera"], min_length=1, max_length=2)
    projector: bool = True
    model: Literal["perspective", "fisheye"] = "perspective"
    keys: dict[str, EyeKeys] = Field(default={})


def with_calibration(path: Path, table: dict[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """Return a sensor file's table completed with the optics of its ``[calibration]`` files, and warnings.

    Keys that the sensor file itself gives for a camera or the projector, such as its width, take precedence. The
    warnings name values that look like optics and were not read.

    Raises
    ------
    InputError
        If a file cannot be read, or values are missing or invalid; the error names the file and the keys.
    """
    if "calibration" not in table:
        return table, []
    calibration_table = validate(path, {"calibration": table["calibration"]}, _Calibrated).calibration
    eyes = [*calibration_table.cameras, *(["projector"] if calibration_table.projector else [])]
    for name in calibration_table.keys:
        if name not in eyes:
            raise InputError(path, f"calibration.keys.{name}", "an unknown name", ", ".join(eyes), nearest(name, eyes))
    named = [calibration_table.file] if isinstance(calibration_table.file, str) else calibration_table.file
    for name, keys in calibration_table.keys.items():
        if keys.file is not None and keys.file not in named:
            raise InputError(path, f"calibration.keys.{name}.file", repr(keys.file), " | ".join(named))
    values = _Values(read_tree([path.parent / name for name in named]), calibration_table)
    out = dict(table)
    out["cameras"] = {}
    for index, name in enumerate(calibration_table.cameras):
        own = _own(table, "cameras", name)
        out["cameras"][name] = _eye(values, name, min(index, 1), own) | own
    if calibration_table.projector:
        own = _own(table, "projector")
        out["projector"] = _eye(values, "projector", 2, own) | own
    if values.missing:
        raise values.all_missing()
    straight = [
        name
        for name in eyes
        if not (out["projector"] if name == "projector" else out["cameras"][name]).get("distortion")
    ]
    return out, _notes(values.tree, straight)


def _notes(tree: CalibrationTree, straight: list[str]) -> list[str]:
    """Return the warnings about a calibration: the values that were not read."""
    unread = tree.unread()
    if not unread:
        return []
    without = f"; {' and '.join(straight)} without distortion" if straight else ""
    return [
        f"calibration {', '.join(file.name for file in tree.files)}: values not read: {', '.join(unread)}{without}. "
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
    """Values of a calibration by request; missing values are collected and reported together."""

    def __init__(self, tree: CalibrationTree, calibration_table: CalibrationTable) -> None:
        self.tree, self.calibration_table = tree, calibration_table
        self.missing: list[tuple[str, str, Names]] = []

    def find(
        self, name: str, place: int, what: str, shapes: tuple[tuple[int, ...], ...], needed: bool = True
    ) -> NDArray[np.float64] | None:
        """Return one value of an eye; None if it is missing."""
        keys = self.calibration_table.keys.get(name, EyeKeys())
        given = getattr(keys, what)
        names = (given,) if given else USUAL_NAMES[what][place]
        if keys.file and what in ("matrix", "distortion", "size"):
            # a file of one eye uses the names of a single camera
            names = tuple(f"{keys.file}:{key}" for key in ((given,) if given else names + USUAL_NAMES[what][0]))
        elif (
            place == 2 and len(self.calibration_table.cameras) == 2 and not given
        ):  # R and T are those of the second camera
            names = tuple(key for key in names if key not in USUAL_NAMES[what][1])
        for key in names:
            found = self.tree.find(key)
            if found is not None:
                return _numbers(found[1], found[0], key.rpartition(":")[2].removeprefix("+"), shapes)
        if needed or given:
            self.missing.append((name, what, names))
        return None

    def all_missing(self) -> InputError:
        """Return one error that names all missing values."""
        files = ", ".join(str(file) for file in self.tree.files)
        found = "; ".join(" or ".join(key for key in names if "+" not in key) for _, _, names in self.missing)
        allowed = ", ".join(f"the {what} of {name}" for name, what, _ in self.missing)
        keys = "; ".join(f"in [calibration.keys.{name}], as {what}" for name, what, _ in self.missing)
        known = ", ".join(self.tree.names()[:20])
        return InputError(files, found, "nothing", allowed, f"the file has {known}: give the name to use {keys}")


def _eye(values: _Values, name: str, place: int, own: dict[str, Any]) -> dict[str, Any]:
    """Return the keys of an ``OpticsTable``; ``place`` 0 is the first camera, 1 the second, 2 the projector.

    The sensor file's ``own`` keys may be missing in the calibration.
    """
    calibration_table, file = values.calibration_table, ", ".join(str(each) for each in values.tree.files)
    counts = ((4,),) if calibration_table.model == "fisheye" and place < 2 else ((4,), (5,), (8,), (12,), (14,))
    K = values.find(name, place, "matrix", ((3, 3),), needed="focal_px" not in own)
    distortion = values.find(name, place, "distortion", ((0,), *counts), needed=False)
    size = values.find(name, place, "size", ((2,),), needed=False)
    R = T = None
    if place > 0:
        R = values.find(name, place, "rotation", ((3, 3), (3,), (3, 1), (1, 3)), "rotation_deg" not in own)
        T = values.find(name, place, "translation", ((3,),), "position_mm" not in own)
    out: dict[str, Any] = {"model": calibration_table.model if place < 2 else "perspective"}
    out["distortion"] = [] if distortion is None else distortion.tolist()
    if K is not None:
        if abs(K[0, 1]) > 1e-9 and K[0, 0] > 0:
            hint = "calibrate without skew: est_alpha = 0 in MATLAB's toolbox"
            raise InputError(file, f"matrix of {name}", f"a skew of {K[0, 1]:.3g} px", "fx 0 cx, 0 fy cy, 0 0 1", hint)
        if K[0, 0] <= 0 or K[1, 1] <= 0 or abs(K[2, 2] - 1) > 1e-9:
            raise InputError(file, f"matrix of {name}", np.round(K, 3).tolist(), "fx 0 cx, 0 fy cy, 0 0 1")
        out |= {"focal_px": [float(K[0, 0]), float(K[1, 1])], "principal_px": [float(K[0, 2]), float(K[1, 2])]}
    if size is not None:
        out |= {"width": int(size[0]), "height": int(size[1])}
    elif place < 2 or calibration_table.keys.get(name, EyeKeys()).file:
        own_file = calibration_table.keys.get(name, EyeKeys()).file
        found = [values.tree.find(f"{own_file}:{key}" if own_file else key) for key in ("image_width", "image_height")]
        if found[0] is not None and found[1] is not None:
            shapes: tuple[tuple[int, ...], ...] = ((1,),)
            width, height = (_numbers([each[1]], each[0], "image_width", shapes) for each in found if each)
            out |= {"width": int(width[0]), "height": int(height[0])}
    if R is None or T is None:
        return out
    if R.size == 3:
        R = np.asarray(Rotation.from_rotvec(R.reshape(3)).as_matrix())
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-4 or np.linalg.det(R) < 0:
        raise InputError(file, f"rotation of {name}", np.round(R, 4).tolist(), "a rotation matrix, 3 x 3, by rows")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # at 90 deg about y the angles are not unique; any solution is valid
        turn = Rotation.from_matrix(R.T)
        out["rotation_deg"] = turn.as_euler("xyz", degrees=True).tolist()
    out["position_mm"] = (-turn.apply(T) * calibration_table.to_mm).tolist()
    return out


def _numbers(value: Any, file: Path, key: str, shapes: tuple[tuple[int, ...], ...]) -> NDArray[np.float64]:
    """Convert a matrix or lists to an array of one of several shapes; row and column vectors are equivalent."""
    try:
        values = np.asarray(value, float)
    except (ValueError, TypeError):
        values = np.array(math.nan)
    vector = len(shapes[0]) == 1
    found = values.reshape(-1) if vector and values.ndim and values.size == max(values.shape) else values
    if found.shape not in shapes or not np.isfinite(found).all():
        if vector and values.ndim and values.size == 0 and (0,) in shapes:
            return np.empty(0)
        allowed = " or ".join(" x ".join(map(str, shape)) for shape in shapes) + " finite numbers"
        shown = f"an array of {' x '.join(map(str, values.shape))}" if values.ndim else "something else"
        raise InputError(file, key, shown, allowed)
    return found
