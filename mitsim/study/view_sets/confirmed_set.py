"""Find a set of views that keeps its limits in virtual measurements: search with the map, measure, and search again.

Signal chain: limits -> the fewest views that keep them according to the map (:mod:`characterisation.scores.task_sets`)
-> virtual measurements of the whole set (:mod:`mitsim.study.view_sets.joined`) -> a stricter search limit for each
measurement that missed its limit, by the ratio of expected to measured uncertainty -> next set. If no set is predicted
to keep a stricter limit, the search comes back half of the way to the limit before; if it finds a set that is already
measured, it goes on to stricter limits. The loop ends if all limits are kept, if :data:`MOST_SEARCHES` searches find no
further set, or after :data:`MOST_SETS` sets.

The map contains neither the random finish nor the effects of curved faces and edges, so its u can be too small. The
loop measures by how much.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Protocol

from characterisation.files.atomic_io import json_values, write_text
from characterisation.scores.view_sets import ViewSet
from characterisation.statements.losses import losses
from characterisation.statements.statement import Statement, statement
from characterisation.statements.tolerance import tolerance_of
from characterisation.words.numbers import aligned, beside, percent, two_digits
from characterisation.words.progress import say, track
from mitsim.study import SetTable
from mitsim.study.exposures.planned import with_exposure
from mitsim.study.session import Session
from mitsim.study.view_sets.joined import JoinedMeasurements
from mitsim.study.virtual.stated import digits, plain
from mitsim.study.virtual.trials import TrialFolder
from mitsim.study.virtual.world import SET_DAYS, Trial

#: largest number of sets to measure
MOST_SETS = 5

#: searches for one more set, with limits between the last and the stricter ones
MOST_SEARCHES = 8

#: a missed limit becomes stricter for the search by at least this factor
_TIGHTENING = 0.9

#: factor for a measurement without any value, whose uncertainty is unknown
_WITHOUT_VALUE = 0.5

#: part of the digest of a set's trials; raise it when the same clouds are joined differently
_JOINING_VERSION = 2


class Search(Protocol):
    """Finds the fewest views that keep limits, by measurement, according to the map."""

    def __call__(self, limits: dict[str, float], *, table: SetTable | None = None) -> ViewSet:
        """Return the views; ``table`` replaces the study's own for the joining and the time of the search."""


@dataclass(frozen=True)
class TriedSet:
    """A set of views, the limits of its search, and its statements from virtual measurements of the whole set."""

    chosen: ViewSet
    searched: dict[str, float]
    stated: tuple[Statement, ...]

    @property
    def trials(self) -> int:
        """Return the number of virtual measurements of the set, the same for every measurement."""
        return self.stated[0].trials

    def excess(self, limits: dict[str, float]) -> float:
        """Return the largest ratio of root mean square error to limit, over reachable limits.

        It is at most 1 if all reachable limits are kept.
        """
        statements = {entry.measurement: entry for entry in self.stated}
        reachable = [name for name, able in zip(limits, self.chosen.feasible, strict=True) if able]
        return max((_excess(statements[name], limits[name]) for name in reachable), default=0.0)


def confirmed_set(
    session: Session, first: ViewSet, search: Search, over: Callable[[], bool] = lambda: False
) -> list[TriedSet]:
    """Measure the first set, and sets for stricter limits until one keeps the limits, or time is over.

    Returns all sets with at least two virtual measurements, the best last: the set that keeps all reachable limits, or
    the one of least excess. Trials in the folder are reused. Says of each set which limits it misses, and why no
    further set is tried.

    ``session``, ``first``: the study, with a table ``set``, and the set that is measured first. ``search``, ``over``:
    finds a set for other limits; returns whether time is over.
    """
    table = session.study.file.set
    assert table is not None
    chosen, searched, tried = first, dict(table.limits), list[TriedSet]()
    while True:
        measured = TriedSet(chosen, dict(searched), tuple(state_set(session, chosen, over)))
        if over() and measured.trials < 2:
            break
        tried.append(measured)
        if tried[-1].excess(table.limits) <= 1 or over():
            break
        say(f"set {len(tried)}, views {', '.join(map(str, chosen.views))}: {_missed(tried[-1], table.limits)}")
        if len(tried) == MOST_SETS:
            say(f"no further set is tried: {MOST_SETS} sets were measured, the most that a run measures")
            break
        next_set = _next_set(search, stricter(tried[-1], table.limits), first, tried)
        if next_set is None:
            say(
                f"no further set is tried: by the map, no set of other views is more accurate "
                f"({MOST_SEARCHES} searches with stricter limits)"
            )
            break
        chosen, searched = next_set
        say(f"the next set: views {', '.join(map(str, chosen.views))}")
    return sorted(tried, key=lambda tried_set: -tried_set.excess(table.limits))


def _next_set(
    search: Search, strict: dict[str, float], first: ViewSet, tried: Sequence[TriedSet]
) -> tuple[ViewSet, dict[str, float]] | None:
    """Return a set that is not measured yet, with the limits of its search: the strictest that the map can keep.

    ``strict`` are the limits by what the last search missed. A limit that no set can keep is taken back half of the
    way, in ratio, to the limit before. If the set is an old one, limits that were missed become stricter by the least
    step. None if :data:`MOST_SEARCHES` searches find no new set.
    """
    limits, before = dict(strict), tried[-1].searched
    missed = [name for name in strict if strict[name] < before[name]]
    for _ in range(MOST_SEARCHES):
        chosen = search(limits)
        lost = [name for name, once, now in zip(limits, first.feasible, chosen.feasible, strict=True) if once > now]
        for name in lost:
            limits[name] = math.sqrt(limits[name] * before[name])
        if lost or not chosen.views:
            continue
        if all(set(tried_set.chosen.views) != set(chosen.views) for tried_set in tried):
            return chosen, limits
        for name in missed:
            limits[name] *= _TIGHTENING
    return None


def _missed(tried: TriedSet, limits: dict[str, float]) -> str:
    """Return text such as ``radius missed, 1.3 times its limit``."""
    stated = {entry.measurement: entry for entry in tried.stated}
    ratios = {name: _excess(entry, limits[name]) for name, entry in stated.items() if name in limits}
    missed = {name: two_digits(ratio) for name, ratio in ratios.items() if 1 < ratio < math.inf}
    words = [f"{name} missed, {ratio} times its limit" for name, ratio in missed.items()]
    return "; ".join(words + [f"{name} without a value" for name, ratio in ratios.items() if ratio == math.inf])


def stricter(tried: TriedSet, limits: dict[str, float]) -> dict[str, float]:
    """Return the limits for the next search: missed limits times the ratio of expected to measured uncertainty."""
    out, stated = dict(tried.searched), {entry.measurement: entry for entry in tried.stated}
    for name, expected, able in zip(limits, tried.chosen.uncertainty.tolist(), tried.chosen.feasible, strict=True):
        error = stated[name].root_mean_square
        if able and _excess(stated[name], limits[name]) > 1:
            optimism = expected / error if error > 0 else _WITHOUT_VALUE
            out[name] = min(limits[name] * optimism, _TIGHTENING * tried.searched[name])
    return out


def _excess(stated: Statement, limit: float) -> float:
    return stated.root_mean_square / limit if math.isfinite(stated.root_mean_square) else math.inf


def state_set(session: Session, chosen: ViewSet, over: Callable[[], bool] = lambda: False) -> list[Statement]:
    """State every measurement from a set of views, reusing trials; ``over`` may stop it after each trial."""
    study, renderer, table = session.study, session.renderer, session.study.file.set
    assert table is not None and renderer is not None  # clouds drawn from a map cannot be joined
    content = ["set", list(chosen.views), table.joining, list(table.pose_known), _JOINING_VERSION]
    if len(chosen.views) == 1:
        content = ["view", *chosen.views]  # nothing is joined
    decided_by = with_exposure(session.digest, None, content)
    trials = TrialFolder.of(session.folder / "set_trials" / decided_by, decided_by, study.task)
    runner = JoinedMeasurements(renderer, [study.view(number) for number in chosen.views], table)
    days = [SET_DAYS + k for k in range(table.trials)]
    missing = [day for day in days if Trial(day) not in trials.known(0)]
    for day, outcome in track(runner.run(missing), "confirm the set", len(missing)):
        trials.add(0, Trial(day), outcome)
        if over():
            break
    wanted = [trial for trial in map(Trial, days) if trial in trials.known(0)]
    errors = trials.errors_of_parts(0, wanted)
    return [
        replace(
            statement(name, asked.unit, errors[m], tolerance_of(study.task, name)),
            losses=losses(trials.reasons(0, wanted, name)),
        )
        for m, (name, asked) in enumerate(study.task.measurements.items())
    ]


def tried_entries(tried: Sequence[TriedSet], limits: dict[str, float]) -> list[dict[str, Any]]:
    """Return views, expected uncertainty and root mean square error of every measured set as JSON values."""
    return [
        {
            "views": list(tried_set.chosen.views),
            "excess": json_values(tried_set.excess(limits)),
            "searched": tried_set.searched,
            "expected": dict(zip(limits, tried_set.chosen.uncertainty.tolist(), strict=True)),
            "found": json_values(
                {entry.measurement: entry.root_mean_square for entry in tried_set.stated if entry.measurement in limits}
            ),
        }
        for tried_set in tried
    ]


def joining_in_words(table: SetTable) -> str:
    """Return text such as ``joined by robot: each pose to 0.3 mm and 0.03 deg``."""
    if table.joining == "exact":
        return "joined as if their poses were exact"
    position, angle = table.pose_known
    if table.joining == "best_fit":
        return f"joined by best fit, from poses known to {position:g} mm and {angle:g} deg"
    return f"joined by {table.joining}: each pose to {position:g} mm and {angle:g} deg"


def confirmed_entry(stated: Sequence[Statement]) -> dict[str, Any]:
    """Return the results of virtual measurements of the set, by measurement, as JSON values."""
    keys = ("unit", "trials", "without_value", "bias", "standard_uncertainty", "interval", "verdict")
    out = {}
    for entry in stated:
        decision = None if entry.decided is None else asdict(entry.decided)
        out[entry.measurement] = json_values({key: getattr(entry, key) for key in keys} | {"decision": decision})
    return out


def write_set_csv(path: Path, table: SetTable, tried: TriedSet) -> None:
    """Write limit, expected and confirmed uncertainty of every measurement, one row each."""

    def text(value: float | None) -> str:
        return "" if value is None or not math.isfinite(value) else f"{value:.4g}"

    expected = dict(zip(table.limits, tried.chosen.uncertainty.tolist(), strict=True))
    lines = ["measurement,unit,limit,expected_uncertainty,trials,without_value,bias,uncertainty,low,high,verdict"]
    for entry in tried.stated:
        limit = f"{table.limits[entry.measurement]:g}" if entry.measurement in table.limits else ""
        counts = [text(expected.get(entry.measurement)), str(entry.trials), text(entry.without_value)]
        numbers = map(text, (entry.bias, entry.standard_uncertainty, *entry.interval))
        lines.append(",".join([entry.measurement, entry.unit, limit, *counts, *numbers, entry.verdict]))
    write_text(path, "\n".join(lines) + "\n")


def set_table(table: SetTable, tried: TriedSet) -> str:
    """Return the set as a text table: limit, expected u, and bias and u from virtual measurements."""
    expected = dict(zip(table.limits, tried.chosen.uncertainty.tolist(), strict=True))
    rows = [("measurement", "unit", "limit", "expected u", "bias", "u", "no value", "limit kept")]
    for entry in tried.stated:
        limit = table.limits.get(entry.measurement)
        kept = "-" if limit is None else "yes" if entry.root_mean_square <= limit else "no"
        wanted = ("-", "-") if limit is None else (f"{limit:g}", digits(expected[entry.measurement]))
        u = entry.standard_uncertainty
        numbers = plain(beside(entry.bias, u)), digits(u), plain(percent(entry.without_value))
        rows.append((entry.measurement, entry.unit, *wanted, *numbers, kept))
    return "\n".join(aligned(rows))
