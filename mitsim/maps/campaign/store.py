"""Kept shots of a campaign: each is a folder that is written completely or not at all, and checked when it is read.

::

    coupons/aluminium-ground_Ra_0.37_600mm_0f3a9c1b2d4e/+0.1234-0.0567/
      shot.json      coupon and pose of the shot, the SHA-256 of a found capture, size and SHA-256 of every other file
      patches.npy    a row for each patch, a field for each metric
      capture/       the capture, if the campaign keeps images: see mitsim.capture.folder

An interrupted campaign reads existing shots and takes the others.
"""

from __future__ import annotations

import hashlib
import io
import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from pydantic import Field

from characterisation.coupon.patch_table import PATCHES, patch_table
from characterisation.files.atomic_io import write_folder
from characterisation.files.checked_files import (
    LARGEST_FILE,
    content_checksum,
    is_inside,
    read_bounded,
    read_json_object,
)
from characterisation.files.datasets import check_dataset
from characterisation.files.documents import Document, validate
from characterisation.files.errors import InputError, MissingEnvironmentError, in_one_line
from characterisation.words.version import __version__
from mitsim.capture.capture import Capture
from mitsim.capture.packed_files import packed
from mitsim.maps.campaign.plan import Shot

#: longest accepted header of a table [bytes]; some thirty columns take 1,100
_LONGEST_HEADER = 10_000

#: files and folders of a shot, all that another one replaces
_ENTRIES = ("shot.json", "patches.npy", "capture")


@dataclass(frozen=True)
class Finished:
    """Result of a shot: ``patches``, one row each, ``source`` of the capture, and the capture if it is kept."""

    patches: xr.Dataset
    source: str
    capture: Capture | None = None


class KeptFile(Document):
    """One file of a shot."""

    bytes: int = Field(ge=0, le=LARGEST_FILE)
    sha256: str = Field(pattern="^[0-9a-f]{64}$")


class ShotDocument(Document):
    """Content of ``shot.json``."""

    schema_version: Literal[1]
    sample: str
    distance_mm: float
    normal: tuple[float, float, float]
    seed: int
    source: str
    mitsim: str
    found: str | None = Field(default=None, pattern="^[0-9a-f]{64}$")
    files: dict[str, KeptFile] = Field(max_length=10_000)
    checksum: str = Field(pattern="^[0-9a-f]{64}$")


def shot_folder(captures: Path, shot: Shot) -> Path:
    """Return the folder of a shot."""
    return captures / shot.series.name / shot.name


def write_shot(captures: Path, shot: Shot, finished: Finished) -> None:
    """Write a shot completely or not at all; MissingEnvironmentError if the disk is full or not writable."""
    folder = shot_folder(captures, shot)
    files = {"patches.npy": _table_bytes(finished.patches)}
    if finished.capture is not None:
        capture_files = packed(finished.capture, folder / "capture")
        files |= {f"capture/{path}": data for path, data in capture_files.items()}
    document: dict[str, Any] = {
        "schema_version": 1,
        "sample": shot.series.sample.label(),
        "distance_mm": float(shot.series.distance),
        "normal": [float(component) for component in shot.normal],
        "seed": shot.seed,
        "source": finished.source,
        "mitsim": __version__,
        "files": {p: {"bytes": len(d), "sha256": hashlib.sha256(d).hexdigest()} for p, d in files.items()},
    }
    if shot.found is not None:
        document["found"] = shot.found
    document["checksum"] = content_checksum(document)
    files["shot.json"] = (json.dumps(document, indent=1) + "\n").encode()
    try:
        write_folder(folder, files, overwrite=_ENTRIES if shot.found is not None else ())
    except OSError as error:
        raise MissingEnvironmentError(
            f"{folder}: a capture that cannot be written ({error.strerror or error}); captures finished before are "
            "kept: free some space, or permit writing, and run the same command again"
        ) from None


def read_shot(captures: Path, shot: Shot) -> Finished | None:
    """Return a kept shot; None if missing or of another capture; InputError with the file that is damaged."""
    folder = shot_folder(captures, shot)
    if not folder.exists():
        return None
    document = _document(folder)
    if document.found != shot.found:
        return None
    data = {path: _checked(folder, path, entry) for path, entry in document.files.items()}
    if "patches.npy" not in data:
        raise InputError(folder / "shot.json", "files", "no patches.npy", "a shot of mitsim map make", _AGAIN)
    patches = _table(data["patches.npy"], folder / "patches.npy")
    return Finished(patches.assign_attrs(source=document.source), document.source)


def remove_partial(captures: Path) -> None:
    """Remove partial captures, and partial files next to their folder, of a killed run."""
    for partial in captures.glob("*/.*.partial-*"):
        shutil.rmtree(partial, ignore_errors=True)
    for partial in captures.parent.glob(".*.partial"):
        partial.unlink(missing_ok=True)


_AGAIN = "remove this folder, and run the same command again to repeat the capture"


def _document(folder: Path) -> ShotDocument:
    where = folder / "shot.json"
    table = read_json_object(where, "a complete capture folder", _AGAIN)
    if isinstance(version := table.get("schema_version"), int) and version > 1:
        raise InputError(where, "schema_version", version, "up to 1", "update mitsim to read this campaign")
    if table.get("checksum") != content_checksum(table):
        raise InputError(where, "checksum", "changed content", "an unchanged file", _AGAIN)
    return validate(where, table, ShotDocument)


def _checked(folder: Path, path: str, entry: KeptFile) -> bytes:
    file = folder / path
    if not is_inside(file, folder):
        raise InputError(folder / "shot.json", f"files.{path}", "a path outside the folder", "a file of the shot")
    data = read_bounded(file, "a complete capture folder", _AGAIN)
    if len(data) != entry.bytes:
        raise InputError(file, "size", f"{len(data)} bytes", f"{entry.bytes} bytes, as written", _AGAIN)
    if hashlib.sha256(data).hexdigest() != entry.sha256:
        raise InputError(file, "sha256", "changed content", "an unchanged file", _AGAIN)
    return data


def _table_bytes(patches: xr.Dataset) -> bytes:
    columns = {str(name): patches.variables[name].values for name in patches.data_vars}
    table = np.empty(patches.sizes["patch"], [(name, values.dtype) for name, values in columns.items()])
    for name, values in columns.items():
        table[name] = values
    stream = io.BytesIO()
    np.save(stream, table, allow_pickle=False)
    return stream.getvalue()


def _table(data: bytes, where: Path) -> xr.Dataset:
    try:
        stream = io.BytesIO(data)
        table: NDArray[np.void] = np.lib.format.read_array(stream, False, max_header_size=_LONGEST_HEADER)
    except Exception as error:  # numpy raises many types for a damaged header, which is Python text
        cause = in_one_line(error)
        raise InputError(where, "", f"a table that cannot be read ({cause})", "an unchanged file", _AGAIN) from None
    kinds = [table.dtype[number] for number in range(len(table.dtype.names or ()))]
    if table.ndim != 1 or not kinds or any(kind.kind not in "fiub" or kind.shape for kind in kinds):
        found = f"shape {table.shape} and type {str(table.dtype)[:200]}"
        raise InputError(where, "", found, "a table of columns of numbers", _AGAIN)
    patches = patch_table(**{name: np.ascontiguousarray(table[name]) for name in table.dtype.names or ()})
    check_dataset(where, patches, PATCHES)
    return patches
