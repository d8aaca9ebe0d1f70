"""State the mean of repeated captures of one part, by virtual measurements of every capture.

Signal chain: days of a statement -> several captures of each day, with the same unknowns but new pose and noise ->
mean error of each day -> statement of every measurement.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from characterisation.statements.one_sided import OneSidedErrors
from characterisation.statements.statement import Statement, statement
from characterisation.statements.tolerance import tolerance_of
from characterisation.tasks.definitions import DEFINITIONS
from mitsim.running.time_limit import TimeLimit
from mitsim.study.session import Session
from mitsim.study.virtual.drawn_numbers import related, statement_trials
from mitsim.study.virtual.race import Job, complete
from mitsim.study.virtual.world import Trial
from mitsim.views import View


def state_mean(session: Session, view: View, captures: int, count: int, limit: TimeLimit) -> list[Statement]:
    """State the mean of several captures of a day for every measurement.

    Captures without a value are left out of the mean of their day. Days that time does not suffice for are not used.

    ``session``, ``view``, ``limit``: of the study, the view at its exposures, and the time. ``captures``, ``count``:
    number of captures of a day, and largest number of days.
    """
    study, source = session.study, session.trials_of(view)
    trials = source.folder
    days = list(dict.fromkeys(trial.day for trial in statement_trials(2 * count)))[:count]
    for day in days:
        jobs = [Job(view, Trial(day, capture)) for capture in range(captures)]
        complete(trials, source.runner, jobs, f"capture day {day - days[0] + 1} of {len(days)}", limit.over)
        if limit.over():
            break
    outcomes = trials.known(view.number)
    whole = [day for day in days if all(Trial(day, capture) in outcomes for capture in range(captures))]
    rows = [trials.errors_of_parts(view.number, [Trial(day, k) for day in whole]) for k in range(captures)]
    common = related([Trial(day) for day in whole])
    return [
        statement(
            name,
            asked.unit,
            mean_errors([row[m] for row in rows], DEFINITIONS[asked.kind].of == "form"),
            tolerance_of(study.task, name),
            (),
            None,
            common,
        )
        for m, (name, asked) in enumerate(study.task.measurements.items())
    ]


def mean_errors(captures: list[np.ndarray | OneSidedErrors], form: bool) -> np.ndarray | OneSidedErrors:
    """Return the mean errors (n,) of days from those of each capture.

    The last deviation of a ``form`` is a standard deviation, that of its noise
    (:func:`~characterisation.tasks.deviations.form_size`), which differs from capture to capture.
    """
    first = captures[0]
    if not isinstance(first, OneSidedErrors):
        return _known_mean(np.array(captures))
    vectors = np.array([capture.vectors for capture in captures if isinstance(capture, OneSidedErrors)])
    mean = _known_mean(vectors)
    if form:
        noise = vectors[:, :, -1]
        mean[:, -1] = np.sqrt(_known_mean(noise**2) / np.maximum(np.isfinite(noise).sum(axis=0), 1))
    return replace(first, vectors=mean)


def _known_mean(values: np.ndarray) -> np.ndarray:
    """Return the mean over the first axis without NaN; NaN where there is no number."""
    finite = np.isfinite(values)
    count = finite.sum(axis=0)
    total = np.where(finite, values, 0.0).sum(axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)
