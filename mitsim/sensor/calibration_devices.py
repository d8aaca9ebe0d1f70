"""Read calibrations of devices, data sets and photogrammetry that state their cameras in forms of their own.

Signal chain: text -> cameras of the form, by its documented conventions -> maps in OpenCV's form, with their unit.

- COLMAP's ``cameras.txt``. The centre of the first pixel is at 0.5, 0.5 (its tutorial, "feature detection").
- Middlebury's ``calib.txt`` of 2014 and later, which ETH3D has too: rectified, ``baseline`` in mm, ``doffs`` = cx1 -
  cx0.
- KITTI's: ``P`` = K (I | t) of rectified cameras, in metres; ``K_00``, ``D_00``, ``R_00`` and ``T_00`` before
  rectification, from camera 0 to camera 00 (readme of the development kit).
- ZED's ``SN*.conf``: T = (-Baseline, TY, TZ) in mm and the rotation vector (RX, CV, RZ) are those of
  ``cv2.stereoCalibrate`` (stereolabs/zed-opencv-calibration, ``saveCalibZED``).
- Metashape's XML (manual, "Camera models"): cx and cy from the middle of the image, the first pixel's centre at 0.5,
  0.5; fx = f + b1; p1 and p2 in the other order; k4 of r^8, p3, p4 and the skew b2 are in no lens of OpenCV.
- Azure Kinect's raw calibration: shares of the sensor's sides, from the corner of the first pixel; the modes cut or bin
  the sensor (Azure-Kinect-Sensor-SDK, ``mode_specific_calibration.c``, ``intrinsic_transformation.c``).
- mrcal's ``.cameramodel``: coefficients in OpenCV's order, extrinsics from a reference frame to the camera.
- A matrix alone, 3 x 3 or 4 x 4, as of ScanNet.
"""

from __future__ import annotations

import ast
import configparser
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from characterisation.files.errors import InputError
from mitsim.sensor.calibration_numbers import vector
from mitsim.sensor.calibration_qualifiers import OF_FORMAT

#: forms that are read from text, for messages
FORMS = (
    "cameras.txt of COLMAP, calib.txt of Middlebury or KITTI, .conf of a ZED, .cameramodel of mrcal, or a matrix alone "
    "of 3 x 3 or 4 x 4 numbers"
)

#: parameters of COLMAP's models in their order, of those that OpenCV has (``src/colmap/sensor/models.h``)
_COLMAP = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "OPENCV_FISHEYE": "fx fy cx cy k1 k2 k3 k4",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
}

#: sizes of the images of a ZED [px], by the ending of names
_ZED = {
    "2K": (2208, 1242),
    "FHD": (1920, 1080),
    "HD": (1280, 720),
    "VGA": (672, 376),
    "FHD1200": (1920, 1200),
    "SVGA": (960, 600),
    "4K": (3840, 2160),
    "QHDPLUS": (3200, 1800),
}

#: values of a camera of KITTI before rectification, and how many numbers they have
_RAW = {"K": 9, "D": 5, "R": 9, "T": 3}

#: values of Metashape that are 0 if they are missing
_METASHAPE = ("cx", "cy", "b1", "b2", "p1", "p2", "p3", "p4", "k1", "k2", "k3", "k4")

#: parameters of an Azure Kinect in their order
_AZURE = ("cx", "cy", "fx", "fy", "k1", "k2", "k3", "k4", "k5", "k6", "codx", "cody", "p2", "p1")

#: sizes of the depth images of an Azure Kinect: side of the binned sensor, and corner of the part in it [px]
_AZURE_DEPTH = {
    (640, 576): (1024, (192, 180)),
    (320, 288): (512, (96, 90)),
    (1024, 1024): (1024, (0, 0)),
    (512, 512): (512, (0, 0)),
}

#: sizes of its colour images, which are the middle of the binned sensor [px]
_AZURE_COLOUR = ((1280, 720), (1920, 1080), (2560, 1440), (2048, 1536), (3840, 2160), (4096, 3072))

#: lens models of mrcal that are OpenCV's
_MRCAL = re.compile(r"LENSMODEL_(?:PINHOLE|OPENCV(?:4|5|8|12))")

#: largest difference of ``doffs`` from cx1 - cx0 [px]; chosen: files have three digits
_DOFFS_PX = 0.01

#: largest text [bytes]; chosen: mrcal's have the corners from which they were made
_LARGEST = 8 * 1024**2

#: cameras of one size of images, by name
_Cameras = dict[str, dict[str, Any]]
_Size = tuple[int, int]


def from_text(file: Path, data: bytes, size: _Size | None) -> dict[str, Any]:
    """Return the cameras of a text by name, of the images' ``size`` (width, height) [px] if it has several sizes.

    Raises InputError if its form is none of :data:`FORMS`, or it is incomplete.
    """
    if len(data) > _LARGEST:
        raise InputError(file, "size", f"{len(data):,} bytes", f"up to {_LARGEST:,} of {FORMS}")
    text = data.decode("utf-8-sig", "replace")
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    if "oST version" in text:
        found, hint = "the .ini form of ROS's calibrator", "it saves the same numbers as .yaml"
        raise InputError(file, "", found, FORMS, hint)
    if file.suffix.lower() == ".cameramodel":
        return _mrcal(file, text)
    if re.search(r"^[ \t]*\[(?:LEFT|RIGHT)_CAM_\w+\]", text, re.MULTILINE):
        return _zed(file, text, size)
    values: dict[str, list[str]] = {}
    for line in lines:
        name, mark, rest = re.fullmatch(r"\s*(?:(\w+)\s*([:=]))?(.*)", line, re.DOTALL).groups()  # type: ignore[union-attr]
        words = re.sub(r"[\[\];,]", " ", rest).split()
        if mark:
            values[name] = words
        elif values:
            values[next(reversed(values))] += words  # of a matrix over several lines
    if {"cam0", "cam1", "baseline"} <= set(values):
        return _middlebury(file, values)
    if any(re.fullmatch(r"P(?:\d|_rect_\d\d)", name) for name in values):
        return _kitti(file, values, size)
    if lines and not values and all(re.match(r"\s*\d+\s+[A-Z_]+\s+\d+\s+\d+\s", line) for line in lines):
        return {f"camera_{line.split()[0]}": _colmap(file, line.split()) for line in lines}
    alone = vector([word for line in lines for word in line.replace(",", " ").split()])
    if alone is not None and len(alone) in (9, 16):
        return {"K": alone.reshape(math.isqrt(len(alone)), -1)}
    hint = "write its numbers as JSON or YAML under the usual names: cam_K, proj_K, R, T and so on"
    raise InputError(file, "", "text of another form", FORMS, hint)


def _of_size(file: Path, cameras: Mapping[_Size, _Cameras], size: _Size | None) -> _Cameras:
    """Return the cameras of images of a size."""
    if size is None and len(cameras) == 1:
        return next(iter(cameras.values()))
    if size is None or size not in cameras:
        found = "images of unknown size" if size is None else f"images of {size[0]} x {size[1]} px"
        allowed = " or ".join(f"{width} x {height}" for width, height in cameras) + " px, the sizes of its cameras"
        hint = (
            "of scaled images, scale the numbers too, in [cameras.NAME] of a TOML; else give the images, or width and "
        )
        raise InputError(file, "size", found, allowed, f"{hint}height in [cameras.NAME] beside [calibration]")
    return cameras[size]


def _numbers(file: Path, values: Mapping[str, Any], name: str, count: int) -> NDArray[np.float64]:
    """Return the numbers of a name."""
    numbers = vector(values.get(name), count)
    if numbers is None:
        found = repr(values[name]) if name in values else "nothing"
        raise InputError(file, name, found, "a number" if count == 1 else f"{count} numbers")
    return numbers


def _colmap(file: Path, words: Sequence[str]) -> dict[str, Any]:
    number, model, *numbers = words
    names = _COLMAP.get(model, "").split()
    values = vector(numbers)
    if not names or values is None or len(values) != 2 + len(names):
        found = f"{model} with {len(numbers) - 2} parameters"
        allowed = ", ".join(f"{known} with {len(needed.split())}" for known, needed in _COLMAP.items())
        raise InputError(file, f"camera {number}", found, allowed, "undistort the images with COLMAP, to PINHOLE")
    named = dict(zip(("width", "height", *names), values.tolist(), strict=True))
    focal = named.pop("f", None)
    named |= {} if focal is None else {"fx": focal, "fy": focal}
    named |= {"cx": named["cx"] - 0.5, "cy": named["cy"] - 0.5}
    return named | {"camera_model": "fisheye" if model == "OPENCV_FISHEYE" else "perspective"}


def _middlebury(file: Path, values: Mapping[str, list[str]]) -> _Cameras:
    K0, K1 = (_numbers(file, values, name, 9).reshape(3, 3) for name in ("cam0", "cam1"))
    doffs = _numbers(file, values, "doffs", 1)[0]
    if abs(K1[0, 2] - K0[0, 2] - doffs) > _DOFFS_PX:
        raise InputError(file, "doffs", doffs, f"cx of cam1 less cx of cam0, {K1[0, 2] - K0[0, 2]:g}")
    sides = {name: _numbers(file, values, name, 1)[0] for name in ("width", "height") if name in values}
    shift = [-float(_numbers(file, values, "baseline", 1)[0]), 0.0, 0.0]
    return {"cam0": {"K": K0, **sides}, "cam1": {"K": K1, "R": np.eye(3), "T": shift, **sides}}


def _kitti(file: Path, values: Mapping[str, list[str]], size: _Size | None) -> _Cameras:
    """Return the rectified cameras, or those before rectification if the images have their size."""
    sized: dict[_Size | None, _Cameras] = {}

    def put(side: str, name: str, camera: dict[str, Any]) -> None:
        sides = None if side not in values else tuple(int(each) for each in _numbers(file, values, side, 2))
        stated = {} if sides is None else {"width": sides[0], "height": sides[1]}
        sized.setdefault(sides, {})[name] = camera | stated | {OF_FORMAT: "m"}  # type: ignore[arg-type]

    for name in values:
        if re.fullmatch(r"P(?:\d|_rect_\d\d)", name):
            P = _numbers(file, values, name, 12).reshape(3, 4)
            shift = np.linalg.lstsq(P[:, :3], P[:, 3], rcond=None)[0]
            put(name.replace("P", "S"), name, {"K": P[:, :3], "R": np.eye(3), "T": shift})
        elif name.startswith("K_"):
            raw = {letter: _numbers(file, values, f"{letter}{name[1:]}", count) for letter, count in _RAW.items()}
            put(f"S{name[1:]}", name, raw | {"K": raw["K"].reshape(3, 3), "R": raw["R"].reshape(3, 3)})
    return sized[None] if None in sized else _of_size(file, sized, size)  # type: ignore[arg-type]


def _zed(file: Path, text: str, size: _Size | None) -> _Cameras:
    parser = configparser.ConfigParser(strict=False, interpolation=None, inline_comment_prefixes=(";", "#"))
    try:
        parser.read_string(text)
    except configparser.Error as error:
        raise InputError(file, "", f"sections that cannot be read ({str(error).splitlines()[0]})", FORMS) from None
    sections = {name.upper(): {key.lower(): value for key, value in parser[name].items()} for name in parser.sections()}
    sized: dict[_Size, _Cameras] = {}
    for side, (ending, sides) in [(side, each) for side in ("LEFT", "RIGHT") for each in _ZED.items()]:
        camera = sections.get(f"{side}_CAM_{ending}")
        if camera is None:
            continue
        lens = camera | sections.get(f"{side}_DISTO", {})
        model = "fisheye" if "k4" in lens and "p1" not in lens else "perspective"
        out: dict[str, Any] = lens | {"width": sides[0], "height": sides[1], "camera_model": model, OF_FORMAT: "mm"}
        if side == "RIGHT" and "STEREO" in sections:
            of_both = sections["STEREO"]
            low = ending.lower()
            keys = ["baseline", *(f"{each}_{low}" if f"{each}_{low}" in of_both else each for each in ("ty", "tz"))]
            keys += [f"{each}_{low}" for each in ("rx", "cv", "rz")]
            numbers = [_numbers(file, of_both, key, 1)[0] for key in keys]
            out |= {"R": numbers[3:], "T": [-numbers[0], *numbers[1:3]]}
        sized.setdefault(sides, {})[side.lower()] = out
    return _of_size(file, sized, size)


def from_metashape(file: Path, data: bytes) -> dict[str, Any] | None:
    """Return the cameras of Metashape's XML by name; None of XML of another program.

    Calibrations that it adjusted come before those from which it began. Raises InputError if OpenCV has no such lens.
    """
    text = data.decode("utf-8-sig", "replace")
    bodies = [piece.rpartition("<calibration")[2].partition(">") for piece in text.split("</calibration>")[:-1]]
    blocks = [(attributes, inner) for attributes, _, inner in bodies]
    adjusted = [block for block in blocks if "adjusted" in block[0]] or blocks
    out: dict[str, Any] = {}
    for attributes, inner in adjusted:
        values = dict(re.findall(r"<(\w+)>([^<>]*)</\1>", inner))
        values |= dict(re.findall(r'(width|height)="(\d+)"', inner))
        kinds = [*re.findall(r'type="(\w+)"', attributes), *([values["projection"]] if "projection" in values else [])]
        if not kinds:
            return None
        if kinds[0].strip() != "frame":
            raise InputError(file, "projection", kinds[0], "frame: mitsim knows no formula of the others")
        values = dict.fromkeys(_METASHAPE, "0") | values
        names = (*_METASHAPE, "f", "width", "height")
        cx, cy, b1, b2, p1, p2, p3, p4, k1, k2, k3, k4, f, w, h = (
            float(_numbers(file, values, name, 1)[0]) for name in names
        )
        if p3 or p4:
            raise InputError(
                file, "p3, p4", f"{p3:g}, {p4:g}", "0: no lens of OpenCV has them", "optimise without them"
            )
        camera = {"fx": f + b1, "fy": f, "cx": w / 2 + cx - 0.5, "cy": h / 2 + cy - 0.5, "skew": b2}
        camera |= {"width": w, "height": h, "k1": k1, "k2": k2, "p1": p2, "p2": p1, "k3": k3} | (
            {"k4": k4} if k4 else {}
        )
        out[f"camera_{len(out)}"] = camera
    return out or None


def from_azure_kinect(file: Path, table: Any, size: _Size | None) -> dict[str, Any] | None:
    """Return the camera of an Azure Kinect whose images have a ``size`` (width, height) [px]; None of other JSON.

    Raises InputError if no camera of it has such images, or another lens model.
    """
    listed = table.get("Cameras") if isinstance(table, dict) else None
    if not isinstance(listed, list) or not all(
        isinstance(camera, dict) and "Intrinsics" in camera for camera in listed
    ):
        return None
    sized: dict[_Size, _Cameras] = {}
    for camera in listed:
        inner = camera["Intrinsics"] if isinstance(camera["Intrinsics"], dict) else {}
        model = str(inner.get("ModelType"))
        named = dict(zip(_AZURE, _numbers(file, inner, "ModelParameters", len(_AZURE)).tolist(), strict=True))
        if not model.endswith("BrownConrady") or named.pop("codx") or named.pop("cody"):
            raise InputError(file, "ModelType", model, "CALIBRATION_LensDistortionModelBrownConrady around cx and cy")
        wide, high = (float(_numbers(file, camera, f"Sensor{side}", 1)[0]) for side in ("Width", "Height"))
        modes: dict[_Size, tuple[tuple[float, float], tuple[float, float]]]
        if str(camera.get("Purpose")).endswith("Depth"):
            if (wide, high) != (1024, 1024):
                raise InputError(file, "SensorWidth, SensorHeight", f"{wide:g} x {high:g}", "1024 x 1024 of depth")
            modes = {sides: ((side, side), corner) for sides, (side, corner) in _AZURE_DEPTH.items()}
        else:
            whole = {sides: (sides[0], sides[0] * high / wide) for sides in _AZURE_COLOUR}
            modes = {sides: (full, (0, (full[1] - sides[1]) / 2)) for sides, full in whole.items()}
        for sides, (full, corner) in modes.items():
            pixels = {f"f{axis}": named[f"f{axis}"] * full[at] for at, axis in enumerate("xy")}
            pixels |= {f"c{axis}": named[f"c{axis}"] * full[at] - corner[at] - 0.5 for at, axis in enumerate("xy")}
            of_mode = named | pixels | {"width": sides[0], "height": sides[1], "camera_model": "perspective"}
            sized[sides] = {"camera": of_mode}
    return _of_size(file, sized, size)


def _mrcal(file: Path, text: str) -> dict[str, Any]:
    try:
        model = ast.literal_eval(text)
    except (ValueError, SyntaxError, RecursionError, MemoryError):
        model = None
    if not isinstance(model, dict) or "lensmodel" not in model:
        raise InputError(file, "", "text of another form", FORMS)
    if not _MRCAL.fullmatch(str(model["lensmodel"])):
        allowed = "LENSMODEL_PINHOLE, LENSMODEL_OPENCV4, 5, 8 or 12"
        hint = "convert it: mrcal-convert-lensmodel LENSMODEL_OPENCV8 FILE"
        raise InputError(file, "lensmodel", model["lensmodel"], allowed, hint)
    bent = int(re.sub(r"\D", "", model["lensmodel"]) or 0)
    fx, fy, cx, cy, *lens = _numbers(file, model, "intrinsics", 4 + bent).tolist()
    width, height = _numbers(file, model, "imagersize", 2).tolist()
    pose = _numbers(file, model, "rt_cam_ref" if "rt_cam_ref" in model else "extrinsics", 6)
    camera = {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "width": width, "height": height, "camera_model": "perspective"}
    return {"camera": camera | {"distortion": lens, "rvec": pose[:3], "tvec": pose[3:]}}
