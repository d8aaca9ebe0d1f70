"""Tabulate the results of a run: the expectation of every measurement from the chosen view; as CSV and JSON.

Signal chain: ``run.json``, ``statement.json``, ``task.json`` -> an :class:`ExpectedResult` for every measurement ->
CSV, JSON or QIF (:mod:`mitsim.report.export.qif`).
"""

from __future__ import annotations

import csv
import io
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from characterisation.files.atomic_io import write_json, write_text
from characterisation.files.errors import InputError
from characterisation.statements.statement import ANY_PART, AT_THE_LIMIT
from characterisation.tasks.deviations import fold_of
from characterisation.tasks.task_file import Measurement, Task
from characterisation.tasks.task_reading import read_task
from characterisation.words.version import __version__
from mitsim.report.export.run_scene import view_pose
from mitsim.sensor.transforms import Transform
from mitsim.study.run_files import TASK
from mitsim.study.run_folder import read_run
from mitsim.study.statement_file import StatedMeasurement

#: what to do about a run without a statement
_GO_ON = "run the same mitsim run again: it continues; with more --minutes it comes to the statement"


@dataclass(frozen=True)
class ExpectedResult:
    """Expected result of one measurement, in its ``unit`` (mm or deg); missing numbers are None.

    Errors are those of the part that ``errors_of`` names: ``any part``, or of a value that cannot fall below 0 a part
    at the limit of its tolerance, or far from nominal. ``error_low`` to ``error_high`` contain 95 % of them.
    ``expected`` is the mean reading of this part, its value + ``bias``; ``low`` to ``high`` contain 95 % of its
    readings. The value of any part is the nominal one; a part far from nominal has none, and no reading.
    ``uncertainty`` is the standard deviation about the mean (k = 1). ``verdict`` compares them with the tolerance: it
    states whether the sensor is good enough, and nothing about a real part. The decision rule accepts readings from
    ``accepted_low``, None without a lower limit, to ``accepted_high``, None where it accepts none.
    """

    measurement: str
    kind: str
    features: tuple[str, ...]
    unit: str
    nominal: float
    tolerance: float | tuple[float, float] | None
    view: int
    expected: float | None
    bias: float | None
    bias_uncertainty: float | None
    uncertainty: float | None
    low: float | None
    high: float | None
    trials: int
    without_value: float
    verdict: str
    error_low: float | None
    error_high: float | None
    errors_of: str
    accepted_low: float | None = None
    accepted_high: float | None = None


@dataclass(frozen=True)
class RunResults:
    """Results of a run, its task, and the views of its plan: number, pose and measurements of each."""

    results: tuple[ExpectedResult, ...]
    task: Task
    sensor: str
    study: str
    source: str
    plan: tuple[tuple[int, Transform, tuple[str, ...]], ...]


def read_results(folder: str | Path, task_file: str | Path | None = None) -> RunResults:
    """Read the results of a finished run.

    The plan is the run's set of views, if it has one, in which every view measures everything; else the stated view.

    ``task_file`` is the task TOML; None uses the copy in the run's folder. Raises InputError if the folder is not a
    run, has no statement, or the task is missing or a different one.
    """
    run = read_run(folder)
    if run.statement is None:
        raise InputError(Path(folder) / "statement.json", "", "no such file", "a run with a statement", _GO_ON)
    task = run.task() if task_file is None else read_task(task_file)
    if list(task.measurements) != list(run.about.measurements):
        where, found = task_file or run.folder / TASK, ", ".join(task.measurements)
        allowed = f"{', '.join(run.about.measurements)}: the task of the run"
        raise InputError(where, "measurements", found, allowed, "give the run's own: --task FILE")
    if task_file is not None and run.has(TASK):
        _check_same(task_file, task, run.task())
    view = run.statement.view
    stated = run.statement.measurements
    results = tuple(expected_result(name, asked, stated[name], view) for name, asked in task.measurements.items())
    numbers = run.about.view_sets[0].views if run.about.view_sets else [view]
    plan = tuple((number, view_pose(run, number), tuple(task.measurements)) for number in numbers)
    return RunResults(results, task, run.about.sensor, run.about.study, run.statement.measured_by, plan)


def _check_same(task_file: str | Path, given: Task, own: Task) -> None:
    """Check that a task is the run's own: its nominal values and tolerances are those of the errors and verdicts."""
    for kind in ("features", "measurements"):
        entries, kept = getattr(given, kind), getattr(own, kind)
        for name in [*kept, *entries]:
            if entries.get(name) != kept.get(name):
                hint = "leave --task out, or run the study again with this task"
                raise InputError(task_file, f"{kind}.{name}", "another definition", "that of the run's task", hint)


def write_results_csv(run_results: RunResults, path: str | Path) -> None:
    """Write one row for every measurement; missing numbers are empty fields."""
    out = io.StringIO()
    rows = [asdict(result) for result in run_results.results]
    for row in rows:  # several features, and lower and upper deviation, have a space between
        row |= {name: " ".join(map(str, value)) for name, value in row.items() if isinstance(value, tuple)}
    writer = csv.DictWriter(out, list(ExpectedResult.__dataclass_fields__), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_text(path, out.getvalue())


def write_results_json(run_results: RunResults, path: str | Path) -> None:
    """Write the results and the plan as JSON."""
    document: dict[str, Any] = {
        "schema_version": 1,
        "software": f"mitsim {__version__}",
        "sensor": run_results.sensor,
        "study": run_results.study,
        "measured_by": run_results.source,
        "coverage_probability": 0.95,
        "results": [asdict(result) for result in run_results.results],
        "plan": [
            {"view": number, "part_from_sensor": pose.matrix().tolist(), "measurements": list(names)}
            for number, pose, names in run_results.plan
        ],
    }
    write_json(path, document)


def expected_result(name: str, asked: Measurement, stated: StatedMeasurement, view: int) -> ExpectedResult:
    """Return the expected result of a measurement of the task from its statement at a view."""
    value = _part_value(asked, stated.errors_of)
    expected, low, high = (
        None if end is None or value is None else value + end for end in (stated.bias, *stated.interval)
    )
    accepted = None if stated.decision is None else stated.decision.accepted
    task = asked.kind, asked.features, asked.unit, asked.nominal, asked.tolerance
    uncertainty = stated.bias, stated.bias_uncertainty, stated.standard_uncertainty
    counts = stated.trials, stated.without_value, stated.verdict
    errors, readings = (*stated.interval, stated.errors_of), accepted or (None, None)
    return ExpectedResult(name, *task, view, expected, *uncertainty, low, high, *counts, *errors, *readings)


def _part_value(asked: Measurement, errors_of: str) -> float | None:
    """Return the value of the part whose errors are stated; None for a part far from nominal."""
    if errors_of == AT_THE_LIMIT:
        return asked.limits[0 if fold_of(asked) else 1]
    return asked.nominal if errors_of == ANY_PART else None
