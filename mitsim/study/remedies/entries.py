"""Read the changes that would make measurements fit from ``run.json``, and describe them in words.

Signal chain: ``remedies`` of ``run.json`` -> a line for every change that makes measurements fit, one for every
measurement that no change tried makes fit, and one of what was not tried.
"""

from __future__ import annotations

import math
from typing import Any

from pydantic import Field, model_validator

from characterisation.statements.verdict_words import NAMED, named
from characterisation.words.numbers import listed, or_nan, two_digits
from mitsim.study.statement_file import PartialDocument

#: kind of what was not tried, if no change of any kind was
ANY = "any"


class MissedEntry(PartialDocument):
    """A measurement that does not fit; ``fits_by`` is the index of the first change with which it does."""

    unit: str
    standard_uncertainty: float | None
    needed: float | None
    demand: float | None = None
    fits_by: int | None = None


class ChangedMeasurement(PartialDocument):
    """A measurement under a change."""

    bias: float | None
    standard_uncertainty: float | None
    demand: float | None
    verdict: str


class TriedChangeEntry(PartialDocument):
    """A change that was measured virtually, with the ``keys`` of the study file that make it."""

    change: str
    words: str
    keys: dict[str, Any] = Field(default_factory=dict)
    views: list[int] = Field(default_factory=list)
    captures: int = 1
    trials: int
    measurements: dict[str, ChangedMeasurement]


class UntriedChange(PartialDocument):
    """A kind of ``change`` that was not tried for lack of time, in words, and the ``measurements`` that it was for."""

    change: str
    words: str
    measurements: list[str]


class RemediesEntry(PartialDocument):
    """``remedies`` of ``run.json``."""

    measurements: dict[str, MissedEntry]
    tried: list[TriedChangeEntry]
    untried: list[UntriedChange] = Field(default_factory=list)

    @model_validator(mode="after")
    def _of_tried(self) -> RemediesEntry:
        for name, measurement in self.measurements.items():
            index = measurement.fits_by
            if index is not None and not (0 <= index < len(self.tried) and name in self.tried[index].measurements):
                raise ValueError(f"fits_by {index} of {name} must be the index of a change tried that has {name}")
        return self


def remedies_in_words(remedies: RemediesEntry | None) -> list[str]:
    """Return lines such as ``sprayed matt white: pillar1_radius fits, u 0.58 to 0.03 mm (40 virtual measurements)``."""
    if remedies is None or not remedies.measurements:
        return []
    lines = list[str]()
    for index, tried in enumerate(remedies.tried):
        names = [name for name, measurement in remedies.measurements.items() if measurement.fits_by == index]
        if names:
            changed = [_changed(name, remedies.measurements[name], tried.measurements[name]) for name in names]
            verb = "fits" if len(names) == 1 else "fit"
            if len(names) > NAMED + 1:
                changed = [*changed[:NAMED], f"{len(names) - NAMED} more"]
            lines.append(f"{tried.words}: {listed(changed)} {verb} ({tried.trials} virtual measurements)")
    still = [name for name, measurement in remedies.measurements.items() if measurement.fits_by is None]
    waiting = {name for change in remedies.untried for name in change.measurements}
    unsolved: dict[str, list[str]] = {}
    for name in still:
        told, why = _unsolved(remedies, name)
        if why or name not in waiting:
            unsolved.setdefault(why or "by its budget, no single change that mitsim knows suffices", []).append(told)
    lines += [f"{named(entries)}: {why}" for why, entries in unsolved.items()]
    of_any = {name for change in remedies.untried if change.change == ANY for name in change.measurements}
    untried = list[str]()
    for change in remedies.untried:
        names = [name for name in change.measurements if name in still and (change.change == ANY or name not in of_any)]
        if names:
            untried.append(change.words if set(names) == set(still) else f"{change.words} for {named(names)}")
    return lines + [f"not tried for lack of time: {'; '.join(untried)}"] * bool(untried)


def _plain(value: float | None, unit: str) -> str:
    """Return a quantity with two significant digits, for a terminal too."""
    return "-" if value is None else f"{two_digits(value)} {unit}"


def _changed(name: str, before: MissedEntry, after: ChangedMeasurement) -> str:
    u = _plain(after.standard_uncertainty, before.unit)
    if before.standard_uncertainty is None:
        return f"{name} (u {u}, no value before)"
    return f"{name} (u {u}, before {_plain(before.standard_uncertainty, before.unit)})"


def _unsolved(remedies: RemediesEntry, name: str) -> tuple[str, str]:
    """Return a measurement with the nearest uncertainty that was reached, and why no change tried makes it fit.

    The reason is empty if none was tried.
    """
    measurement = remedies.measurements[name]
    rows = [(or_nan(tried.measurements[name].demand), tried) for tried in remedies.tried if name in tried.measurements]
    if not rows:
        return name, ""
    demand, best = min(rows, key=lambda row: math.inf if math.isnan(row[0]) else row[0])
    helps = math.isfinite(demand) and (measurement.demand is None or demand < measurement.demand)
    before, unit = measurement.standard_uncertainty, measurement.unit
    nearest = best.measurements[name].standard_uncertainty if helps else before
    was = f", before {_plain(before, unit)}" if helps and before is not None else ""
    needed = "" if measurement.needed is None else f", {_plain(measurement.needed, unit)} needed"
    told = name if nearest is None else f"{name} (u {_plain(nearest, unit)}{was}{needed})"
    if best.measurements[name].verdict == "not decided" and demand <= 1:
        return told, f"perhaps {best.words}, not decided by {best.trials} virtual measurements"
    if len(rows) == 1:
        return told, f"the one change tried, {best.words}, does not {'suffice' if helps else 'help'}"
    none = f"none of {len(rows)} changes tried"
    return told, f"{none} suffices; nearest is {best.words}" if helps else f"{none} helps"
