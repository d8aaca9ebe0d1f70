"""One command at a time writes to a folder: others are told who holds it since when; a dead holder keeps nothing.

The lock is the system's own (``flock``), which ends with the process that holds it, however that ends; the file
``.mitsim.lock`` only says who that is. Who holds a folder sweeps what killed processes left in it.
"""

from __future__ import annotations

import contextlib
import json
import os
import platform
import re
import shutil
import sys
from collections.abc import Callable
from datetime import datetime
from pathlib import Path

from mitsim.errors import InputError

LOCK = ".mitsim.lock"

#: what :mod:`characterisation.whole_files` writes to before it takes its name; the number is that of the process
_LEFT_OVER = re.compile(r"\..+\.(?:(\d+)\.partial|(?:partial|old)-(\d+)-[0-9a-f]+)")

#: folders of a run in which files are written one by one
_WITHIN = ("", "captures", "clouds", "coupons")


def hold(folder: Path) -> Callable[[], None]:
    """Hold a folder that is there, and sweep it; returns what lets it go.

    Raises
    ------
    InputError
        If another command holds it; told are its process, machine and the time since when.
    """
    handle = _locked(folder)
    if handle is None:
        return lambda: None
    about = {"pid": os.getpid(), "host": platform.node(), "since": f"{datetime.now():%Y-%m-%d %H:%M:%S}",
             "command": " ".join(sys.argv[1:2])}  # fmt: skip
    os.ftruncate(handle, 0)
    os.pwrite(handle, json.dumps(about).encode(), 0)
    sweep(folder)

    def let_go() -> None:
        with contextlib.suppress(OSError):
            (folder / LOCK).unlink(missing_ok=True)
            os.close(handle)

    return let_go


def sweep(folder: Path) -> list[Path]:
    """Remove half-written files of processes of this machine that are no more; returns what was removed."""
    gone = []
    for place in (folder / name for name in _WITHIN):
        for path in place.iterdir() if place.is_dir() else ():
            match = _LEFT_OVER.fullmatch(path.name)
            if match is None or _is_alive(int(match[1] or match[2])):
                continue
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink(missing_ok=True)
            gone.append(path)
    return gone


def _locked(folder: Path) -> int | None:
    """A handle of the lock's file, locked; None where the system has no such locks."""
    try:
        import fcntl
    except ImportError:
        return None
    path = folder / LOCK
    while True:
        handle = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o644)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            told = _holder(handle)
            os.close(handle)
            raise InputError(
                folder, "", f"a folder that {told} writes to", "a folder to which nothing else writes",
                "wait until it has ended, or choose another folder with -o",
            ) from None  # fmt: skip
        except OSError:  # a file system without locks
            os.close(handle)
            path.unlink(missing_ok=True)
            return None
        with contextlib.suppress(FileNotFoundError):
            if os.fstat(handle).st_ino == path.stat().st_ino:
                return handle
        os.close(handle)  # its holder has just removed it


def _holder(handle: int) -> str:
    try:
        about = json.loads(os.pread(handle, 4096, 0))
        return (f"mitsim {str(about['command'])[:40]} (process {int(about['pid'])} on {str(about['host'])[:80]}, "
                f"since {str(about['since'])[:40]})")  # fmt: skip
    except (ValueError, KeyError, TypeError, RecursionError):
        return "another mitsim"


def _is_alive(pid: int) -> bool:
    if pid == os.getpid():
        return True
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except OSError:
        return True
    return True
