"""Insert fitted numbers into the text of a sensor file, and keep its comments.

Signal chain: text of the file -> line of every fitted key, else a new line in its table, else a new table at the end ->
the value, preceded by a comment with its uncertainty and captures -> the cameras of the captured unit, its exposure ->
text that is again a valid sensor file.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from mitsim.sensor.camera import Camera

_TABLE = re.compile(r"^\s*\[(?!\[)\s*([^\]]+?)\s*\]")
_ARRAY_OF_TABLES = re.compile(r"^\s*\[\[\s*([^\]]+?)\s*\]\]")
_EXPOSURE_RULE = re.compile(r"\s*(rule|reflectance|distance_mm|level|percentile|exposure_s)\s*=")
_KEY = re.compile(r"^(\s*)([A-Za-z0-9_]+)\s*=\s*(.*)$")


@dataclass(frozen=True)
class Entry:
    """A ``value`` of a key in TOML syntax, and the ``comment`` above it."""

    value: str
    comment: str


def number(value: float) -> str:
    """Format a number for TOML with five digits."""
    return f"{value:.5g}" if abs(value) < 1e15 else f"{value:.5e}"


def numbers(values: Sequence[float] | np.ndarray, digits: int = 9) -> str:
    """Format an array of numbers for TOML."""
    return "[" + ", ".join(f"{float(value):.{digits}g}" for value in values) + "]"


def with_entries(text: str, entries: Mapping[str, Entry]) -> str:
    """Set the values of keys such as ``imager.full_well_e``; top-level keys have no dot."""
    for key, entry in entries.items():
        text = _with_entry(text, *_split(key), entry)
    return text


def with_cameras(text: str, cameras: Mapping[str, Camera], source: str) -> str:
    """Replace the tables of the cameras."""
    blocks = _blocks(text)
    kept = [lines for table, lines in blocks if not table.startswith("cameras.")]
    index = next((n for n, (table, _) in enumerate(blocks) if table.startswith("cameras.")), 1)
    made: list[str] = [f"# cameras of this unit, from {source}"]
    for name, camera in cameras.items():
        matrix, place = camera.matrix, camera.sensor_from_camera
        made += [
            f"[cameras.{name}]",
            f"width = {camera.width}",
            f"height = {camera.height}",
            f"focal_px = {numbers([matrix[0, 0], matrix[1, 1]])}",
            f"principal_px = {numbers([matrix[0, 2], matrix[1, 2]])}",
            f"distortion = {numbers(camera.distortion)}",
        ]
        if camera.model != "perspective":
            made.append(f'model = "{camera.model}"')
        if place.translation.any() or not np.array_equal(place.rotation, np.eye(3)):
            turn = Rotation.from_matrix(place.rotation).as_euler("xyz", degrees=True)
            made += [f"position_mm = {numbers(place.translation)}", f"rotation_deg = {numbers(turn)}"]
        made.append("")
    kept.insert(index, made)
    return "\n".join(line for lines in kept for line in lines)


def with_exposure(text: str, seconds: float, comment: str) -> str:
    """Set a fixed exposure; limits and bracket stay."""
    out = []
    for table, lines in _blocks(text):
        if table == "exposure":
            kept = [line for line in lines[1:] if not _EXPOSURE_RULE.match(line)]
            lines = [lines[0], 'rule = "fixed"', f"# {comment}", f"exposure_s = {number(seconds)}", *kept]
        out += lines
    return "\n".join(out)


def moved_paths(text: str, old: Path, new: Path) -> str:
    """Make the paths of calibration and covariance, relative to folder ``old``, relative to ``new``."""

    def moved(match: re.Match[str]) -> str:
        path = (old / match[2]).absolute()
        return f'{match[1]}"{Path(os.path.relpath(path, new.absolute())).as_posix()}"'

    out = []
    for table, lines in _blocks(text):
        key = {"calibration": "file", "unknowns.calibration": "covariance"}.get(table)
        if key is not None:
            lines = [re.sub(rf'^(\s*{key}\s*=\s*)"([^"]+)"', moved, line) for line in lines]
        out += lines
    return "\n".join(out)


def _split(key: str) -> tuple[str, str]:
    table, _, name = key.rpartition(".")
    return table, name


def _blocks(text: str) -> list[tuple[str, list[str]]]:
    """Return the tables and their lines, with headers and the comments directly above; the first has no name."""
    blocks: list[tuple[str, list[str]]] = [("", [])]
    for line in text.split("\n"):
        header = _ARRAY_OF_TABLES.match(line) or _TABLE.match(line)
        if header:
            blocks.append((header[1], [line]))
        else:
            blocks[-1][1].append(line)
    return blocks


def _with_entry(text: str, table: str, key: str, entry: Entry) -> str:
    comment = [f"# {line}" for line in entry.comment.split("\n")] if entry.comment else []
    blocks = _blocks(text)
    for name, lines in blocks:
        if name != table:
            continue
        for index, line in enumerate(lines):
            match = _KEY.match(line)
            if match and match[2] == key:
                beside = _comment_of(match[3])
                lines[index : index + 1] = [*comment, f"{key} = {entry.value}{beside}"]
                return "\n".join(line for _, part in blocks for line in part)
        at = 1 if table else 0
        lines[at:at] = [*comment, f"{key} = {entry.value}"]
        return "\n".join(line for _, part in blocks for line in part)
    return "\n".join([text.rstrip("\n"), "", f"[{table}]", *comment, f"{key} = {entry.value}", ""])


def _comment_of(rest: str) -> str:
    """Return the comment behind a one-line value, with the previous value."""
    value, mark, comment = rest.partition("#")
    said = f"before: {value.strip()}" + (f"; {comment.strip()}" if mark else "")
    return f"  # {said}"
