"""The race: which of the views that the map thinks promising measures best when measurements are made.

Signal chain: scores of all candidate views -> shortlist -> trials of every view on it, in the same worlds -> posterior
of their risks (:mod:`characterisation.statements.selection`) -> more trials where they decide -> the leader of every
measurement, and of all together.

A view leaves no race for good: it gets trials as long as it has a chance to be better than the leader by more than the
margin. The race ends when every leader is the best, or within the margin of it, with the stated probability; when all
that could decide have had the most trials that one may have; or when time is over.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from characterisation.statements.selection import Standing, judge, posterior, sampled
from mitsim.progress import say, say_progress
from mitsim.views import View
from mitsim.virtual.trials import TrialFolder
from mitsim.virtual.world import RACE_DAY, Trial

Floats = NDArray[np.float64]

#: trials that every view on the shortlist gets, and that one gets at a time afterwards. Few trials of many views find a
#: better one than many of few (tests/benchmarks/race_starts.py, on the open cases of scenes/parts)
FIRST, BATCH = 1, 2

#: chance to be better than the leader under which a view gets no more trials
_HOPELESS = 0.01

#: views that get a batch in one round for each measurement that is not decided
_CHALLENGERS = 4

#: seconds between lines of progress
_SAY_EVERY_S = 10.0

#: name of the objective that weighs all measurements together
ALL = "all measurements"


@dataclass(frozen=True)
class Job:
    """One virtual measurement: a trial from a view."""

    view: View
    trial: Trial


class Maker(Protocol):
    """What makes virtual measurements: by rendering, or from the map."""

    source: str

    def in_order(self, jobs: Iterable[Job]) -> list[Job]:
        """Jobs in the order in which they are made with the least work."""

    def run(self, jobs: Iterable[Job]) -> Iterator[tuple[Job, dict[str, float]]]:
        """Errors of every measurement, NaN where it has no value, job by job."""


@dataclass(frozen=True)
class RaceRules:
    """``shortlist`` views of each measurement, at most ``most`` trials each; when a race is decided."""

    shortlist: int
    most: int
    margin: float
    confidence: float
    seconds: float | None


@dataclass(frozen=True)
class Raced:
    """The outcome of a race.

    ``views`` (v,) their numbers; ``standings`` by measurement, with :data:`ALL` for all together; ``errors``
    (measurement, v, world) in the task's units, NaN without a value, infinite where not tried; ``decided`` whether
    every leader reached the confidence.
    """

    views: NDArray[np.int64]
    standings: dict[str, Standing]
    errors: Floats
    decided: bool

    def leader(self, name: str) -> int:
        """Number of the view that leads."""
        return int(self.views[self.standings[name].leader])

    def leaders(self) -> dict[str, int]:
        """Numbers of the views that lead, :data:`ALL` first; none where no view was raced."""
        names = [ALL, *(name for name in self.standings if name != ALL)] if len(self.views) else []
        return {name: self.leader(name) for name in names}

    @property
    def trials(self) -> int:
        """Number of trials in all."""
        return int((~np.isinf(self.errors[0])).sum()) if self.errors.size else 0


def shortlist(scores: xr.Dataset, count: int) -> list[int]:
    """Numbers of the views worth a trial: the first ``count`` of each measurement and of all together, by the map.

    In the order of the predicted risk u / sqrt(chance); a view with a chance of nothing counts as not possible.
    """
    return sorted(int(scores["view"].values[i]) for i in first_of_each(screening_risk(scores), count))


def first_of_each(cost: Floats, count: int) -> set[int]:
    """Places of the ``count`` views of least cost (measurement, view), of each measurement and of their mean.

    A view of infinite cost is none of them.
    """
    return {
        int(i)
        for row in [*cost, cost.mean(axis=0)]
        for i in np.argsort(row, kind="stable")[:count]
        if np.isfinite(row[i])
    }


def prior_risk(u: Floats) -> Floats:
    """The map's u (view,) of a measurement as a prior: three times the largest where the map knows none, 1 of none."""
    known = np.where(np.isfinite(u) & (u > 0), u, np.nan)
    worst = np.nanmax(known) if np.isfinite(known).any() else 1.0
    return np.where(np.isfinite(known), known, 3 * worst)


def screening_risk(scores: xr.Dataset) -> Floats:
    """Logarithm of the predicted risk (measurement, view), infinite where the map sees no possibility."""
    u = scores["predicted_uncertainty"].transpose("measurement", "view").values
    chance = scores["chance"].transpose("measurement", "view").values
    able = np.isfinite(u) & (u > 0) & (chance > 0)
    return np.where(able, np.log(np.where(able, u, 1.0)) - 0.5 * np.log(np.where(able, chance, 1.0)), np.inf)


def run_race(views: Sequence[View], scores: xr.Dataset, maker: Maker, trials: TrialFolder, rules: RaceRules) -> Raced:
    """Race the views on the shortlist; trials that the folder holds are not made again."""
    numbers = shortlist(scores, rules.shortlist)
    if not numbers:
        say("race: the map sees no view from which anything can be measured")
        return Raced(np.empty(0, np.int64), {}, np.empty((len(trials.measurements), 0, 0)), False)
    by_number = {view.number: view for view in views}
    counts = dict.fromkeys(numbers, 0)
    told = scores.sel(view=numbers)
    began = last = time.monotonic()

    def over() -> bool:
        return rules.seconds is not None and time.monotonic() - began > rules.seconds

    def measure(wanted: dict[int, int]) -> None:
        nonlocal last
        jobs = [
            Job(by_number[number], trial)
            for number, count in wanted.items()
            for trial in _days(count)
            if trial not in trials.known(number)
        ]
        for done, (job, errors) in enumerate(maker.run(maker.in_order(jobs)), 1):
            trials.add(job.view.number, job.trial, errors)
            if time.monotonic() - last > _SAY_EVERY_S:
                last = time.monotonic()
                say_progress(f"race: {done} of {len(jobs)} trials of this round")
            if over() and done < len(jobs):
                break

    wanted = dict.fromkeys(numbers, FIRST)
    while True:
        measure(wanted)
        for number in wanted:
            counts[number] = sum(trial in trials.known(number) for trial in _days(wanted[number]))
        raced = standings(told, numbers, trials, counts, rules)
        wanted = _next(raced, counts, rules)
        _tell(raced, counts, rules, time.monotonic() - began)
        if raced.decided or not wanted or over():
            return raced


def standings(
    scores: xr.Dataset, numbers: Sequence[int], trials: TrialFolder, counts: dict[int, int], rules: RaceRules
) -> Raced:
    """How the race stands with so many trials of each view."""
    names = list(trials.measurements)
    most = max(max(counts.values(), default=0), 1)
    errors = np.full((len(names), len(numbers), most), np.inf)
    for v, number in enumerate(numbers):
        known = trials.known(number)
        for k, trial in enumerate(_days(most)):
            if trial in known and k < counts[number]:
                errors[:, v, k] = [known[trial][name] for name in names]
    u = scores["predicted_uncertainty"].sel(measurement=names).transpose("measurement", "view").values
    chance = scores["chance"].sel(measurement=names).transpose("measurement", "view").values
    tolerances = scores["tolerance"].sel(measurement=names).values
    found, samples = {}, []
    for m, name in enumerate(names):
        mean, covariance = posterior(errors[m], prior_risk(u[m]), chance[m])
        samples.append(sampled(mean, covariance, seed=m))
        found[name] = judge(samples[-1], rules.margin)
    found[ALL] = judge(together(np.array(samples), tolerances), rules.margin)
    decided = all(one.confidence >= rules.confidence for one in found.values())
    return Raced(np.array(numbers), found, errors, decided)


def together(samples: Floats, tolerances: Floats) -> Floats:
    """Logarithm (s, v) of the risk of all measurements at once, of that of each, (m, s, v).

    With a tolerance for every measurement the largest share of a tolerance; else the geometric mean of the risks.
    """
    if np.isfinite(tolerances).all():
        return np.asarray((samples - np.log(tolerances)[:, None, None]).max(axis=0))
    return np.asarray(samples.mean(axis=0))


def _days(count: int) -> list[Trial]:
    return [Trial(RACE_DAY + day) for day in range(count)]


def _next(raced: Raced, counts: dict[int, int], rules: RaceRules) -> dict[int, int]:
    """How many trials each view shall have after the next round, of those that get more."""
    wanted = {}
    for one in raced.standings.values():
        if one.confidence >= rules.confidence:
            continue
        rivals = [int(v) for v in np.argsort(-one.chance, kind="stable") if one.chance[v] > _HOPELESS]
        for place in [one.leader, *rivals[:_CHALLENGERS]]:
            number = int(raced.views[place])
            if counts[number] < rules.most:
                wanted[number] = min(counts[number] + BATCH, rules.most)
    return wanted


def _tell(raced: Raced, counts: dict[int, int], rules: RaceRules, seconds: float) -> None:
    open_ones = [name for name, one in raced.standings.items() if one.confidence < rules.confidence]
    best = raced.standings[ALL]
    state = f"{len(open_ones)} of {len(raced.standings)} choices open" if open_ones else "all choices made"
    left = "" if rules.seconds is None else f", {max(0.0, rules.seconds - seconds):.0f} s left"
    say_progress(
        f"race: {sum(counts.values())} trials of {len(counts)} views; leads: view {raced.leader(ALL)} "
        f"({100 * best.confidence:.0f} % sure to be the best or within {100 * rules.margin:.0f} %); {state}{left}"
    )
