"""What the pages quote, by the comments before it, and when a quoted figure is the one that a command prints.

A comment directly before a fenced output, a table of figures or a picture says where it comes from::

    <!-- made by: mitsim decode captures/first -o first.ply; takes 3 s -->
    <!-- made by: as above -->                        by the command of the figure before
    <!-- held by: tests/surface/test_metals.py -->    a test computes it again and compares
    <!-- not run: needs the recording stereo.zip -->  a recording, a device, numbers that are settings
    <!-- file: brighten.py -->                        the fence below is a file that later commands need

**When a figure is the same.** Each quoted line has to be in the output, in this order, with the same words. ``...``
stands for any text, or for omitted lines. Two whole numbers are equal; of 1000 or more they count pixels or points and
may differ by 0.1 %, because other processors round differently. Other numbers are the same if both can be roundings of
one value: they differ by at most half a unit in the last digit of the one plus half a unit in the last digit of the
other, and no digit is quoted that the command does not print. Times (``17 s``) and absolute paths are not compared. Of
a table, which may be arranged otherwise, each number has to be in the output, except in columns *by others*. A picture
has to have the same proportions, and grey levels that differ by 2 of 255 in the mean at most.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

ROOT = Path(__file__).resolve().parents[2]
PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")))

MARKER = re.compile(r"\s*<!-- (made by|held by|not run|file): (.*?)(?:; takes (\d+) (s|min|h))? -->")
PICTURE = re.compile(r"!\[[^\]]*\]\(([^)\s]+)\)")
SECONDS = {"s": 1, "min": 60, "h": 3600}

NUMBER = r"(?<![A-Za-z_\d.])[-+−]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?(?![A-Za-z_\d])"
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
    told: str = ""  # command, test, reason or file name
    seconds: float = 0.0

    @property
    def where(self) -> str:
        """Page and line."""
        return f"{self.page.relative_to(ROOT)}:{self.line}"


def figures(page: Path) -> list[Figure]:
    """Return everything on a page that has a marker or needs one."""
    lines = page.read_text(encoding="utf-8").splitlines()
    found: list[Figure] = []
    markers: list[tuple[str, str, float]] = []
    at = 0

    def add(kind: str, first: int, text: list[str], needed: bool) -> None:
        for marker, told, seconds in markers or ([("", "", 0.0)] if needed else []):
            if (marker, told) == ("made by", "as above"):
                told, seconds = next((one.told, one.seconds) for one in reversed(found) if one.marker == marker)
            found.append(Figure(page, first + 1, "file" if marker == "file" else kind, text, marker, told, seconds))

    while at < len(lines):
        line, end = lines[at], at + 1
        if match := MARKER.fullmatch(line):
            told = float(match[3] or 0) * SECONDS[match[4] or "s"]
            markers.append((match[1], match[2], told))
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
            markers = []
        at = end
    return found


def cells(table: list[str]) -> list[str]:
    """Return the filled cells of a table under its head and after its first column."""
    return [cell for row in table[2:] for cell in row_of(row)[1:] if cell]


def row_of(line: str) -> list[str]:
    """Return the cells of a line of a table."""
    return [cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]]


def holds_figures(table: list[str]) -> bool:
    """Return whether more than two fifths of a table's cells begin with a number."""
    filled = cells(table)
    return sum(bool(re.match(r"[-*(+−±<>~]*\s*\d", cell)) for cell in filled) > 0.4 * len(filled)


def same(quoted: str, found: str) -> bool:
    """Return whether two printed numbers are the same figure."""
    first, second = (float(one.replace("−", "-")) for one in (quoted, found))
    if unit(quoted) >= 1 and unit(found) >= 1:
        return first == second or abs(first - second) <= 1e-3 * abs(first) >= 1
    rounded = (unit(quoted) + unit(found)) / 2 if unit(found) <= unit(quoted) else 0.0
    return abs(first - second) <= rounded * (1 + 1e-9)


def unit(number: str) -> float:
    """Return the unit of the last digit of a printed number."""
    digits, _, power = number.lower().partition("e")
    return float(10.0 ** (int(power or 0) - len(digits.partition(".")[2])))


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


def missing_numbers(table: list[str], output: str) -> list[str]:
    """Return the numbers in the cells of a table that the output does not have."""
    printed = re.findall(NUMBER, output)
    others = [at for at, head in enumerate(row_of(table[0])) if "by others" in head]
    own = [cell for row in table[2:] for at, cell in enumerate(row_of(row)) if at not in (0, *others)]
    wanted = re.findall(NUMBER, re.sub(r"`[^`]*`", "", " | ".join(own)))
    return [one for one in wanted if not any(same(one, other) for other in printed)]


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
