"""Make the results of a talk that are missing: pieces of work and virtual measurements, here or by workers.

Signal chain: plan -> results that are kept -> orders of the others, pieces first, then the virtual measurements of one
view of one sample each -> results, each kept as soon as it is made. A stopped command therefore goes on where it ended.
Virtual measurements are kept one by one, as in every run (:mod:`mitsim.study.virtual.trials`).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import xarray as xr

from characterisation.words.numbers import time_in_words
from characterisation.words.progress import say_progress, track
from mitsim.running.executor import Executor
from mitsim.running.time_limit import TimeLimit
from mitsim.study.session import Session
from mitsim.study.virtual.plan import rendering_of
from mitsim.study.virtual.race import Job
from mitsim.study.virtual.spread_out import TrialOrder, make_trials
from mitsim.study.virtual.world import Trial
from mitsim.talk.plan import Piece, make_piece, pieces_of
from mitsim.talk.results import Results
from mitsim.talk.talk_file import ArtefactEntry, Talk
from mitsim.talk.view_pieces import errors_of

#: time of a piece on one quiet core [s], for the announcement; measured
_PIECE_S = 8.0

#: time of a virtual measurement on one quiet core [s], for the announcement; measured
_TRIAL_S = 0.7


@dataclass(frozen=True)
class _Unfinished:
    """The virtual measurements of a sample: its session, and the views that lack some."""

    sample: ArtefactEntry
    session: Session
    missing: dict[int, tuple[Job, ...]]


#: one order for a worker: the talk's folder and a piece, or the trials of a view
_Order = tuple[str, Piece] | TrialOrder


def work(order: _Order) -> Any:
    """Work on one order; workers call this function."""
    return make_trials(order) if isinstance(order, TrialOrder) else make_piece(*order)


def trials_name(sample: ArtefactEntry) -> str:
    """Return the name of the result with the errors of a sample's virtual measurements."""
    return f"trials_{sample.key}"


def missing_results(talk: Talk, results: Results, measured: tuple[str, ...] = ()) -> list[str]:
    """Return the names of all results of a talk that are missing; ``measured`` samples need no virtual measurements."""
    names = [piece.name for piece in pieces_of(talk)]
    names += [trials_name(sample) for sample in talk.file.samples if sample.key not in measured]
    return [name for name in names if results.get(name) is None]


def make(
    talk: Talk,
    results: Results,
    folder: Path,
    workers: Executor | None = None,
    limit: TimeLimit | None = None,
    measured: tuple[str, ...] = (),
) -> list[str]:
    """Make all missing results of a talk, and return the names of those that are still missing.

    Parameters
    ----------
    talk, results
        The talk, and the results that are kept; new ones are added.
    folder, workers, limit
        Output folder, where single virtual measurements are kept; processes or cluster, None for this process; time,
        None for no limit.
    measured
        Keys of samples that were captured, and need no virtual measurements.
    """
    limit = TimeLimit() if limit is None else limit
    pieces = pieces_of(talk)
    for piece in pieces:
        results.digests[piece.name] = piece.digest(talk.folder)
    missing = [piece for piece in pieces if results.get(piece.name) is None]
    shown = [example.sample for example in talk.file.examples]
    wanted = [sample for sample in talk.file.samples if sample.key not in measured]
    wanted.sort(key=lambda sample: sample.name not in shown)  # those of the examples first
    samples = [_unfinished(talk, results, sample, folder) for sample in wanted]
    unfinished = [entry for entry in samples if entry is not None]
    talk_folder = str(talk.folder)
    of_trials = [order for entry in unfinished for order in _trial_orders(talk, entry)]
    orders: list[_Order] = [*((talk_folder, piece) for piece in missing), *of_trials]
    if orders:
        trials = sum(len(of_trial.jobs) for of_trial in of_trials)
        seconds = _PIECE_S * len(missing) + _TRIAL_S * trials
        say_progress(
            f"{len(missing)} pieces of work and {trials} virtual measurements to make: about "
            f"{time_in_words(seconds)} of one quiet core"
        )
    here = ((order, work(order)) for order in orders)
    made = here if workers is None else workers.distribute(orders, lambda order: order, work)
    for order, result in track(made, "the talk", len(orders)):
        if isinstance(order, TrialOrder):
            kept = next(entry.session.trials for entry in unfinished if entry.session.digest == order.digest)
            for job, outcome in zip(order.jobs, result, strict=True):
                kept.add(job.view.number, job.trial, outcome)
        else:
            results.add(order[1].name, result)
        if limit.over():
            break
    for entry in unfinished:
        _finish(talk, results, entry)
    return missing_results(talk, results, measured)


def _unfinished(talk: Talk, results: Results, sample: ArtefactEntry, folder: Path) -> _Unfinished | None:
    """Return the virtual measurements that a sample lacks; None if all of them are kept."""
    session = Session(talk.study(sample), folder / "views" / sample.key)
    name = trials_name(sample)
    results.digests[name] = f"{session.digest}, {talk.file.trials} trials"
    if results.get(name) is not None:
        return None
    days = [Trial(day) for day in range(talk.file.trials)]
    missing = {}
    for view in session.study.views:
        finished = session.trials.known(view.number)
        if jobs := tuple(Job(view, trial) for trial in days if trial not in finished):
            missing[view.number] = jobs
    return _Unfinished(sample, session, missing)


def _trial_orders(talk: Talk, unfinished: _Unfinished) -> list[TrialOrder]:
    session, rendering = unfinished.session, rendering_of(unfinished.session.study)
    common = str(talk.path.absolute()), session.study.file, session.unknowns, False, session.digest
    return [TrialOrder(*common, jobs, rendering) for jobs in unfinished.missing.values()]


def _finish(talk: Talk, results: Results, unfinished: _Unfinished) -> None:
    """Keep the errors of a sample once all of its views are measured."""
    views = [view.number for view in unfinished.session.study.views]
    data: xr.Dataset = errors_of(unfinished.session.trials, views, talk.file.trials)
    if (data["tried"].values >= talk.file.trials).all():
        results.add(trials_name(unfinished.sample), data)
