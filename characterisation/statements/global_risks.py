"""Global risks of accepting readings (JCGM 106, 9.5): means over the parts of a process, with the errors of trials."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from characterisation.files.arrays import Floats
from characterisation.statements.one_sided import OneSidedErrors
from characterisation.statements.tolerance import Tolerance
from characterisation.tasks.task_file import AT_FOLD

#: errors (n,) of trials, or those of a value that folds
Errors = Floats | OneSidedErrors


def limited_below(errors: Errors, tolerance: Tolerance) -> bool:
    """Return whether only the lower limit is one that values can exceed: those of a right angle are at most 90 deg."""
    return isinstance(errors, OneSidedErrors) and errors.fold == 90 and tolerance.upper >= 90 - AT_FOLD


def global_risks(errors: Errors, tolerance: Tolerance, limits: tuple[float, float] | None) -> tuple[float, float]:
    """Return the global consumer's and producer's risk (JCGM 106, 9.5) of accepting readings between ``limits``.

    They are means over parts of the tolerance's process, with equally likely errors (n,).
    """
    process, lower, upper = tolerance.process.cdf, tolerance.lower, tolerance.upper
    if isinstance(errors, OneSidedErrors):
        if math.isinf(lower):
            return _one_sided_risks(errors, process, upper, limits and limits[1])
        if limited_below(errors, tolerance):

            def deviations(size: Floats) -> Floats:
                return np.asarray(process(90 + size) - process(90 - size))

            return _one_sided_risks(errors, deviations, 90 - lower, limits and 90 - limits[0])
        errors = errors.stated
    conforming = float(process(upper) - process(lower))
    if limits is None:
        return 0.0, conforming
    a, b = limits[0] - errors, limits[1] - errors  # values whose reading lies at a limit
    below = process(np.minimum(lower, b)) - process(a)
    above = process(b) - process(np.maximum(upper, a))
    right = process(np.minimum(upper, b)) - process(np.maximum(lower, a))
    consumer = np.maximum(below, 0.0) + np.maximum(above, 0.0)
    return float(consumer.mean()), conforming - float(np.maximum(right, 0.0).mean())


def _one_sided_risks(
    errors: OneSidedErrors, process: Callable[[Any], Any], largest: float, limit: float | None
) -> tuple[float, float]:
    """Return the global risks of accepting readings of deviations up to a limit, of a value that folds.

    ``process`` is the distribution function of the deviations of the parts, of which those up to ``largest`` conform.
    No reading is accepted if ``limit`` is None.
    """
    conforming = float(process(largest))
    if limit is None:
        return 0.0, conforming
    low, high = errors.accepted_parts(limit)
    accepted = process(np.minimum(largest, high)) - process(np.minimum(largest, low))
    wrong = process(np.maximum(largest, high)) - process(np.maximum(largest, low))
    return float(wrong.mean()), float(conforming - accepted.mean())
