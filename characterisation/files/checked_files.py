"""Read files with checks: of a bounded size, inside their folder, with a checksum."""

from __future__ import annotations

import hashlib
import json
import stat
from pathlib import Path
from typing import TYPE_CHECKING, Any

from characterisation.files.errors import InputError, in_one_line

if TYPE_CHECKING:
    import xarray as xr

#: attribute of a netCDF file that holds its :func:`dataset_digest`
DIGEST = "content_sha256"

#: text that mitsim appends to a netCDF file; the SHA-256 of all bytes before it follows, in hexadecimal digits
SEAL = b"mitsim sha256 "

#: size of the largest file that is read [bytes]
LARGEST_FILE = 256 * 1024**2


def read_bounded(
    file: Path, absent: str | None = None, hint: str = "", largest: int = LARGEST_FILE, first: int | None = None
) -> bytes:
    """Read a plain file of at most ``largest`` bytes.

    Raises InputError if the file is missing, too large, a folder, a pipe or a device, or cannot be read.

    Parameters
    ----------
    file, absent, hint
        The file; a description of the expected file, for the error about a missing one; advice that the errors add.
    largest, first
        Largest size [bytes]; number of bytes to read from the beginning, by default all.
    """
    try:
        about = file.stat()
        if not stat.S_ISREG(about.st_mode):  # a pipe would be waited for, and a device may have no end
            raise InputError(file, "", _kind_of(about.st_mode), "a plain file", hint)
        if about.st_size > largest:
            raise InputError(file, "size", f"{about.st_size} bytes", f"up to {largest} bytes", hint)
        with file.open("rb") as stream:
            data = stream.read(largest + 1 if first is None else first)
        if len(data) > largest:
            raise InputError(file, "size", f"over {largest} bytes", f"up to {largest} bytes", hint)
        return data
    except InputError:
        raise
    except ValueError as error:
        raise InputError(file, "", f"a path that cannot be ({error})", "the path of a file", hint) from None
    except OSError as error:
        if absent is not None and isinstance(error, FileNotFoundError):
            raise InputError(file, "", "no such file", absent, hint) from None
        raise InputError(file, "", f"a file that cannot be read ({error})", "a readable file", hint) from None


def read_text_bounded(file: Path, absent: str | None = None, hint: str = "", largest: int = LARGEST_FILE) -> str:
    """Read a plain file of at most ``largest`` bytes as UTF-8, with or without a byte order mark.

    Raises InputError as :func:`read_bounded`, or if the text is not UTF-8.

    Parameters
    ----------
    file, absent, hint, largest
        As in :func:`read_bounded`.
    """
    try:
        return read_bounded(file, absent, hint, largest).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        found = f"text that is not UTF-8 ({error.reason} at byte {error.start})"
        raise InputError(file, "", found, "UTF-8", hint) from None


def read_json_object(file: Path, absent: str | None = None, hint: str = "") -> dict[str, Any]:
    """Read a JSON object from a plain file; InputError as :func:`read_text_bounded`, or if the text is none."""
    text = read_text_bounded(file, absent, hint)
    try:
        table = json.loads(text)
    except (ValueError, RecursionError) as error:
        cause = "nested too deep" if isinstance(error, RecursionError) else in_one_line(error)
        raise InputError(file, "", f"text that is not JSON ({cause})", "JSON in UTF-8", hint) from None
    if not isinstance(table, dict):
        raise InputError(file, "", type(table).__name__, "a JSON object", hint)
    return table


def is_file(path: str | Path) -> bool:
    """Return whether a path is an existing plain file; False for a name that no file can have."""
    try:
        return Path(path).is_file()
    except (OSError, ValueError):
        return False


def _kind_of(mode: int) -> str:
    for test, name in ((stat.S_ISDIR, "a folder"), (stat.S_ISFIFO, "a pipe"), (stat.S_ISSOCK, "a socket")):
        if test(mode):
            return name
    return "a device"


def is_inside(file: Path, folder: Path) -> bool:
    """Return whether a path lies in a folder: it is no link, and does not lead out of the folder."""
    return not file.is_symlink() and file.resolve().is_relative_to(folder.resolve())


def content_checksum(table: dict[str, Any]) -> str:
    """Return the SHA-256 of a table as JSON with sorted keys and no spaces, without its ``checksum``."""
    content = {key: value for key, value in table.items() if key != "checksum"}
    return hashlib.sha256(json.dumps(content, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def dataset_digest(data: xr.Dataset) -> str:
    """Return the SHA-256 of names, dimensions, values and attributes of a dataset; a netCDF file does not change it.

    netCDF has no booleans and no lists of one element, and does not keep the bits of a NaN.
    """
    import numpy as np

    def plain(attributes: dict[Any, Any]) -> list[Any]:
        entries = {str(key): value for key, value in attributes.items() if key != DIGEST}
        return [[key, np.atleast_1d(entries[key]).tolist()] for key in sorted(entries)]

    digest = hashlib.sha256(json.dumps(plain(data.attrs), default=str).encode())
    for name in sorted(map(str, data.variables)):
        variable = data.variables[name]
        values = np.asarray(variable.values)
        content = [name, list(map(str, variable.dims)), list(values.shape), plain(variable.attrs)]
        digest.update(json.dumps(content, default=str).encode())
        if values.dtype.kind == "f":
            whole = np.where(np.isnan(values), np.nan, values).astype(f"<f{values.dtype.itemsize}")
            digest.update(np.ascontiguousarray(whole).tobytes())
        elif values.dtype.kind in "biu":
            digest.update(np.ascontiguousarray(values.astype("<i8")).tobytes())
        else:
            digest.update(json.dumps(list(map(str, values.ravel().tolist()))).encode())
    return digest.hexdigest()
