"""Read a 16-bit depth image and its camera as a capture.

Signal chain: PNG or TIFF of 16 bits -> grey levels, one of which marks missing depths -> times ``scale_mm`` -> depth
along the camera's axis [mm].

The image uses the camera's own pixels: if the calibration has lens distortion, the image has it too.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from characterisation.files.errors import InputError
from mitsim.capture.capture import Capture
from mitsim.capture.decoding import Decoding
from mitsim.capture.grey_image import read_grey
from mitsim.capture.recordings.calibration_file import Calibrated, camera_of, read_calibration
from mitsim.sensor.camera import Rig

Depth = NDArray[np.float32]

#: depths beyond this are not measurements [mm]
FARTHEST_MM = 1e6


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
    depth = image.astype(np.float32) * np.float32(scale_mm)
    depth[image == invalid] = np.nan
    if (image == invalid).all():
        raise InputError(path, "", f"an image with only the level {invalid}", "an image with some depths")
    settings = {"depth_scale_mm": float(scale_mm), "depth_invalid": int(invalid), "imported_from": path.name}
    read = read_calibration(calibration, (image.shape[1], image.shape[0]))
    return depth_capture(depth, read, path, settings, camera=camera, sensor=sensor)


def depth_capture(
    depth: Depth,
    calibrated: Calibrated,
    where: Path,
    settings: dict[str, Any],
    *,
    camera: str | None = None,
    sensor: str | None = None,
) -> Capture:
    """Return the capture of a map of depths.

    Parameters
    ----------
    depth
        (H, W) along the axis of the camera [mm], NaN where missing.
    calibrated
        The cameras.
    where
        File of the map, for messages.
    settings
        Records of the import.
    camera
        Name of the camera; by default the first.
    sensor
        Name of the sensor; by default that of the calibration, or ``depth-camera``.

    Raises
    ------
    InputError
        If no pixel has a depth, a depth is no measurement, or the size of the map differs from the camera's.

    See Also
    --------
    read_depth_image : of a file
    """
    height, width = depth.shape
    eye = camera_of(calibrated, camera, (width, height), where)
    seen = depth[np.isfinite(depth)]
    if not seen.size:
        raise InputError(where, "", "no pixel with a depth", "an image with some depths")
    if seen.min() <= 0 or seen.max() > FARTHEST_MM:
        found = f"{seen.min():g} to {seen.max():g} mm"
        raise InputError(where, "depth", found, f"over 0 to {FARTHEST_MM:g} mm", "check --scale")
    if calibrated.notes:
        settings = settings | {"warnings": [*settings.get("warnings", []), *calibrated.notes]}
    near, far = calibrated.range_mm or (None, None)
    return Capture(
        sensor=sensor or calibrated.sensor or "depth-camera",
        technology="depth_map",
        source="device",
        rig=Rig({camera or next(iter(calibrated.rig.cameras)): eye}, calibrated.rig.projector),
        images={},
        bits=16,
        decoding=Decoding(near_mm=near, far_mm=far),
        settings=settings,
        derived={"depth": depth},
    )
