"""Write the result of a fit as a sensor file and as a table."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np

from characterisation.files.atomic_io import atomic_write
from mitsim.running.numbers import two_digits
from mitsim.sensor.preset import load_sensor
from mitsim.twin.sensor.estimate import Estimate
from mitsim.twin.sensor.run import SensorFit, sensor_path
from mitsim.twin.sensor.sensor_text import (
    Entry,
    moved_paths,
    number,
    numbers,
    with_cameras,
    with_entries,
    with_exposure,
)

_ARRAY = re.compile(r"^(.*)\[(\d+)\]$")


def write_sensor(fit: SensorFit, sensor: str | Path, output: Path) -> None:
    """Write the sensor file of a fit: the file of ``sensor`` with the fitted numbers."""
    path = sensor_path(sensor)
    text = moved_paths(path.read_text(encoding="utf-8"), path.parent, output.parent)
    first = fit.input_captures[0]
    entries = {
        "name": Entry(
            f'"{output.stem}"',
            f"fitted by `mitsim fit sensor` from {path.stem}: "
            + ", ".join(sorted({source.name for source in fit.input_captures})),
        )
    }
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
    for one in fit.estimates:
        low, high = one.interval()
        lines.append(
            f"| {one.key} | {one.value:.4g} | {low:.4g} to {high:.4g} | {one.unit} | "
            f"{', '.join(one.captures)} | {one.method} |"
        )
    if fit.undetermined:
        lines += ["", "| not determined, kept | value | a capture that would determine it |", "| --- | --- | --- |"]
        lines += [f"| {one.key} | {one.value:.4g} | {one.determined_by} |" for one in fit.undetermined]
    return "\n".join(lines) + "\n"


def _entries(fit: SensorFit) -> dict[str, Entry]:
    entries: dict[str, Entry] = {}
    arrays: dict[str, dict[int, Estimate]] = {}
    for one in fit.estimates:
        match = _ARRAY.match(one.key)
        if one.key == "imager.companding_dn":
            knees = ", ".join(numbers(knee, 6) for knee in fit.sensor.imager.companding)
            entries[one.key] = Entry(f"[{knees}]", _comment(one) + "; unknown beyond the brightest level seen")
        elif match:
            arrays.setdefault(match[1], {})[int(match[2])] = one
        else:
            entries[one.key] = Entry(number(one.value), _comment(one))
    for key, parts in arrays.items():
        count, limit = (3, 200.0) if key == "room.curvature" else (2, 20.0)
        values = [parts[index].value if index in parts else 0.0 for index in range(count)]
        spreads = [two_digits(parts[index].uncertainty) if index in parts else "-" for index in range(count)]
        some = next(iter(parts.values()))
        comment = f"fitted: standard uncertainties {', '.join(spreads)}; {some.method}; {', '.join(some.captures)}"
        entries[key] = Entry(numbers(np.clip(values, -limit, limit), 5), comment)
    for kept in fit.undetermined:
        if _ARRAY.match(kept.key):
            continue  # a term of the room without an estimate: none
        entries[kept.key] = Entry(number(kept.value), f"not determined; needs {kept.determined_by}")
    if "misalignment.row_mrad" in entries:
        row, roll = (next(e for e in fit.estimates if e.key == f"misalignment.{key}_mrad") for key in ("row", "roll"))
        comment = "rotation of one unit's second camera off its calibration, assumed for the next unit too"
        for key, one in (("row", row), ("roll", roll)):
            size = float(np.hypot(one.value, one.uncertainty))
            entries[f"unknowns.calibration.{key}_mrad"] = Entry(number(size), comment)
    return entries


def _comment(one: Estimate) -> str:
    low, high = one.interval()
    found = f"fitted: {one.value:.4g} {one.unit}, 95 % interval {low:.4g} to {high:.4g}"
    return f"{found}; {one.method}; {', '.join(one.captures)}"
