"""Make the files of a capture's folder in memory: their bytes by path, and the index with their SHA-256."""

from __future__ import annotations

import hashlib
import json
import platform
import re
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from characterisation.files.checked_files import content_checksum
from characterisation.files.documents import validate
from characterisation.files.errors import InputError
from characterisation.files.threads import in_threads
from characterisation.words.version import __version__
from mitsim.capture.calibration import CalibrationDocument, PoseDocument, calibration_table, pose_table
from mitsim.capture.capture import DERIVED_UNITS, Capture
from mitsim.capture.capture_document import FRAME, SCHEMA_VERSION, UNITS, CaptureDocument
from mitsim.capture.decoding import settings_table
from mitsim.capture.npy import encode_npy
from mitsim.capture.truth import FOLDER, Truth, encode_exr
from mitsim.sensor.png import LONGEST_SIDE_PX, encode_png

#: allowed names of cameras and files
SAFE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")


def packed(
    capture: Capture,
    folder: str | Path,
    *,
    vendor: Mapping[str, bytes] | None = None,
    truth: Mapping[str, Truth] | None = None,
) -> dict[str, bytes]:
    """Return the bytes of every file of a capture's folder, by path in the folder, ``capture.json`` last.

    Raises InputError if something in the capture cannot be written to a file, or the file could not be read back.

    Parameters
    ----------
    capture, folder, vendor, truth
        Capture to write, folder that messages name, the maker's files by name, and true values by camera.
    """
    folder = Path(folder)
    extra = {("vendor", name): data for name, data in (vendor or {}).items()}
    extra |= {(FOLDER, f"{camera}.exr"): encode_exr(one) for camera, one in (truth or {}).items()}
    calibration = calibration_table(capture.rig)
    pose = pose_table(capture.world_from_sensor)
    validate(folder / "calibration.json", calibration, CalibrationDocument)
    validate(folder / "pose.json", pose, PoseDocument)
    files = {
        "calibration.json": _json(calibration, folder, "calibration"),
        "settings.json": _json(settings_table(capture.decoding, capture.settings), folder, "settings"),
        "pose.json": _json(pose, folder, "pose"),
    }
    entries: list[dict[str, Any]] = [{"path": path, "role": path.removesuffix(".json")} for path in files]
    for camera, stack in capture.images.items():
        _check_name(camera, folder, "images", "the name of a camera")
        if stack.dtype not in (np.uint8, np.uint16) or stack.size == 0 or len(stack) > 1000:
            found = f"{stack.dtype} {stack.shape}"
            raise InputError(folder, f"images.{camera}", found, "1 to 1000 uint8 or uint16 images")
        paths = [f"images/{camera}_{frame:03d}.png" for frame in range(len(stack))]
        for path, image in zip(paths, stack, strict=True):
            check_image(image, [], capture.bits, folder / path)
        for frame, (path, image, data) in enumerate(zip(paths, stack, in_threads(encode_png, stack), strict=True)):
            files[path] = data
            entries.append(
                {"path": path, "role": "image", "camera": camera, "frame": frame}
                | {"dtype": str(image.dtype), "shape": list(image.shape), "unit": "DN", "scale": 1.0, "invalid": None}
            )
    for name, values in capture.derived.items():
        if np.isinf(values).any() or values.size == 0 or max(values.shape) > LONGEST_SIDE_PX:
            found = f"shape {values.shape}, empty, too large or with infinite numbers"
            allowed = f"a map of finite numbers or NaN, up to {LONGEST_SIDE_PX} a side"
            raise InputError(folder, f"derived.{name}", found, allowed)
        path = f"derived/{name}.npy"
        files[path] = encode_npy(values)
        entries.append(
            {"path": path, "role": "derived", "name": name, "dtype": str(values.dtype), "shape": list(values.shape)}
            | {"unit": DERIVED_UNITS[name], "scale": 1.0, "invalid": "nan"}
        )
    for (role, name), data in extra.items():
        parts = PurePosixPath(name).parts
        for part in parts or ("",):
            _check_name(part, folder, role, "the name of a file")
        path = "/".join([role, *parts])
        files[path] = data
        entries.append({"path": path, "role": role})
    for entry in entries:
        entry["sha256"] = hashlib.sha256(files[entry["path"]]).hexdigest()
    index = {
        "schema_version": SCHEMA_VERSION,
        "sensor": capture.sensor,
        "technology": capture.technology,
        "source": capture.source,
        "serial": capture.serial,
        "bits": capture.bits,
        "units": UNITS,
        "frame": FRAME,
        "software": {"mitsim": __version__, "python": platform.python_version()}
        | {"numpy": np.__version__, "opencv": cv2.__version__},
        "files": entries,
    }
    index["checksum"] = content_checksum(index)
    validate(folder / "capture.json", index, CaptureDocument)
    files["capture.json"] = _json(index, folder, "capture")
    return files


def check_image(
    image: NDArray[np.unsignedinteger[Any]], frames: list[NDArray[np.unsignedinteger[Any]]], bits: int, where: Path
) -> None:
    """Check that an image [DN] has the type of the earlier images ``frames``, and no value above its bits."""
    if frames and frames[0].dtype != image.dtype:
        raise InputError(where, "dtype", image.dtype, f"{frames[0].dtype}, as in the first frame")
    if image.max() > 2**bits - 1:
        raise InputError(where, "pixel value", image.max(), f"0 to {2**bits - 1}, since bits is {bits}")


def _check_name(name: str, folder: Path, field: str, description: str) -> None:
    if not SAFE_NAME.fullmatch(name):
        raise InputError(folder, field, repr(name), f"{description} of letters, digits, dot, dash, underscore")


def _json(value: Any, folder: Path, field: str) -> bytes:
    try:
        text = json.dumps(value, indent=1, allow_nan=False, ensure_ascii=False)
        if field == "settings" and json.loads(text) != value:
            raise ValueError("tuples, or keys that are not text")
        return (text + "\n").encode()
    except (TypeError, ValueError, RecursionError) as error:
        found = f"a value that JSON cannot hold ({error})"
        raise InputError(folder, field, found, "texts, finite numbers, lists, tables, null") from None
