"""Read the changes that would make measurements fit from ``run.json``, and describe them in words.

Signal chain: ``remedies`` of ``run.json`` -> a line for every change that makes measurements fit, one for every
measurement that no change tried makes fit, and one of what was not tried.
"""

from __future__ import annotations

import math
from typing import Any

from pydantic import Field

from characterisation.statements.verdict_words import named
from mitsim.running.numbers import listed, or_nan, two_digits
from mitsim.study.statement_file import PartialDocument

#: what was not tried: any change for a measurement, whose name follows
CHANGES_FOR = "changes for "

#: why no change makes a measurement fit, if time did not suffice for any
_NOT_TRIED = "not tried"


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


class RemediesEntry(PartialDocument):
    """``remedies`` of ``run.json``."""

    measurements: dict[str, MissedEntry]
    tried: list[TriedChangeEntry]
    untried: list[str] = Field(default_factory=list)


def remedies_in_words(found: RemediesEntry | None) -> list[str]:
    """Return lines such as ``sprayed matt white: pillar1_radius fits, u 0.58 to 0.03 mm (40 virtual measurements)``."""
    if found is None or not found.measurements:
        return []
    lines = list[str]()
    for index, tried in enumerate(found.tried):
        names = [name for name, measurement in found.measurements.items() if measurement.fits_by == index]
        if names:
            changed = [_changed(name, found.measurements[name], tried.measurements[name]) for name in names]
            verb = "fits" if len(names) == 1 else "fit"
            lines.append(f"{tried.words}: {listed(changed)} {verb} ({tried.trials} virtual measurements)")
    unsolved: dict[str, list[str]] = {}
    for name, measurement in found.measurements.items():
        if measurement.fits_by is None:
            told, why = _unsolved(found, name)
            unsolved.setdefault(why, []).append(told)
    open_ones = [one.removeprefix(CHANGES_FOR) for one in found.untried if one.startswith(CHANGES_FOR)]
    for why, entries in unsolved.items():
        if why == _NOT_TRIED and not found.tried:
            continue  # the last line says so
        names = [entry for entry in entries if why != _NOT_TRIED or entry not in open_ones]
        lines += [f"{named(names)}: {why}"] if names else []
    if found.untried and any(measurement.fits_by is None for measurement in found.measurements.values()):
        others = [one for one in found.untried if not one.startswith(CHANGES_FOR)]
        untried = ([f"{CHANGES_FOR}{named(open_ones)}"] if open_ones else []) + others
        lines.append(f"not tried for lack of time: {'; '.join(untried)}")
    return lines


def _plain(value: float | None, unit: str) -> str:
    """Return a quantity with two significant digits, for a terminal too."""
    return "-" if value is None else f"{two_digits(value)} {unit}"


def _changed(name: str, before: MissedEntry, after: ChangedMeasurement) -> str:
    u = _plain(after.standard_uncertainty, before.unit)
    if before.standard_uncertainty is None:
        return f"{name} (u {u}, no value before)"
    return f"{name} (u {u}, before {_plain(before.standard_uncertainty, before.unit)})"


def _unsolved(found: RemediesEntry, name: str) -> tuple[str, str]:
    """Return a measurement with the nearest uncertainty that was reached, and why no change makes it fit."""
    one = found.measurements[name]
    rows = [(or_nan(tried.measurements[name].demand), tried) for tried in found.tried if name in tried.measurements]
    rows = [row for row in rows if math.isfinite(row[0])]
    if not rows:
        return name, _NOT_TRIED if found.untried else "by its budget, no single change that mitsim knows suffices"
    demand, best = min(rows, key=lambda row: row[0])
    helps = one.demand is None or demand < one.demand
    nearest = best.measurements[name].standard_uncertainty if helps else one.standard_uncertainty
    needed = "" if one.needed is None else f", {_plain(one.needed, one.unit)} needed"
    told = f"{name} (u {_plain(nearest, one.unit)}{needed})"
    if best.measurements[name].verdict == "not decided" and demand <= 1:
        return told, f"perhaps {best.words}, not decided by {best.trials} virtual measurements"
    if len(rows) == 1:
        return told, f"the one change tried, {best.words}, does not {'suffice' if helps else 'help'}"
    none = f"none of {len(rows)} changes tried"
    return told, f"{none} suffices; nearest is {best.words}" if helps else f"{none} helps"
