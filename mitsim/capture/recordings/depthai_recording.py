"""Read recordings of Luxonis' DepthAI (``RecordMessage``: MCAP files), with the device's calibration, as captures.

Points are measured from the first of these that was recorded; the setting ``measured_from`` names it:

raw pair
    matched by mitsim. The device's own maps, if recorded, are kept beside the images.
disparity
    Z = f B / d with the calibrated baseline B and the frame's own f.
device depth
    as computed by the device. Devices may use the design baseline instead of the calibrated one, which scales all
    depths (DepthAI's ``useSpecTranslation``; depthai-core, issues 358 and 847). The settings state both.

A disparity has units of 1/2^n px, and the recording does not state n. With a depth map, n follows from Z d = f B.
Otherwise it is the given one, or 5 for 16 bits (DepthAI 3's default) and 0 for 8.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from characterisation.files.checked_files import is_inside
from characterisation.files.errors import InputError
from mitsim.capture.capture import Capture
from mitsim.capture.decoding import Decoding
from mitsim.capture.recordings.depth_image import missing_depths
from mitsim.capture.recordings.depthai_calibration import DepthaiCalibration, read_depthai_calibration
from mitsim.capture.recordings.read_options import ReadOptions
from mitsim.capture.recordings.recording_files import frame_of, needs_recordings
from mitsim.sensor.camera import Camera, Rig, stereo_rectification
from mitsim.sensor.transforms import Transform

if TYPE_CHECKING:
    from mitsim.capture.recordings.depthai_frames import RecordedFrame

_VIDEOS = (".mp4", ".h264", ".h265", ".hevc", ".mjpeg", ".avi", ".mkv")

#: default n for a disparity of 16 bits: that of DepthAI 3
DEFAULT_SUBPIXEL_BITS = 5

#: largest relative difference of f B between the maps and the calibration: the design baseline and rounding of f differ
_LOOSE = 0.25


def recorded_streams(path: str | Path) -> dict[str, Path]:
    """Return the files of the streams ``left``, ``right``, ``disparity`` and ``depth``, recognised by their names."""
    path = Path(path)
    if path.is_file():
        files = [path]
    elif path.is_dir():
        there = (file for file in sorted(path.iterdir()) if file.suffix.lower() == ".mcap")
        files = [file for file in there if file.is_file() and is_inside(file, path)]
    else:
        raise InputError(path, "", "no such file or folder", "an .mcap file, or a folder of them")
    streams: dict[str, Path] = {}
    for file in files:
        stream = _stream_of(file.stem)
        if stream is None:
            continue
        if stream in streams:
            raise InputError(path, stream, f"{streams[stream].name} and {file.name}", "one file of each stream")
        streams[stream] = file
    videos = [] if path.is_file() else sorted(file.name for file in path.iterdir() if file.suffix.lower() in _VIDEOS)
    if not streams and videos:
        hint = "video is compressed with loss, which adds noise: record the streams themselves"
        raise InputError(path, videos[0], "a video", "streams recorded by RecordMessage, .mcap", hint)
    if not streams:
        names = ", ".join(file.name for file in files[:6]) or "no .mcap"
        raise InputError(path, "", names, "files whose names say left, right, disparity or depth")
    return streams


def read_depthai_recording(path: str | Path, options: ReadOptions) -> Capture:
    """Read one frame of a recording: an .mcap file, or a folder of them, one for each stream.

    The calibration is JSON as DepthAI saves it; by default ``calibration.json`` or the only ``*calib*.json`` beside the
    streams. Raises MissingEnvironmentError without the packages of the extra ``recordings``.
    """
    path = Path(path)
    streams = recorded_streams(path)
    device_calibration = read_depthai_calibration(options.calibration or calibration_beside(path))
    frames = _read_frames(streams, frame_of(options.frame, path))
    for stream, one in frames.items():
        socket = device_calibration.right if stream == "right" else device_calibration.left
        if one.socket not in (0, socket):
            hint = "align maps to the left camera: setDepthAlign(RECTIFIED_LEFT)"
            raise InputError(streams[stream], "instanceNum", one.socket, f"the camera at socket {socket}", hint)
    first = frames.get("left", next(iter(frames.values())))
    settings: dict[str, Any] = {
        "imported_from": path.name,
        "maker": "Luxonis",
        "streams": {name: file.name for name, file in streams.items()},
        "sequence": first.sequence,
        "baseline_mm": float(np.linalg.norm(device_calibration.right_from_left.translation)),
        "spec_baseline_mm": device_calibration.spec_baseline_mm,
    }
    if first.exposure_s > 0:
        settings["sensitivity_iso"] = first.sensitivity_iso
    derived = _derived(frames, device_calibration, options.subpixel_bits, settings)
    images: dict[str, NDArray[Any]] = {}
    if {"left", "right"} <= set(frames):
        technology, settings["measured_from"] = "active_stereo", "raw pair"
        images = {side: frames[side].image[None] for side in ("left", "right")}
        rig = _pair(frames["left"], frames["right"], device_calibration, streams["right"])
    elif "disparity" in frames:
        technology, settings["measured_from"] = "disparity_map", "disparity"
        rig = _disparity_rig(frames["disparity"], device_calibration)
    elif "depth" in frames:
        technology, settings["measured_from"] = "depth_map", "device depth"
        rig = _depth_rig(frames["depth"], device_calibration)
    else:
        raise InputError(path, ", ".join(streams), "a single image", "left and right, disparity, or depth")
    return Capture(
        sensor=options.named or device_calibration.name,
        technology=technology,
        source="replay",
        rig=rig,
        images=images,
        bits=8 * max((stack.dtype.itemsize for stack in images.values()), default=2),
        decoding=Decoding(exposure_s=first.exposure_s if first.exposure_s > 0 else None),
        settings=settings,
        derived=derived,
    )


def _read_frames(streams: dict[str, Path], frame: int | None) -> dict[str, RecordedFrame]:
    """Return the frames of the streams; only here are the packages of the extra ``recordings`` imported."""
    with needs_recordings(next(iter(streams.values())), "a recording of DepthAI"):
        from mitsim.capture.recordings.depthai_frames import read_frames
    return read_frames(streams, frame)


def calibration_beside(path: Path) -> Path:
    """Return the only calibration in the folder of a recording."""
    folder = path if path.is_dir() else path.parent
    if (folder / "calibration.json").is_file():
        return folder / "calibration.json"
    files = sorted(file for file in folder.iterdir() if re.search(r"calib.*\.json$", file.name.lower()))
    if len(files) != 1:
        names = ", ".join(file.name for file in files[:4]) or "no such file"
        raise InputError(folder, "*calib*.json", names, "one calibration beside the recording", "or --calibration FILE")
    return files[0]


def _stream_of(name: str) -> str | None:
    """Return the stream of a file's name; None for unused ones, such as rectified images and confidence."""
    plain = re.sub("[^a-z0-9]", "", name.lower()).replace("depthai", "")
    if "rectified" in plain or "confidence" in plain:
        return None
    words = ("disparity", "depth", "left", "camb", "right", "camc")
    word = next((word for word in words if word in plain), None)
    return {"camb": "left", "camc": "right"}.get(word, word) if word else None


def _derived(
    frames: dict[str, RecordedFrame], calibration: DepthaiCalibration, bits: int | None, settings: dict[str, Any]
) -> dict[str, NDArray[np.float32]]:
    """Return the device's own maps, NaN where it has no value."""
    derived = {}
    if "depth" in frames:
        levels = frames["depth"].image  # DepthAI: uint16 [mm]
        missing, warnings = missing_depths(levels)
        derived["depth"] = np.where(missing, np.float32(np.nan), levels.astype(np.float32))
        if warnings:
            settings["warnings"] = warnings
    if "disparity" in frames:
        frame = frames["disparity"]
        by_depth = _subpixel_bits(frame, frames.get("depth"), calibration)
        default = DEFAULT_SUBPIXEL_BITS if frame.image.dtype == np.uint16 else 0
        origins = {"option": bits, "depth": by_depth, "default": default}
        origin, bits = next((origin, number) for origin, number in origins.items() if number is not None)
        settings |= {"subpixel_bits_from": origin, "subpixel_bits": bits}
        disparity = frame.image.astype(np.float32) / np.float32(2**bits)
        derived["disparity"] = np.where(disparity > 0, disparity, np.float32(np.nan))
    return derived


def _subpixel_bits(frame: RecordedFrame, depth: RecordedFrame | None, calibration: DepthaiCalibration) -> int | None:
    """Return n for which Z d = f B; None without a depth map of the same pixels, or if no n fits."""
    if depth is None or depth.image.shape != frame.image.shape:
        return None
    both = ~missing_depths(depth.image)[0] & (frame.image > 0)
    if not both.any():
        return None
    product = float(np.median(depth.image[both].astype(float) * frame.image[both]))
    baseline = float(np.linalg.norm(calibration.right_from_left.translation))
    steps = np.log2(product / (_matrix(frame, calibration)[0, 0] * baseline))
    nearest = round(steps)
    return nearest if 0 <= nearest <= 8 and abs(steps - nearest) < np.log2(1 + _LOOSE) else None


def _matrix(frame: RecordedFrame, calibration: DepthaiCalibration) -> NDArray[np.float64]:
    """Return K of a map's pixels: the frame's own, or that of the left camera at the frame's size."""
    return frame.matrix if frame.matrix is not None else calibration.rig(*frame.image.shape[::-1]).reference.matrix


def _without_skew(frame: RecordedFrame, calibration: DepthaiCalibration) -> NDArray[np.float64]:
    return _matrix(frame, calibration) * [[1, 0, 1], [0, 1, 1], [1, 1, 1]]


def _pair(left: RecordedFrame, right: RecordedFrame, calibration: DepthaiCalibration, where: Path) -> Rig:
    height, width = left.image.shape
    if right.image.shape != (height, width) or right.image.dtype != left.image.dtype:
        found = f"{right.image.shape[1]} x {right.image.shape[0]} px of {right.image.dtype}"
        raise InputError(where, "size", found, f"{width} x {height} px of {left.image.dtype}, as the left image")
    return calibration.rig(width, height)


def _disparity_rig(frame: RecordedFrame, calibration: DepthaiCalibration) -> Rig:
    """Return the calibrated pair, rectified as by the device: its rotations, and one K for both."""
    rig, K = calibration.rig(*frame.image.shape[::-1]), _without_skew(frame, calibration)
    pair = stereo_rectification(*rig.cameras.values())
    return replace(rig, rectification=replace(pair, matrix_left=K, matrix_right=K))


def _depth_rig(frame: RecordedFrame, calibration: DepthaiCalibration) -> Rig:
    """Return the rectified camera of the depth map, which has no distortion, in the frame of the left camera."""
    height, width = frame.image.shape
    turned = stereo_rectification(*calibration.rig(width, height).cameras.values()).rotation_left
    K = _without_skew(frame, calibration)
    return Rig({"depth": Camera(K, np.zeros(5), width, height, Transform(turned.T, np.zeros(3)))})
