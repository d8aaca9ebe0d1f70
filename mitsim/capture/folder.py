"""A capture as a folder of plain files: written whole or not at all, and read with every file checked.

::

    capture_0007/
      capture.json       what it is, and every other file with its size, type and SHA-256
      calibration.json   cameras, projector, rectification
      settings.json      exposure, gain and so on, units in the names
      pose.json          world_from_sensor, 4 x 4 [mm], and its covariance, or null
      images/left_000.png  raw, lossless, 8 or 16 bits: <camera>_<frame>.png
      derived/depth.npy  what the device itself made of them, where it did: depth, disparity or points
      truth/left.exr     what is true at each pixel, for simulated captures that were asked for it
      vendor/            the maker's own files, untouched, where there are any

The format is written down in docs/reference/formats/capture-folder.md.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from characterisation.atomic_io import FULL, write_folder
from characterisation.checked_files import content_checksum, is_inside, read_bounded
from characterisation.documents import validate
from characterisation.errors import InputError
from mitsim.capture.calibration import CalibrationDocument, PoseDocument, rig_of
from mitsim.capture.capture import DERIVED_UNITS, SOURCES, Capture
from mitsim.capture.capture_document import SCHEMA_VERSION, CaptureDocument, FileEntry
from mitsim.capture.npy import decode_npy
from mitsim.capture.packed_files import SAFE_NAME, check_image, files_of, packed
from mitsim.capture.png import decode_png
from mitsim.sensor.transforms import Transform

#: the largest capture that is believed [bytes]
LARGEST_CAPTURE = 8 * 1024**3


def write_capture(
    capture: Capture,
    folder: str | Path,
    *,
    overwrite: bool = False,
    vendor: Mapping[str, bytes] | None = None,
    truth: Mapping[str, bytes] | None = None,
) -> Path:
    """Write a capture, all of it or nothing.

    Parameters
    ----------
    capture
        What to write.
    folder
        To be made. Its files are first written beside it and moved there in one step.
    overwrite
        Replace a capture that is there already; anything else that is there is never replaced.
    vendor
        The maker's own files by name, kept as they are.
    truth
        OpenEXR images by camera, see :func:`mitsim.simulation.truth.encode_exr`.

    Raises
    ------
    InputError
        If the folder is taken or cannot be written, or something in the capture has no place in a file.
    OSError
        If there is no room for it.
    """
    return write_packed(packed(capture, folder, vendor=vendor, truth=truth), folder, overwrite=overwrite)


def write_packed(files: Mapping[str, bytes], folder: str | Path, *, overwrite: bool = False) -> Path:
    """Write what :func:`packed` gives, all of it or nothing.

    Raises
    ------
    InputError
        If the folder is taken or cannot be written.
    OSError
        If there is no room for it.
    """
    folder = Path(folder).absolute()
    refuse_taken(folder, overwrite)
    try:
        write_folder(folder, files, overwrite=overwrite)
    except OSError as error:
        if error.errno in FULL:
            raise
        raise InputError(folder, "", f"a folder that cannot be written ({error})", "a place to write to") from None
    return folder


def is_written(capture: Capture, folder: str | Path, vendor: Mapping[str, bytes] | None = None) -> bool:
    """Whether a folder holds this very capture, whole; which software wrote it does not matter.

    Raises
    ------
    InputError
        If it does, and a file of it is missing, damaged or changed since.
    """
    folder = Path(folder).absolute()
    if not (folder / "capture.json").is_file():
        return False
    files = files_of(capture, {("vendor", name): data for name, data in (vendor or {}).items()}, folder)
    mine = json.loads(files["capture.json"])
    there = _read_index(folder)[0].model_dump(mode="json")
    paths = [{entry["path"]: entry["sha256"] for entry in index["files"]} for index in (mine, there)]
    same = ("sensor", "technology", "source", "serial", "bits")
    if paths[0] != paths[1] or any(mine[key] != there[key] for key in same):
        return False
    read_capture(folder)
    return True


def read_capture(folder: str | Path) -> Capture:
    """Read a capture folder back, checking each file.

    Raises
    ------
    InputError
        If anything is missing, damaged, changed since it was written, of the wrong size or of a newer format; file
        and field are named.
    """
    folder = Path(folder)
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
    images: dict[str, list[NDArray[np.unsignedinteger[Any]]]] = {name: [] for name in rig.cameras}
    derived: dict[str, NDArray[np.float32]] = {}
    for number, entry in enumerate(document.files):
        if entry.role == "derived":
            if entry.name is None or entry.name in derived:
                raise InputError(where, f"files.{number}.name", repr(entry.name), "each map once, by name")
            derived[entry.name] = _derived_map(data[entry.path], entry, f"files.{number}", where, folder / entry.path)
        if entry.role != "image":
            continue
        if entry.camera not in images:
            raise InputError(where, f"files.{number}.camera", entry.camera, f"one of {', '.join(images)}")
        stack, camera = images[entry.camera], rig.cameras[entry.camera]
        if entry.frame != len(stack):
            raise InputError(where, f"files.{number}.frame", entry.frame, f"{len(stack)}: frames in order from 0")
        image = decode_png(data[entry.path], folder / entry.path, (camera.height, camera.width))
        if image.dtype != entry.dtype or image.shape != entry.shape:
            raise InputError(
                where, f"files.{number}", f"{entry.dtype} {entry.shape}", f"{image.dtype} {image.shape}, as in the file"
            )
        check_image(image, stack, document.bits, folder / entry.path)
        stack.append(image)
    source = next((known for known in SOURCES if known == document.source), None)
    if source is None:
        raise InputError(where, "source", document.source, " | ".join(SOURCES))
    return Capture(
        sensor=document.sensor,
        technology=document.technology,
        source=source,
        rig=rig,
        images={name: np.stack(stack) for name, stack in images.items() if stack},
        bits=document.bits,
        settings=only("settings")[1],
        world_from_sensor=pose.transform(),
        serial=document.serial,
        derived=derived,
        pose_covariance=None if pose.covariance is None else np.array(pose.covariance),
    )


def read_settings_and_pose(folder: str | Path) -> tuple[str, dict[str, Any], Transform | None]:
    """Name of the sensor, settings and ``world_from_sensor`` of a capture, without reading its images.

    Raises
    ------
    InputError
        As :func:`read_capture`, for what is read.
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


def _derived_map(data: bytes, entry: FileEntry, field: str, where: Path, file: Path) -> NDArray[np.float32]:
    """A map as float32 in its unit, NaN where invalid, from whatever numbers it is stored in."""
    assert entry.name is not None
    stored = decode_npy(data, file)
    if str(stored.dtype) != entry.dtype or stored.shape != entry.shape:
        found, allowed = f"{entry.dtype} {entry.shape}", f"{stored.dtype} {stored.shape}, as in the file"
        raise InputError(where, field, found, allowed)
    if stored.shape[2:] != ((3,) if entry.name == "points" else ()):
        raise InputError(where, f"{field}.shape", entry.shape, "rows and columns, and of points 3 channels")
    if entry.unit != DERIVED_UNITS[entry.name]:
        raise InputError(where, f"{field}.unit", repr(entry.unit), DERIVED_UNITS[entry.name])
    if entry.scale is None:
        raise InputError(where, f"{field}.scale", "nothing", f"what a stored 1 is in {entry.unit}")
    values = stored.astype(np.float32) * np.float32(entry.scale)
    if isinstance(entry.invalid, int):
        values[(stored == entry.invalid).reshape(*stored.shape[:2], -1).all(axis=-1)] = np.nan
    if np.isinf(values).any():
        raise InputError(file, "", "infinite numbers", "finite ones, or NaN")
    return values


def _parse(data: bytes, where: Path) -> dict[str, Any]:
    def refuse(constant: str) -> None:
        raise ValueError(f"{constant} is not a JSON number")

    try:
        table = json.loads(data.decode(), parse_constant=refuse)
    except (ValueError, RecursionError) as error:
        raise InputError(where, "", f"text that is not JSON ({error})", "JSON in UTF-8") from None
    if not isinstance(table, dict):
        raise InputError(where, "", type(table).__name__, "a JSON object")
    return table


def _read_index(folder: Path) -> tuple[CaptureDocument, Path]:
    where = folder / "capture.json"
    table = _parse(read_bounded(where, "a whole capture folder"), where)
    version = table.get("schema_version")
    if type(version) is int and version > SCHEMA_VERSION:
        raise InputError(
            where, "schema_version", version, f"up to {SCHEMA_VERSION}", "update mitsim to read this capture"
        )
    document = validate(where, table, CaptureDocument)
    if document.source not in SOURCES:
        raise InputError(where, "source", repr(document.source), " | ".join(SOURCES))
    if document.checksum != content_checksum(table):
        raise InputError(where, "checksum", "another content than was written", "an unchanged file")
    return document, where


def _read_checked(folder: Path, entry: FileEntry, field: str, where: Path) -> bytes:
    path = PurePosixPath(entry.path)
    if path.is_absolute() or not path.parts or not all(SAFE_NAME.fullmatch(part) for part in path.parts):
        raise InputError(where, f"{field}.path", repr(entry.path), "a file inside the folder, of plain names")
    file = folder / path
    if not is_inside(file, folder):
        raise InputError(where, f"{field}.path", repr(entry.path), "a file inside the folder, not a link")
    data = read_bounded(file, "a whole capture folder")
    if hashlib.sha256(data).hexdigest() != entry.sha256:
        raise InputError(
            file, "sha256", "another content than was written", "an unchanged file: copy the capture again"
        )
    return data


def refuse_taken(folder: Path, overwrite: bool = False) -> None:
    """Refuse a folder that holds something, or a capture that is not to be replaced.

    Raises
    ------
    InputError
        If it does.
    """
    if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
        return
    if not (folder / "capture.json").is_file():
        raise InputError(folder, "", "something there that is no capture", "a new or empty folder")
    if not overwrite:
        raise InputError(
            folder, "", "another capture that is there already", "a new folder", "or remove this one first"
        )
