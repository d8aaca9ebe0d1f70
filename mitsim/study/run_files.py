"""Record which command owns the files of a run, and their digests, so that no report mixes two runs.

``run_of.json`` names the command that wrote into a folder, with a digest of everything that decides its results. Before
a command writes, it moves results of another study, seed, version or map to ``earlier/``.

Captures of coupons and trials stay, since each has its own digest and is reused only if that matches. ``run.json`` is
written last and names the files of its run with their SHA-256. Readers of a run use no other files.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Mapping
from pathlib import Path

from characterisation.files.atomic_io import write_json
from characterisation.files.checked_files import read_json_object
from characterisation.files.errors import InputError
from characterisation.words.version import __version__

#: name of the file that records the owner of a folder's results
OWNER = "run_of.json"

#: name of the task of a run, a copy: an export needs no file beyond the folder
TASK = "task.json"

#: folder for results of another study
EARLIER = "earlier"

#: files that show that a folder holds results, and all files that belong to them; ``run.json`` first, as it names
#: others
_KNOWN_BY = ("run.json", "scores.nc", "checks.nc", "statement.json")
_WRITTEN = ("report.html", "sheet.pdf", "scores.csv", "view_set.csv", "part.ply", TASK, "stand.npz")
_RESULTS = (*_KNOWN_BY, *_WRITTEN, "poses", "clouds", "captures")

#: hint for a folder whose files are of several runs
AGAIN = "run the study again: mitsim run STUDY.toml -o DIR"


def claim_folder(folder: str | Path, command: str, digest: str) -> Path | None:
    """Reserve a folder for the results of a command, before it writes anything; remove its ``run.json``.

    ``folder``: folder of the run. ``command``: command that writes: ``run``, ``score``, ``budget of view 3``.
    ``digest``: digest of everything that decides the results. Returns: new place of results of another command or
    digest; None if there were none. Raises InputError if they cannot be moved, or the folder cannot be written to.
    """
    folder = Path(folder)
    mine = {"schema_version": 1, "command": command, "digest": digest, "mitsim": __version__}
    try:
        before = _owner(folder / OWNER)
        moved = None
        there = [name for name in _RESULTS if os.path.lexists(folder / name)]
        if before != mine and any(name in _KNOWN_BY for name in there):
            moved = _free_place(folder / EARLIER, str(before.get("digest", "unknown"))[:12])
            moved.mkdir(parents=True)
            for name in there:
                (folder / name).rename(moved / name)
        (folder / "run.json").unlink(missing_ok=True)  # until the command ends, the folder holds no whole run
        if before != mine:
            folder.mkdir(parents=True, exist_ok=True)
            write_json(folder / OWNER, mine)
    except OSError as error:
        fault = f"a folder that cannot be written to ({error.strerror})"
        raise InputError(folder, "", fault, "a writable folder", "choose another with -o") from None
    return moved


def digests_of(folder: Path, names: Iterable[str]) -> dict[str, str]:
    """Return the SHA-256 of files of a folder, by their paths in it; missing files are omitted."""
    return {name: _sha256(folder / name) for name in names if (folder / name).is_file()}


def check_own(folder: Path, files: Mapping[str, str], names: Iterable[str]) -> None:
    """Check files against their run's digests, which old runs lack; InputError names a changed or foreign file."""
    for name in names:
        if name not in files:
            continue
        try:
            digest = _sha256(folder / name)
        except FileNotFoundError:
            raise InputError(folder / name, "", "no such file", "a file that run.json names", AGAIN) from None
        except OSError as error:
            raise InputError(folder / name, "", f"a file that cannot be read ({error.strerror})", "a file") from None
        if digest != files[name]:
            other, allowed = "a file of another run, or a changed one", "the file that run.json names"
            raise InputError(folder / name, "sha256", other, allowed, AGAIN)


def _sha256(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _owner(path: Path) -> dict[str, object]:
    try:
        return read_json_object(path)
    except InputError:
        return {}


def _free_place(folder: Path, name: str) -> Path:
    """Return a free path in a folder: ``name``, or ``name`` with a number."""
    plain = "".join(character for character in name if character.isalnum()) or "unknown"
    number = 1
    while os.path.lexists(path := folder / (plain if number == 1 else f"{plain}-{number}")):
        number += 1
    return path
