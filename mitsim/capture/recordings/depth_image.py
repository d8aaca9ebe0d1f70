"""Read a 16-bit depth image and its camera as a capture.

Signal chain: PNG or TIFF of 16 bits -> grey levels, one of which marks missing depths -> times ``scale_mm`` -> depth
along the camera's axis [mm].

The image uses the camera's own pixels: if the calibration has lens distortion, the image has it too.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from characterisation.files.errors import InputError
from mitsim.capture.capture import Capture
from mitsim.capture.decoding import Decoding
from mitsim.capture.grey_image import read_grey
from mitsim.capture.recordings.calibration_file import camera_of, read_calibration
from mitsim.sensor.camera import Rig


def read_depth_image(
    path: str | Path,
    calibration: str | Path,
    *,
    scale_mm: float = 1.0,
    invalid: int = 0,
    camera: str | None = None,
    sensor: str | None = None,
) -> Capture:
    """Read one depth image.

    Parameters
    ----------
    path
        Path of the image.
    calibration
        A preset's name or a file, see :mod:`mitsim.capture.recordings.calibration_file`.
    scale_mm
        Depth of one grey level [mm].
    invalid
        Grey level of missing depths.
    camera
        Name of the camera in the calibration; by default the first.
    sensor
        Name of the sensor; by default that of the calibration, or ``depth-camera``.

    Raises
    ------
    InputError
        If the image or the calibration cannot be read, the image has 8 bits, or its size differs from the camera's.
    """
    path = Path(path)
    image = read_grey(path)
    if image.dtype != np.uint16:
        hint = "an 8-bit picture has lost its depths: save the device's 16 bits"
        raise InputError(path, "depth", "8 bits", "16 bits", hint)
    height, width = image.shape
    read = read_calibration(calibration, (width, height))
    eye = camera_of(read, camera, (width, height), path)
    depth = image.astype(np.float32) * np.float32(scale_mm)
    depth[image == invalid] = np.nan
    if not np.isfinite(depth).any():
        raise InputError(path, "", f"an image with only the level {invalid}", "an image with some depths")
    settings: dict[str, Any] = {"depth_scale_mm": float(scale_mm), "depth_invalid": int(invalid)}
    settings["imported_from"] = path.name
    if read.notes:
        settings["warnings"] = list(read.notes)
    near, far = read.range_mm or (None, None)
    return Capture(
        sensor=sensor or read.sensor or "depth-camera",
        technology="depth_map",
        source="device",
        rig=Rig({camera or next(iter(read.rig.cameras)): eye}, read.rig.projector),
        images={},
        bits=16,
        decoding=Decoding(near_mm=near, far_mm=far),
        settings=settings,
        derived={"depth": depth},
    )
