"""Lock a folder, so that one command at a time writes to it.

The lock is the system's ``flock``: the system releases it when the process ends, for whatever reason. The file
``.mitsim.lock`` names the process, and other commands print it. It lies in the folder, or beside one that is written
elsewhere and moved there in one step. The command that locks a folder removes partial files of killed processes.
"""

from __future__ import annotations

import contextlib
import json
import os
import platform
import re
import shutil
import sys
import time
from collections.abc import Callable
from datetime import datetime
from pathlib import Path

from characterisation.files.atomic_io import HOST, pointed_to
from characterisation.files.errors import InputError

LOCK = ".mitsim.lock"

#: temporary names that :mod:`characterisation.files.atomic_io` writes to, with process and machine
_LEFT_OVER = re.compile(
    r"\.(?P<name>.+)\.(?:(?P<pid>\d+)(?:-(?P<host>[0-9a-f]{6}))?\.partial"
    r"|(?P<kind>partial|old)-(?P<pid2>\d+)-(?P<host2>[0-9a-f]{6})[0-9a-f]*)"
)

#: age [s] after which a partial file counts as abandoned whose process cannot be checked: that of another machine
_STALE_S = 24 * 3600.0

#: folders of a run in which files are written one by one
_WITHIN = ("", "captures", "clouds", "coupons", "trials")

#: folders that are runs, in that of a command: its own, those of the sensors of ``choose`` and of samples of a talk,
#: and those of the changes that are tried for each
_RUNS = ("", "*", "views/*", "remedies/*", "*/remedies/*")


def lock_folder(folder: Path, whole: bool = False) -> Callable[[], None]:
    """Lock an existing folder and remove abandoned files; return the function that releases it.

    ``whole``: the command moves the whole folder to its place, and it need not exist yet. Raises InputError if another
    command has locked it in either way; the message has its process, machine and start time.
    """
    inside, beside = folder / LOCK, folder.parent / f".{folder.name}{LOCK}"
    lock, other = (beside, inside) if whole else (inside, beside)
    if other.is_file():
        _unlocked(other, _locked(other, folder))
    handle = _locked(lock, folder)
    if handle is None:
        return lambda: None
    about = {"pid": os.getpid(), "host": platform.node(), "since": f"{datetime.now():%Y-%m-%d %H:%M:%S}"}
    about |= {"command": " ".join(sys.argv[1:2])}
    os.ftruncate(handle, 0)
    os.pwrite(handle, json.dumps(about).encode(), 0)
    if whole:
        remove_partial_beside(folder)
    else:
        remove_partial(folder)
    return lambda: _unlocked(lock, handle)


#: folders that the running command has locked, each with the function that releases it, and those that it has created
_locked_folders: dict[Path, Callable[[], None]] = {}
_created_folders: list[Path] = []


def lock_until_end(folder: Path, whole: bool = False) -> None:
    """Lock a folder as :func:`lock_folder` does, unless this command has; :func:`release_folders` releases it."""
    if folder not in _locked_folders:
        _locked_folders[folder] = lock_folder(folder, whole)


def create_until_end(folder: Path) -> None:
    """Create a folder and its parents; :func:`release_folders` removes those that are still empty."""
    _created_folders.extend(path for path in (*reversed(folder.absolute().parents), folder) if not path.exists())
    folder.mkdir(parents=True, exist_ok=True)


def release_folders() -> None:
    """Release all folders of the command, however it ended, and remove those of them that it left empty."""
    while _locked_folders:
        _locked_folders.popitem()[1]()
    while _created_folders:
        with contextlib.suppress(OSError):  # it is not empty
            _created_folders.pop().rmdir()


def _unlocked(lock: Path, handle: int | None) -> None:
    """Release a lock, and remove its file; nothing without a handle."""
    if handle is not None:
        with contextlib.suppress(OSError):
            lock.unlink(missing_ok=True)
            os.close(handle)


def remove_partial(folder: Path) -> list[Path]:
    """Remove partial files of dead processes; return the paths removed or restored."""
    runs = [path for pattern in _RUNS for path in (folder.glob(pattern) if pattern else [folder]) if path.is_dir()]
    return [path for run in runs for name in _WITHIN for path in _swept(run / name)]


def remove_partial_beside(path: Path) -> list[Path]:
    """Remove partial files that dead processes left for one file or folder, and nothing else in its parent folder."""
    path = pointed_to(path).absolute()
    return _swept(path.parent, path.name)


def _swept(folder: Path, name: str | None = None) -> list[Path]:
    gone = []
    for path in folder.iterdir() if folder.is_dir() else ():
        match = _LEFT_OVER.fullmatch(path.name)
        if match is None or (name is not None and not _is_of(match["name"], name)) or _may_be_alive(path, match):
            continue
        if match["kind"] == "old" and not os.path.lexists(folder / match["name"]):
            path.rename(folder / match["name"])  # killed between the two steps of a replacement: restore
        elif path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)
        gone.append(path)
    return gone


def _is_of(target: str, name: str) -> bool:
    """Return whether a partial file is for a name; temporary folders of the system add letters to it."""
    return target == name or re.fullmatch(re.escape(name) + r"\.[a-z0-9_]{8}", target) is not None


def _may_be_alive(path: Path, match: re.Match[str]) -> bool:
    ours = (match["host"] or match["host2"] or HOST) == HOST
    if ours and sys.platform != "win32":  # signal 0 is Ctrl-C on Windows: os.kill would interrupt the process
        return _is_alive(int(match["pid"] or match["pid2"]))
    try:
        return time.time() - path.stat().st_mtime < _STALE_S
    except OSError:
        return True


def _locked(path: Path, folder: Path) -> int | None:
    """Return a locked handle of the lock file of a folder; None if the system cannot lock files."""
    try:
        import fcntl
    except ImportError:
        return None
    while True:
        handle = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o644)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = _holder(handle)
            os.close(handle)
            allowed = "a folder that no other command is writing to"
            hint = "wait until that command ends, or choose another folder with -o"
            raise InputError(folder, "", f"a folder that {holder} is writing to", allowed, hint) from None
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
        return (
            f"mitsim {str(about['command'])[:40]} (process {int(about['pid'])} on {str(about['host'])[:80]}, "
            f"since {str(about['since'])[:40]})"
        )
    except (ValueError, KeyError, TypeError, RecursionError, OverflowError):
        return "another mitsim"


def _is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except OSError:  # of another user
        pass
    return True
