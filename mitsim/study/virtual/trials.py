"""Keep finished trials: one text file for each view, which gets a line for every finished trial.

A file starts with a digest of everything that determines a trial: sensor, part, task, unknowns, pose, and how captures
are made. It is used only with the same digest; a file with another digest is moved aside, never overwritten. If a line
is incomplete, because of a kill or a full disk, it is dropped and its trial is repeated.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from characterisation.files.errors import InputError
from characterisation.tasks.result import Result
from mitsim.study.virtual.world import GROUPS, Trial


@dataclass(frozen=True)
class Outcome:
    """Outcome of a virtual measurement: ``errors`` in mm or deg, NaN without a value, by measurement.

    ``reasons`` says why a measurement has no value.
    """

    errors: Mapping[str, float]
    reasons: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, measured: Mapping[str, Result]) -> Outcome:
        """Return the errors of a cloud's measurements, and the reasons of those without a value."""
        return cls(
            {name: float(one.error) for name, one in measured.items()},
            {name: one.reason for name, one in measured.items() if not one.possible},
        )


#: upper bound of days and captures, so that they fit into 64 bits
_MOST_DAYS = 2**62


class TrialFolder:
    """Trials of one study in a folder, one file for each view; ``digest`` identifies the study."""

    def __init__(self, folder: str | Path, digest: str, measurements: Sequence[str]) -> None:
        self.folder, self.digest, self.measurements = Path(folder), digest, tuple(measurements)
        self._known: dict[int, dict[Trial, Outcome]] = {}

    def known(self, view: int) -> dict[Trial, Outcome]:
        """Return the finished trials of a view; the file is read once."""
        if view not in self._known:
            self._known[view] = self._read(view)
        return self._known[view]

    def take_up(self, view: int, trials: Mapping[Trial, Mapping[str, float]]) -> None:
        """Add trials whose errors are kept elsewhere; they are not written again."""
        known = self.known(view)
        for trial, errors in trials.items():
            known.setdefault(trial, Outcome(dict(errors)))

    def add(self, view: int, trial: Trial, outcome: Outcome) -> None:
        """Keep a finished trial; it is on the disk when this function returns."""
        known, path = self.known(view), self._path(view)
        values = {name: float(outcome.errors[name]) for name in self.measurements}
        line = {
            "day": trial.day,
            "capture": trial.capture,
            "swapped": trial.swapped,
            "errors": [value if math.isfinite(value) else None for value in values.values()],
        }
        if outcome.reasons:
            line["reasons"] = dict(outcome.reasons)
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
        known[trial] = Outcome(values, dict(outcome.reasons))

    def errors(self, view: int, trials: Sequence[Trial]) -> NDArray[np.float64]:
        """Return the errors (measurements, trials) of finished trials of a view."""
        known = self.known(view)
        return np.array([[known[trial].errors[name] for trial in trials] for name in self.measurements], float)

    def reasons(self, view: int, trials: Sequence[Trial], measurement: str) -> list[str]:
        """Return the known reasons why a measurement has no value in finished trials of a view."""
        known = self.known(view)
        reasons = [known[trial].reasons for trial in trials if trial in known]
        return [one[measurement] for one in reasons if measurement in one]

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
        found = {}
        kept = [lines[0]]
        for line in lines[1:]:
            entry = self._entry(line)
            if entry is None:
                break  # lines after an invalid line are not trusted either
            found[entry[0]] = entry[1]
            kept.append(line)
        if "\n".join([*kept, ""]) != text:
            partial = path.with_suffix(f".{os.getpid()}.partial")
            partial.write_text("\n".join([*kept, ""]), encoding="utf-8")
            partial.replace(path)
        return found

    def _entry(self, line: str) -> tuple[Trial, Outcome] | None:
        table = _parsed(line)
        try:
            trial = Trial(int(table["day"]), int(table["capture"]), str(table["swapped"]))
            values = [math.nan if value is None else float(value) for value in table["errors"]]
            reasons = {str(name): str(reason) for name, reason in table.get("reasons", {}).items()}
        except (
            AttributeError,
            TypeError,
            KeyError,
            ValueError,
            OverflowError,
        ):  # OverflowError: an integer of 400 digits
            return None
        known = all(
            math.isfinite(value) for value, listed in zip(values, table["errors"], strict=True) if listed is not None
        )
        if not known or len(values) != len(self.measurements) or trial.swapped not in ("", *GROUPS):
            return None
        if not (0 <= trial.day < _MOST_DAYS and 0 <= trial.capture < _MOST_DAYS):
            return None
        return trial, Outcome(dict(zip(self.measurements, values, strict=True)), reasons)


def _parsed(line: str) -> Any:
    try:
        return json.loads(line)
    except (ValueError, RecursionError):
        return None
