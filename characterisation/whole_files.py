"""Files and folders that are there whole or not at all."""

from __future__ import annotations

import json
import os
import shutil
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any


@contextmanager
def written_whole(path: str | Path) -> Iterator[Path]:
    """Give a place beside ``path`` to write to; it takes the name when the block ends well, and is gone otherwise."""
    path = Path(path)
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        yield partial
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def write_folder(folder: str | Path, files: Mapping[str, bytes], *, overwrite: bool = False) -> None:
    """Write a folder of files by their paths in it, so that it survives a loss of power as a whole or not at all.

    The files are written beside it, flushed to the disk and moved there in one step. ``overwrite`` replaces a folder
    that is there.

    Raises
    ------
    OSError
        If it cannot be written, or is there already; what was there before is there still.
    """
    folder = Path(folder).absolute()
    tag = uuid.uuid4().hex[:12]
    partial, old = (folder.with_name(f".{folder.name}.{kind}-{tag}") for kind in ("partial", "old"))
    try:
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


def write_json(path: str | Path, data: Any) -> None:
    """Write JSON whole or not at all."""
    with written_whole(path) as file:
        file.write_text(json.dumps(data, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")
