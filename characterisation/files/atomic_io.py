"""Files and folders that are there whole or not at all, on a full disk too."""

from __future__ import annotations

import errno
import hashlib
import json
import math
import os
import platform
import shutil
import tempfile
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from characterisation.files.checked_files import DIGEST, SEAL, dataset_digest

if TYPE_CHECKING:  # the command line wants FULL, and --help is to be quick
    import xarray as xr

#: what a system says where a disk, a quota or a process's largest file is full
FULL = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})

#: this machine in the names of what is being written: the number of a process says nothing on another
HOST = hashlib.sha256(platform.node().encode()).hexdigest()[:6]

#: bytes that netCDF writes for a file beside the values; measured: 8 kB
_NETCDF_FILE = 16 * 1024

#: bytes that netCDF writes for each variable beside the values; measured: 2.9 kB, deflated
_NETCDF_VARIABLE = 4 * 1024


@contextmanager
def atomic_write(path: str | Path) -> Iterator[Path]:
    """Give a place beside ``path`` to write to; it takes the name when the block ends well, and is gone otherwise.

    Raises
    ------
    OSError
        Where there is no room: its ``errno`` is in :data:`FULL`, its ``filename`` is ``path``.
    """
    path = Path(path)
    partial = path.with_name(f".{path.name}.{os.getpid()}-{HOST}.partial")
    try:
        with _naming(path):
            yield partial
            partial.replace(path)
    finally:
        with suppress(OSError):  # a read-only file system refuses that too; its reason is already reported
            partial.unlink(missing_ok=True)


@contextmanager
def atomic_write_named(path: str | Path) -> Iterator[Path]:
    """:func:`atomic_write` for libraries that go by the end of a name: a place of that name in a folder beside it.

    Raises
    ------
    OSError
        As :func:`atomic_write`.
    """
    path = Path(path).absolute()
    ours = f"{os.getpid()}-{HOST}.partial"
    with tempfile.TemporaryDirectory(prefix=f".{path.name}.", suffix=f".{ours}", dir=path.parent) as folder:
        partial = Path(folder) / path.name
        with _naming(path):
            yield partial
            partial.replace(path)


@contextmanager
def atomic_folder(folder: str | Path) -> Iterator[Path]:
    """Make a folder beside ``folder``; it takes the name when the block ends well, and is gone otherwise.

    Raises
    ------
    OSError
        As :func:`atomic_write`, and if ``folder`` is there with files in it.
    """
    folder = Path(folder).absolute()
    partial = _beside(folder, "partial")
    try:
        with _naming(folder):
            partial.mkdir(parents=True)
            yield partial
            partial.rename(folder)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _beside(folder: Path, kind: str) -> Path:
    """Return a path beside a folder that no other process uses, by which :mod:`mitsim.cli.folder_lock` knows ours."""
    return folder.with_name(f".{folder.name}.{kind}-{os.getpid()}-{HOST}{uuid.uuid4().hex[:12]}")


def write_folder(folder: str | Path, files: Mapping[str, bytes], *, overwrite: bool = False) -> None:
    """Write a folder of files by their paths in it, so that it survives a loss of power as a whole or not at all.

    The files are written beside it, flushed to the disk and moved there in one step. ``overwrite`` replaces a folder
    that is there.

    Raises
    ------
    OSError
        If it cannot be written, or is there already; what was there before is there still. Where there is no room, its
        ``errno`` is in :data:`FULL` and its ``filename`` is ``folder``.
    """
    folder = Path(folder).absolute()
    partial, old = _beside(folder, "partial"), _beside(folder, "old")
    try:
        with _naming(folder):
            folder.parent.mkdir(parents=True, exist_ok=True)
            for path, data in files.items():
                _write_synced(partial / path, data)
            for directory in [*sorted(p for p in partial.glob("**/") if p != partial), partial]:
                _sync_directory(directory)
            if folder.exists() and overwrite:
                folder.rename(old)
            partial.rename(folder)
            _sync_directory(folder.parent)
    finally:
        if old.exists() and not folder.exists():
            old.rename(folder)
        shutil.rmtree(partial, ignore_errors=True)
        shutil.rmtree(old, ignore_errors=True)


def _write_synced(file: Path, data: bytes) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    with file.open("xb") as stream:
        stream.write(data)
        stream.flush()
        os.fsync(stream.fileno())


def _sync_directory(directory: Path) -> None:
    """Make names durable too, where the system can (Windows cannot open a folder)."""
    if os.name == "posix":
        handle = os.open(directory, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


@contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Say what it was that cannot be written: ``write`` itself names no file, and others name the place beside it."""
    try:
        yield
    except OSError as error:
        if error.errno in FULL or ".partial" in str(error.filename):
            raise type(error)(error.errno, error.strerror, str(path)) from None
        raise


def write_netcdf(data: xr.Dataset, path: str | Path, encoding: Mapping[Any, Mapping[str, Any]] | None = None) -> None:
    """Write a dataset as netCDF with a digest of its content, whole or not at all.

    Room for all of it uncompressed is asked for first: on a full disk HDF5 says "HDF error" or "Permission denied",
    and holds the file open, and with it the room, until the process ends. Behind the last byte stands a seal, by which
    a reader knows a damaged file before HDF5 parses it: on some of them it never ends.
    """
    data = data.assign_attrs({DIGEST: dataset_digest(data)})
    attributes = [data.attrs, *(variable.attrs for variable in data.variables.values())]
    text = sum(len(str(value)) for table in attributes for value in table.values())
    with atomic_write(path) as file:
        with file.open("xb") as stream:
            stream.write(bytes(data.nbytes + text + _NETCDF_FILE + len(attributes) * _NETCDF_VARIABLE))
        file.unlink()
        data.to_netcdf(file, encoding=encoding)
        with file.open("r+b") as stream:
            digest = hashlib.file_digest(stream, "sha256").hexdigest()
            stream.seek(0, os.SEEK_END)
            stream.write(SEAL + digest.encode())  # HDF5 reads no byte beyond the end that its own header names


def write_text(path: str | Path, text: str) -> None:
    """Write text as UTF-8 whole or not at all."""
    with atomic_write(path) as file:
        file.write_text(text, encoding="utf-8")


def write_json(path: str | Path, data: Any) -> None:
    """Write JSON whole or not at all."""
    write_text(path, json.dumps(data, indent=2, ensure_ascii=False) + "\n")


def json_values(value: Any) -> Any:
    """Value as JSON has it: null for numbers that are not finite, lists for tuples; also inside lists and tables."""
    if isinstance(value, dict):
        return {key: json_values(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [json_values(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
