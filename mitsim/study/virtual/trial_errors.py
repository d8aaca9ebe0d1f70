"""Return the errors of finished trials, for statements: of values that fold, with the deviations behind them.

Signal chain: kept trials of a view -> errors, or the deviations that each trial measured on a nominal part, and a
random direction for each day -> errors of a part at the limit of its tolerance
(:mod:`characterisation.statements.one_sided`).

The direction follows from the measurement and the day. So a repeat of a capture, and a trial with one group of unknowns
drawn again, are about the same part.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from characterisation.statements.one_sided import OneSidedErrors, stated_errors
from characterisation.tasks.folded import FoldedValue, folded_values
from characterisation.tasks.task_file import Task
from mitsim.study.virtual.trials import TrialFolder
from mitsim.study.virtual.world import Trial

Floats = NDArray[np.float64]


def errors_of_trials(
    task: Task, trials: TrialFolder, view: int, wanted: Sequence[Trial]
) -> list[Floats | OneSidedErrors]:
    """Return the errors (n,) of finished trials of a view, for every measurement of the task in its order."""
    plain, folded = trials.errors(view, wanted), folded_values(task)
    return [
        _one_sided(folded[name], trials, view, wanted) if name in folded else plain[m]
        for m, name in enumerate(trials.measurements)
    ]


def stated_errors_of_trials(task: Task, trials: TrialFolder, view: int, wanted: Sequence[Trial]) -> Floats:
    """Return the errors (measurements, n) of finished trials that a statement is about, NaN without a value.

    Those of a value that folds are at the limit of its tolerance.
    """
    found = errors_of_trials(task, trials, view, wanted)
    return np.array([stated_errors(one) for one in found], float).reshape(len(found), len(wanted))


def _one_sided(folded: FoldedValue, trials: TrialFolder, view: int, wanted: Sequence[Trial]) -> OneSidedErrors:
    vectors = trials.deviations(view, wanted, folded.name).reshape(len(wanted), *folded.shape)
    directions = np.array([folded.direction(trial.day) for trial in wanted]).reshape(vectors.shape)
    return OneSidedErrors(vectors, directions, folded.size, folded.limit, folded.fold)
