"""Ensenso recordings ("file cameras": a zip, an .enscam or a folder) into captures.

Signal chain: ``*_left.png``, ``*_right.png`` -> images; ``*_calib.json`` (the camera's node of the NxLib tree) -> rig
with the maker's own rectification.

What the files do not say aloud, found on real recordings:

- every matrix is stored column by column: transpose;
- distortion is an array k1 k2 t1 t2 k3 in old files, an object K1 K2 K3 T1 T2 Rx Ry in new ones, where Rx, Ry are
  OpenCV's tilts tau_x, tau_y, entries 13 and 14 of 14;
- ``Calibration/Dynamic/Stereo`` is the calibration as last corrected by the device; its camera matrices are for the
  disparity map shrunk by ``Parameters/DisparityMap/Scaling``, so they are divided by it (all of fx, fy, cx, cy, without
  half-pixel shift);
- the sensor frame is that of the left camera. The right camera follows from the two rectifying rotations and the
  baseline B: its centre is rotation_left^T (B, 0, 0);
- ``Link`` moves NxLib's own point maps to a workspace. It is *not* applied here, only recorded in the settings.
"""

from __future__ import annotations

import json
import lzma
import struct
import zipfile
import zlib
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from characterisation.checked_files import LARGEST_FILE, read_bounded
from characterisation.errors import InputError
from mitsim.capture.capture import Capture
from mitsim.capture.png import decode_png
from mitsim.sensor.camera import Camera, Rectification, Rig
from mitsim.sensor.frames import Transform

_ENDINGS = {"left": "_left.png", "right": "_right.png", "calib": "_calib.json"}

#: what the standard library raises for a damaged, encrypted or odd zip
_DAMAGED = (
    zipfile.BadZipFile, zlib.error, lzma.LZMAError, struct.error, EOFError, OSError, NotImplementedError, RuntimeError,
    ValueError,
)  # fmt: skip


def read_ensenso(path: str | Path, *, dynamic: bool = True) -> Capture:
    """Read one recording.

    Parameters
    ----------
    path
        A zip or .enscam file, or a folder, that holds ``<base>_left.png``, ``<base>_right.png`` and
        ``<base>_calib.json``, at its top or one level down.
    dynamic
        Use the rectification as last corrected by the device; False for that of the factory.

    Returns
    -------
    Capture
        ``source`` is ``device``, or ``simulated`` for the vendor's virtual cameras.

    Raises
    ------
    InputError
        If a file is missing or damaged, or the calibration lacks a field (which is named).
    """
    path = Path(path)
    parts = _recording(path)
    where, text = parts["calib"]
    tree = _Tree(_parse(text, where), where)

    images = {side: decode_png(parts[side][1], parts[side][0]) for side in ("left", "right")}
    height, width = images["left"].shape
    if images["right"].shape != (height, width):
        found = f"{images['right'].shape[1]} x {images['right'].shape[0]} px"
        raise InputError(parts["right"][0], "size", found, f"{width} x {height} px, as the left image")
    if tree.has("Sensor/Size") and tree.numbers("Sensor/Size", (2,)).tolist() != [width, height]:
        raise tree.fault("Sensor/Size", f"{width} x {height} px, as the images are; binned ones are not read")
    deepest = max(image.dtype.itemsize for image in images.values())
    return Capture(
        sensor=tree.text("ModelName"),
        technology="active_stereo",
        source="simulated" if _is_virtual(tree.root) else "device",
        rig=_rig(tree, (height, width), dynamic),
        images={side: image[None] for side, image in images.items()},
        bits=8 * deepest,
        settings=_settings(tree, dynamic),
        serial=tree.text("SerialNumber"),
    )


def ensenso_originals(path: str | Path) -> dict[str, bytes]:
    """Read the three files of a recording as they are, by name, to be kept under ``vendor/`` in a capture folder.

    Raises
    ------
    InputError
        If ``path`` is no zip and no folder, or a file is missing, damaged, encrypted or too large.
    """
    return {Path(name).name: data for name, data in _recording(Path(path)).values()}


def _recording(path: Path) -> dict[str, tuple[str, bytes]]:
    """For left, right and calib: what to call the file in messages, and its bytes."""
    if path.is_dir():
        inside = [file.relative_to(path).as_posix() for file in (*path.glob("*"), *path.glob("*/*")) if file.is_file()]
        return {part: (f"{path}/{name}", read_bounded(path / name)) for part, name in _parts(path, inside).items()}
    if not path.is_file():
        raise InputError(path, "", "no such file or folder", "an Ensenso recording: a zip, an .enscam or a folder")
    try:
        # nothing is ever unpacked to disk, so a name in the archive cannot lead out of a folder
        with zipfile.ZipFile(path) as archive:
            parts = _parts(path, archive.namelist())
            return {part: (f"{path}/{name}", _read_member(archive, name, path)) for part, name in parts.items()}
    except InputError:
        raise
    except _DAMAGED as error:
        raise InputError(
            path, "", f"a file that cannot be unpacked ({error})", "a whole zip without password"
        ) from None


def _parts(path: Path, names: list[str]) -> dict[str, str]:
    """Choose the three files of a recording, at the top or one level down."""
    parts = {}
    for part, ending in _ENDINGS.items():
        found = [
            name for name in names
            if name.lower().endswith(ending) and len(steps := PurePosixPath(name).parts) <= 2 and steps[0] != "__MACOSX"
        ]  # fmt: skip
        if len(found) != 1:
            raise InputError(
                path, f"*{ending}", ", ".join(sorted(found)[:4]) or "no such file", "one in a recording",
                "a stereo recording has <base>_left.png, <base>_right.png and <base>_calib.json",
            )  # fmt: skip
        parts[part] = found[0]
    return parts


def _read_member(archive: zipfile.ZipFile, name: str, path: Path) -> bytes:
    with archive.open(name) as member:
        data = member.read(LARGEST_FILE + 1)  # the size that the archive states may be a lie
    if len(data) > LARGEST_FILE:
        raise InputError(path, name, f"more than {LARGEST_FILE} bytes", f"up to {LARGEST_FILE} bytes")
    return data


def _parse(text: bytes, where: str) -> dict[str, Any]:
    try:
        tree = json.loads(text.decode("utf-8-sig"), parse_constant=lambda _: None)  # NaN is no value
    except (ValueError, RecursionError) as error:
        raise InputError(where, "", f"text that is not JSON ({error})", "the camera's node as NxLib saves it") from None
    if not isinstance(tree, dict):
        raise InputError(where, "", type(tree).__name__, "a JSON object: the camera's node as NxLib saves it")
    return tree


class _Tree:
    """A node of the NxLib tree, read by paths such as ``Calibration/Stereo/Baseline``; what is missing is named."""

    def __init__(self, root: dict[str, Any], where: str) -> None:
        self.root, self.where = root, where

    def get(self, path: str, default: Any = None) -> Any:
        """Value at a path, or ``default`` where there is none."""
        node: Any = self.root
        for key in path.split("/"):
            if not isinstance(node, dict) or key not in node:
                return default
            node = node[key]
        return node

    def has(self, path: str) -> bool:
        """Whether there is something other than null at a path."""
        return self.get(path) is not None

    def text(self, path: str) -> str:
        """Text at a path."""
        value = self.get(path)
        if not isinstance(value, str):
            raise self.fault(path, "a text")
        return value

    def numbers(self, path: str, shape: tuple[int, ...]) -> NDArray[np.float64]:
        """Finite numbers of a given shape at a path, as they are stored."""
        allowed = f"{shape} finite numbers" if shape else "a finite number"
        try:
            values = np.asarray(self.get(path))
        except ValueError:  # lists of unequal lengths
            raise self.fault(path, allowed) from None
        if values.dtype.kind not in "iuf" or values.shape != shape or not (np.abs(values) <= 1e9).all():
            raise self.fault(path, allowed)
        return values.astype(np.float64)

    def fault(self, path: str, allowed: str) -> InputError:
        """Say that a field is missing or wrong."""
        value = self.get(path)
        found = "nothing" if value is None else repr(value)
        return InputError(self.where, path, found if len(found) <= 80 else found[:77] + "...", allowed)


def _is_virtual(root: dict[str, Any]) -> bool:
    """Whether the vendor's simulator made the images: a model or port of the camera or its imagers says Virtual."""
    sensor = root.get("Sensor")
    nodes = [root, sensor, *(sensor.values() if isinstance(sensor, dict) else ())]
    for node in (node for node in nodes if isinstance(node, dict)):
        port = node.get("Port")
        named = [node.get("ModelName"), node.get("Type"), port.get("Type") if isinstance(port, dict) else None]
        if any("virtual" in str(name).lower() for name in named):
            return True
    return False


def _camera_matrix(tree: _Tree, path: str) -> NDArray[np.float64]:
    K = tree.numbers(path, (3, 3)).T
    if K[0, 0] <= 0 or K[1, 1] <= 0 or np.any(K[2] != [0, 0, 1]) or K[1, 0] != 0:
        raise tree.fault(path, "a camera matrix, stored by columns, with positive focal lengths")
    return K


def _rotation(tree: _Tree, path: str) -> NDArray[np.float64]:
    rotation = tree.numbers(path, (3, 3)).T
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-4 or np.linalg.det(rotation) < 0:
        raise tree.fault(path, "a rotation, stored by columns")
    u, _, v = np.linalg.svd(rotation)  # stored to single precision: take the nearest exact rotation
    return np.asarray(u @ v)


def _distortion(tree: _Tree, path: str) -> NDArray[np.float64]:
    """Fourteen coefficients in OpenCV's order, of either way of storing them."""
    if isinstance(tree.get(path), dict):
        named = ["K1", "K2", "T1", "T2", "K3"]
        k1, k2, t1, t2, k3 = (float(tree.numbers(f"{path}/{name}", ())) for name in named)
        tilts = [float(tree.numbers(f"{path}/{n}", ())) if tree.has(f"{path}/{n}") else 0.0 for n in ("Rx", "Ry")]
    else:
        k1, k2, t1, t2, k3 = tree.numbers(path, (5,)).tolist()
        tilts = [0.0, 0.0]
    return np.array([k1, k2, t1, t2, k3, *[0.0] * 7, *tilts])


def _rig(tree: _Tree, size: tuple[int, int], dynamic: bool) -> Rig:
    scaling = 1.0
    stereo = "Calibration/Stereo"
    if dynamic and tree.has("Calibration/Dynamic/Stereo"):
        stereo = "Calibration/Dynamic/Stereo"
        if tree.has("Parameters/DisparityMap/Scaling"):
            scaling = float(tree.numbers("Parameters/DisparityMap/Scaling", ()))
            if not 0 < scaling <= 1:
                raise tree.fault("Parameters/DisparityMap/Scaling", "0 to 1")
    baseline = float(tree.numbers("Calibration/Stereo/Baseline", ()))
    if baseline <= 0:
        raise tree.fault("Calibration/Stereo/Baseline", "a positive distance [mm]: right camera to the right")
    K = {side: _camera_matrix(tree, f"{stereo}/{side}/Camera") / scaling for side in ("Left", "Right")}
    for matrix in K.values():
        matrix[2, 2] = 1.0
    if not np.allclose(K["Left"][:2, :2], K["Right"][:2, :2]) or not np.isclose(K["Left"][1, 2], K["Right"][1, 2]):
        raise tree.fault(f"{stereo}/Right/Camera", "the focal length and row of the left one: a rectified pair")
    rotation = {side: _rotation(tree, f"{stereo}/{side}/Rotation") for side in ("Left", "Right")}
    height, width = size
    rectification = Rectification(K["Left"], K["Right"], rotation["Left"], rotation["Right"], baseline, width, height)
    left_from_right = Transform(
        rotation["Left"].T @ rotation["Right"], rotation["Left"].T @ np.array([baseline, 0.0, 0.0])
    )
    cameras = {
        side.lower(): Camera(
            matrix=_camera_matrix(tree, f"Calibration/Monocular/{side}/Camera"),
            distortion=_distortion(tree, f"Calibration/Monocular/{side}/Distortion"),
            width=width, height=height, sensor_from_camera=place,
        )
        for side, place in (("Left", Transform.identity()), ("Right", left_from_right))
    }  # fmt: skip
    return Rig(cameras, rectification=rectification)


def _settings(tree: _Tree, dynamic: bool) -> dict[str, Any]:
    """What was set when the images were taken, under our names; what a file does not say is left out."""
    capture = "Parameters/Capture"
    volume = "Parameters/DisparityMap/MeasurementVolume"
    corners = {"near_mm": f"{volume}/Near/LeftTop", "far_mm": f"{volume}/Far/LeftTop"}
    read = {
        "auto_exposure": tree.get(f"{capture}/AutoExposure"),
        "gain": tree.get(f"{capture}/Gain"),
        "auto_gain": tree.get(f"{capture}/AutoGain"),
        "gain_boost": tree.get(f"{capture}/GainBoost"),
        "hardware_gamma": tree.get(f"{capture}/HardwareGamma"),
        "hdr": tree.get(f"{capture}/Hdr"),
        "projector_on": tree.get(f"{capture}/Projector"),
        "front_light_on": tree.get(f"{capture}/FrontLight"),
        "flex_view": tree.get(f"{capture}/FlexView"),
        "imager_model": tree.get("Sensor/ModelName"),
        "imager_temperature_degC": tree.get("Sensor/Temperature"),
        "pixel_size_um": tree.get("Sensor/PixelSize"),
        "link_target": tree.get("Link/Target"),
        "link_axis": tree.get("Link/Rotation/Axis"),
        "link_angle_rad": tree.get("Link/Rotation/Angle"),
        "link_translation_mm": tree.get("Link/Translation"),
    }
    for depth in corners:  # z of a corner of the volume that NxLib searches, in the rectified left frame
        read[depth] = float(tree.numbers(corners[depth], (3,))[2]) if tree.has(corners[depth]) else None
    settings = {name: value for name, value in read.items() if value is not None}
    if tree.has(f"{capture}/Exposure"):
        settings["exposure_s"] = float(tree.numbers(f"{capture}/Exposure", ())) / 1000  # NxLib: ms
    settings["maker"] = "Ensenso"
    settings["rectification"] = "dynamic" if dynamic and tree.has("Calibration/Dynamic/Stereo") else "static"
    return settings
