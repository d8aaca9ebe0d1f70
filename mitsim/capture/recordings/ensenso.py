"""Read Ensenso recordings ("file cameras": a zip, an .enscam or a folder) as captures.

Signal chain: ``*_left.png``, ``*_right.png`` -> images; ``*_calib.json`` (the camera's node of the NxLib tree) -> rig
with the manufacturer's rectification.

The files of one image set share a base name. A FlexView series, pairs of images with a shifted pattern, has two digits
before the side: ``<base>_00_left.png`` to ``<base>_15_right.png`` (the manufacturer's manual 3.0, *Using File
Cameras*). A recording may contain several sets, and several cameras in separate folders.

The files do not state the following; real recordings confirm it:

- Cameras, rectification and ``Link``: see :mod:`mitsim.capture.recordings.nxlib_calibration`.
- ``Link`` transforms NxLib's point maps to a workspace. Points decoded from the images stay in the sensor frame. The
  settings keep ``sensor_from_workspace``, with which ``mitsim decode --points-in workspace`` transforms them. For a
  point map saved by NxLib, the link is inverted (:mod:`mitsim.capture.recordings.organised_cloud`).
"""

from __future__ import annotations

import re
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from characterisation.files.errors import InputError
from mitsim.capture.capture import Capture
from mitsim.capture.decoding import Decoding
from mitsim.capture.grey_image import Image, check_image_size, decode_grey
from mitsim.capture.recordings.nxlib_calibration import NxLibTree, nxlib_rig, sensor_from_workspace
from mitsim.capture.recordings.recording_files import chosen_frame, plain_name, recorded_files, recorded_names

_CALIB = "_calib.json"
_EXPECTED = "an Ensenso recording: a zip, an .enscam or a folder"


def read_ensenso(path: str | Path, *, dynamic: bool = True, frame: int | None = None) -> Capture:
    """Read one image set of a recording: a zip or .enscam file, or a folder.

    It holds ``<base>_left.png``, ``<base>_right.png`` and ``<base>_calib.json``, or a FlexView series of them, at its
    top or up to two levels down; PNG or TIFF. ``dynamic`` takes the rectification as last corrected by the device, not
    the factory's. ``frame`` is the number of the set, counted from 0 in the order of the names; required if there are
    several.

    ``source`` of the capture is ``device``, or ``simulated`` for the vendor's virtual cameras. The images of a FlexView
    series are in the order of the pattern's shifts, for each side. Raises InputError if a file is missing or damaged,
    or the calibration lacks a field; the error names it.
    """
    path = Path(path)
    calibration, *names = _image_set(path, frame)
    data = recorded_files(path, [calibration, *names])
    tree = NxLibTree(data[calibration], f"{path}/{calibration}")
    images = [decode_grey(data[name], f"{path}/{name}") for name in names]
    left, right = images[: len(images) // 2], images[len(images) // 2 :]
    height, width = left[0].shape
    for name, image in zip(names, images, strict=True):
        check_image_size(image, (width, height), f"{path}/{name}", "as the left image")
    if tree.has("Sensor/Size") and tree.numbers("Sensor/Size", (2,)).tolist() != [width, height]:
        raise tree.fault("Sensor/Size", f"{width} x {height} px, as the images are; binned ones are not read")
    decoding, settings = _decoding(tree), _settings(tree, dynamic)
    _check_series(tree, len(left))
    return Capture(
        sensor=tree.text("ModelName"),
        technology="active_stereo",
        source="simulated" if tree.is_virtual() else "device",
        rig=nxlib_rig(tree, (width, height), dynamic=dynamic),
        images={"left": _stacked(left), "right": _stacked(right)},
        bits=8 * max(image.dtype.itemsize for image in images),
        decoding=decoding,
        settings=settings | {"image_set": PurePosixPath(calibration[: -len(_CALIB)]).name},
        serial=tree.text("SerialNumber"),
    )


def ensenso_originals(path: str | Path, frame: int | None = None) -> dict[str, bytes]:
    """Read the files of an image set unchanged, by name, for ``vendor/`` in a capture folder."""
    data = recorded_files(Path(path), _image_set(Path(path), frame))
    return {plain_name(name): content for name, content in data.items()}


def image_sets(path: str | Path) -> list[str]:
    """Return the names of the image sets of a recording, in order."""
    names = recorded_names(Path(path), _EXPECTED)
    return [PurePosixPath(name[: -len(_CALIB)]).name for name in names if name.lower().endswith(_CALIB)]


def _image_set(path: Path, frame: int | None) -> list[str]:
    """Return the names of the files of one set: its calibration, then the left images in order, and as many right."""
    names = recorded_names(path, _EXPECTED)
    hint = "a stereo recording has <base>_left.png, <base>_right.png and <base>_calib.json"
    bases = [name[: -len(_CALIB)] for name in names if name.lower().endswith(_CALIB)]
    for side in ("left", "right"):
        if not any(re.search(rf"_{side}\.(png|tiff?)$", name, re.IGNORECASE) for name in names):
            raise InputError(path, f"*_{side}.png", "no such file", "one in a recording", hint)
    if not bases:
        raise InputError(path, f"*{_CALIB}", "no such file", "one in a recording", hint)
    shown = ", ".join(PurePosixPath(base).name for base in bases[:4])
    number = chosen_frame(frame, len(bases), path, f"image sets ({shown})")
    strays = [
        PurePosixPath(name).name
        for name in names
        if re.search(r"_(left|right)\.(png|tiff?)$", name, re.IGNORECASE)
        and not any(_side_pattern(base, "(?:left|right)").fullmatch(name) for base in bases)
    ]
    if frame is None and strays:
        raise InputError(path, strays[0], "an image without its calibration", "complete image sets", hint)
    base = bases[number]
    left, right = (_of_side(path, base, side, names, hint) for side in ("left", "right"))
    if len(left) != len(right):
        raise InputError(path, f"{base}_*", f"{len(left)} left and {len(right)} right images", "as many of each")
    return [base + _CALIB, *left, *right]


def _of_side(path: Path, base: str, side: str, names: list[str], hint: str) -> tuple[str, ...]:
    """Return the image of one side, or the images of a FlexView series in order."""
    pattern = _side_pattern(base, side)
    series = sorted((match.group(1) or "", name) for name in names if (match := pattern.fullmatch(name)))
    numbers = [number for number, _ in series]
    if numbers not in ([""], [f"{index:02d}" for index in range(max(len(series), 1))]):
        shown = ", ".join(PurePosixPath(name).name for _, name in series[:4]) or "no such file"
        raise InputError(path, f"*_{side}.png", shown, f"one for {base}, or a series from _00_{side}.png on", hint)
    return tuple(name for _, name in series)


def _side_pattern(base: str, side: str) -> re.Pattern[str]:
    """Return the pattern of a set's image names; group 1 is the number in a series."""
    return re.compile(rf"{re.escape(base)}(?:_(\d\d))?_{side}\.(?:png|tiff?)", re.IGNORECASE)


def _check_series(tree: NxLibTree, count: int) -> None:
    """Check that the number of pairs is the camera's FlexView setting."""
    asked = tree.get("Parameters/Capture/FlexView")
    if asked is None:
        return
    expected = asked if isinstance(asked, int) and asked > 1 else 1
    if count not in (expected, 1):
        raise tree.fault("Parameters/Capture/FlexView", f"{count}, the number of image pairs")
    if count < expected:
        raise tree.fault("Parameters/Capture/FlexView", "false or 0, since there is one image pair")


def _stacked(images: list[Image]) -> Image:
    """Stack the images of one side (n, H, W), in the type of the deepest."""
    return np.stack(images) if len({image.dtype for image in images}) == 1 else np.stack(images).astype(np.uint16)


def _decoding(tree: NxLibTree) -> Decoding:
    """Return exposure and range of the camera; a value missing in the file is None."""
    exposure, volume = "Parameters/Capture/Exposure", "Parameters/DisparityMap/MeasurementVolume"
    corners = (f"{volume}/Near/LeftTop", f"{volume}/Far/LeftTop")
    # z of a corner of the volume that NxLib searches, in the rectified left frame
    near, far = (float(tree.numbers(corner, (3,))[2]) if tree.has(corner) else None for corner in corners)
    for corner, depth in zip(corners, (near, far), strict=True):
        if depth is not None and not 0 < depth <= 1e7:
            raise tree.fault(corner, "z over 0 to 1e7 mm")
    seconds = float(tree.numbers(exposure, ())) / 1000 if tree.has(exposure) else None  # NxLib: ms
    if seconds is not None and not 0 <= seconds <= 1e6:
        raise tree.fault(exposure, "0 to 1e9 ms")
    return Decoding(exposure_s=seconds, near_mm=near, far_mm=far)


def _settings(tree: NxLibTree, dynamic: bool) -> dict[str, Any]:
    """Return the camera's other settings under mitsim's names; settings missing in the file are left out."""
    capture = "Parameters/Capture"
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
    settings = {name: value for name, value in read.items() if value is not None}
    workspace = sensor_from_workspace(tree, dynamic=dynamic)
    if workspace is not None:
        settings["sensor_from_workspace"] = workspace.matrix().tolist()
    settings["maker"] = "Ensenso"
    settings["rectification"] = "dynamic" if dynamic and tree.has("Calibration/Dynamic/Stereo") else "static"
    return settings
