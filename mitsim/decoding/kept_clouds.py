"""Keep decoded clouds between commands, so that several measurements of one capture decode it once.

Signal chain: capture as it was read, with its rig and images, settings of the decoder, build of mitsim -> SHA-256 ->
cloud file of that name in the user's cache folder, read if it is there and whole, else written after decoding.

The folder is ``mitsim/clouds`` in ``$XDG_CACHE_HOME`` or ``~/.cache``. ``MITSIM_CACHE`` names another one; if it is
empty, nothing is kept. The oldest clouds beyond :data:`MOST_CLOUDS` are removed. A folder that cannot be written is not
used.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from characterisation.cloud_files import read_cloud, write_cloud
from characterisation.files.errors import InputError
from characterisation.files.value_digest import value_digest
from characterisation.point_cloud import PointCloud
from mitsim.running.build import own_build

#: clouds that are kept
MOST_CLOUDS = 20

#: time of decoding [s] from which a cloud is kept
SLOW_S = 1.0


def kept_cloud(contents: object, decode: Callable[[], PointCloud]) -> PointCloud:
    """Return a kept cloud, or that of ``decode``, kept if it took long; ``contents`` determines the cloud."""
    folder = _folder()
    file = None if folder is None else folder / f"{value_digest((own_build(), contents))}.ply"
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


def _remove_oldest(folder: Path) -> None:
    files = sorted(folder.glob("*.ply"), key=lambda file: file.stat().st_mtime)
    for file in files[:-MOST_CLOUDS]:
        file.unlink(missing_ok=True)
