"""Read one view of the ROBI data set, shiny metal parts in a bin seen by an Ensenso or a RealSense, as a capture.

A view, by its number in ``list.txt`` of ``Scene_N/<sensor>``, has a ``StereoPattern`` pair, the device's own ``Depth``
with its pose, and the cameras of ``cam/<sensor>_LEFT.yml``, ``_RIGHT.yml`` and ``_DEPTH.yml``.

The data set (Yang, Gao, Li and Waslander, IROS 2021) contains rectified images. Its reader (ROBI_Toolkit, ``inout.py``)
computes the disparity of a depth Z as f B / Z - (cx_right - cx_left) + ``disparity_shift``: the images of the RealSense
are shifted by 78 px. The right camera is therefore read with cx_right reduced by the shift, which makes its images an
ordinary rectified pair. Depth is in ``depth_unit`` mm per grey level, 0 where missing. The translation of ``cam_pose``
is assumed to be in mm.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from characterisation.files.checked_files import read_bounded
from characterisation.files.errors import InputError
from mitsim.capture.capture import Capture
from mitsim.capture.decoding import Decoding
from mitsim.capture.grey_image import read_grey
from mitsim.capture.recordings.depth_image import missing_depths
from mitsim.capture.recordings.json_fields import JsonFields, nearest_rotation, parsed_json
from mitsim.capture.recordings.read_options import ReadOptions
from mitsim.capture.recordings.recording_files import chosen_frame, frame_of
from mitsim.sensor.calibration_qualifiers import check_camera
from mitsim.sensor.camera import Camera, Rectification, Rig
from mitsim.sensor.transforms import Transform

#: required keys of a camera file
_CAMERA_KEYS = ("width", "height", "fx", "fy", "cx", "cy")

#: percentiles of the device's depth that bound the search range, against false matches; chosen
_PERCENTILES = (1.0, 99.0)

#: margin of the search range beyond them, as a share of each; chosen
_WIDER = 0.15

#: tolerance on the orthogonality of a rotation stored with few digits
_RIGID = 1e-3

#: largest number of a camera file; chosen
_LARGEST = 1e9


def is_robi(folder: Path) -> bool:
    """Return whether a folder has the layout of a sensor's folder of a scene."""
    return (folder / "list.txt").is_file() and (folder / "StereoPattern").is_dir()


def read_robi(folder: str | Path, options: ReadOptions) -> tuple[Capture, list[Path]]:
    """Read one view of ``Scene_N/Ensenso`` or ``Scene_N/RealSense``, and list its files.

    The calibration is the folder with ``<sensor>_LEFT.yml`` etc.; by default ``cam`` in one of the parent folders.
    ``frame`` is the number of the view in ``list.txt``; required if there are several.
    """
    folder = Path(folder)
    frame = frame_of(options.frame, folder)
    views = read_bounded(folder / "list.txt").decode("utf-8", "replace").split()
    if not views:
        raise InputError(folder / "list.txt", "", "no view", "the names of the views, one per line: view_0")
    view = views[chosen_frame(frame, len(views), folder, "views of list.txt")]
    where = _calibrations(folder, options.calibration)
    files = {
        "left": folder / "StereoPattern" / f"LEFT_{view}.bmp",
        "right": folder / "StereoPattern" / f"RIGHT_{view}.bmp",
        "depth": folder / "Depth" / f"DEPTH_{view}.png",
    }
    tables = {name: where / f"{folder.name}_{name.upper()}.yml" for name in files}
    missing = [str(file) for file in (*files.values(), *tables.values()) if not file.is_file()]
    if missing:
        allowed = "images, depth and camera files of the view"
        raise InputError(folder, "", f"a scene without {', '.join(missing)}", allowed)
    numbers = {name: _numbers(path) for name, path in tables.items()}
    rig = _rig(tables, numbers)
    images = {name: _image(files[name], rig.cameras[name])[None] for name in ("left", "right")}
    grey, unit = read_grey(files["depth"]), numbers["depth"].get("depth_unit", float("nan"))
    if grey.shape != images["left"].shape[1:] or not unit > 0:
        found = f"{grey.shape[1]} x {grey.shape[0]} pixels of depth, depth_unit {unit:g}"
        raise InputError(files["depth"], "", found, "as many as the left image, and a unit over 0 mm")
    without_depth, warnings = missing_depths(grey)
    depth = np.where(without_depth, np.float32(np.nan), grey * np.float32(unit)).astype(np.float32)
    settings: dict[str, Any] = {
        "view": view,
        "files": {name: file.name for name, file in files.items()},
        "projector_on": True,
        "disparity_shift_px": numbers["depth"].get("disparity_shift", 0.0),
    }
    if warnings:
        settings["warnings"] = warnings
    depths, decoding = depth[np.isfinite(depth)], Decoding()
    if len(depths):
        near, far = np.percentile(depths, _PERCENTILES)
        decoding = Decoding(near_mm=float(near) * (1 - _WIDER), far_mm=float(far) * (1 + _WIDER))
    pose_files = [file for file in [folder / "Depth" / f"DEPTH_{view}.json"] if file.is_file()]
    capture = Capture(
        sensor=options.named or folder.name,
        technology="active_stereo",
        source="device",
        rig=rig,
        images=images,
        decoding=decoding,
        settings=settings,
        world_from_sensor=_pose(pose_files[0]) if pose_files else None,
        derived={"depth": depth},
    )
    return capture, [*files.values(), *tables.values(), *pose_files]


def _calibrations(folder: Path, calibration: str | Path | None) -> Path:
    """Return the folder of the camera files: the given one, else ``cam`` in a parent folder."""
    if calibration is not None:
        return Path(calibration)
    above = [parent / "cam" for parent in folder.resolve().parents]
    camera_folder = next((path for path in above if (path / f"{folder.name}_LEFT.yml").is_file()), None)
    if camera_folder is None:
        allowed = "the folder cam of the data set's toolkit: --calibration ROBI_Toolkit/cam"
        raise InputError(folder, "calibration", f"no cam/{folder.name}_LEFT.yml in a parent folder", allowed)
    return camera_folder


def _numbers(path: Path) -> dict[str, float]:
    """Return the plain numbers of a file of ``key: number`` lines; lists and comments are skipped."""
    out = {}
    for line in read_bounded(path).decode("utf-8", "replace").splitlines():
        key, _, value = line.partition("#")[0].partition(":")
        with suppress(ValueError):
            out[key.strip()] = float(value)
    wrong = next((key for key, number in out.items() if not abs(number) <= _LARGEST), None)
    if wrong is not None:
        raise InputError(path, wrong, f"{out[wrong]:g}", f"a number up to {_LARGEST:g}")
    return out


def _rig(tables: dict[str, Path], numbers: dict[str, dict[str, float]]) -> Rig:
    """Return the rectified pair: cameras without distortion, the right one shifted by the baseline."""
    lost = [f"{tables[name]}: {key}" for name in ("left", "right") for key in _CAMERA_KEYS if key not in numbers[name]]
    lost += [f"{tables['depth']}: {key}" for key in ("baseline", "depth_unit") if key not in numbers["depth"]]
    if lost:
        found = f"camera files without {'; '.join(lost)}"
        raise InputError(tables["left"].parent, "", found, "these keys, in px and mm")
    baseline, shift = numbers["depth"]["baseline"], numbers["depth"].get("disparity_shift", 0.0)
    if not baseline > 0:
        raise InputError(tables["depth"], "baseline", f"{baseline:g}", "a length over 0 mm")
    left, right = (_matrix(numbers[name]) for name in ("left", "right"))
    right[0, 2] -= shift
    width, height = (int(numbers["left"][key]) for key in ("width", "height"))
    beside = Transform(np.eye(3), np.array([baseline, 0.0, 0.0]))
    cameras = {
        "left": Camera(left, np.zeros(5), width, height),
        "right": Camera(right, np.zeros(5), width, height, beside),
    }
    for name, camera in cameras.items():
        check_camera(camera, tables[name])
    return Rig(cameras, None, Rectification(left, right, np.eye(3), np.eye(3), baseline, width, height))


def _matrix(numbers: dict[str, float]) -> NDArray[np.float64]:
    return np.array([[numbers["fx"], 0, numbers["cx"]], [0, numbers["fy"], numbers["cy"]], [0, 0, 1.0]])


def _image(path: Path, camera: Camera) -> NDArray[np.uint8]:
    image = read_grey(path)
    if image.dtype != np.uint8 or image.shape != (camera.height, camera.width):
        found = f"{image.dtype}, {image.shape[1]} x {image.shape[0]} pixels"
        raise InputError(path, "", found, f"8 bits, {camera.width} x {camera.height} pixels, as in the camera file")
    return np.asarray(image, np.uint8)


def _pose(path: Path) -> Transform:
    """Return the pose of the camera in the world, ``cam_pose``."""
    fields = JsonFields(parsed_json(read_bounded(path), path, "the pose of a view in JSON"), path)
    rows = fields.get("cam_pose")
    by_rows = isinstance(rows, list) and len(rows) == 4
    matrix = fields.numbers("cam_pose", (4, 4) if by_rows else (16,)).reshape(4, 4)
    turn = nearest_rotation(matrix[:3, :3], _RIGID)
    if turn is None:
        raise InputError(path, "cam_pose", "a matrix that is not a rigid motion", "a rotation and a translation")
    return Transform(turn, matrix[:3, 3])
