"""Keep decoded clouds between commands, so that several measurements of one capture decode it once.

Signal chain: files of the capture, settings of the decoder, build of mitsim -> SHA-256 -> cloud file of that
name in the user's cache folder, read if it is there and whole, else written after decoding.

The folder is ``mitsim/clouds`` in ``$XDG_CACHE_HOME`` or ``~/.cache``. ``MITSIM_CACHE`` names another one; if it is
empty, nothing is kept. The oldest clouds beyond :data:`MOST_CLOUDS` are removed. A folder that cannot be written is not
used.
"""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel

from characterisation.cloud_files import read_cloud, write_cloud
from characterisation.files.errors import InputError
from characterisation.point_cloud import PointCloud
from mitsim.capture.recordings.recording_files import MOST_FILES
from mitsim.running.build import own_build

#: clouds that are kept
MOST_CLOUDS = 20

#: time of decoding [s] from which a cloud is kept
SLOW_S = 1.0

#: largest capture whose files are hashed [bytes]
_LARGEST = 4 * 1024**3


def kept_cloud(path: Path, settings: Iterable[object], decode: Callable[[], PointCloud]) -> PointCloud:
    """Return the cloud of a capture or recording: the kept one, or that of ``decode``, which is kept if it took long.

    Parameters
    ----------
    path
        File or folder of the capture; all its files count.
    settings
        Everything else that determines the cloud; each object by all of its values.
    decode
        Function that decodes the capture.
    """
    folder = _folder()
    name = None if folder is None else _digest(path, settings)
    file = None if folder is None or name is None else folder / f"{name}.ply"
    if file is not None and file.is_file():
        with suppress(InputError, OSError):
            cloud = read_cloud(file)
            os.utime(file)
            return cloud
    begun = time.monotonic()
    cloud = decode()
    if folder is not None and file is not None and time.monotonic() - begun > SLOW_S:
        with suppress(OSError, InputError):
            folder.mkdir(parents=True, exist_ok=True)
            write_cloud(cloud, file)
            _remove_oldest(folder)
    return cloud


def _folder() -> Path | None:
    folder = os.environ.get("MITSIM_CACHE")
    if folder is not None:
        return Path(folder) / "clouds" if folder else None
    with suppress(RuntimeError):  # no home
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "mitsim" / "clouds"
    return None


def _digest(path: Path, settings: Iterable[object]) -> str | None:
    """Return the SHA-256 of everything that determines a cloud; None if the files are too many, too large or gone."""
    sha = hashlib.sha256(repr(own_build()).encode())
    for setting in settings:
        sha.update(repr(_values(setting)).encode())
    files = [path] if path.is_file() else sorted(entry for entry in path.rglob("*") if entry.is_file())
    try:
        if len(files) > MOST_FILES or sum(file.stat().st_size for file in files) > _LARGEST:
            return None
        for file in files:
            sha.update(file.name.encode())
            with file.open("rb") as stream:
                sha.update(hashlib.file_digest(stream, "sha256").digest())
    except OSError:
        return None
    return sha.hexdigest()


def _values(setting: Any) -> Any:
    """Return all values of an object, whose representation may leave some out or shorten them."""
    if isinstance(setting, BaseModel):
        return type(setting).__name__, [(name, _values(getattr(setting, name))) for name in type(setting).model_fields]
    if is_dataclass(setting):
        return type(setting).__name__, [(one.name, _values(getattr(setting, one.name))) for one in fields(setting)]
    if isinstance(setting, np.ndarray):
        return setting.shape, setting.tolist()
    if isinstance(setting, Mapping):
        return [(name, _values(value)) for name, value in setting.items()]
    return [_values(value) for value in setting] if isinstance(setting, list | tuple) else setting


def _remove_oldest(folder: Path) -> None:
    files = sorted(folder.glob("*.ply"), key=lambda file: file.stat().st_mtime)
    for file in files[:-MOST_CLOUDS]:
        file.unlink(missing_ok=True)
