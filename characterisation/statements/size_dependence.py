"""Find the drawn number on which the size of an error depends most, from the trials of a statement.

Signal chain: errors of trials, and the numbers that each drew -> rank correlation of every number with the absolute
error about the bias (Spearman, Am. J. Psychol. 15, 1904) -> the strongest, if chance among so many numbers hardly
explains it -> uncertainty, and share inside the interval, at both ends of that number.

A statement covers all draws together. A user has one part and one sensor. If the size of the error depends on a number
that is the same in all his captures, such as the finish, his errors are larger or smaller than stated, and a
measurement of that number tells which. A budget does not show this: it divides the variance by the *means* of errors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import spearmanr

from characterisation.files.arrays import Floats

#: largest probability that a dependence is reported although no number has one (Bonferroni); chosen
_CHANCE = 0.01

#: least ratio of the uncertainties at both ends that is worth a sentence; chosen
_WORTH = 1.5

#: least number of trials at each end, with which a standard deviation is known to 16 %; chosen
_LEAST = 20


@dataclass(frozen=True)
class DrawnNumber:
    """A number that trials drew: its ``group`` of unknowns, its ``name``, what it is ``of``, and ``values`` (n,).

    ``of`` is empty, or the name of the thing that has this number, such as a finish.
    """

    group: str
    name: str
    of: str
    values: Floats


@dataclass(frozen=True)
class SizeDependence:
    """Dependence of the size of an error on a drawn number. Pairs are for its low and its high values.

    Low and high values are the lowest and the highest third of the trials; of a number with two values, these.

    Parameters
    ----------
    group
        Group of unknowns.
    name
        Name of the number.
    of
        Thing that has this number, such as a finish; or empty.
    uncertainty
        Root mean square of the error about the bias of all trials, in the unit of the measurement.
    inside
        Share of these trials inside the stated interval [1].
    trials
        Number of these trials.
    """

    group: str
    name: str
    of: str
    uncertainty: tuple[float, float]
    inside: tuple[float, float]
    trials: tuple[int, int]


def size_dependence(
    errors: ArrayLike, interval: tuple[float, float], numbers: Sequence[DrawnNumber], days: ArrayLike
) -> SizeDependence | None:
    """Return the strongest dependence of the size of errors on a drawn number; None if none is sure and large.

    Parameters
    ----------
    errors
        (n,) of trials; NaN for trials without a value.
    interval
        Stated interval of the error.
    numbers
        Numbers that the trials drew, of which one is looked for.
    days
        (n,) days of the trials. The numbers are those of a day, so only the first trial of a day counts.
    """
    every, day = np.asarray(errors, float), np.asarray(days)
    first = np.zeros(len(every), bool)
    finite = np.flatnonzero(np.isfinite(every))
    first[finite[np.unique(day[finite], return_index=True)[1]]] = True
    error = every[first]
    if len(error) < 3 * _LEAST:
        return None
    apart = error - error.mean()
    varied = [
        (drawn_number, drawn_number.values[first]) for drawn_number in numbers if np.ptp(drawn_number.values[first]) > 0
    ]
    if not varied or not np.ptp(np.abs(apart)) > 0:
        return None
    tests = [spearmanr(np.abs(apart), values) for _, values in varied]
    strongest = int(np.argmax([abs(test.statistic) for test in tests]))
    if tests[strongest].pvalue * len(tests) > _CHANCE:
        return None
    number, values = varied[strongest]
    ends = _ends(values)
    trials = tuple(int(end.sum()) for end in ends)
    if min(trials) < _LEAST:
        return None
    low, high = (float(np.sqrt((apart[end] ** 2).mean())) for end in ends)
    if not max(low, high) >= _WORTH * min(low, high):
        return None
    held = (error >= interval[0]) & (error <= interval[1])
    return SizeDependence(
        number.group,
        number.name,
        number.of,
        (low, high),
        (float(held[ends[0]].mean()), float(held[ends[1]].mean())),
        (trials[0], trials[1]),
    )


def _ends(values: Floats) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return which trials have low values, and which have high ones."""
    kinds = np.unique(values)
    if len(kinds) == 2:
        return values == kinds[0], values == kinds[1]
    rank = np.argsort(np.argsort(values, kind="stable"), kind="stable")
    third = len(values) // 3
    return rank < third, rank >= len(values) - third
