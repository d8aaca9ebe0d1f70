"""Find the cheapest change with which each missed measurement fits, by virtual measurements of every change tried.

Signal chain: changes in the order of their effort (:mod:`mitsim.study.remedies.changes`) -> virtual measurements of the
first change that can help a measurement that no earlier one helps, few at first and more while it may still fit -> next
change, until every measurement fits or time is over -> :class:`Remedies`.

A change is confirmed if the decision rule gives the verdict *fits* from its virtual measurements alone. Their draws are
those of the statement, so that only the change makes the difference.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

from characterisation.files.atomic_io import json_values
from characterisation.files.errors import InputError
from characterisation.statements.statement import Statement
from characterisation.words.progress import say
from mitsim.running.time_limit import TimeLimit
from mitsim.study.remedies.change import Change, Shortfall
from mitsim.study.remedies.changes import changes
from mitsim.study.remedies.entries import ANY, UntriedChange
from mitsim.study.remedies.sensors import other_sensors

#: first trials of a change, and those of the next steps while a verdict is open, over the trials of the study's table
_STEPS = (0.25, 1.0, 4.0)

#: share of the time that is left which one change may take, so that later ones have a chance, unless the fewest trials
#: need more; chosen
_CHANGE_SHARE = 0.5

#: share of the time that is left for screening other sensors
_SCREENING_SHARE = 0.4

#: fewest trials whose verdict counts
_FEWEST = 8


@dataclass(frozen=True)
class TriedChange:
    """A change with the statements of all measurements by name, and the ``seconds`` that it took."""

    change: Change
    stated: dict[str, Statement]
    seconds: float

    @property
    def trials(self) -> int:
        """Return the number of virtual measurements."""
        return max((statement.trials for statement in self.stated.values()), default=0)

    @property
    def fits(self) -> list[str]:
        """Return the measurements that fit."""
        return [name for name, statement in self.stated.items() if statement.verdict == "fits"]


@dataclass
class Remedies:
    """Statements ``missed`` by name, changes tried, ``failed`` with the reason, and ``untried`` for lack of time."""

    missed: dict[str, Statement]
    tried: list[TriedChange] = field(default_factory=list)
    failed: list[tuple[Change, str]] = field(default_factory=list)
    untried: list[UntriedChange] = field(default_factory=list)

    @property
    def open(self) -> list[str]:
        """Return the measurements that no change makes fit so far."""
        solved = {name for change in self.tried for name in change.fits}
        return [name for name in self.missed if name not in solved]


def find_remedies(
    missed: dict[str, Statement],
    proposed: Iterable[Change],
    trials: int,
    limit: TimeLimit | None = None,
    before: Remedies | None = None,
    trial_s: float = 0.0,
) -> Remedies:
    """Try changes until every missed measurement fits with one, no change is left, or time is over.

    - ``missed``: statements of the measurements that do not fit, by name.
    - ``proposed``: changes, the least effort first; each is asked for only when those before it do not suffice.
    - ``trials``, ``trial_s``: virtual measurements of a change; a quarter of them can exclude it, and four times as
      many may decide it. Expected time of one [s]: a change that time does not suffice for the fewest of is not tried.
    - ``limit``, ``before``: time, none by default; what was tried before: it is not tried again, and is part of the
      result.
    """
    earlier = Remedies(missed) if before is None else before
    remedies, limit = Remedies(missed, list(earlier.tried), list(earlier.failed)), limit or TimeLimit()
    done = {
        change.words
        for change in (
            *(tried_change.change for tried_change in earlier.tried),
            *(impossible for impossible, _ in earlier.failed),
        )
    }
    kinds = set[str]()
    for change in proposed:
        kinds.add(change.kind)
        wanted = [name for name in change.expected if name in remedies.open]
        if not wanted or change.words in done:
            continue
        untried = UntriedChange(change=change.kind, words=change.words, measurements=wanted)
        needed_s = _FEWEST * trial_s if change.needs_trials else 0.0
        change_limit = limit.part(_CHANGE_SHARE if _CHANGE_SHARE * limit.left > needed_s else 1.0)
        if change_limit.left <= needed_s:
            remedies.untried.append(untried)
            continue
        began = time.monotonic()
        try:
            stated = _stated(change, wanted, trials, change_limit)
        except InputError as error:
            remedies.failed.append((change, str(error)))
            continue
        finally:
            change.release()
            gc.collect()
        seconds = time.monotonic() - began
        tried = TriedChange(change, stated, seconds)
        if tried.trials < _FEWEST:
            remedies.untried.append(untried)
            continue
        remedies.tried.append(tried)
        fits = ", ".join(name for name in wanted if name in tried.fits) or "no measurement"
        say(f"remedies: {change.words}: {fits} of {len(wanted)} fits, by {tried.trials} trials in {seconds:.0f} s")
        if not remedies.open:
            break
    return _without_sensors(remedies) if limit.over() and "sensor" not in kinds else remedies


def of_missed(remedies: Remedies | None, missed: dict[str, Statement], proposed_all: bool = True) -> Remedies | None:
    """Return remedies for the measurements that a longer statement misses; None if it misses none.

    Changes were chosen for the measurements that were missed before; they may help others too. Unless all kinds were
    proposed, other sensors are among what was not tried.
    """
    if not missed:
        return None
    now = Remedies(missed) if remedies is None else replace(remedies, missed=missed)
    missed_before = () if remedies is None else remedies.missed
    if new := [name for name in now.open if name not in missed_before]:
        any_change = UntriedChange(change=ANY, words="any change", measurements=new)
        now = replace(now, untried=[*now.untried, any_change])
    return now if proposed_all else _without_sensors(now)


def _without_sensors(remedies: Remedies) -> Remedies:
    """Return remedies that name other sensors among what was not tried, if a measurement is open."""
    if not remedies.open:
        return remedies
    sensors = UntriedChange(change="sensor", words="with another sensor", measurements=remedies.open)
    return replace(remedies, untried=[*(entry for entry in remedies.untried if entry.change != "sensor"), sensors])


def all_changes(now: Shortfall, limit: TimeLimit, short: bool = False) -> Iterator[Change]:
    """Yield the changes of a study that may help, as :func:`changes`; other sensors come last."""
    yield from changes(now, short)
    yield from other_sensors(now, limit.part(_SCREENING_SHARE))


def _stated(change: Change, wanted: list[str], trials: int, limit: TimeLimit) -> dict[str, Statement]:
    """Return the statements under a change, from more trials while a wanted verdict is open and may become good."""
    stated: dict[str, Statement] = {}
    for share in _STEPS:
        stated = {
            statement.measurement: statement for statement in change.state(max(_FEWEST, round(share * trials)), limit)
        }
        asked = [stated[name] for name in wanted]
        if limit.over() or not any(_deserves_more(statement, share < 1) for statement in asked):
            break
    return stated


def _deserves_more(statement: Statement, first: bool) -> bool:
    """Return whether a verdict deserves more trials: one that may become *fits*, or does so by the first few alone.

    After the first few, one standard deviation of the logarithm of the demand may be missing, later nothing.
    """
    if statement.decided is None or statement.verdict != "not decided":
        return statement.verdict == "fits" and first
    demand, high = statement.decided.demand, statement.decided.demand_interval[1]
    return demand <= 1 or (first and demand**2 <= high / demand)


def remedies_document(remedies: Remedies) -> dict[str, Any]:
    """Return the changes that were tried as JSON values; see docs/reference/formats/run-folder.md."""
    return {
        "measurements": {
            name: {
                "unit": statement.unit,
                "standard_uncertainty": json_values(statement.standard_uncertainty),
                "needed": None if statement.decided is None else json_values(statement.decided.needed),
                "demand": None if statement.decided is None else json_values(statement.decided.demand),
                "fits_by": next((i for i, tried in enumerate(remedies.tried) if name in tried.fits), None),
            }
            for name, statement in remedies.missed.items()
        },
        "tried": [_entry(change, remedies.missed) for change in remedies.tried],
        "impossible": [{"words": change.words, "reason": why} for change, why in remedies.failed],
        "untried": [entry.model_dump() for entry in remedies.untried],
    }


def _entry(tried: TriedChange, missed: Iterable[str]) -> dict[str, Any]:
    change = tried.change
    return {
        "change": change.kind,
        "words": change.words,
        "keys": dict(change.keys),
        "views": list(change.views),
        "captures": change.captures,
        "trials": tried.trials,
        "seconds": round(tried.seconds, 1),
        "measurements": {name: _measured(tried.stated[name], change) for name in missed if name in tried.stated},
    }


def _measured(statement: Statement, change: Change) -> dict[str, Any]:
    decided = statement.decided
    return {
        "expected": json_values(change.expected.get(statement.measurement)),
        "bias": json_values(statement.bias),
        "standard_uncertainty": json_values(statement.standard_uncertainty),
        "without_value": statement.without_value,
        "demand": None if decided is None else json_values(decided.demand),
        "demand_interval": None if decided is None else json_values(list(decided.demand_interval)),
        "verdict": statement.verdict,
    }
