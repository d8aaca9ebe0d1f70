"""Does the prediction hold? What was predicted of the checked views beside the errors that were found in them.

Signal chain: predicted standard uncertainty u and view score V_m, and the true error of every repeat -> rank
correlation of either with the error -> share of the errors within 2 u, and the median of |error| / u.

Two questions, answered apart. Whether u puts the views in the right order: its rank correlation with the error, against
the level that unrelated numbers reach. And whether u has the right size: if it has and the errors are normal, 95.45 %
of them lie within 2 u (:mod:`characterisation.scores.coverage`) and the median of |error| / u is 0.67.
An error that is the length of a small vector, as that of an angle of nominally 0 deg, has u as its root mean square: by
how alike its two components err, 95.45 to 98.2 % lie within 2 u and the median is 0.67 to 0.83.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.stats import t

from characterisation.scores.coverage import NORMAL_COVERAGE, coverage_interval
from characterisation.scores.rank_agreement import spearman

Floats = NDArray[np.float64]

#: what the checked views say of the order that u gives
CONFIRMED, REVERSED = "smaller u, smaller error", "smaller u, larger error: do not trust it"
CHANCE, TOO_FEW = "could be chance", "too few views to tell"


@dataclass(frozen=True)
class Agreement:
    """One measurement in the checked views, arrays (views,); uncertainties and errors in the measurement's unit.

    ``possible`` by u; ``uncertainty`` u, NaN where there is none; ``score`` V_m; ``error`` mean, ``least`` and ``most``
    of |error| over the repeats that could be measured, NaN where none could; ``failed`` share of repeats that could
    not.

    Over the ``count`` views that could be measured, ``spearman`` is the rank correlation of u with ``error``, views
    that u says to be impossible coming last, and ``score_spearman`` that of V_m with minus ``error``: 1 is perfect for
    both (NaN below 4 views). Over the ``trials``, repeats with an error and a u, ``coverage`` is the share of errors
    within 2 u, ``low`` to ``high`` its 95 % interval, and ``ratio`` the median of |error| / u; NaN without trials.
    """

    views: NDArray[np.int64]
    possible: NDArray[np.bool_]
    uncertainty: Floats
    score: Floats
    error: Floats
    least: Floats
    most: Floats
    failed: Floats
    count: int
    spearman: float
    score_spearman: float
    trials: int
    coverage: float
    low: float
    high: float
    ratio: float

    @property
    def optimistic(self) -> bool:
        """Whether fewer errors lie within 2 u than a right u leaves to chance: the interval ends below 95.45 %."""
        return self.high < NORMAL_COVERAGE

    @property
    def order(self) -> str:
        """What the checked views say of the order that u gives."""
        if not math.isfinite(self.spearman):
            return TOO_FEW
        if abs(self.spearman) < chance_level(self.count):
            return CHANCE
        return CONFIRMED if self.spearman > 0 else REVERSED


def agreement(scores: xr.Dataset, checks: xr.Dataset, measurement: str) -> Agreement:
    """Hold what was predicted of the checked views against what was measured in them."""
    here = scores.sel(measurement=measurement, view=checks["view"].values)
    errors = np.abs(checks["error"].sel(measurement=measurement).transpose("view", "repeat").values)
    known = np.isfinite(errors)
    some = known.any(axis=1)
    error = np.full(len(errors), np.nan)
    error[some] = np.nanmean(errors[some], axis=1)
    least, most = np.where(known, errors, np.inf).min(axis=1), np.where(known, errors, -np.inf).max(axis=1)

    possible = here["uncertainty_possible"].values.astype(bool)
    uncertainty, score = here["predicted_uncertainty"].values, here["V_m"].values
    predicted = np.where(possible, uncertainty, np.inf)
    z = errors / np.where(uncertainty > 0, uncertainty, np.nan)[:, None]
    trials = z[np.isfinite(z)]
    return Agreement(
        checks["view"].values, possible, uncertainty, score, error, np.where(some, least, np.nan),
        np.where(some, most, np.nan), 1 - known.mean(axis=1), int(some.sum()),
        spearman(predicted[some], error[some]), spearman(score[some], -error[some]),
        len(trials), *coverage_interval(z), float(np.median(trials)) if len(trials) else math.nan,
    )  # fmt: skip


def chance_level(count: int) -> float:
    """Size that the rank correlation of unrelated pairs exceeds one time in twenty (Student's approximation)."""
    if count < 4:
        return math.nan
    quantile = float(t.ppf(0.975, count - 2))
    return quantile / math.sqrt(count - 2 + quantile**2)
