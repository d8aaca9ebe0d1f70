"""Compare the predicted uncertainty of the checked views with the errors measured in them.

Signal chain: predicted standard uncertainty u and view score V_m, and the true error of every repeat -> rank
correlation of each with the error -> share of the errors within 2 u, and the median of |error| / u.

The module answers two separate questions:

- Does u order the views correctly? The rank correlation of u with the error is compared with the level that unrelated
  numbers reach.
- Is u of the right size? If it is, and the errors are normal, 95.45 % of them lie within 2 u
  (:mod:`characterisation.scores.coverage`). The median of |error| / u is then 0.67.

The error of an angle of nominally 0 deg is the length of a small vector, and u is its root mean square. Then 95.45 to
98.2 % lie within 2 u and the median is 0.67 to 0.83, depending on the ratio of the two components.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.stats import t

from characterisation.files.arrays import Floats
from characterisation.scores.coverage import NORMAL_COVERAGE, coverage_interval
from characterisation.scores.deciles import spearman

#: verdict on the order that u gives the checked views: it is right
CONFIRMED = "smaller u, smaller error"

#: verdict: the order is significantly reversed
REVERSED = "smaller u, larger error: do not trust it"
#: verdict: the rank correlation is not significant
CHANCE = "could be chance"

#: verdict: there is no rank correlation
TOO_FEW = "too few views to tell"


@dataclass(frozen=True)
class Agreement:
    """Prediction and errors of one measurement in the checked views, in the measurement's unit.

    Arrays have the shape (views,). ``possible`` says whether u rates the view as possible; ``uncertainty`` is u, NaN
    without a prediction; ``score`` is V_m. ``error`` is the mean, ``least`` and ``most`` are the extremes of |error|
    over the repeats with a value, NaN without any. ``failed`` is the share of repeats without a value.

    ``count`` is the number of views with a value. Over these, ``spearman`` is the rank correlation of u with ``error``;
    views that u rates as impossible rank last. ``score_spearman`` is that of V_m with minus ``error``. For both, 1 is
    perfect and NaN stands for fewer than 4 views. ``trials`` is the number of repeats with an error and a u. Over
    these, ``coverage`` is the share of errors within 2 u, ``low`` to ``high`` is its 95 % interval, and ``ratio`` is
    the median of |error| / u. They are NaN without trials.
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
        """Return whether significantly fewer than 95.45 % of the errors lie within 2 u (95 % interval)."""
        return self.high < NORMAL_COVERAGE

    @property
    def order(self) -> str:
        """Return the verdict on the order that u gives the checked views."""
        if not math.isfinite(self.spearman):
            return TOO_FEW
        if abs(self.spearman) < chance_level(self.count):
            return CHANCE
        return CONFIRMED if self.spearman > 0 else REVERSED


def agreement(scores: xr.Dataset, checks: xr.Dataset, measurement: str) -> Agreement:
    """Compare the uncertainties predicted for the checked views with the errors measured in them."""
    here = scores.sel(measurement=measurement, view=checks["view"].values)
    errors = np.abs(checks["error"].sel(measurement=measurement).transpose("view", "repeat").values.astype(float))
    valid = np.isfinite(errors)
    measured = valid.any(axis=1)
    error = np.full(len(errors), np.nan)
    error[measured] = np.nanmean(errors[measured], axis=1)
    least = np.min(errors, axis=1, where=valid, initial=np.inf)
    most = np.max(errors, axis=1, where=valid, initial=0.0)

    possible = here["uncertainty_possible"].values.astype(bool)
    uncertainty, score = here["predicted_uncertainty"].values, here["V_m"].values
    predicted = np.where(possible, uncertainty, np.inf)
    z = errors / np.where(uncertainty > 0, uncertainty, np.nan)[:, None]
    trials = z[np.isfinite(z)]
    return Agreement(
        checks["view"].values,
        possible,
        uncertainty,
        score,
        error,
        np.where(measured, least, np.nan),
        np.where(measured, most, np.nan),
        1 - valid.sum(axis=1) / np.maximum(_tried(checks, measurement), 1),
        int(measured.sum()),
        spearman(predicted[measured], error[measured]),
        spearman(score[measured], -error[measured]),
        len(trials),
        *coverage_interval(z),
        float(np.median(trials)) if len(trials) else math.nan,
    )


def _tried(checks: xr.Dataset, measurement: str) -> NDArray[np.int64]:
    """Return the number of trials made of every checked view; all of the table if it does not tell."""
    if "tried" not in checks:
        return np.full(checks.sizes["view"], checks.sizes["repeat"])
    return np.asarray(checks["tried"].sel(measurement=measurement).sum("repeat").values, np.int64)


def chance_level(count: int) -> float:
    """Return the size of rank correlation that unrelated pairs exceed in 5 % of cases (Student's approximation)."""
    if count < 4:
        return math.nan
    quantile = float(t.ppf(0.975, count - 2))
    return quantile / math.sqrt(count - 2 + quantile**2)
