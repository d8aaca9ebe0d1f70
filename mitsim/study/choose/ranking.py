"""Rank sensors by the demands of their measurements: fewest impossible measurements first, then the least worst demand.

Signal chain: demands of every sensor and measurement, infinite where impossible -> without tolerances, multiples of the
least of all sensors -> number of impossible measurements, then the other demands, largest first -> order.

A measurement that one sensor cannot make counts against this sensor. A measurement that no sensor can make counts
equally against all of them, and does not hide the others.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import ArrayLike

from characterisation.files.arrays import Floats

#: demand by screening, relative to the limit of the decision rule, above which a sensor is not measured; relative to
#: the best sensor's worst demand if that is above the limit as well
LARGEST_DEMAND = 3.0

#: reason why a sensor is not measured: no view can make any measurement
NONE_POSSIBLE = "no measurement possible"

#: reason: the best sensor can make more of the measurements
FEWER_POSSIBLE = "fewer measurements possible"

#: reason: its demand is over :data:`LARGEST_DEMAND`
OUT_BY_FAR = "out by far"

#: number of impossible measurements, and the demands of the others, largest first
RankKey = tuple[int, tuple[float, ...]]


def rank_key(demands: Iterable[float], impossible: int | None = None) -> RankKey:
    """Return the key that sorts sensors, best first, from the demands of one of them.

    ``demands`` are those of the measurements that are compared; infinite or NaN for an impossible one. ``impossible``
    is the number of impossible measurements, if others than those compared count too.
    """
    every = list(demands)
    possible = sorted((demand for demand in every if math.isfinite(demand)), reverse=True)
    return len(every) - len(possible) if impossible is None else impossible, tuple(possible)


def rank_keys(demands: ArrayLike, has_tolerance: ArrayLike, references: ArrayLike = True) -> list[RankKey]:
    """Return the key of every sensor from ``demands`` (sensor, measurement), infinite for an impossible measurement.

    If a sensor can make a measurement that ``has_tolerance`` (measurement,), only those with a tolerance are compared:
    the others have no limit. Impossible ones count with and without tolerance. If there are no tolerances, demands are
    in the unit of the measurement, and the least of the sensors ``references`` (sensor,), by default all, is 1.
    """
    table, compared = np.asarray(demands, float), np.asarray(has_tolerance, bool)
    impossible = (~np.isfinite(table)).sum(axis=1)
    table = table[:, compared] if np.isfinite(table[:, compared]).any() else relative_to_least(table, references)
    return [rank_key(row, int(count)) for row, count in zip(table.tolist(), impossible, strict=True)]


def relative_to_least(demands: ArrayLike, references: ArrayLike) -> Floats:
    """Return demands (sensor, measurement) as multiples of the least of the ``references``, a mask (sensor,).

    If no reference can make a measurement, the least of all sensors counts. Impossible ones stay infinite.
    """
    table = np.where(np.isfinite(np.asarray(demands, float)), demands, np.inf)
    chosen = np.broadcast_to(np.asarray(references, bool), len(table))
    least = np.min(table, axis=0, initial=np.inf, where=chosen[:, None])
    least = np.where(np.isfinite(least), least, np.min(table, axis=0, initial=np.inf))
    return np.where(np.isfinite(table), table / np.where(np.isfinite(least), least, 1.0), np.inf)


def unpromising(keys: Sequence[RankKey], tolerances: bool) -> list[str]:
    """Return for each screened sensor, by its key, the reason against measuring it, empty if it is promising.

    With ``tolerances`` the demands are relative to a limit; otherwise to those of the best sensor. A limit that the
    best sensor exceeds excludes no sensor that is about as good.
    """
    first = min(keys)
    least = max((1.0, *first[1]) if tolerances else first[1], default=math.inf)

    def reason(key: RankKey) -> str:
        if not key[1]:
            return NONE_POSSIBLE
        if key[0] > first[0]:
            return FEWER_POSSIBLE
        return OUT_BY_FAR if key != first and key[1][0] > LARGEST_DEMAND * least else ""

    return [reason(key) for key in keys]
