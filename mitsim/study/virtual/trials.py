"""Keep finished trials: one text file for each view, which gets a line for every finished trial.

A file starts with a digest of everything that determines a trial: sensor, part, task, unknowns, pose, and how captures
are made. It is used only with the same digest; a file with another digest is moved aside, never overwritten. If a line
is incomplete, because of a kill or a full disk, it is dropped and its trial is repeated.

Of a value that folds, such as a zone, a trial keeps the deviations from nominal that it measured. A statement adds them
to the deviation of a part at the limit of its tolerance, in a random direction
(:mod:`characterisation.statements.one_sided`). The direction follows from the measurement and the day. So the captures
of one day are about the same part.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field, ValidationError

from characterisation.files.arrays import Floats
from characterisation.files.atomic_io import json_values, write_text
from characterisation.files.documents import Document
from characterisation.files.errors import InputError
from characterisation.statements.one_sided import OneSidedErrors
from characterisation.tasks.folded import FoldedValue, folded_values
from characterisation.tasks.result import Result
from characterisation.tasks.task_file import Task
from characterisation.words.numbers import or_nan
from mitsim.study.virtual.world import Trial


@dataclass(frozen=True)
class Outcome:
    """Outcome of a virtual measurement: ``errors`` in mm or deg, NaN without a value, by measurement.

    ``reasons`` says why a measurement has no value. ``deviations`` are those (k m,) from nominal behind a value that
    folds, row by row (:mod:`characterisation.tasks.deviations`); NaN where a form has no points.
    """

    errors: Mapping[str, float]
    reasons: Mapping[str, str] = field(default_factory=dict)
    deviations: Mapping[str, Sequence[float]] = field(default_factory=dict)

    @classmethod
    def of(cls, measured: Mapping[str, Result]) -> Outcome:
        """Return the errors of a cloud's measurements, and the reasons of those without a value."""
        return cls(
            {name: float(result.error) for name, result in measured.items()},
            {name: result.reason for name, result in measured.items() if not result.possible},
            {
                name: result.deviations.ravel().tolist()
                for name, result in measured.items()
                if result.deviations is not None
            },
        )


class _KeptTrial(Document):
    """A line of a file; ``errors`` are in the order of the measurements, None without a value."""

    day: int = Field(ge=0, lt=2**62)
    capture: int = Field(ge=0, lt=2**62)
    errors: list[float | None]
    reasons: dict[str, str] = Field(default_factory=dict)
    deviations: dict[str, list[float | None]] = Field(default_factory=dict)


class TrialFolder:
    """Trials of one study in a folder, one file for each view; ``digest`` identifies the study.

    ``folded_values`` describes the measurements whose values fold; ``folded`` has the number of deviations of each. A
    kept trial that lacks them is measured again.
    """

    def __init__(
        self,
        folder: str | Path,
        digest: str,
        measurements: Sequence[str],
        folded_values: Mapping[str, FoldedValue] | None = None,
    ) -> None:
        self.folder, self.digest, self.measurements = Path(folder), digest, tuple(measurements)
        self.folded_values = dict(folded_values or {})
        self.folded = {name: math.prod(value.shape) for name, value in self.folded_values.items()}
        self._outcomes: dict[int, dict[Trial, Outcome]] = {}

    @classmethod
    def of(cls, folder: str | Path, digest: str, task: Task) -> TrialFolder:
        """Return the trials of a task in a folder."""
        return cls(folder, digest, list(task.measurements), folded_values(task))

    def known(self, view: int) -> dict[Trial, Outcome]:
        """Return the finished trials of a view; the file is read once."""
        if view not in self._outcomes:
            self._outcomes[view] = self._read(view)
        return self._outcomes[view]

    def add(self, view: int, trial: Trial, outcome: Outcome) -> None:
        """Keep a finished trial; it is on the disk when this function returns."""
        outcomes, path = self.known(view), self._path(view)
        values = {name: float(outcome.errors[name]) for name in self.measurements}
        deviations = {name: list(outcome.deviations[name]) for name in self.folded if name in outcome.deviations}
        line: dict[str, Any] = {
            "day": trial.day,
            "capture": trial.capture,
            "errors": json_values(list(values.values())),
        }
        if outcome.reasons:
            line["reasons"] = dict(outcome.reasons)
        if deviations:
            line["deviations"] = json_values(deviations)
        try:
            fresh = not path.exists()
            if fresh:
                self.folder.mkdir(parents=True, exist_ok=True)
            with path.open("a", encoding="utf-8") as stream:
                if fresh:
                    stream.write(json.dumps(self._head()) + "\n")
                stream.write(json.dumps(line) + "\n")
                stream.flush()
                os.fsync(stream.fileno())
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(path)) from None
        outcomes[trial] = Outcome(values, dict(outcome.reasons), deviations)

    def errors(self, view: int, trials: Sequence[Trial]) -> Floats:
        """Return the errors (measurements, trials) of finished trials of a view."""
        outcomes = self.known(view)
        return np.array([[outcomes[trial].errors[name] for trial in trials] for name in self.measurements], float)

    def deviations(self, view: int, trials: Sequence[Trial], measurement: str) -> Floats:
        """Return the deviations (trials, k m) behind a value that folds; NaN in trials without a value."""
        outcomes, none = self.known(view), [math.nan] * self.folded[measurement]
        return np.array([outcomes[trial].deviations.get(measurement, none) for trial in trials], float)

    def errors_of_parts(self, view: int, trials: Sequence[Trial]) -> list[Floats | OneSidedErrors]:
        """Return the errors (n,) of finished trials of a view, for every measurement of the task in its order."""
        plain = self.errors(view, trials)
        return [
            self._one_sided(self.folded_values[name], view, trials) if name in self.folded_values else plain[m]
            for m, name in enumerate(self.measurements)
        ]

    def _one_sided(self, folded: FoldedValue, view: int, trials: Sequence[Trial]) -> OneSidedErrors:
        vectors = self.deviations(view, trials, folded.name).reshape(len(trials), *folded.shape)
        directions = np.array([folded.direction(trial.day) for trial in trials]).reshape(vectors.shape)
        return OneSidedErrors(vectors, directions, folded.size, folded.limit, folded.fold)

    def reasons(self, view: int, trials: Sequence[Trial], measurement: str) -> list[str]:
        """Return the known reasons why a measurement has no value in finished trials of a view."""
        outcomes = self.known(view)
        reasons = [outcomes[trial].reasons for trial in trials if trial in outcomes]
        return [reason[measurement] for reason in reasons if measurement in reason]

    def _head(self) -> dict[str, Any]:
        return {"schema_version": 1, "digest": self.digest, "measurements": list(self.measurements)}

    def _path(self, view: int) -> Path:
        return self.folder / f"view_{view:04d}.jsonl"

    def _read(self, view: int) -> dict[Trial, Outcome]:
        path = self._path(view)
        try:
            text = path.read_bytes().decode("utf-8", errors="replace")
        except FileNotFoundError:
            return {}
        except OSError as error:
            raise InputError(path, "", f"a file that cannot be read ({error.strerror})", "trials of a study") from None
        whole = text[: text.rfind("\n") + 1]
        lines = whole.splitlines()
        if not lines or _parsed(lines[0]) != self._head():
            path.replace(path.with_suffix(f".{path.stat().st_mtime_ns}.other"))
            return {}
        outcomes = {}
        kept = [lines[0]]
        for line in lines[1:]:
            entry = self._entry(line)
            if entry is None:
                break  # lines after an invalid line are not trusted either
            outcomes[entry[0]] = entry[1]
            kept.append(line)
        if "\n".join([*kept, ""]) != text:
            write_text(path, "\n".join([*kept, ""]))
        return outcomes

    def _entry(self, line: str) -> tuple[Trial, Outcome] | None:
        try:
            kept = _KeptTrial.model_validate(_parsed(line))
        except ValidationError:
            return None
        if len(kept.errors) != len(self.measurements):
            return None
        errors = dict(zip(self.measurements, _numbers(kept.errors), strict=True))
        deviations = {name: _numbers(values) for name, values in kept.deviations.items()}
        outcome = Outcome(errors, kept.reasons, deviations)
        return (Trial(kept.day, kept.capture), outcome) if self.is_whole(outcome) else None

    def is_whole(self, outcome: Outcome) -> bool:
        """Return whether every value that folds has its deviations, and no infinite number is among them."""
        return all(
            len(outcome.deviations.get(name, ())) == count
            and not any(math.isinf(value) for value in outcome.deviations[name])
            for name, count in self.folded.items()
            if math.isfinite(outcome.errors[name])
        )


def _numbers(values: Iterable[float | None]) -> list[float]:
    return [or_nan(value) for value in values]


def _parsed(line: str) -> Any:
    try:
        return json.loads(line)
    except (ValueError, RecursionError):
        return None
