"""What the pages quote, by the comments before it, and when a quoted figure is the one that a command prints.

A comment directly before a fenced output, a table of figures or a picture says where it comes from::

    <!-- made by: mitsim decode captures/first -o first.ply; takes 3 s -->
    <!-- made by: as above -->                        by the command of the figure before
    <!-- held by: tests/scene/surface/test_metals.py -->    a test computes it again and compares
    <!-- not run: needs the recording stereo.zip -->  a recording, a device, numbers that are settings
    <!-- file: look.py -->                            the fence below is a file that later commands need; it equals
                                                      the file of this name in the repository, if there is one
    <!-- columns: recorded = real -->                 of a table: names that the command prints otherwise
    <!-- rows: all = all of 1000 calibrations -->

**When a figure is the same.** Each quoted line has to be in the output, in this order, with the same words. ``...``
stands for any text, or for omitted lines. ``quoted_numbers.py`` says when two numbers are the same. Times (``17 s``)
and absolute paths are not compared. Tables are compared cell by cell: see ``quoted_tables.py``, also for the comments
*columns* and *rows*. A picture has to have the same proportions, and grey levels that differ by 2 of 255 in the mean at
most.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image
from quoted_numbers import NUMBER, same
from quoted_tables import names_of, row_of

ROOT = Path(__file__).resolve().parents[2]
PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")))

MARKER = re.compile(r"\s*<!-- (made by|held by|not run|file): (.*?)(?:; takes (\d+) (s|min|h))? -->")
NAMES = re.compile(r"\s*<!-- (columns|rows): (.*?) -->")
PICTURE = re.compile(r"!\[[^\]]*\]\(([^)\s]+)\)")
SECONDS = {"s": 1, "min": 60, "h": 3600}

#: parts of a quoted line, by name
PARTS = re.compile(
    r"(?P<any>\.\.\.)|(?P<time>\d[\d.]*\s?(?:ms|s|min|minutes|h)\b)|(?P<path>(?<!\S)/\S+)"
    rf"|(?P<number>{NUMBER})|(?P<space>\s+)|(?P<word>.)"
)


@dataclass(frozen=True)
class Figure:
    """A quoted output, table or picture, and what the marker before it says."""

    page: Path
    line: int  # first line of the quoted text or of the picture, from 1
    kind: str  # output, table, picture, file
    text: list[str]
    marker: str = ""  # made by, held by, not run, file; empty: there is none
    source: str = ""  # command, test, reason or file name
    seconds: float = 0.0
    columns: Mapping[str, str] = field(default_factory=dict)  # of a table: printed names by quoted ones
    rows: Mapping[str, str] = field(default_factory=dict)

    @property
    def where(self) -> str:
        """Page and line."""
        return f"{self.page.relative_to(ROOT)}:{self.line}"


def figures(page: Path) -> list[Figure]:
    """Return everything on a page that has a marker or needs one."""
    lines = page.read_text(encoding="utf-8").splitlines()
    found: list[Figure] = []
    markers: list[tuple[str, str, float]] = []
    names: dict[str, dict[str, str]] = {"columns": {}, "rows": {}}
    at = 0

    def add(kind: str, first: int, text: list[str], needed: bool) -> None:
        for marker, source, seconds in markers or ([("", "", 0.0)] if needed else []):
            if (marker, source) == ("made by", "as above"):
                source, seconds = next((one.source, one.seconds) for one in reversed(found) if one.marker == marker)
            own = "file" if marker == "file" else kind
            found.append(Figure(page, first + 1, own, text, marker, source, seconds, **names))

    while at < len(lines):
        line, end = lines[at], at + 1
        if match := MARKER.fullmatch(line):
            seconds = float(match[3] or 0) * SECONDS[match[4] or "s"]
            markers.append((match[1], match[2], seconds))
        elif match := NAMES.fullmatch(line):
            names[match[1]] |= names_of(match[2])
        elif line.startswith("```"):
            while lines[end] != "```":
                end += 1
            add("output", at + 1, lines[at + 1 : end], needed=line[3:].strip() in ("", "text"))
            end += 1
        elif line.startswith("|"):
            while end < len(lines) and lines[end].startswith("|"):
                end += 1
            add("table", at, lines[at:end], needed=holds_figures(lines[at:end]) and "formats" not in page.parts)
        elif PICTURE.search(line):
            add("picture", at, [line], needed=True)
        if not (line.startswith("<!--") or PICTURE.search(line)):
            markers, names = [], {"columns": {}, "rows": {}}
        at = end
    return found


def cells(table: list[str]) -> list[str]:
    """Return the filled cells of a table under its head and after its first column."""
    return [cell for row in table[2:] for cell in row_of(row)[1:] if cell]


def holds_figures(table: list[str]) -> bool:
    """Return whether more than two fifths of a table's cells begin with a number."""
    filled = cells(table)
    return sum(bool(re.match(r"[-*(+−±<>~]*\s*\d", cell)) for cell in filled) > 0.4 * len(filled)


def pattern(line: str) -> re.Pattern[str]:
    """Return what a line of output has to match to have the words of a quoted line; the groups are its numbers."""
    made = {"any": r".*?", "time": r"\d[\d.]*\s?\w+", "path": r"\S+", "number": f"({NUMBER})", "space": r"\s+"}
    parts = PARTS.finditer(line.strip())
    return re.compile("".join(made.get(str(part.lastgroup)) or re.escape(part.group()) for part in parts))


def compared(quoted: list[str], output: str) -> tuple[list[str], list[str]]:
    """Return the differences of a quoted output from the output, and the quoted lines with the output's numbers."""
    printed, after = [line.strip() for line in output.splitlines()], 0
    faults, mended = [], list(quoted)
    for at, line in enumerate(quoted):
        if line.strip() in ("", "..."):
            continue
        wanted = pattern(line)
        numbers = [part.group() for part in PARTS.finditer(line.strip()) if part.lastgroup == "number"]
        alike = [(i, match) for i, text in enumerate(printed) if i >= after and (match := wanted.fullmatch(text))]
        equal = [i for i, match in alike if all(map(same, numbers, match.groups()))]
        if equal:
            after = equal[0] + 1
        elif alike:
            after = alike[0][0] + 1
            faults.append(f"quoted: {line.strip()}\n    printed: {printed[after - 1]}")
            mended[at] = line if "..." in line else output.splitlines()[after - 1].rstrip()
        else:
            faults.append(f"quoted: {line.strip()}\n    printed: no line with these words")
    return faults, mended


def pictures_differ(kept: Path, new: Path) -> str:
    """Return how a picture differs from the one in the repository, which may be smaller; empty if it does not."""
    first, second = (cv2.imread(str(one), cv2.IMREAD_GRAYSCALE) for one in (kept, new))
    if (
        first is None
        or second is None
        or abs(first.shape[0] / first.shape[1] / second.shape[0] * second.shape[1] - 1) > 0.02
    ):
        return "other proportions"
    mean = float(np.abs(resized(second, first).astype(float) - first).mean())
    return f"grey levels differ by {mean:.1f} in the mean" if mean > 2 else ""


def put_picture(new: Path, kept: Path) -> None:
    """Replace a picture of the repository, at the width that it has there and with 256 colours: it stays small."""
    with Image.open(new) as made:
        image = made.convert("RGB")
    if kept.exists():
        with Image.open(kept) as old:
            width = old.width
        if width != image.width:
            image = image.resize((width, round(image.height / image.width * width)), Image.Resampling.LANCZOS)
    image.quantize(256).save(kept, optimize=True)


def resized(image: NDArray[np.uint8], other: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a grey image at the size of another one."""
    if image.shape == other.shape:
        return image
    return np.asarray(cv2.resize(image, other.shape[::-1], interpolation=cv2.INTER_AREA), np.uint8)
