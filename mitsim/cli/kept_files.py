"""Refuse to write over a file that the command reads, or that belongs to a capture or a run."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

from characterisation.files.checked_files import is_file
from characterisation.files.errors import InputError

#: options whose value is a file or folder to write; all other arguments may name what the command reads
_WRITTEN = frozenset({"-o", "--output", "--html", "--bounces", "--picture", "--figure", "--compact"})

#: documents that list the files of their folder, by their paths in it
_LISTS = ("capture.json", "run.json")

#: documents that no other command may replace, whether or not one of :data:`_LISTS` is beside them
_DOCUMENTS = frozenset({*_LISTS, "choice.json", "exposures.json", "poses.json", "run_of.json", "statement.json"})

#: arguments of the running command line
_arguments: list[str] = []


def note_arguments(arguments: list[str]) -> None:
    """Note the arguments of the command line, before it runs."""
    _arguments[:] = arguments


def refuse_kept(file: Path) -> None:
    """Raise InputError for an existing file that the command reads, or that a capture or a run consists of."""
    if not is_file(file):
        return
    owner = "the command reads" if any(is_file(path) and file.samefile(path) for path in _read()) else _owner(file)
    if owner:
        raise InputError("--output", "", f"{file}, which {owner}", "another file")


def _read() -> Iterator[str]:
    """Yield the arguments that may name a file that is read, and the values of those of the form NAME=VALUE."""
    option = ""
    for argument in _arguments:
        if option not in _WRITTEN and argument.partition("=")[0] not in _WRITTEN:
            yield from (argument, argument.partition("=")[2])
        option = argument


def _owner(file: Path) -> str:
    """Return whose file a path is; empty for any other file."""
    file = file.resolve()
    if file.name in _DOCUMENTS:
        return "a capture or a run consists of"
    for folder in file.parents[:2]:
        name = json.dumps(file.relative_to(folder).as_posix(), ensure_ascii=False)
        for listing in (folder / each for each in _LISTS):
            if is_file(listing) and name in listing.read_text(encoding="utf-8", errors="replace"):
                return f"{listing} lists"
    return ""
