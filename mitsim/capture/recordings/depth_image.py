"""Read a 16-bit depth image, or depths in an ``.npy``, and its camera as a capture.

Signal chain: PNG or TIFF of 16 bits, floating point of TIFF, PFM or EXR, or an array -> levels, one of which marks
missing depths -> times ``scale_mm`` -> depth along the camera's axis [mm].

The image uses the camera's own pixels: if the calibration has lens distortion, the image has it too.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
from numpy.typing import NDArray

from characterisation.files.checked_files import read_bounded
from characterisation.files.errors import InputError
from characterisation.words.numbers import percent
from mitsim.capture.capture import Capture
from mitsim.capture.decoding import Decoding
from mitsim.capture.grey_image import read_depths
from mitsim.capture.npy import NPY_MAGIC
from mitsim.capture.recordings.array_file import arrays_in, disparities, is_disparity, map_among, unit_of_depths
from mitsim.capture.recordings.calibration_file import Calibrated, camera_of, read_calibration
from mitsim.capture.recordings.cloud_numbers import FAR_BEYOND, FARTHEST_MM, METRES_UNDER, NEITHER_ABOVE, near_note
from mitsim.capture.recordings.read_options import ReadOptions
from mitsim.capture.recordings.recording_files import EXR_MAGIC, frame_of
from mitsim.capture.recordings.stated_scale import check_scale, scale_by_folder, stated_scales
from mitsim.sensor.camera import Rig
from mitsim.sensor.png import LONGEST_SIDE_PX

Depth = NDArray[np.float32]

#: beginning of the names of folders of disparities, such as KITTI's disp_occ_0, whose files are named by numbers alone
_DISPARITIES = re.compile(r"disp(?:arit(?:y|ies))?s?(?![a-z])", re.IGNORECASE)

#: names of the channel of an OpenEXR image that has depths, along the axis of the camera
_CHANNELS = ("Z", "depth.Z", "depth.V", "depth.Y", "Depth.Z", "Depth.V")

#: share of the pixels with one largest depth from which it may mean no depth; chosen
_MARKED = 0.01


def read_depth_image(path: str | Path, options: ReadOptions) -> Capture:
    """Read one depth image, or one of several in a file of NumPy.

    The depth of one level is by default 1 mm, or 1000 mm for floating point with a median under
    :data:`~mitsim.capture.recordings.cloud_numbers.METRES_UNDER`. Depths are missing at the level ``invalid``, at 0 and
    the largest one of 16 bits, and where they are under 0 or far beyond all others. Raises InputError if no camera is
    given, the image or the calibration cannot be read, the image has 8 bits, its size differs from the camera's, or it
    has disparities or an unknown unit.
    """
    path = Path(path)
    calibration, frame = options.cameras_of(path, "a depth image"), frame_of(options.frame, path)
    of_disparities = _DISPARITIES.match(path.resolve().parent.name) and "depth" not in path.stem.lower()
    if of_disparities or is_disparity(path.stem):
        raise disparities(path)
    image, beside, unit_mm = _levels(path, frame)
    scale_mm, invalid = options.scale_mm or unit_mm, options.invalid or 0
    if image.dtype == np.uint8:
        hint = "an 8-bit picture has lost its depths: save the device's 16 bits"
        raise InputError(path, "depth", "8 bits", "16 bits", hint)
    missing, warnings = missing_depths(image, invalid)
    median = 0.0 if missing.all() else float(np.median(image[~missing]))
    in_metres = image.dtype.kind == "f" and median < METRES_UNDER
    scale_mm, assumed = scale_mm or (1000.0 if in_metres else 1.0), scale_mm is None
    settings: dict[str, Any] = {"imported_from": path.name}
    settings |= {"depth_scale_mm": float(scale_mm), "depth_invalid": int(invalid)}
    if assumed and not in_metres and (note := near_note(median, "--scale 10")):
        warnings.append(note)
    if warnings:
        settings["warnings"] = warnings
    if missing.all():
        levels = np.unique(image[np.isfinite(image)])
        only = f"an image with only the level {levels[0]:g}" if len(levels) == 1 else "no depth over 0"
        raise InputError(path, "", only, "an image with some depths")
    if assumed and median > 0 and not METRES_UNDER <= median * scale_mm <= NEITHER_ABOVE:
        found = f"a median of {median:.4g}, in a unit that the file does not state"
        allowed = f"{METRES_UNDER:g} to {NEITHER_ABOVE:g} mm from the camera"
        raise InputError(path, "depth", found, allowed, "name the depth of one level in mm: --scale 0.001")
    with np.errstate(over="ignore"):
        depth = image.astype(np.float32) * np.float32(scale_mm)
    depth[missing] = np.nan
    read = read_calibration(calibration, (image.shape[1], image.shape[0]))
    if assumed and image.dtype.kind != "f":
        check_scale(beside, path)
        check_scale(read.depth_scales, calibration)
        if not beside and not read.depth_scales:
            check_scale(scale_by_folder(path), path.parent.parent)
    return depth_capture(depth, read, path, settings, options)


def missing_depths(image: NDArray[Any], invalid: int = 0) -> tuple[NDArray[np.bool_], list[str]]:
    """Return the pixels (H, W) of an image without a depth, and warnings about those that the user did not name.

    These have the level ``invalid`` or 0, no finite number, or less than 0; the largest level of 16 bits; or one level
    far beyond all others, such as 1e10, in many pixels.
    """
    missing = (image == invalid) | (image == 0) | ~np.isfinite(image)
    warnings: list[str] = []

    def leave_out(pixels: NDArray[np.bool_], reason: str) -> None:
        if pixels.any():
            warnings.append(f"{percent(float(np.mean(pixels)))} of the pixels have {reason}: left out")
            missing[pixels] = True

    full = np.iinfo(np.uint16).max
    if image.dtype == np.uint16 and invalid != full:
        leave_out((image == full) & ~missing, f"the level {full}, the largest")
    elif image.dtype == np.uint16:
        missing |= image == full
    under = (image < 0) & ~missing
    if under.sum() < 0.5 * (~missing).sum() or len(np.unique(image[under])) == 1:
        leave_out(under, "a depth under 0")
    if (~missing).any():
        seen = image[~missing]
        farthest = seen.max()
        same = (image == farthest) & ~missing
        nearer = seen[seen < farthest]
        many = nearer.size and same.sum() >= _MARKED * image.size
        if many and float(farthest) > FAR_BEYOND * float(np.median(nearer)) > 0:
            leave_out(same, f"the same depth of {farthest:g}, far beyond all others")
    return missing, warnings


def _levels(path: Path, frame: int | None) -> tuple[NDArray[Any], dict[str, float], float | None]:
    """Return the numbers (H, W) of an image or a file of NumPy, the scales beside them, and their unit [mm] by name.

    Integers beyond 16 bits are floating point.
    """
    data = read_bounded(path, "a depth image")
    arrays: dict[str, NDArray[Any]] = {}
    if data.startswith(NPY_MAGIC) or path.suffix.lower() == ".npz":
        arrays = arrays_in(data, path)
        values = map_among(arrays, path, frame)
    else:
        values = _exr_depths(path) if data.startswith(EXR_MAGIC) else read_depths(path)
    if values.ndim != 2 or not all(1 <= side <= LONGEST_SIDE_PX for side in values.shape):
        raise InputError(path, "shape", " x ".join(map(str, values.shape)), "depths of rows x columns")
    if values.dtype.kind != "f" and values.dtype not in (np.uint8, np.uint16):
        values = values.astype(np.uint16 if values.min() >= 0 and values.max() < 1 << 16 else np.float64)
    return values, dict(stated_scales(arrays)), unit_of_depths(arrays)


def _exr_depths(path: Path) -> NDArray[Any]:
    """Return the depths (H, W) of an OpenEXR image: of the channel of a depth, else of the only one, or equal ones."""
    try:
        with OpenEXR.File(str(path), separate_channels=True) as image:
            channels = {name: np.array(channel.pixels) for name, channel in image.channels().items()}
    except (RuntimeError, ValueError, KeyError) as error:
        raise InputError(path, "", str(error), "a whole OpenEXR image") from None
    named = [name for name in _CHANNELS if name in channels][:1]
    values = [channels[name] for name in named or channels if name.rpartition(".")[2] != "A"]
    if not values or any(not np.array_equal(values[0], other, equal_nan=True) for other in values[1:]):
        raise InputError(path, "channels", ", ".join(channels) or "none", f"one channel, or one named {_CHANNELS[0]}")
    return values[0].astype(np.float32) if values[0].dtype == np.float16 else values[0]


def depth_capture(
    depth: Depth, calibrated: Calibrated, where: Path, settings: dict[str, Any], options: ReadOptions
) -> Capture:
    """Return the capture of a map of depths (H, W) along the axis of the camera [mm], NaN where missing.

    The camera is by default the first; ``settings`` are records of the import. Raises InputError if no pixel has a
    depth, a depth is no measurement, or the size of the map differs from the camera's.
    """
    height, width = depth.shape
    name, eye = camera_of(calibrated, options.camera, (width, height), where)
    seen = depth[~np.isnan(depth)]
    if not seen.size:
        raise InputError(where, "", "no pixel with a depth", "an image with some depths")
    if seen.min() <= 0 or seen.max() > FARTHEST_MM:
        found = f"{seen.min():g} to {seen.max():g} mm"
        raise InputError(where, "depth", found, f"over 0 to {FARTHEST_MM:g} mm", "check --scale")
    if calibrated.notes:
        settings = settings | {"warnings": [*settings.get("warnings", []), *calibrated.notes]}
    near, far = calibrated.range_mm or (None, None)
    return Capture(
        sensor=options.named or calibrated.sensor or "depth-camera",
        technology="depth_map",
        source="device",
        rig=Rig({name: eye}, calibrated.rig.projector),
        images={},
        bits=16,
        decoding=Decoding(near_mm=near, far_mm=far),
        settings=settings,
        derived={"depth": depth},
    )
