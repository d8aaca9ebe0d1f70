"""Write a capture as a folder of plain files, completely or not at all, and read it with a check of every file.

::

    capture_0007/
      capture.json       sensor, source and units, and every other file with its shape, type and SHA-256
      calibration.json   cameras, projector, rectification
      settings.json      exposure, gain and others, with units in the names
      pose.json          world_from_sensor, 4 x 4 [mm], and its covariance, or null
      images/left_000.png  raw, lossless, 8 or 16 bits: <camera>_<frame>.png
      derived/depth.npy  map that the device itself computed: depth, disparity or points
      truth/left.exr     true values at each pixel, in simulated captures that request them
      vendor/            the maker's own files, unchanged, if there are any

docs/reference/formats/capture-folder.md describes the format.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from characterisation.files.atomic_io import FULL, write_folder
from characterisation.files.checked_files import content_checksum, is_inside, read_bounded
from characterisation.files.documents import validate
from characterisation.files.errors import InputError
from characterisation.files.threads import in_threads
from mitsim.capture.calibration import CalibrationDocument, PoseDocument, rig_of
from mitsim.capture.capture import DERIVED_UNITS, Capture
from mitsim.capture.capture_document import SCHEMA_VERSION, CaptureDocument, FileEntry
from mitsim.capture.decoding import read_settings
from mitsim.capture.npy import decode_npy
from mitsim.capture.packed_files import SAFE_NAME, check_image, packed
from mitsim.capture.recordings.json_fields import parsed_json
from mitsim.capture.truth import Truth
from mitsim.sensor.camera import Camera
from mitsim.sensor.png import Image, decode_png
from mitsim.sensor.transforms import Transform

#: files and folders of a capture: of its folder, all that a new capture replaces
_ENTRIES = ("capture.json", "calibration.json", "settings.json", "pose.json", "images", "derived", "truth", "vendor")

#: largest allowed size of all files of a capture [bytes]
LARGEST_CAPTURE = 8 * 1024**3

#: values of a capture that its index has
_KEPT = ("sensor", "technology", "source", "serial", "bits")


def write_capture(
    capture: Capture,
    path: str | Path,
    *,
    overwrite: bool = False,
    vendor: Mapping[str, bytes] | None = None,
    truth: Mapping[str, Truth] | None = None,
) -> Path:
    """Write a capture as a folder: images as PNG, calibration, settings and pose as JSON; completely or not at all.

    Parameters
    ----------
    capture
        From :func:`mitsim.render` or :func:`read_capture`.
    path
        New or empty folder. Its files are first written beside it, and moved there in one step.
    overwrite
        Replace an existing capture. Other files in its folder stay.
    vendor
        The maker's own files by name, kept unchanged.
    truth
        True values by camera, from :func:`mitsim.render` or :func:`mitsim.read_truth`.

    Returns
    -------
    Path
        The folder, as an absolute path.

    Raises
    ------
    InputError
        If the folder is not free or cannot be written, or something in the capture cannot be written to a file.
    OSError
        If the disk is full.

    See Also
    --------
    read_capture : the inverse
    mitsim.capture.truth.read_truth : the inverse for the true values

    Examples
    --------
    >>> import mitsim as ms
    >>> ms.write_capture(ms.read_capture("capture"), "copy").name
    'copy'
    """
    return write_packed(packed(capture, path, vendor=vendor, truth=truth), path, overwrite=overwrite)


def write_packed(files: Mapping[str, bytes], folder: str | Path, *, overwrite: bool = False) -> Path:
    """Write the files of :func:`~mitsim.capture.packed_files.packed` to a folder, completely or not at all.

    Raises InputError if the folder is not free or cannot be written. Raises OSError if the disk is full.
    """
    folder = Path(folder).absolute()
    check_free(folder, overwrite)
    try:
        write_folder(folder, files, overwrite=_ENTRIES if overwrite else ())
    except OSError as error:
        if error.errno in FULL:
            raise
        found = f"a folder that cannot be written ({error})"
        raise InputError(folder, "", found, "a folder with write permission") from None
    return folder


def is_written(capture: Capture, folder: str | Path, vendor: Mapping[str, bytes] | None = None) -> bool:
    """Return whether a folder contains exactly this capture. The versions of the software may differ.

    Raises InputError if the index of the folder cannot be read, or the capture could not be written. Also if the folder
    contains this capture, but a file of it is missing, damaged or changed.
    """
    folder = Path(folder).absolute()
    if not (folder / "capture.json").is_file():
        return False
    files = packed(capture, folder, vendor=vendor)
    own_index = json.loads(files["capture.json"])
    found_index = _read_index(folder)[0].model_dump(mode="json")
    paths = [{entry["path"]: entry["sha256"] for entry in index["files"]} for index in (own_index, found_index)]
    if paths[0] != paths[1] or any(own_index[key] != found_index[key] for key in _KEPT):
        return False
    read_capture(folder)
    return True


def read_capture(path: str | Path) -> Capture:
    """Read a capture folder of ``mitsim render``, ``capture`` or ``import``, or of :func:`write_capture`.

    Parameters
    ----------
    path
        The folder.

    Returns
    -------
    Capture
        Images, calibration, settings, and the pose if it is known.

    Raises
    ------
    InputError
        If a file is missing, damaged, changed since it was written, of the wrong size or of a newer format. The error
        names file and field.

    Examples
    --------
    >>> import mitsim as ms
    >>> capture = ms.read_capture("capture")
    >>> capture.sensor, sorted(capture.images)
    ('small', ['left', 'right'])
    """
    folder = Path(path)
    if not folder.is_dir():
        raise InputError(folder, "", "no such folder", "a capture folder")
    document, where = _read_index(folder)
    data: dict[str, bytes] = {}
    total = 0
    for number, entry in enumerate(document.files):
        if entry.path in data:
            raise InputError(where, f"files.{number}.path", entry.path, "each file once")
        data[entry.path] = _read_checked(folder, entry, f"files.{number}", where)
        total += len(data[entry.path])
        if total > LARGEST_CAPTURE:
            raise InputError(where, "files", f"over {total} bytes", f"up to {LARGEST_CAPTURE} bytes in all")

    def only(role: str) -> tuple[Path, dict[str, Any]]:
        paths = [entry.path for entry in document.files if entry.role == role]
        if len(paths) != 1:
            raise InputError(where, "files", f"{len(paths)} files of role {role}", "one")
        return folder / paths[0], _parse(data[paths[0]], folder / paths[0])

    calibration = validate(*only("calibration"), CalibrationDocument)
    pose = validate(*only("pose"), PoseDocument)
    rig = rig_of(calibration)
    decoding, records = read_settings(*only("settings"), document.technology)
    frames: dict[str, list[int]] = {name: [] for name in rig.cameras}
    derived: dict[str, NDArray[np.float32]] = {}
    for number, entry in enumerate(document.files):
        if entry.role == "derived":
            if entry.name is None or entry.name in derived:
                raise InputError(where, f"files.{number}.name", repr(entry.name), "each map once, by name")
            derived[entry.name] = _derived_map(data[entry.path], entry, f"files.{number}", where, folder / entry.path)
        if entry.role != "image":
            continue
        if entry.camera not in frames:
            raise InputError(where, f"files.{number}.camera", entry.camera, f"one of {', '.join(frames)}")
        if entry.frame != (count := len(frames[entry.camera])):
            raise InputError(where, f"files.{number}.frame", entry.frame, f"{count}: frames in order from 0")
        frames[entry.camera].append(number)
    return Capture(
        **{name: getattr(document, name) for name in _KEPT},
        rig=rig,
        images={
            name: _read_stack(rig.cameras[name], numbers, document, data, folder)
            for name, numbers in frames.items()
            if numbers
        },
        decoding=decoding,
        settings=records,
        world_from_sensor=pose.transform(),
        derived=derived,
    )


def read_settings_and_pose(folder: str | Path) -> tuple[str, dict[str, Any], Transform | None]:
    """Return the sensor's name, settings and ``world_from_sensor`` of a capture folder, without reading its images.

    Raises InputError as :func:`read_capture`, for the files that are read.
    """
    folder = Path(folder)
    document, where = _read_index(folder)
    read: dict[str, dict[str, Any]] = {}
    for number, entry in enumerate(document.files):
        if entry.role in ("settings", "pose"):
            read[entry.role] = _parse(_read_checked(folder, entry, f"files.{number}", where), folder / entry.path)
    if set(read) != {"settings", "pose"}:
        raise InputError(where, "files", f"only {', '.join(read) or 'none'} of settings and pose", "both")
    pose = validate(folder / "pose.json", read["pose"], PoseDocument)
    return document.sensor, read["settings"], pose.transform()


def _read_stack(
    camera: Camera, numbers: list[int], document: CaptureDocument, data: Mapping[str, bytes], folder: Path
) -> Image:
    """Return the images (P, H, W) of a camera, from the bytes of the files that the index lists at ``numbers``."""

    def read(number: int) -> Image:
        entry = document.files[number]
        image = decode_png(data[entry.path], folder / entry.path, (camera.height, camera.width))
        if image.dtype != entry.dtype or image.shape != entry.shape:
            found, allowed = f"{entry.dtype} {entry.shape}", f"{image.dtype} {image.shape}, as in the file"
            raise InputError(folder / "capture.json", f"files.{number}", found, allowed)
        return image

    frames = in_threads(read, numbers)
    for number, image in zip(numbers, frames, strict=True):
        check_image(image, frames[:1], document.bits, folder / document.files[number].path)
    return np.stack(frames)


def _derived_map(data: bytes, entry: FileEntry, field: str, where: Path, file: Path) -> NDArray[np.float32]:
    """Return a derived map as float32 in its unit, NaN where invalid, from any allowed type of stored numbers."""
    assert entry.name is not None
    stored = decode_npy(data, file)
    if str(stored.dtype) != entry.dtype or stored.shape != entry.shape:
        found, allowed = f"{entry.dtype} {entry.shape}", f"{stored.dtype} {stored.shape}, as in the file"
        raise InputError(where, field, found, allowed)
    if stored.shape[2:] != ((3,) if entry.name == "points" else ()):
        raise InputError(where, f"{field}.shape", entry.shape, "rows and columns, and 3 channels for points")
    if entry.unit != DERIVED_UNITS[entry.name]:
        raise InputError(where, f"{field}.unit", repr(entry.unit), DERIVED_UNITS[entry.name])
    if entry.scale is None:
        raise InputError(where, f"{field}.scale", "nothing", f"the value of a stored 1 in {entry.unit}")
    values = stored.astype(np.float32) * np.float32(entry.scale)
    if isinstance(entry.invalid, int):
        values[(stored == entry.invalid).reshape(*stored.shape[:2], -1).all(axis=-1)] = np.nan
    if np.isinf(values).any():
        raise InputError(file, "", "infinite numbers", "finite numbers or NaN")
    return values


def _parse(data: bytes, where: Path) -> dict[str, Any]:
    def reject(constant: str) -> None:
        raise ValueError(f"{constant} is not a JSON number")

    table = parsed_json(data, where, "JSON in UTF-8", reject)
    if not isinstance(table, dict):
        raise InputError(where, "", type(table).__name__, "a JSON object")
    return table


def _read_index(folder: Path) -> tuple[CaptureDocument, Path]:
    """Return the checked index of a folder, and its path; raise an InputError if it is damaged, changed or too new."""
    where = folder / "capture.json"
    hint = f"mitsim import {folder} -o CAPTURE makes one of a recording or of images"
    table = _parse(read_bounded(where, "a complete capture folder", hint), where)
    version = table.get("schema_version")
    if type(version) is int and version > SCHEMA_VERSION:
        of_newer = "update mitsim to read this capture"
        raise InputError(where, "schema_version", version, f"up to {SCHEMA_VERSION}", of_newer)
    document = validate(where, table, CaptureDocument)
    if document.checksum != content_checksum(table):
        raise InputError(where, "checksum", "content that differs from what was written", "an unchanged file")
    return document, where


def _read_checked(folder: Path, entry: FileEntry, field: str, where: Path) -> bytes:
    """Return the bytes of a file of the folder; raise an InputError if it is outside, missing or changed."""
    path = PurePosixPath(entry.path)
    if path.is_absolute() or not path.parts or not all(SAFE_NAME.fullmatch(part) for part in path.parts):
        raise InputError(where, f"{field}.path", repr(entry.path), "a file inside the folder, of plain names")
    file = folder / path
    if not is_inside(file, folder):
        raise InputError(where, f"{field}.path", repr(entry.path), "a file inside the folder, not a link")
    data = read_bounded(file, "a complete capture folder")
    if hashlib.sha256(data).hexdigest() != entry.sha256:
        found = "content that differs from what was written"
        raise InputError(file, "sha256", found, "an unchanged file: copy the capture again")
    return data


def check_free(folder: Path, overwrite: bool = False) -> None:
    """Check that a capture can be written to a folder: it is missing, empty, or has a capture to ``overwrite``.

    Raises InputError if it is not free.
    """
    if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
        return
    if not (folder / "capture.json").is_file():
        raise InputError(folder, "", "a file or folder that is not a capture", "a new or empty folder")
    if not overwrite:
        raise InputError(folder, "", "an existing capture", "a new folder", "remove this one first, or name another")
