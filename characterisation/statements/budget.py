"""Compute the uncertainty budget: the contribution of each group of unknowns to the variance.

Signal chain: error of a trial, and of the same trial with one group of unknowns drawn again -> half the mean square of
their difference, the total effect of the group -> its share, with an interval.

The estimator is Jansen's (1999; Saltelli et al. 2010, table 2): V_g = E[(e - e_g)^2] / 2. It is the variance from the
group alone and in interaction with others. The shares add up to 1 where groups do not interact, and to more where they
do. Noise outside the group is the same in both trials and cancels.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import chi2

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class BudgetLine:
    """Contribution of one group of unknowns to the variance of an error.

    Interactions of groups count in each group that takes part, so the shares may add up to more than 1.

    Parameters
    ----------
    group
        Name of the group, such as ``calibration``, ``finish``, ``light``, ``unit``, ``pose`` or ``noise``.
    variance
        Variance of the error by this group [unit^2].
    low
        Low end of the 95 % interval of ``variance``, for normal errors. Heavy tails make it wider.
    high
        Its high end.
    share
        ``variance`` over the variance of the error by all groups.
    pairs
        Number of pairs of trials with a value that it rests on.
    """

    group: str
    variance: float
    low: float
    high: float
    share: float
    pairs: int


def budget(
    errors: ArrayLike, swapped: Mapping[str, ArrayLike], variance: float | None = None
) -> tuple[BudgetLine, ...]:
    """Return the budget of one measurement, largest contribution first.

    Parameters
    ----------
    errors
        (n,) of trials, NaN for trials without a value.
    swapped
        By group, errors (n,) of the same trials with that group drawn again.
    variance
        Of the error over all trials, which may be more; by default that of ``errors``.

    Notes
    -----
    The interval assumes normal differences: V times the pairs over a chi-square quantile.
    """
    base = np.asarray(errors, float)
    whole = float(np.nanvar(base, ddof=1)) if variance is None else variance
    lines = []
    for group, values in swapped.items():
        square = (base - np.asarray(values, float)) ** 2 / 2
        square = square[np.isfinite(square)]
        pairs = len(square)
        if not pairs:
            continue
        part = float(square.mean())
        low, high = (part * pairs / float(chi2.ppf(tail, pairs)) for tail in (0.975, 0.025))
        lines.append(BudgetLine(group, part, low, high, part / whole if whole > 0 else 0.0, pairs))
    return tuple(sorted(lines, key=lambda line: -line.variance))
