"""Make the outputs, tables and pictures of the pages again, by the commands named beside them, and compare.

``quoted.py`` describes the comments that name a command, and when a figure is the same. Each page has a scratch folder
with a copy of ``scenes`` and links to the rest of the repository. Its commands run there in the order of the page.
``A && B`` runs A first; what has run on the page is not run again, so commands build on the folders of earlier ones.

    python docs/site/figures.py --list | --check | --write [--only TEXT] [--within SECONDS]
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass, field
from pathlib import Path

from quoted import PAGES, PICTURE, ROOT, Figure, compared, figures, pictures_differ, put_picture
from quoted_tables import table_faults

#: recordings that are not in the repository; commands name their folder as $MITSIM_REAL_DATA
RECORDINGS = Path(os.environ.get("MITSIM_REAL_DATA", ROOT.parent / "shared" / "real"))


@dataclass
class Scratch:
    """A folder in which the commands of one page run."""

    folder: Path
    outputs: dict[str, str] = field(default_factory=dict)  # by command

    def __post_init__(self) -> None:
        shutil.copytree(ROOT / "scenes", self.folder / "scenes")
        for name in ("characterisation", "mitsim", "tests", "pyproject.toml"):
            (self.folder / name).symlink_to(ROOT / name)
        (self.folder / "docs" / "images").mkdir(parents=True)
        for name, words in (("python", ""), ("mitsim", "-m mitsim")):
            program = self.folder / "bin" / name
            program.parent.mkdir(exist_ok=True)
            program.write_text(f'#!/bin/sh\nexec "{sys.executable}" {words} "$@"\n', encoding="utf-8")
            program.chmod(0o755)

    def run(self, command: str) -> str:
        """Return what a command prints; each of its parts runs once."""
        path = f"{self.folder / 'bin'}{os.pathsep}{os.environ['PATH']}"
        environment = os.environ | {
            "PATH": path,
            "PYTHONPATH": str(ROOT),
            "XDG_CACHE_HOME": str(self.folder / "cache"),
            "MITSIM_REAL_DATA": str(RECORDINGS),
        }
        for part in command.split(" && "):
            if part not in self.outputs:
                done = subprocess.run(
                    ["bash", "-c", part],
                    cwd=self.folder,
                    env=environment,
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.PIPE,
                    stderr=subprocess.STDOUT,
                    check=False,
                )
                if done.returncode in (130, -2):
                    raise KeyboardInterrupt(part)
                self.outputs[part] = done.stdout.decode("utf-8", "replace")
        return "\n".join(self.outputs[part] for part in command.split(" && "))


def made_again(figure: Figure, scratch: Scratch, write: bool) -> list[str]:
    """Run the command of a figure and return what differs; with ``write``, put the new one in the page."""
    output = scratch.run(figure.source)
    if figure.kind == "picture":
        kept = [figure.page.parent / name for name in PICTURE.findall(figure.text[0])]
        faults = []
        for picture in kept:
            new = next((one for one in scratch.folder.rglob(picture.name) if one.is_file()), None)
            differs = "the command makes no such picture" if new is None else pictures_differ(picture, new)
            faults += [f"{picture.name}: {differs}"] if differs else []
            if write and new and differs:
                put_picture(new, picture)
    elif figure.kind == "table":
        faults = table_faults(figure.text, output, figure.columns, figure.rows)
    else:
        faults, mended = compared(figure.text, output)
        if write and mended != figure.text:
            lines = figure.page.read_text(encoding="utf-8").splitlines()
            lines[figure.line - 1 : figure.line - 1 + len(mended)] = mended
            figure.page.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return [*faults, *(f"  | {line}" for line in output.splitlines()[-30:])] if faults else []


def selected(page: Path, only: str = "", within: float = float("inf")) -> list[Figure]:
    """Return the figures of a page that a command can make here: those with a text in page or command, and a time."""
    every = [one for one in figures(page) if one.marker == "made by" and one.seconds <= within]
    every = [one for one in every if RECORDINGS.is_dir() or "$MITSIM_REAL_DATA" not in one.source]
    return [one for one in every if only in f"{one.where} {one.source}"]


def check(page: Path, chosen: list[Figure], write: bool = False) -> list[str]:
    """Make the chosen figures of a page again and return what differs."""
    faults = []
    with tempfile.TemporaryDirectory() as folder:
        scratch = Scratch(Path(folder) / "page")
        for one in figures(page):
            if one.kind == "file":
                (scratch.folder / one.source).parent.mkdir(parents=True, exist_ok=True)
                (scratch.folder / one.source).write_text("\n".join(one.text) + "\n", encoding="utf-8")
        for one in chosen:
            found = made_again(one, scratch, write)
            print(f"{'differs' if found else 'same   '}  {one.where}  {one.source}", *found, sep="\n    ", flush=True)
            faults += [f"{one.where}: {fault}" for fault in found]
    return faults


def main() -> int:
    """Run as a script."""
    parser = argparse.ArgumentParser(description="Make the figures of the pages again, and compare.")
    for name, what in (("list", "what each comes from"), ("check", "compare"), ("write", "put them in the pages")):
        parser.add_argument(f"--{name}", action="store_true", help=what)
    parser.add_argument("--only", default="", metavar="TEXT", help="those with this text in page or command")
    parser.add_argument("--within", type=float, default=float("inf"), metavar="SECONDS", help="those that take less")
    given = parser.parse_args()
    if given.list:
        for one in (one for page in PAGES for one in figures(page) if given.only in f"{one.where} {one.source}"):
            print(f"{one.where}  {one.kind}  {one.marker or 'NO MARKER'}: {one.source}  {one.seconds:.0f} s")
        return int(any(not one.marker for page in PAGES for one in figures(page)))
    faults = []
    for page in PAGES:
        if chosen := selected(page, given.only, given.within):
            faults += check(page, chosen, given.write)
    return int(bool(faults))


if __name__ == "__main__":
    sys.exit(main())
