"""Calibrations as OpenCV writes them: FileStorage in YAML, XML or JSON, under whatever names their author gave.

Signal chain: file -> node of a name -> K, distortion, size, R and T of each camera and of the projector -> the tables
``[cameras.NAME]`` and ``[projector]`` of a sensor file, as if somebody had copied the numbers there.

R and T are those of ``cv2.stereoCalibrate``: a point X of the first camera's frame is R X + T in that of the other eye,
whose place in the sensor frame is therefore R^T, -R^T T. Numbers may stand in matrices of OpenCV's or in plain lists.
"""

from __future__ import annotations

import math
import warnings
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.spatial.transform import Rotation

from characterisation.documents import Document, validate
from characterisation.errors import InputError, nearest

#: names under which things are looked for unless the sensor file says otherwise, by what they are of: the first
#: camera, the second, the projector
USUAL_NAMES: dict[str, tuple[tuple[str, ...], tuple[str, ...], tuple[str, ...]]] = {
    "matrix": (
        ("camera_matrix", "camera_K", "cam_K", "K", "K1", "M1", "cameraMatrix", "cameraMatrix1", "mtx"),
        ("K2", "M2", "cameraMatrix2", "camera_matrix_2"),
        ("projector_matrix", "projector_K", "proj_K", "proj_int", "Kp", "K2", "M2", "cameraMatrix2"),
    ),
    "distortion": (
        ("distortion_coefficients", "camera_distortion", "cam_kc", "D", "D1", "distCoeffs", "distCoeffs1", "dist"),
        ("D2", "distCoeffs2", "distortion_coefficients_2"),
        ("projector_distortion", "proj_kc", "proj_dist", "Dp", "D2", "distCoeffs2"),
    ),
    "size": (
        ("image_size", "imageSize", "camera_size", "camera_resolution"),
        ("image_size_2", "image_size", "imageSize", "camera_size", "camera_resolution"),
        ("projector_size", "proj_size", "projector_resolution"),
    ),
    "rotation": ((), ("R",), ("R", "projector_R", "Rp")),
    "translation": ((), ("T", "t"), ("T", "t", "projector_T", "Tp")),
}


class EyeKeys(Document):
    """Names of one camera's or the projector's values in the file, with dots to step into maps: ``stereo.R``."""

    matrix: str | None = None
    distortion: str | None = None
    size: str | None = None
    rotation: str | None = None
    translation: str | None = None


class CalibrationTable(Document):
    """Where the geometry of cameras and projector stands, in place of their own keys.

    ``file`` beside the sensor file; ``to_mm`` what its unit of length is in mm; ``cameras`` their names, the reference
    first; ``projector`` whether it is calibrated there too; ``model`` of the cameras' lenses; ``keys`` of each camera,
    and of ``projector``, where the file does not use the usual names.
    """

    file: str
    to_mm: Annotated[float, Field(gt=0, le=1e6)] = 1.0
    cameras: list[str] = Field(default=["camera"], min_length=1, max_length=2)
    projector: bool = True
    model: Literal["perspective", "fisheye"] = "perspective"
    keys: dict[str, EyeKeys] = Field(default={})


def with_calibration(path: Path, table: dict[str, Any]) -> dict[str, Any]:
    """A sensor file's table with the optics of its ``[calibration]`` file filled in, where it names one.

    What the sensor file itself says of a camera or of the projector, its width for example, goes before.

    Raises
    ------
    InputError
        If the file cannot be read, or a value is missing or not what it must be: naming the file and the key.
    """
    if "calibration" not in table:
        return table
    asked = validate(path, {"calibration": table["calibration"]}, _Calibrated).calibration
    eyes = [*asked.cameras, *(["projector"] if asked.projector else [])]
    for name in asked.keys:
        if name not in eyes:
            raise InputError(path, f"calibration.keys.{name}", "an unknown name", ", ".join(eyes), nearest(name, eyes))
    file = path.parent / asked.file
    storage = _opened(file)
    try:
        out = dict(table)
        out["cameras"] = {
            name: _eye(storage, file, asked, name, min(index, 1)) | _own(table, "cameras", name)
            for index, name in enumerate(asked.cameras)
        }
        if asked.projector:
            out["projector"] = _eye(storage, file, asked, "projector", 2) | _own(table, "projector")
        return out
    finally:
        storage.release()


class _Calibrated(Document):
    calibration: CalibrationTable


def _own(table: dict[str, Any], *names: str) -> dict[str, Any]:
    """A table of the sensor file's own; empty if there is none."""
    inner: Any = table
    for name in names:
        inner = inner.get(name, {}) if isinstance(inner, dict) else {}
    return inner if isinstance(inner, dict) else {}


def _opened(file: Path) -> Any:
    if not file.is_file():
        raise InputError(file, "", "no such file", "a calibration that OpenCV wrote: .yml, .yaml, .xml or .json")
    try:
        storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_READ)
        if storage.isOpened() and storage.root().isMap():
            return storage
        fault = "nothing in it"
    except (cv2.error, SystemError) as error:
        fault = str(error).strip().splitlines()[-1]
    hint = "a YAML file begins with %YAML:1.0" if file.suffix in (".yml", ".yaml") else ""
    raise InputError(file, "", f"a file that OpenCV cannot read ({fault})", "YAML, XML or JSON of FileStorage", hint)


def _eye(storage: Any, file: Path, asked: CalibrationTable, name: str, place: int) -> dict[str, Any]:
    """Keys of an ``OpticsTable``; ``place`` 0 for the first camera, 1 for the second, 2 for the projector."""
    own = asked.keys.get(name, EyeKeys())

    def find(what: str, shapes: tuple[tuple[int, ...], ...], needed: bool = True) -> NDArray[np.float64] | None:
        given = getattr(own, what)
        names = (given,) if given else USUAL_NAMES[what][place]
        for key in names:
            node = _node(storage, key)
            if node is not None:
                return _numbers(node, file, key, shapes)
        if not needed and not given:
            return None
        known = list(storage.root().keys())
        hint = f"the file has {', '.join(known[:12])}: name the right one in [calibration.keys.{name}], as {what}"
        raise InputError(file, " or ".join(names), "nothing", f"the {what} of {name}", hint)

    counts = ((4,),) if asked.model == "fisheye" and place < 2 else ((4,), (5,), (8,), (12,), (14,))
    K = find("matrix", ((3, 3),))
    assert K is not None
    distortion = find("distortion", ((0,), *counts), needed=False)
    size = find("size", ((2,),), needed=False)
    if K[0, 0] <= 0 or K[1, 1] <= 0 or abs(K[0, 1]) > 1e-9 or abs(K[2, 2] - 1) > 1e-9:
        raise InputError(file, f"matrix of {name}", np.round(K, 3).tolist(), "fx 0 cx, 0 fy cy, 0 0 1")
    out: dict[str, Any] = {
        "focal_px": [float(K[0, 0]), float(K[1, 1])], "principal_px": [float(K[0, 2]), float(K[1, 2])],
        "distortion": [] if distortion is None else distortion.tolist(),
        "model": asked.model if place < 2 else "perspective",
    }  # fmt: skip
    if size is not None:
        out |= {"width": int(size[0]), "height": int(size[1])}
    else:
        plain = [_node(storage, key) for key in ("image_width", "image_height")]
        if place < 2 and all(node is not None for node in plain):
            out |= {"width": int(plain[0].real()), "height": int(plain[1].real())}
    if place == 0:
        return out
    R, T = find("rotation", ((3, 3),)), find("translation", ((3,),))
    assert R is not None and T is not None
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-4 or np.linalg.det(R) < 0:
        raise InputError(file, f"rotation of {name}", np.round(R, 4).tolist(), "a rotation matrix, 3 x 3, by rows")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # at 90 deg about y the three angles are not unique, and any will do
        turn = Rotation.from_matrix(R.T)
        out["rotation_deg"] = turn.as_euler("xyz", degrees=True).tolist()
    out["position_mm"] = (-turn.apply(T) * asked.to_mm).tolist()
    return out


def _node(storage: Any, key: str) -> Any:
    """A node by its name, or by names with dots between; None if there is none."""
    node = storage.root()
    for part in key.split("."):
        if not node.isMap():
            return None
        node = node.getNode(part)
    return None if node.empty() else node


def _numbers(node: Any, file: Path, key: str, shapes: tuple[tuple[int, ...], ...]) -> NDArray[np.float64]:
    """An array of one of several shapes, out of a matrix or of lists; rows and columns of vectors are the same."""
    try:
        values = np.asarray(node.mat(), float) if node.isMap() else np.asarray(_listed(node), float)
    except (cv2.error, ValueError, TypeError):
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


def _listed(node: Any) -> Any:
    if node.isSeq():
        return [_listed(node.at(index)) for index in range(node.size())]
    if not (node.isReal() or node.isInt()):
        raise ValueError("no number")
    return node.real()
