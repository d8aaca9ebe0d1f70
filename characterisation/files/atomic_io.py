"""Write files and folders atomically: completely or not at all, also on a full disk.

A symbolic link stays, and the file or folder that it points to is written.
"""

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
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from characterisation.files.checked_files import DIGEST, SEAL, dataset_digest

if TYPE_CHECKING:  # the command line wants FULL, and --help is to be quick
    import xarray as xr

#: error numbers of a full disk, of a full quota, and of a file over the largest size of a process
FULL = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})

#: this machine in the names of partial files, since process numbers of different machines may be equal
HOST = hashlib.sha256(platform.node().encode()).hexdigest()[:6]

#: bytes that a disk must still have for a failed writer's error not to be that of a full disk; chosen
_ROOM = 64 * 1024

#: bytes of a netCDF file beside its values, for each file; measured: 8 kB
_NETCDF_FILE = 16 * 1024

#: the same for each variable; measured: 2.9 kB, deflated
_NETCDF_VARIABLE = 4 * 1024


@contextmanager
def atomic_write(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path beside ``path``; it is renamed to ``path`` when the block succeeds, and removed otherwise.

    Raises OSError if the disk is full: its ``errno`` is in :data:`FULL`, its ``filename`` is ``path``.
    """
    target = pointed_to(path)
    partial = target.with_name(f".{target.name}.{os.getpid()}-{HOST}.partial")
    try:
        with _naming(Path(path)):
            yield partial
            partial.replace(target)
    finally:
        with suppress(OSError):  # a read-only file system rejects that too; its error is already reported
            partial.unlink(missing_ok=True)


@contextmanager
def atomic_write_named(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path of the same name in a folder beside ``path``, for libraries that need the suffix.

    Raises OSError as :func:`atomic_write`.
    """
    path, name = pointed_to(path).absolute(), Path(path).name
    ours = f"{os.getpid()}-{HOST}.partial"
    with tempfile.TemporaryDirectory(prefix=f".{path.name}.", suffix=f".{ours}", dir=path.parent) as folder:
        partial = Path(folder) / name
        with _naming(path):
            try:
                yield partial
            except Exception as error:
                if not isinstance(error, OSError):  # libraries report a full disk as errors of their own
                    (Path(folder) / ".full").write_bytes(bytes(_ROOM))
                raise
            partial.replace(path)


@contextmanager
def atomic_folder(folder: str | Path) -> Iterator[Path]:
    """Yield a temporary folder beside ``folder``; it is renamed when the block succeeds, and removed otherwise.

    Raises OSError as :func:`atomic_write`, or if ``folder`` exists and is not empty.
    """
    folder = pointed_to(folder).absolute()
    partial = beside(folder, "partial")
    try:
        with _naming(folder):
            partial.mkdir(parents=True)
            yield partial
            partial.rename(folder)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def pointed_to(path: str | Path) -> Path:
    """Return the path that a symbolic link points to; any other path as it is."""
    path = Path(path)
    return Path(os.path.realpath(path)) if path.is_symlink() else path


def beside(path: Path, kind: str) -> Path:
    """Return a path beside another that nothing else uses; :mod:`mitsim.cli.folder_lock` recognises its form."""
    return path.with_name(f".{path.name}.{kind}-{os.getpid()}-{HOST}{uuid.uuid4().hex[:12]}")


def write_folder(folder: str | Path, files: Mapping[str, bytes], *, overwrite: Collection[str] = ()) -> None:
    """Write a folder of files by their paths in it; after a loss of power it is complete or absent.

    The files are written beside the folder, flushed to the disk, and renamed in one step. With ``overwrite`` the folder
    may exist: these names in it are replaced or removed, and all others stay. Raises OSError if the folder cannot be
    written, or exists already; an existing folder is then unchanged. If the disk is full, ``errno`` is in :data:`FULL`
    and ``filename`` is ``folder``.
    """
    folder = pointed_to(folder).absolute()
    partial, old = beside(folder, "partial"), beside(folder, "old")
    try:
        with _naming(folder):
            folder.parent.mkdir(parents=True, exist_ok=True)
            for path, data in files.items():
                _write_synced(partial / path, data)
            for other in folder.iterdir() if overwrite and folder.exists() else ():
                if other.name not in overwrite:
                    _copy(other, partial / other.name)
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


def _copy(source: Path, target: Path) -> None:
    if source.is_dir() and not source.is_symlink():
        shutil.copytree(source, target, symlinks=True)
    else:
        shutil.copy2(source, target, follow_symlinks=False)


def _write_synced(file: Path, data: bytes) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    with file.open("xb") as stream:
        stream.write(data)
        stream.flush()
        os.fsync(stream.fileno())


def _sync_directory(directory: Path) -> None:
    """Flush the names in a folder to the disk, except on Windows, which cannot open a folder."""
    if os.name == "posix":
        handle = os.open(directory, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


@contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Name ``path`` in errors of writing: ``write`` names no file, and other calls name the temporary path."""
    try:
        yield
    except OSError as error:
        if error.errno in FULL or ".partial" in str(error.filename):
            raise type(error)(error.errno, error.strerror, str(path)) from None
        raise


def write_netcdf(data: xr.Dataset, path: str | Path, encoding: Mapping[Any, Mapping[str, Any]] | None = None) -> None:
    """Write a dataset as netCDF with a digest of its content, atomically.

    The function first writes as many bytes as the uncompressed data need: on a full disk HDF5 reports "HDF error" or
    "Permission denied", and holds the file open until the process ends. A seal follows the last byte. A reader checks
    it before HDF5 parses the file, which may hang on a damaged file.
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
    r"""Write text as UTF-8, atomically; bytes of file names that are not UTF-8 become escapes such as ``\udce9``."""
    with atomic_write(path) as file:
        file.write_text(text, encoding="utf-8", errors="backslashreplace")  # in JSON the same text again


def write_json(path: str | Path, data: Any) -> None:
    """Write JSON, atomically."""
    write_text(path, json.dumps(data, indent=2, ensure_ascii=False) + "\n")


def json_values(value: Any) -> Any:
    """Return a value for JSON: null for numbers that are not finite, lists for tuples; also inside lists and tables."""
    if isinstance(value, dict):
        return {key: json_values(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [json_values(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
