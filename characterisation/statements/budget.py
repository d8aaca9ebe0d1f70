"""Divide the variance of a measurement's error among the groups of unknowns, from the trials of its statement.

Signal chain: errors of trials, and what every group drew for them -> shares of the groups in the variance
(:mod:`characterisation.statements.variance_components`) -> a line for each group, with its 95 % interval. The lines add
up to the variance.

The line of a group is the variance that its draw alone explains. For drawn numbers, this is the variance of a linear
function of them, and of other functions of them that the caller states, such as squares; for a seed, the variance
between draws. *Interaction and unexplained* is what the captures of a day have in common and no group explains. *Noise*
is what differs between captures of a day and no group explains; interactions with noise and pose count there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import chi2

from characterisation.files.arrays import Floats
from characterisation.statements.one_sided import OneSidedErrors, stated_errors
from characterisation.statements.variance_components import RESIDUAL, Components, components

#: line that no group of unknowns explains and that is common to the captures of a day
INTERACTION = "interaction"

#: line that no group of unknowns explains and that is new in each capture
NOISE = "noise"

#: least number of trials with a value for a budget; chosen
LEAST_TRIALS = 30

#: width of the interval of a share above which the trials are too few to tell it; chosen
_TOO_WIDE = 0.5

#: half width of a 95 % interval, in standard errors
_HALF = 2.0


@dataclass(frozen=True)
class BudgetLine:
    """Contribution of one group of unknowns to the variance of an error. The lines of a budget add up to all of it.

    Parameters
    ----------
    group
        Name of the group, such as ``calibration``, ``finish``, ``light``, ``unit``, ``pose`` or ``noise``;
        ``interaction`` for what no group explains alone.
    variance
        Variance of the error by this group [unit^2].
    low
        Low end of the 95 % interval of ``variance``, for the stated variance of the error.
    high
        Its high end.
    share
        ``variance`` over the variance of the error by all groups.
    share_interval
        95 % interval of ``share``.
    settled
        Whether this interval is narrower than 0.5. Else the trials are too few to tell.
    """

    group: str
    variance: float
    low: float
    high: float
    share: float
    share_interval: tuple[float, float]
    settled: bool = True


class SizedLine(Protocol):
    """Size of a line of a budget, as in :class:`BudgetLine`."""

    @property
    def low(self) -> float:
        """Return the low end of the interval of the variance."""

    @property
    def high(self) -> float:
        """Return its high end."""

    @property
    def share(self) -> float:
        """Return the share in the whole variance."""

    @property
    def settled(self) -> bool:
        """Return whether the trials tell the share."""


_Line = TypeVar("_Line", bound=SizedLine)


def largest_line(lines: Sequence[_Line]) -> _Line | None:
    """Return the largest line of a budget; None without lines, or if the trials are too few to tell which it is.

    ``lines`` are sorted, the largest first.
    """
    if not lines:
        return None
    largest = lines[0]
    next_high = max((line.high for line in lines[1:]), default=0.0)
    told = largest.settled and (largest.low >= next_high or largest.share >= 0.5)
    return largest if told else None


def budget(
    errors: ArrayLike | OneSidedErrors, numbers: Mapping[str, ArrayLike], seeds: Mapping[str, ArrayLike]
) -> tuple[BudgetLine, ...]:
    """Return the budget of one measurement, largest contribution first; empty for under 30 trials with a value.

    Parameters
    ----------
    errors
        (n,) of trials, NaN for trials without a value. Errors of a value that folds are those at the limit of its
        tolerance.
    numbers
        By group, (n, p) independent numbers that it drew, and functions of them that are uncorrelated with these.
    seeds
        By group, (n,) whole numbers: trials with the same number have the same draw of the group. ``interaction`` has
        the day of each trial.

    See Also
    --------
    largest_line : the largest contribution

    Notes
    -----
    Intervals are those of twice the standard error. That of the noise is at least as wide as by chi-square with the
    degrees of freedom of Satterthwaite (1946).
    """
    every = stated_errors(errors) if isinstance(errors, OneSidedErrors) else np.asarray(errors, float)
    finite = np.isfinite(every)
    if finite.sum() < LEAST_TRIALS or not np.ptp(every[finite]) > 0:
        return ()
    drawn = float(every[finite].var(ddof=1))
    estimate = components(
        every[finite],
        {name: np.asarray(number, float)[finite] for name, number in numbers.items()},
        {name: np.asarray(seed)[finite] for name, seed in seeds.items()},
        errors.part(finite).gradients if isinstance(errors, OneSidedErrors) else None,
    )
    low, high = _intervals(estimate)
    lines = [
        BudgetLine(
            NOISE if name == RESIDUAL else name,
            drawn * float(estimate.shares[i]),
            drawn * float(low[i]),
            drawn * float(high[i]),
            float(estimate.shares[i]),
            (float(low[i]), float(high[i])),
            bool(high[i] - low[i] < _TOO_WIDE),
        )
        for i, name in enumerate(estimate.names)
    ]
    return tuple(sorted(lines, key=lambda line: -line.variance))


def _intervals(estimate: Components) -> tuple[Floats, Floats]:
    """Return the ends (m,) of the 95 % intervals of shares."""
    low = np.clip(estimate.shares - _HALF * estimate.errors, 0.0, 1.0)
    high = np.clip(estimate.shares + _HALF * estimate.errors, 0.0, 1.0)
    share, error = float(estimate.shares[-1]), float(estimate.errors[-1])
    if error > 0:
        degrees = max(2 * (share / error) ** 2, 1.0)
        ends = degrees * share / np.array([chi2.ppf(tail, degrees) for tail in (0.975, 0.025)])
        low[-1], high[-1] = min(low[-1], ends[0]), max(high[-1], min(ends[1], 1.0))
    return low, high
