"""Write the result of a fit: as a table, and into the text of a sensor file, whose comments are kept.

Signal chain: text of the file -> line of every fitted key, else a new line in its table, else a new table at the end ->
the value, and above its table a comment with its uncertainty and captures -> the cameras of the captured unit, its
exposure -> text that is again a valid sensor file.
"""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from characterisation.files.atomic_io import atomic_write
from characterisation.words.numbers import two_digits
from mitsim.sensor.camera import Camera
from mitsim.sensor.fitted_to import FittedCapture
from mitsim.sensor.preset import load_sensor
from mitsim.twin.sensor.estimate import FittedKey
from mitsim.twin.sensor.run import SensorFit, sensor_path

_TABLE = re.compile(r"^\s*\[(?!\[)\s*([^\]]+?)\s*\]")
_ARRAY_OF_TABLES = re.compile(r"^\s*\[\[\s*([^\]]+?)\s*\]\]")
_EXPOSURE_RULE = re.compile(r"\s*(rule|reflectance|distance_mm|level|percentile|exposure_s)\s*=")
_KEY = re.compile(r"^(\s*)([A-Za-z0-9_]+)\s*=\s*(.*)$")
#: a text in quotes, or a comment
_QUOTED = re.compile(r"""\"([^\"]+)\"|'([^']+)'|#.*""")
#: the value of a key with the texts in it, and the comment after it
_VALUE = re.compile(r"""((?:"[^"]*"?|'[^']*'?|[^"'#])*)(?:#(.*))?""")
_ARRAY = re.compile(r"^(.*)\[(\d+)\]$")


def write_sensor(fit: SensorFit, sensor: str | Path, output: Path) -> None:
    """Write the sensor file of a fit: the file of ``sensor`` with the fitted numbers."""
    path, first = sensor_path(sensor), fit.input_captures[0]
    text = moved_paths(path.read_text(encoding="utf-8"), path.parent, output.parent)
    origin = f"fitted by `mitsim fit sensor` from {path.stem}\nverdict: {fit.verdict.word}: {fit.verdict.why}"
    entries = {"name": Entry(f'"{output.stem}"', origin), "fitted_to": Entry(_list(fit.fitted_to), "")}
    entries |= _entries(fit)
    if "[calibration]" not in text and first.capture.source != "simulated":
        text = with_cameras(text, dict(first.capture.rig.cameras), first.name)
    seconds = fit.sensor.exposure.base_s
    assert seconds is not None
    text = with_exposure(text, seconds, f"of {first.name}; power and room hold for this exposure only")
    with atomic_write(output) as trial:
        trial.write_text(with_entries(text, entries), encoding="utf-8")
        checked = trial.with_suffix(".check.toml")
        shutil.copy(trial, checked)
        try:
            load_sensor(checked)
        finally:
            checked.unlink()


def fit_table(fit: SensorFit) -> str:
    """Return a Markdown table of the estimates and the undetermined numbers."""
    lines = ["| number | value | 95 % interval | unit | captures | how |", "| --- | --- | --- | --- | --- | --- |"]
    lines += [
        f"| {one.key} | {one.value:.4g} | {one.interval_in_words()} | {one.unit} | {', '.join(one.captures)} "
        f"| {one.method} |"
        for one in fit.estimates
    ]
    kept = [entry for entry in fit.undetermined if entry.value]
    if kept:
        lines += ["", "| not determined | in the file | a capture that would determine it |", "| --- | --- | --- |"]
        lines += [
            f"| {entry.key} | {f'0, before {entry.value:.4g}' if entry.contained else f'{entry.value:.4g}, kept'} "
            f"| {entry.determined_by} |"
            for entry in kept
        ]
    absent = [f"{entry.key} ({entry.determined_by})" for entry in fit.undetermined if not entry.value]
    if absent:
        lines += ["", f"Not determined, and 0 before and after: {', '.join(absent)}."]
    return "\n".join(lines) + "\n"


def _entries(fit: SensorFit) -> dict[str, Entry]:
    entries, arrays = dict[str, Entry](), dict[str, dict[int, FittedKey]]()
    for estimate in fit.estimates:
        match = _ARRAY.match(estimate.key)
        if estimate.key == "imager.companding_dn":
            knees = ", ".join(numbers(knee, 6) for knee in fit.sensor.imager.companding)
            comment = _comment(estimate) + "; unknown beyond the brightest level seen"
            entries[estimate.key] = Entry(f"[{knees}]", comment)
        elif match:
            arrays.setdefault(match[1], {})[int(match[2])] = estimate
        else:
            entries[estimate.key] = Entry(number(estimate.value), _comment(estimate))
    for key, parts in arrays.items():
        count, limit = (3, 200.0) if key == "room.curvature" else (2, 20.0)
        values = [parts[index].value if index in parts else 0.0 for index in range(count)]
        known = [index in parts and parts[index].determined for index in range(count)]
        spreads = [two_digits(parts[index].uncertainty) if known[index] else "-" for index in range(count)]
        part = next(iter(parts.values()))
        stated = f"standard uncertainties {', '.join(spreads)}" if any(known) else "not determined"
        comment = f"fitted: {stated}; {part.method}; {', '.join(part.captures)}"
        entries[key] = Entry(numbers(np.clip(values, -limit, limit), 5), comment)
    for kept in fit.undetermined:
        if kept.contained:
            entries[kept.key] = Entry("0", f"not determined; needs {kept.determined_by}", True)
    turns = {one.key: one for one in fit.estimates if one.key.startswith("misalignment.")}
    if turns:
        comment = "rotation of one unit's second camera off its calibration, assumed for the next unit too"
        sizes = {key: float(np.hypot(one.value, one.uncertainty)) for key, one in turns.items()}
        for key, size in sizes.items():
            entries[key.replace("misalignment", "unknowns.calibration")] = Entry(number(size), comment)
        vergence = float(np.sqrt(np.mean(np.square(list(sizes.values())))))
        if vergence > fit.sensor.unknowns.calibration.vergence_mrad:
            comment = "causes no row error; assumed as large as the other two rotations, whose mounts are the same"
            entries["unknowns.calibration.vergence_mrad"] = Entry(number(vergence), comment)
    return entries


def _comment(key: FittedKey) -> str:
    interval = f"95 % interval {key.interval_in_words()}" if key.determined else key.interval_in_words()
    text = f"fitted: {key.value:.4g} {key.unit}, {interval}"
    return f"{text}; {key.method}; {', '.join(key.captures)}"


@dataclass(frozen=True)
class Entry:
    """A ``value`` in TOML with the ``comment`` above its table; ``optional``: not added to a file without the key."""

    value: str
    comment: str
    optional: bool = False


def _list(captures: Sequence[FittedCapture]) -> str:
    texts = ((json.dumps(capture.name, ensure_ascii=False), capture.images_sha256) for capture in captures)
    return "[\n" + "".join(f'    {{ name = {name}, images_sha256 = "{digest}" }},\n' for name, digest in texts) + "]"


def number(value: float) -> str:
    """Format a number for TOML with five digits."""
    return f"{value:.5g}"


def numbers(values: Sequence[float] | np.ndarray, digits: int = 9) -> str:
    """Format an array of numbers for TOML."""
    return "[" + ", ".join(f"{float(value):.{digits}g}" for value in values) + "]"


def with_entries(text: str, entries: Mapping[str, Entry]) -> str:
    """Set the values of keys such as ``imager.full_well_e``; top-level keys have no dot."""
    for key, entry in entries.items():
        table, _, name = key.rpartition(".")
        text = _with_entry(text, table, name, entry)
    return text


def with_cameras(text: str, cameras: Mapping[str, Camera], source: str) -> str:
    """Replace the tables of the cameras; comments on lines of their own are kept above them."""
    blocks = _blocks(text)
    former = [n for n, (table, _) in enumerate(blocks) if table.startswith("cameras.")]
    made = [line for n in former for line in blocks[n][1] if line.lstrip().startswith("#")]
    made.append(f"# cameras of this unit, from {source}")
    for name, camera in cameras.items():
        matrix, pose = camera.matrix, camera.sensor_from_camera
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
        if pose.translation.any() or not np.array_equal(pose.rotation, np.eye(3)):
            turn = Rotation.from_matrix(pose.rotation).as_euler("xyz", degrees=True)
            made += [f"position_mm = {numbers(pose.translation)}", f"rotation_deg = {numbers(turn)}"]
        made.append("")
    kept = [lines for n, (_, lines) in enumerate(blocks) if n not in former]
    kept.insert(former[0] if former else 1, made)
    return "\n".join(line for lines in kept for line in lines)


def with_exposure(text: str, seconds: float, comment: str) -> str:
    """Set a fixed exposure; limits and bracket stay, and the former rule as a comment."""
    out = []
    for table, lines in _blocks(text):
        if table == "exposure":
            at = next(index for index, line in enumerate(lines) if _TABLE.match(line))
            kept = [f"# before: {line.strip()}" if _EXPOSURE_RULE.match(line) else line for line in lines[at + 1 :]]
            fixed = ['rule = "fixed"', f"# {comment}", f"exposure_s = {number(seconds)}"]
            lines = [*lines[: at + 1], *kept]
            lines[_end(lines) : _end(lines)] = fixed
        out += lines
    return "\n".join(out)


def moved_paths(text: str, old: Path, new: Path) -> str:
    """Make the paths of calibration and covariance, relative to folder ``old``, relative to ``new``."""

    def moved(match: re.Match[str]) -> str:
        if match[0].startswith("#"):
            return match[0]
        path = (old / (match[1] or match[2])).absolute()
        return f'"{Path(os.path.relpath(path, new.absolute())).as_posix()}"'

    out = []
    for table, lines in _blocks(text):
        key = {"calibration": "file", "unknowns.calibration": "covariance"}.get(table)
        for index, line in enumerate(lines):
            if (match := _KEY.match(line)) and match[2] == key:
                for at in range(index, _end_of_value(lines, index) + 1):
                    lines[at] = _QUOTED.sub(moved, lines[at])
        out += lines
    return "\n".join(out)


def _blocks(text: str) -> list[tuple[str, list[str]]]:
    """Return the tables and their lines, with headers and the comments directly above; the first has no name."""
    blocks: list[tuple[str, list[str]]] = [("", [])]
    for line in text.split("\n"):
        header = _ARRAY_OF_TABLES.match(line) or _TABLE.match(line)
        if not header:
            blocks[-1][1].append(line)
            continue
        above: list[str] = []
        before = blocks[-1][1]
        while before and before[-1].startswith("#"):
            above.insert(0, before.pop())
        if not any(not row.lstrip().startswith("#") and row.strip() for row in before) and not blocks[-1][0]:
            before += above  # the title of the file
            above = []
        blocks.append((header[1], [*above, line]))
    return blocks


def _with_entry(text: str, table: str, key: str, entry: Entry) -> str:
    """Set the value of a key; its comment stands above the header of its table, so that no comment in it is split."""
    said = f"{key}: {entry.comment}" if table else entry.comment
    comment = [f"# {line}" for line in said.split("\n")] if entry.comment else []
    blocks = _blocks(text)
    for name, lines in blocks:
        if name != table:
            continue
        header = next((n for n, line in enumerate(lines) if _TABLE.match(line)), -1) if table else -1
        index = next((n for n, line in enumerate(lines) if (match := _KEY.match(line)) and match[2] == key), None)
        if index is None and not entry.optional:
            # without a table, above the first key, below the title of the file
            first = next((n for n, line in enumerate(lines) if _KEY.match(line)), len(lines))
            at = _end(lines) if table else first
            lines.insert(at, f"{key} = {entry.value}")
            at = header if table else at
            lines[at:at] = comment
        elif index is not None:
            lines[index : _end_of_value(lines, index) + 1] = _replaced(lines, index, f"{key} = {entry.value}")
            at = header if table else index
            lines[at:at] = comment
        return "\n".join(line for _, part in blocks for line in part)
    if entry.optional:
        return text
    return "\n".join([text.rstrip("\n"), "", *comment, f"[{table}]", f"{key} = {entry.value}", ""])


def _replaced(lines: list[str], index: int, new: str) -> list[str]:
    """Return the lines in place of the value that begins in a line: it stays as a comment."""
    end = _end_of_value(lines, index)
    if end > index:  # an array over several lines
        return [*(f"# before: {line.strip()}" for line in lines[index : end + 1]), new]
    match = _KEY.match(lines[index])
    before, remark = _value_and_remark(match[3] if match else "")
    return [f"{new}  # before: {before}" + f"; {remark}" * bool(remark)]


def _end(lines: list[str]) -> int:
    return max((n for n, line in enumerate(lines) if line.strip()), default=-1) + 1


def _value_and_remark(text: str) -> tuple[str, str]:
    """Return the value of a key and the comment after it; a # in quotes is part of the value."""
    match = _VALUE.match(text)
    assert match is not None
    return match[1].strip(), (match[2] or "").strip()


def _end_of_value(lines: list[str], index: int) -> int:
    """Return the last line of the value that begins in a line: an array may extend over several."""
    depth = 0
    for end in range(index, len(lines)):
        text = _value_and_remark(lines[end])[0]
        depth += text.count("[") - text.count("]")
        if depth <= 0:
            return end
    return index
