"""Compute coverage intervals from trials, and standard errors due to their finite number.

Signal chain: errors of trials -> order statistics -> the interval that contains a further error. Leaving out a tenth of
the trials at a time -> standard error of any function of them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import beta, binom, t

from characterisation.files.arrays import Floats

#: coverage probability of the intervals
COVERAGE = 0.95

#: number of blocks into which the jackknife divides the trials
BLOCKS = 10


@dataclass(frozen=True)
class Share:
    """A share ``count`` of ``of``, and its 95 % interval [1]."""

    count: int
    of: int
    low: float
    high: float

    @property
    def value(self) -> float:
        """Return the share itself; NaN of none."""
        return self.count / self.of if self.of else float("nan")


def share(inside: ArrayLike) -> Share:
    """Return the share of true among independent trials (n,), with its exact interval (Clopper and Pearson 1934)."""
    covered = np.asarray(inside, bool)
    k, n = int(covered.sum()), len(covered)
    low = float(beta.ppf(0.025, k, n - k + 1)) if k else 0.0
    high = float(beta.ppf(0.975, k + 1, n - k)) if k < n else 1.0
    return Share(k, n, low, high if n else 1.0)


#: exponent of a factor so large that few trials set no limit; chosen
_NO_LIMIT = 50.0


def coverage_interval(errors: Floats, coverage: float = COVERAGE) -> tuple[float, float]:
    """Return the probabilistically symmetric coverage interval of a further trial, from the errors (n,) of trials.

    Its ends are the order statistics number (n + 1) (1 +- coverage) / 2, with linear interpolation. For every
    continuous distribution, a further trial lies between them with exactly the coverage probability on average (Wilks
    1941). With fewer than 2 / (1 - coverage) - 1 trials there are no such order statistics. The interval is then mean
    +- t s sqrt(1 + 1/n), exact for normal errors.
    """
    count = len(errors)
    tail = (1 - coverage) / 2
    if (count + 1) * tail < 1:
        half = float(t.ppf(1 - tail, count - 1)) * float(errors.std(ddof=1)) * math.sqrt(1 + 1 / count)
        return float(errors.mean()) - half, float(errors.mean()) + half
    low, high = np.quantile(errors, [tail, 1 - tail], method="weibull")
    return float(low), float(high)


def expanded_uncertainty(errors: Floats) -> float:
    """Return the end of the 95 % coverage interval of the error that is larger in absolute value."""
    low, high = coverage_interval(errors)
    return max(abs(low), abs(high))


def expanded_interval(errors: Floats, related: NDArray[np.int64] | None = None) -> tuple[float, float]:
    """Return the 95 % interval of the expanded uncertainty of many trials, from the errors (n,) of few.

    Both ends are order statistics, right for any distribution of independent errors. At most 5 % of many absolute
    errors exceed their expanded uncertainty, and 2.5 % lie beyond the end of their interval that is larger. So the
    number of n that do is at most, or is, binomial. For the high end this takes 146 trials, and repeated captures make
    it too low. It is therefore at least the estimate times exp(t s), with s the relative standard error by
    :func:`standard_errors`, and ``related`` as there. From fewer trials it is that alone, and too low if they lack the
    rare large errors.
    """
    count, half, tail = len(errors), expanded_uncertainty(errors), (1 - COVERAGE) / 2
    if not half > 0:
        return 0.0, 0.0
    exceeding = int(binom.isf(tail, count, 1 - COVERAGE)) + 1
    low = float(np.sort(np.abs(errors))[-min(exceeding, count)])
    moved = float(standard_errors(errors, lambda part: np.array([expanded_uncertainty(part)]), related)[0])
    high = half * factor_of_limits(moved / half)
    beyond = int(binom.ppf(tail, count, tail))  # so many or fewer: at least 2.5 %
    if beyond > 0:
        ordered = np.sort(errors)
        high = max(high, abs(float(ordered[beyond - 1])), abs(float(ordered[-beyond])))
    return min(low, half), high


def factor_of_limits(relative_error: float) -> float:
    """Return the factor between a positive number and its 95 % limits, from its relative standard error.

    The error is that of :func:`standard_errors`, so the logarithm is distributed as t. Infinite where few trials set no
    limit.
    """
    exponent = float(t.ppf(0.975, BLOCKS - 1)) * relative_error
    return math.exp(exponent) if exponent < _NO_LIMIT else math.inf


def errors_of_ends(errors: Floats) -> tuple[float, float]:
    """Return standard errors of the ends of the coverage interval, from the errors (n,) of independent trials.

    The number of errors beyond an end is binomial, so the share beyond it has the standard deviation
    sqrt(p (1 - p) / n), p = 0.025. Half the distance between the quantiles that far to either side is right for any
    distribution. The jackknife of :func:`standard_errors` alone is too small too often for a statement that stops as
    soon as it is settled.
    """
    tail = (1 - COVERAGE) / 2
    around = tail + math.sqrt(tail * (1 - tail) / len(errors)) * np.array([-1.0, 1.0])
    outer, inner = np.clip(around, 0.0, 1.0)
    low, high = (
        np.diff(np.quantile(errors, pair, method="weibull")) for pair in ((outer, inner), (1 - inner, 1 - outer))
    )
    return float(low[0]) / 2, float(high[0]) / 2


def standard_errors(
    errors: Floats, numbers: Callable[[Floats], Floats], related: NDArray[np.int64] | None = None
) -> Floats:
    """Return standard errors of ``numbers`` of the errors (n,), by a jackknife that leaves out a tenth at a time.

    Every tenth trial belongs to one block, so the order of the trials has no effect (Efron & Tibshirani 1993, 11.5,
    grouped). Trials with the same number in ``related`` (n,) are not independent, and are left out together.
    """
    group = np.arange(len(errors)) if related is None else np.unique(related, return_inverse=True)[1]
    several = int(group.max(initial=-1)) + 1
    blocks = min(BLOCKS, several)
    index = group % max(blocks, 1)
    if several < 3:
        return np.full(len(numbers(errors)), np.inf)
    left = np.array([numbers(errors[index != block]) for block in range(blocks)])
    return np.asarray(np.sqrt((blocks - 1) / blocks * ((left - left.mean(axis=0)) ** 2).sum(axis=0)))
