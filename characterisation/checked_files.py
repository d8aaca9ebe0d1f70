"""Files that are believed only as far as they can be checked: bounded in size, inside their folder, with a checksum."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from characterisation.errors import InputError

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
