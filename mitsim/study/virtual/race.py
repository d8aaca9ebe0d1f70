"""Race: find the view that measures best, with virtual measurements of the promising views only.

Signal chain: scores of all candidate views -> shortlist -> trials of every view on it, with the same draws -> posterior
of their risks (:mod:`characterisation.statements.selection`) -> more trials where the choice is open -> the best view
for all measurements together, and that of each alone as far as the same trials tell it.

No view is excluded for good. The leader and the views that are expected to gain most on it get the next trials. The
race ends when the leader's risk is expected to exceed the least by no more than the loss that the rules allow. It also
ends when all views that could decide have the largest number of trials, or when time is over.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from characterisation.files.arrays import Floats
from characterisation.statements.selection import Standing, joint_samples, judge
from characterisation.words.numbers import how_many
from characterisation.words.progress import say, say_progress, track
from mitsim.running.time_limit import in_time
from mitsim.study import RaceTable
from mitsim.study.virtual.risks import combined_risk, possible_measurements, prior_risk, shortlist
from mitsim.study.virtual.trials import Outcome, TrialFolder
from mitsim.study.virtual.world import Trial
from mitsim.views import View

#: first trials of every view on the shortlist. Few trials of many views find a better view than many trials of few
#: (tests/benchmarks/race_starts.py, on the open cases of scenes/parts)
FIRST = 1
#: trials of a view per later batch, by the same benchmark
BATCH = 2

#: expected gain on the leader, of the logarithm of the risk, below which a view gets no more trials
_LEAST_GAIN = 0.001

#: number of views beside the leader that get a batch in a round, for each choice that is open
_CHALLENGERS = 4

#: number of trials of a round that the runner orders at once; within them, trials share the light paths of a view
_AT_ONCE = 16

#: time between lines of progress, and between states within a round [s]
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

    def run(self, jobs: Iterable[Job]) -> Iterator[tuple[Job, Outcome]]:
        """Yield the outcome of every virtual measurement, job by job."""


def complete(
    trials: TrialFolder,
    runner: TrialRunner,
    jobs: Iterable[Job],
    label: str,
    over: Callable[[], bool] = lambda: False,
) -> None:
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
    over
        Returns whether to stop after the trial at hand.
    """
    missing = [job for job in jobs if job.trial not in trials.known(job.view.number)]
    if not missing:
        return
    for job, outcome in track(runner.run(in_time(missing, over)), label, len(missing)):
        trials.add(job.view.number, job.trial, outcome)
        if over():
            break


@dataclass(frozen=True)
class Raced:
    """Result of a race.

    ``views`` (v,) are view numbers. ``standings`` are by measurement, with :data:`ALL` for all together. ``errors``
    (measurement, v, trial) are in the units of the task, NaN without a value, infinite if not tried. ``decided`` says
    whether the choices that were asked for are made. ``margin`` is that of the confidences.
    """

    views: NDArray[np.int64]
    standings: dict[str, Standing]
    errors: Floats
    decided: bool
    margin: float = 0.1

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


def run_race(
    views: Sequence[View],
    scores: xr.Dataset,
    runner: TrialRunner,
    trials: TrialFolder,
    rules: RaceTable,
    over: Callable[[], bool] = lambda: False,
    after_round: Callable[[Raced], None] = lambda _: None,
) -> Raced:
    """Race the views on the shortlist, and reuse trials in the folder.

    - ``views``, ``scores``: all candidate views, and their scores by the map.
    - ``runner``: makes the virtual measurements.
    - ``trials``: finished trials, to which those of the race are added.
    - ``rules``: shortlist, largest number of trials, and the end of the race.
    - ``over``: returns whether time is over; asked after every trial.
    - ``after_round``: receives the state before the first trial, after every round, and within long rounds.
    """
    numbers = shortlist(scores, rules.shortlist, rules.each)
    if not numbers:
        say("race: the map predicts that no view can make any measurement")
        return Raced(np.empty(0, np.int64), {}, np.empty((len(trials.measurements), 0, 0)), False, rules.margin)
    by_number = {view.number: view for view in views}
    counts = dict.fromkeys(numbers, 0)
    predicted = scores.sel(view=numbers)
    began = last = time.monotonic()

    def state(wanted: dict[int, int]) -> Raced:
        for number in wanted:
            counts[number] = sum(trial in trials.known(number) for trial in _first_trials(wanted[number]))
        return standings(predicted, numbers, trials, counts, rules)

    def measure(wanted: dict[int, int]) -> None:
        nonlocal last
        jobs = [
            Job(by_number[number], trial)
            for number, count in wanted.items()
            for trial in _first_trials(count)
            if trial not in trials.known(number)
        ]
        done = 0
        # the most promising views come first, so that they have trials when time is over, and the trials of each
        # follow each other, so that they share its light paths
        for first in range(0, len(jobs), _AT_ONCE):
            for job, outcome in runner.run(in_time(jobs[first : first + _AT_ONCE], over)):
                trials.add(job.view.number, job.trial, outcome)
                done += 1
                if time.monotonic() - last > _SAY_EVERY_S:
                    last = time.monotonic()
                    say_progress(f"race: {done} of {len(jobs)} trials of this round")
                    after_round(state(wanted))
                if over() and done < len(jobs):
                    return

    wanted = dict.fromkeys(numbers, FIRST)
    after_round(state(wanted))
    while True:
        measure(wanted)
        raced = state(wanted)
        wanted = _next_round(raced, counts, rules)
        ended = raced.decided or not wanted or over()
        if ended or time.monotonic() - last > _SAY_EVERY_S:
            last = time.monotonic()
            _say_state(raced, counts, last - began)
        if ended:
            return raced
        after_round(raced)


def standings(
    scores: xr.Dataset, numbers: Sequence[int], trials: TrialFolder, counts: dict[int, int], rules: RaceTable
) -> Raced:
    """Return the state of the race after some trials of each view.

    ``scores``: scores of the candidate views, with the variables ``predicted_uncertainty`` and ``chance`` of each
    measurement. ``numbers``: numbers of the views on the shortlist. ``trials``: folder of the trials. ``counts``:
    number of trials that are used, by number of a view. ``rules``: margin and loss of the decision.
    """
    names = list(trials.measurements)
    most = max(max(counts.values(), default=0), 1)
    errors = np.full((len(names), len(numbers), most), np.inf)
    for v, number in enumerate(numbers):
        outcomes = trials.known(number)
        for k, trial in enumerate(_first_trials(most)):
            if trial in outcomes and k < counts[number]:
                errors[:, v, k] = [outcomes[trial].errors[name] for name in names]
    u = scores["predicted_uncertainty"].sel(measurement=names).transpose("measurement", "view").values
    chance = scores["chance"].sel(measurement=names).transpose("measurement", "view").values
    tolerances = scores["tolerance"].sel(measurement=names).values
    prior = np.array([prior_risk(row) for row in u])
    samples = joint_samples(errors, prior, np.nan_to_num(chance))
    by_name = {name: judge(samples[m], rules.margin) for m, name in enumerate(names)}
    possible = possible_measurements(u, errors)
    by_name[ALL] = judge(combined_risk(samples[possible], tolerances[possible]), rules.margin)
    decided = all(by_name[name].loss <= rules.loss for name in asked(by_name, rules))
    return Raced(np.array(numbers), by_name, errors, decided, rules.margin)


def asked(names: Iterable[str], rules: RaceTable) -> list[str]:
    """Return the names of the choices that the race has to make."""
    return list(names) if rules.each else [ALL]


def _first_trials(count: int) -> list[Trial]:
    return [Trial(day) for day in range(count)]


def _next_round(raced: Raced, counts: dict[int, int], rules: RaceTable) -> dict[int, int]:
    """Return the number of trials after the next round, for the views that get more."""
    wanted = {}
    for name in asked(raced.standings, rules):
        standing = raced.standings[name]
        if standing.loss <= rules.loss:
            continue
        rivals = [int(v) for v in np.argsort(-standing.gain, kind="stable") if standing.gain[v] > _LEAST_GAIN]
        for index in [standing.leader, *rivals[:_CHALLENGERS]]:
            number = int(raced.views[index])
            if counts[number] < rules.trials:
                wanted[number] = min(counts[number] + BATCH, rules.trials)
    return wanted


def _say_state(raced: Raced, counts: dict[int, int], seconds: float) -> None:
    trials, views = how_many(sum(counts.values()), "trial"), how_many(len(counts), "view")
    say_progress(
        f"race: {trials} in all, {views}, {seconds:.0f} s; view {raced.leader(ALL)} leads, "
        f"{in_words(raced.standings[ALL], raced.margin)}"
    )


def in_words(standing: Standing, margin: float) -> str:
    """Return how good a choice is: ``with an error expected 4 % above that of the best view (90 % sure ...)``."""
    loss = "expected to be the best"
    if standing.loss >= 0.005:
        loss = f"with an error expected {100 * standing.loss:.0f} % above that of the best view"
    return f"{loss} ({100 * standing.confidence:.0f} % sure to be within {100 * margin:.0f} % of it)"
