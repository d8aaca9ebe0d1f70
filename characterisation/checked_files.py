"""Files that are believed only as far as they can be checked: bounded in size, inside their folder, with a checksum."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from characterisation.errors import InputError

if TYPE_CHECKING:
    import xarray as xr

#: attribute of a netCDF file that holds its :func:`dataset_digest`
DIGEST = "content_sha256"

#: the largest single file that is read [bytes]
LARGEST_FILE = 256 * 1024**2


def read_bounded(file: Path, absent: str | None = None, hint: str = "") -> bytes:
    """Read a file of at most :data:`LARGEST_FILE` bytes.

    Parameters
    ----------
    absent
        What should have been there, said where the file is missing; without it a missing file cannot be read.

    Raises
    ------
    InputError
        If it is missing, too large or cannot be read.
    """
    try:
        if (size := file.stat().st_size) > LARGEST_FILE:
            raise InputError(file, "size", f"{size} bytes", f"up to {LARGEST_FILE} bytes")
        return file.read_bytes()
    except OSError as error:
        if absent is not None and isinstance(error, FileNotFoundError):
            raise InputError(file, "", "no such file", absent, hint) from None
        raise InputError(file, "", f"a file that cannot be read ({error})", "a readable file", hint) from None


def is_inside(file: Path, folder: Path) -> bool:
    """Whether a path is a file of a folder: no link, and not out of it by another way."""
    return not file.is_symlink() and file.resolve().is_relative_to(folder.resolve())


def content_checksum(table: dict[str, Any]) -> str:
    """SHA-256 of a table as JSON with sorted keys and no spaces, without its own ``checksum``."""
    rest = {key: value for key, value in table.items() if key != "checksum"}
    return hashlib.sha256(json.dumps(rest, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def dataset_digest(data: xr.Dataset) -> str:
    """SHA-256 of a dataset: names, dimensions, values and attributes, the same before and after it was netCDF.

    netCDF knows no truth values and no lists of one element, and keeps none of the bits of NaN but that it is one.
    """
    import numpy as np

    def plain(attributes: dict[Any, Any]) -> list[Any]:
        rest = {str(key): value for key, value in attributes.items() if key != DIGEST}
        return [[key, np.atleast_1d(rest[key]).tolist()] for key in sorted(rest)]

    digest = hashlib.sha256(json.dumps(plain(data.attrs), default=str).encode())
    for name in sorted(map(str, data.variables)):
        variable = data.variables[name]
        values = np.asarray(variable.values)
        told = [name, list(map(str, variable.dims)), list(values.shape), plain(variable.attrs)]
        digest.update(json.dumps(told, default=str).encode())
        if values.dtype.kind == "f":
            whole = np.where(np.isnan(values), np.nan, values).astype(f"<f{values.dtype.itemsize}")
            digest.update(np.ascontiguousarray(whole).tobytes())
        elif values.dtype.kind in "biu":
            digest.update(np.ascontiguousarray(values.astype("<i8")).tobytes())
        else:
            digest.update(json.dumps(list(map(str, values.ravel().tolist()))).encode())
    return digest.hexdigest()
