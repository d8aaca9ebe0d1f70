"""Race: find the view that measures best, with virtual measurements of the promising views only.

Signal chain: scores of all candidate views -> shortlist -> trials of every view on it, with the same draws -> posterior
of their risks (:mod:`characterisation.statements.selection`) -> more trials where the choice is open -> the best view
of every measurement, and of all together.

No view is excluded for good. A view gets trials as long as it may be better than the leader by more than the margin.
The race ends when every leader is, with the stated probability, the best or within the margin of the best. It also ends
when all views that could decide have the largest number of trials, or when time is over.
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
from characterisation.tasks.task_file import Task
from mitsim.running.progress import say, say_progress, track
from mitsim.study.virtual.trials import Outcome, TrialFolder
from mitsim.study.virtual.world import Trial
from mitsim.views import View
from mitsim.views.view_scores import screening_risk

Floats = NDArray[np.float64]

#: first trials of every view on the shortlist, and trials per later batch. Few trials of many views find a better view
#: than many trials of few (tests/benchmarks/race_starts.py, on the open cases of scenes/parts)
FIRST, BATCH = 1, 2

#: probability of being better than the leader below which a view gets no more trials
_LEAST_CHANCE = 0.01

#: number of views that get a batch in a round, for each undecided measurement
_CHALLENGERS = 4

#: time between lines of progress [s]
_SAY_EVERY_S = 10.0

#: name of the objective that combines all measurements
ALL = "all measurements"


@dataclass(frozen=True)
class Job:
    """One virtual measurement: a trial from a view."""

    view: View
    trial: Trial


class TrialRunner(Protocol):
    """Makes virtual measurements, by rendering or from the map."""

    source: str

    def in_order(self, jobs: Iterable[Job]) -> list[Job]:
        """Return the jobs in the order that takes the least work."""

    def run(self, jobs: Iterable[Job]) -> Iterator[tuple[Job, Outcome]]:
        """Yield the outcome of every virtual measurement, job by job."""


def complete(trials: TrialFolder, runner: TrialRunner, jobs: Iterable[Job], label: str) -> None:
    """Make the jobs whose trials are not finished yet, and keep each in the folder as soon as it is.

    Parameters
    ----------
    trials
        Folder of the trials of a study.
    runner
        Makes the virtual measurements.
    jobs
        Requested trials of views.
    label
        Name of the work in the line of progress.
    """
    missing = [job for job in jobs if job.trial not in trials.known(job.view.number)]
    for job, outcome in track(runner.run(runner.in_order(missing)), label, len(missing)):
        trials.add(job.view.number, job.trial, outcome)


@dataclass(frozen=True)
class RaceRules:
    """Rules of a race: ``shortlist`` views of each measurement, at most ``most`` trials of each view.

    A choice is decided if its view is within ``margin`` of the best with the probability ``confidence``. ``seconds``
    limit the race.
    """

    shortlist: int
    most: int
    margin: float
    confidence: float
    seconds: float | None


@dataclass(frozen=True)
class Raced:
    """Result of a race.

    ``views`` (v,) are view numbers. ``standings`` are by measurement, with :data:`ALL` for all together. ``errors``
    (measurement, v, trial) are in the units of the task, NaN without a value, infinite if not tried. ``decided`` says
    whether every leader reached the confidence.
    """

    views: NDArray[np.int64]
    standings: dict[str, Standing]
    errors: Floats
    decided: bool

    def leader(self, name: str) -> int:
        """Return the number of the leading view."""
        return int(self.views[self.standings[name].leader])

    def leaders(self) -> dict[str, int]:
        """Return the numbers of the leading views, :data:`ALL` first; empty if no view was raced."""
        names = [ALL, *(name for name in self.standings if name != ALL)] if len(self.views) else []
        return {name: self.leader(name) for name in names}

    @property
    def trials(self) -> int:
        """Return the total number of trials."""
        return int((~np.isinf(self.errors[0])).sum()) if self.errors.size else 0


def shortlist(scores: xr.Dataset, count: int) -> list[int]:
    """Return the numbers of the views worth a trial, in the order of the predicted risk u / sqrt(chance).

    These are the first ``count`` views of each measurement and of all together, by the map. A view with zero chance
    counts as impossible.
    """
    return sorted(int(scores["view"].values[i]) for i in first_of_each(screening_risk(scores), count))


def first_of_each(cost: Floats, count: int) -> set[int]:
    """Return the indices of the ``count`` views of least cost, for each measurement and for the mean cost.

    ``cost`` has the shape (measurement, view). Views of infinite cost are excluded. A measurement of infinite cost in
    all views does not count for the mean.
    """
    possible = cost[np.isfinite(cost).any(axis=1)]
    return {
        int(i)
        for row in [*possible, *([possible.mean(axis=0)] if len(possible) else [])]
        for i in np.argsort(row, kind="stable")[:count]
        if np.isfinite(row[i])
    }


def prior_risk(u: Floats) -> Floats:
    """Return the map's u (view,) of a measurement as a prior risk.

    A view without u gets three times the largest u, which counts as 1 if no view has a u.
    """
    known = np.where(np.isfinite(u) & (u > 0), u, np.nan)
    worst = np.nanmax(known) if np.isfinite(known).any() else 1.0
    return np.where(np.isfinite(known), known, 3 * worst)


def run_race(
    views: Sequence[View], scores: xr.Dataset, runner: TrialRunner, trials: TrialFolder, rules: RaceRules
) -> Raced:
    """Race the views on the shortlist, and reuse trials in the folder.

    Parameters
    ----------
    views, scores
        All candidate views, and their scores by the map.
    runner
        Makes the virtual measurements.
    trials
        Finished trials, to which those of the race are added.
    rules
        Shortlist, largest number of trials, and the end of the race.

    See Also
    --------
    standings : the state after some trials
    """
    numbers = shortlist(scores, rules.shortlist)
    if not numbers:
        say("race: the map predicts that no view can make any measurement")
        return Raced(np.empty(0, np.int64), {}, np.empty((len(trials.measurements), 0, 0)), False)
    by_number = {view.number: view for view in views}
    counts = dict.fromkeys(numbers, 0)
    predicted = scores.sel(view=numbers)
    began = last = time.monotonic()

    def over() -> bool:
        return rules.seconds is not None and time.monotonic() - began > rules.seconds

    def measure(wanted: dict[int, int]) -> None:
        nonlocal last
        jobs = [
            Job(by_number[number], trial)
            for number, count in wanted.items()
            for trial in _first_trials(count)
            if trial not in trials.known(number)
        ]
        for done, (job, outcome) in enumerate(runner.run(runner.in_order(jobs)), 1):
            trials.add(job.view.number, job.trial, outcome)
            if time.monotonic() - last > _SAY_EVERY_S:
                last = time.monotonic()
                say_progress(f"race: {done} of {len(jobs)} trials of this round")
            if over() and done < len(jobs):
                break

    wanted = dict.fromkeys(numbers, FIRST)
    while True:
        measure(wanted)
        for number in wanted:
            counts[number] = sum(trial in trials.known(number) for trial in _first_trials(wanted[number]))
        raced = standings(predicted, numbers, trials, counts, rules)
        wanted = _next_round(raced, counts, rules)
        _say_state(raced, counts, rules, time.monotonic() - began)
        if raced.decided or not wanted or over():
            return raced


def standings(
    scores: xr.Dataset, numbers: Sequence[int], trials: TrialFolder, counts: dict[int, int], rules: RaceRules
) -> Raced:
    """Return the state of the race after some trials of each view.

    Parameters
    ----------
    scores
        Scores of the candidate views, with the variables ``predicted_uncertainty`` and ``chance`` of each measurement.
    numbers
        Numbers of the views on the shortlist.
    trials
        Folder of the trials.
    counts
        Number of trials that are used, by number of a view.
    rules
        Margin and confidence of the decision.

    See Also
    --------
    run_race : the whole race
    """
    names = list(trials.measurements)
    most = max(max(counts.values(), default=0), 1)
    errors = np.full((len(names), len(numbers), most), np.inf)
    for v, number in enumerate(numbers):
        known = trials.known(number)
        for k, trial in enumerate(_first_trials(most)):
            if trial in known and k < counts[number]:
                errors[:, v, k] = [known[trial].errors[name] for name in names]
    u = scores["predicted_uncertainty"].sel(measurement=names).transpose("measurement", "view").values
    chance = scores["chance"].sel(measurement=names).transpose("measurement", "view").values
    tolerances = scores["tolerance"].sel(measurement=names).values
    found, samples = {}, []
    for m, name in enumerate(names):
        mean, covariance = posterior(errors[m], prior_risk(u[m]), chance[m])
        samples.append(sampled(mean, covariance, seed=m))
        found[name] = judge(samples[-1], rules.margin)
    possible = possible_measurements(u, errors)
    found[ALL] = judge(combined_risk(np.array(samples)[possible], tolerances[possible]), rules.margin)
    decided = all(one.confidence >= rules.confidence for one in found.values())
    return Raced(np.array(numbers), found, errors, decided)


def possible_measurements(u: Floats, errors: Floats) -> NDArray[np.bool_]:
    """Return whether each measurement (m,) is possible in a view, by the map or by a trial; all if none is.

    ``u`` (m, v) is the map's, ``errors`` (m, v, trial) are those of the race. An impossible measurement cannot
    distinguish views, so it does not count for all measurements together.
    """
    predicted = (np.isfinite(u) & (u > 0)).any(axis=1)
    possible = predicted | np.isfinite(errors).any(axis=(1, 2))
    return np.asarray(possible if possible.any() else np.ones_like(possible))


def combined_risk(samples: Floats, tolerances: Floats) -> Floats:
    """Return the logarithm (s, v) of the combined risk of all measurements, from that of each, (m, s, v).

    If every measurement has a tolerance, it is the largest ratio of risk to tolerance; else the geometric mean of the
    risks.
    """
    if np.isfinite(tolerances).all():
        return np.asarray((samples - np.log(tolerances)[:, None, None]).max(axis=0))
    return np.asarray(samples.mean(axis=0))


def _first_trials(count: int) -> list[Trial]:
    return [Trial(day) for day in range(count)]


def _next_round(raced: Raced, counts: dict[int, int], rules: RaceRules) -> dict[int, int]:
    """Return the number of trials after the next round, for the views that get more."""
    wanted = {}
    for one in raced.standings.values():
        if one.confidence >= rules.confidence:
            continue
        rivals = [int(v) for v in np.argsort(-one.chance, kind="stable") if one.chance[v] > _LEAST_CHANCE]
        for place in [one.leader, *rivals[:_CHALLENGERS]]:
            number = int(raced.views[place])
            if counts[number] < rules.most:
                wanted[number] = min(counts[number] + BATCH, rules.most)
    return wanted


def _say_state(raced: Raced, counts: dict[int, int], rules: RaceRules, seconds: float) -> None:
    open_ones = [name for name, one in raced.standings.items() if one.confidence < rules.confidence]
    best = raced.standings[ALL]
    state = f"{len(open_ones)} of {len(raced.standings)} choices open" if open_ones else "all choices made"
    left = "" if rules.seconds is None else f", {max(0.0, rules.seconds - seconds):.0f} s left"
    say_progress(
        f"race: {sum(counts.values())} trials of {len(counts)} views; leads: view {raced.leader(ALL)} "
        f"({100 * best.confidence:.0f} % sure to be the best or within {100 * rules.margin:.0f} %); {state}{left}"
    )


def with_race(scores: xr.Dataset, raced: Raced) -> xr.Dataset:
    """Add ``measured_risk``, ``trials`` and ``final_rank`` (measurement, view) from the race.

    Measured views come first, by their risk; the others follow in the order of screening.
    """
    names = [str(name) for name in scores["measurement"].values]
    places = {int(view): place for place, view in enumerate(scores["view"].values)}
    shape = (len(names), scores.sizes["view"])
    risk, count = np.full(shape, np.nan), np.zeros(shape, int)
    columns = [places[int(view)] for view in raced.views]
    if columns:
        risk[:, columns] = [raced.standings[name].risk for name in names]
        count[:, columns] = (~np.isinf(raced.errors)).sum(axis=2)
    screened = scores["uncertainty_rank"].transpose("measurement", "view").values
    order = np.lexsort((screened, np.where(np.isfinite(risk), risk, np.inf)), axis=1)
    rank = np.empty(shape, int)
    np.put_along_axis(rank, order, np.broadcast_to(np.arange(1, shape[1] + 1), shape), axis=1)
    by = ("measurement", "view")
    out = scores.copy()
    name = "root mean square error of virtual measurements over the square root of the share with a value"
    out["measured_risk"] = (by, risk, {"long_name": name, "units": "mm or deg"})
    out["trials"] = (by, count, {"long_name": "virtual measurements of the race", "units": "1"})
    out["final_rank"] = (by, rank, {"long_name": "rank by race, then by screening; 1 is best", "units": "1"})
    return out


def raced_errors(raced: Raced, task: Task) -> xr.Dataset:
    """Return the errors of the race (measurement, view, repeat), NaN without a value; the best view comes first.

    ``tried`` distinguishes a trial without a value from one that was not made.
    """
    order = np.argsort(raced.standings[ALL].risk, kind="stable") if len(raced.views) else np.empty(0, int)
    tried = ~np.isinf(raced.errors[:, order])
    errors = np.where(tried, raced.errors[:, order], np.nan)
    dims = ("measurement", "view", "repeat")
    nominal = np.array([one.nominal for one in task.measurements.values()])[:, None, None]
    return xr.Dataset(
        {
            "error": (dims, errors, {"units": "mm or deg"}),
            "value": (dims, errors + nominal, {"units": "mm or deg"}),
            "tried": (dims, tried.astype(np.int8), {"units": "1"}),
        },
        coords={"measurement": list(task.measurements), "view": raced.views[order]},
    )
