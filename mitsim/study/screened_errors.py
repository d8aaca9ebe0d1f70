"""Convert the uncertainty that a map predicts for a view to the uncertainty that a statement is expected to give.

Signal chain: predicted standard uncertainty of a nominal part -> times the stated share of a value that folds -> errors
that represent it, for a decision rule.
"""

from __future__ import annotations

import numpy as np
from scipy.stats import norm

from characterisation.files.arrays import Floats
from characterisation.statements.decision import needed
from characterisation.statements.tolerance import tolerance_of
from characterisation.tasks.folded import folded_values
from characterisation.tasks.task_file import Task

#: equally likely values of a standard normal distribution
_NORMAL = norm.ppf((np.arange(400) + 0.5) / 400)


def stated_shares(task: Task) -> Floats:
    """Return stated over predicted u of every measurement for equal errors; zones are stated at their limit."""
    folded = folded_values(task)
    return np.array([folded[name].far_share() if name in folded else 1.0 for name in task.measurements])


def needed_by_tolerance(task: Task) -> dict[str, float]:
    """Return the largest standard uncertainty that fits, by measurement with a tolerance: of normal errors, no bias."""
    tolerances = {name: tolerance_of(task, name) for name in task.measurements}
    return {
        name: needed(screened_errors(1.0), tolerance) for name, tolerance in tolerances.items() if tolerance is not None
    }


def screened_errors(u: float) -> Floats:
    """Return errors that represent a screened uncertainty: normal, without bias."""
    return np.asarray(u * _NORMAL)
