"""Coverage intervals from trials, and how well a finite number of trials determines anything.

Signal chain: errors of trials -> order statistics -> the interval that holds a next error; leaving out a tenth of them
at a time -> standard error of any function of them.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t

Floats = NDArray[np.float64]

#: coverage probability of the intervals
COVERAGE = 0.95

#: parts that trials are divided into, to see how far their results still move
BLOCKS = 10


def coverage_interval(errors: Floats, coverage: float = COVERAGE) -> tuple[float, float]:
    """Probabilistically symmetric coverage interval of a next trial, from the errors (n,) of earlier ones.

    The order statistics number (n + 1) (1 +- coverage) / 2, linear in between: of all continuous distributions a next
    trial lies between them with exactly the coverage probability in the mean (Wilks 1941). Fewer trials than
    2 / (1 - coverage) - 1 have no such order statistics; then it is mean +- t s sqrt(1 + 1/n), exact for normal
    errors.
    """
    count = len(errors)
    tail = (1 - coverage) / 2
    if (count + 1) * tail < 1:
        half = float(t.ppf(1 - tail, count - 1)) * float(errors.std(ddof=1)) * math.sqrt(1 + 1 / count)
        return float(errors.mean()) - half, float(errors.mean()) + half
    low, high = np.quantile(errors, [tail, 1 - tail], method="weibull")
    return float(low), float(high)


def standard_errors(errors: Floats, numbers: Callable[[Floats], Floats]) -> Floats:
    """Standard errors of ``numbers`` of the errors (n,), by a jackknife that leaves out a tenth at a time.

    Every tenth trial belongs to one block, whatever order the trials came in (Efron & Tibshirani 1993, 11.5, grouped).
    """
    blocks = min(BLOCKS, len(errors))
    index = np.arange(len(errors)) % blocks
    if len(errors) < 3:
        return np.full(len(numbers(errors)), np.inf)
    left = np.array([numbers(errors[index != block]) for block in range(blocks)])
    return np.asarray(np.sqrt((blocks - 1) / blocks * ((left - left.mean(axis=0)) ** 2).sum(axis=0)))
