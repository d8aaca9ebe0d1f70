"""Read the files of a recording safely, from a folder or a zip.

A zip is never unpacked to disk, so no name in it can lead out of a folder. Each file is read up to a limit, whatever
size the archive states, and so is the total.
"""

from __future__ import annotations

import lzma
import re
import struct
import zipfile
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path, PurePosixPath

from characterisation.files.checked_files import LARGEST_FILE, is_inside, read_bounded
from characterisation.files.errors import InputError, MissingEnvironmentError

#: first and last bytes of an MCAP file (mcap.dev/spec)
MCAP_MAGIC = b"\x89MCAP0\r\n"

#: first bytes of a ROS 1 bag
BAG_MAGIC = b"#ROSBAG V"

#: first bytes of an SQLite file, such as a ROS 2 bag
SQLITE_MAGIC = b"SQLite format 3\0"

#: first bytes of an OpenEXR image
EXR_MAGIC = b"\x76\x2f\x31\x01"

#: largest number of files in one recording
MOST_FILES = 10_000

#: largest total size read from one recording [bytes]
LARGEST_RECORDING = 4 * 1024**3

#: depth of nested folders: a sequence, a camera, its files
_DEEPEST = 3

#: errors of the standard library for a damaged, encrypted or unusual zip
_DAMAGED = (
    zipfile.BadZipFile, zlib.error, lzma.LZMAError, struct.error, EOFError, KeyError, OSError, RuntimeError, ValueError,
)  # fmt: skip


def recorded_names(path: Path, expected: str) -> list[str]:
    """List the files in a folder or zip down to the third level, with ``/`` between; ``expected`` is for messages."""
    if path.is_dir():
        files = (file for level in range(_DEEPEST) for file in path.glob("/".join(["*"] * (level + 1))))
        names = [file.relative_to(path).as_posix() for file in files if file.is_file() and is_inside(file, path)]
    elif path.is_file():
        with _in_words(path), zipfile.ZipFile(path) as archive:
            names = archive.namelist()
    else:
        raise InputError(path, "", "no such file or folder", expected)
    if len(names) > MOST_FILES:
        raise InputError(path, "", f"{len(names)} files", f"up to {MOST_FILES} files")
    kept = [name for name in names if len(PurePosixPath(name).parts) <= _DEEPEST]
    return sorted(name for name in kept if not name.startswith("__MACOSX/") and not name.endswith("/"))


def recorded_files(path: Path, names: Iterable[str]) -> dict[str, bytes]:
    """Return the bytes of some files of a folder or zip, by name."""
    out: dict[str, bytes] = {}
    total = 0
    with _in_words(path), nullcontext() if path.is_dir() else zipfile.ZipFile(path) as archive:
        for name in names:
            out[name] = read_bounded(path / name) if archive is None else _member(archive, name, path)
            total += len(out[name])
            if total > LARGEST_RECORDING:
                raise InputError(path, "size", f"over {total} bytes", f"up to {LARGEST_RECORDING} bytes in all")
    return out


@contextmanager
def _in_words(path: Path) -> Iterator[None]:
    """Turn the errors of the standard library for a damaged zip into one that names the file."""
    try:
        yield
    except InputError:
        raise
    except _DAMAGED as error:
        found = f"a file that cannot be unpacked ({error})"
        raise InputError(path, "", found, "an undamaged zip without password") from None


@contextmanager
def needs_recordings(path: Path, kind: str) -> Iterator[None]:
    """Say which packages a recording needs if they are not installed."""
    try:
        yield
    except ModuleNotFoundError as error:
        found, hint = f"packages that are not installed ({error.name})", "pip install 'mitsim[recordings]'"
        raise MissingEnvironmentError(f"{path}: {kind} needs {found}: {hint}") from None


def plain_name(name: str) -> str:
    """Return a file's name without folders; all but letters, digits, dot, dash and underscore become underscores."""
    plain = re.sub(r"[^A-Za-z0-9._-]", "_", PurePosixPath(name).name)[-100:]
    return plain if re.match("[A-Za-z0-9]", plain) else f"x{plain[1:]}"


def _member(archive: zipfile.ZipFile, name: str, path: Path) -> bytes:
    with archive.open(name) as member:
        data = member.read(LARGEST_FILE + 1)  # the archive may state a wrong size
    if len(data) > LARGEST_FILE:
        raise InputError(path, name, f"more than {LARGEST_FILE} bytes", f"up to {LARGEST_FILE} bytes")
    return data


def frame_of(frame: int | str | None, path: Path, names: list[str] | None = None) -> int | None:
    """Return the number of a frame given by its number, counted from 0, or by its name in ``names``, in order."""
    if frame is None or isinstance(frame, int) or (frame.isascii() and frame.isdigit()):
        if frame is not None and names is not None and not int(frame) < len(names):
            raise InputError(path, "--frame", frame, _readable(names))
        return None if frame is None else int(frame)
    if names and frame in names:
        return names.index(frame)
    raise InputError(path, "--frame", repr(frame), _readable(names) if names else "a number, from 0")


def chosen_frame(frame: int | None, count: int, where: Path, label: str) -> int:
    """Return the number of the chosen frame, from 0; a single frame need not be chosen.

    ``label`` is the name of the frames in messages, in the plural.
    """
    if frame is None and count > 1:
        allowed, hint = "one in a capture", f"choose with --frame 0 to {count - 1}"
        raise InputError(where, "--frame", f"{count} {label}", allowed, hint)
    if frame is not None and not 0 <= frame < count:
        raise InputError(where, "--frame", frame, f"0 to {count - 1}: {label}, in their order")
    return frame or 0


def _readable(names: list[str]) -> str:
    """Return the readable frames in words: their numbers and names."""
    shown = ", ".join(f"{number} ({name})" for number, name in enumerate(names[:8]))
    more = f" to {len(names) - 1} ({names[-1]})" if len(names) > 8 else ""
    return f"{shown}{more}" if names else "no frame"
