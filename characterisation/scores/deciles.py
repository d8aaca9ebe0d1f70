"""Divide views by their score into ten bins, and compare the bins with the true errors of the views.

Signal chain: score and true errors of every view -> bin of every view -> mean error and mean standard deviation of each
bin, with intervals -> ranks of the bins -> mean rank of each bin over several measurements and samples.

Kinnell and Justham, "Task Specific Viewpoint Optimisation" (2018): slides *Example Result* (the bins) and *View Score
Accuracy* (their mean rank). What the slides do not define is filled as follows.

* The bins hold equal shares of the possible views: bin 1 the tenth with the lowest scores, bin 10 the tenth with the
  highest.
* Views with equal scores share a bin: that of their mean rank.
* Views that are impossible by the score have no rank. They are bin 0, beside the ten.
* A view counts once in the mean of its bin, however many of its trials have a value.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray
from scipy import stats

from characterisation.files.arrays import Floats
from characterisation.files.errors import InputError

#: number of bins, beside that of impossible views
BINS = 10

#: bin of the views that are impossible by the score
IMPOSSIBLE = 0

#: confidence of the intervals of means
CONFIDENCE = 0.95

#: quantities of a bin
_QUANTITIES = {"error": "mean absolute error", "deviation": "standard deviation of the error"}


def bins_of(score: ArrayLike) -> NDArray[np.int64]:
    """Return the bin (view,) of every view: 1 to 10 by rising score, 0 where the score is not finite.

    A view of mean rank r (ties share it; 1 is the lowest) among n possible views is in bin floor(10 (r - 1/2) / n) + 1.
    """
    values = np.asarray(score, float)
    possible = np.isfinite(values)
    out = np.full(values.shape, IMPOSSIBLE, np.int64)
    if possible.any():
        rank = stats.rankdata(values[possible])
        out[possible] = np.floor(BINS * (rank - 0.5) / possible.sum() + 1e-9).astype(np.int64) + 1
    return out


def deciles(score: ArrayLike, error: ArrayLike, tried: ArrayLike | None = None) -> xr.Dataset:
    """Return the mean true error and standard deviation of the views in each decile of a score.

    Parameters
    ----------
    score
        (view,), larger is better; NaN or infinite for a view that is impossible by the score. A score that is better
        when small, such as a predicted uncertainty, is given with its sign changed.
    error
        (view,) or (view, trial) true errors, in any unit; NaN for a trial without a value. A view has a mean absolute
        error with one value or more, and a standard deviation with two or more.
    tried
        (view,) number of trials made of each view, those first in its row; by default all.

    Returns
    -------
    xarray.Dataset
        Over ``bin``, 0 (impossible by the score) to 10 (the best tenth): ``views``, their number; ``measured``, the
        number with a value in any trial; ``share``, the share of trials with a value [1]; ``score_low`` and
        ``score_high``; ``error`` and ``deviation``, means over the views of the mean absolute error and of the standard
        deviation, each with ``_low`` and ``_high``, the 95 % interval of the mean by Student's t (NaN for fewer than
        two views, not below 0); ``error_rank``, ``deviation_rank`` and ``share_rank``, see :func:`bin_ranks`. Rank 1
        is the largest share.

        Over ``view``: ``bin_of_view``. Attributes ``error_correlation``, ``deviation_correlation`` and
        ``share_correlation`` are Spearman's correlations of bin and rank: -1 if each better bin is better measured.

    Raises
    ------
    InputError
        If there is not one row of errors for each view.

    See Also
    --------
    mean_ranks : the ranks of bins over several measurements

    Examples
    --------
    >>> import characterisation
    >>> import numpy as np
    >>> score = np.arange(20.0)
    >>> found = characterisation.deciles(score, 20 - score)
    >>> found["error"].sel(bin=[1, 10]).values.tolist(), found.attrs["error_correlation"]
    ([19.5, 1.5], -1.0)
    """
    bins, errors = bins_of(score), np.asarray(error, float)
    if bins.ndim != 1 or errors.ndim not in (1, 2) or len(errors) != len(bins):
        allowed = f"({bins.size},) or ({bins.size}, trials), one row for each view"
        raise InputError("deciles", "error", f"the shape {errors.shape} for scores of {bins.shape}", allowed)
    errors = errors.reshape(len(bins), -1)
    made = np.full(len(bins), errors.shape[1]) if tried is None else np.asarray(tried)
    finite = np.isfinite(errors)
    count = finite.sum(axis=1)
    filled = np.where(finite, errors, 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        size = np.where(count > 0, np.abs(filled).sum(axis=1) / count, np.nan)
        mean = filled.sum(axis=1) / count
        square = (np.where(finite, errors - mean[:, None], 0.0) ** 2).sum(axis=1)
        spread = np.where(count > 1, np.sqrt(square / (count - 1)), np.nan)
    scores = np.asarray(score, float)
    rows: list[dict[str, float]] = []
    for number in range(BINS + 1):
        here = bins == number
        row: dict[str, float] = {
            "views": here.sum(),
            "measured": (count[here] > 0).sum(),
            "share": float(finite[here].sum() / made[here].sum()) if made[here].any() else math.nan,
            "score_low": float(scores[here].min()) if here.any() and number else math.nan,
            "score_high": float(scores[here].max()) if here.any() and number else math.nan,
        }
        for name, values in (("error", size), ("deviation", spread)):
            row[name], row[f"{name}_low"], row[f"{name}_high"] = mean_interval(values[here])
        rows.append(row)
    columns = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    correlations = {}
    smallest_best = {name: columns[name] for name in _QUANTITIES} | {"share": -columns["share"]}
    for name, values in smallest_best.items():
        columns[f"{name}_rank"] = ranks = bin_ranks(values, columns["views"])
        ranked = np.isfinite(ranks)
        correlations[f"{name}_correlation"] = spearman(np.flatnonzero(ranked), ranks[ranked])
    data: dict[str, Any] = {name: ("bin", values) for name, values in columns.items()}
    data |= {name: ("bin", columns[name], {"long_name": long_name}) for name, long_name in _QUANTITIES.items()}
    coordinates = {"bin": np.arange(BINS + 1), "view": np.arange(len(bins))}
    return xr.Dataset(data | {"bin_of_view": ("view", bins)}, coordinates, correlations)


def bin_ranks(values: ArrayLike, views: ArrayLike) -> Floats:
    """Return the rank (bin,) of the bins 1 to 10 by a quantity that is good when small; NaN for bin 0.

    ``values`` (bin,) are those of the bins 0 to 10, NaN without a value; ``views`` (bin,) are their numbers of views.
    Rank 1 is the smallest value. Equal values share their mean rank. A bin whose views have no value ranks after all
    others, since nothing can be measured from it; several such bins share a rank. A bin without views has no rank. If
    only k bins hold views, rank r of k becomes 10 (r - 1/2) / k + 1/2, so that cells of few views can be averaged.
    """
    quantity, occupied = np.asarray(values, float).copy(), np.asarray(views) > 0
    occupied[IMPOSSIBLE] = False
    out = np.full(len(quantity), np.nan)
    if occupied.any():
        worst_last = np.where(np.isfinite(quantity), quantity, np.inf)[occupied]
        out[occupied] = BINS * (stats.rankdata(worst_last) - 0.5) / occupied.sum() + 0.5
    return out


def mean_ranks(cells: Sequence[xr.Dataset], quantity: str = "error") -> xr.Dataset:
    """Return the mean rank of each bin over cells: measurements of samples, each from :func:`deciles`.

    ``quantity`` is ``error``, ``deviation`` or ``share``. The result has over ``bin`` 1 to 10: ``rank``, its 95 %
    interval ``rank_low`` and ``rank_high`` by Student's t, and ``cells``, the number that have a rank. Cells of one
    sample share their views, so the interval is somewhat too narrow. The attribute ``correlation`` is the mean rank
    correlation of bin and quantity over the ``correlated`` cells that have one, ``correlation_low`` and
    ``correlation_high`` its interval.
    """
    ranks = np.array([cell[f"{quantity}_rank"].values[1:] for cell in cells]).reshape(-1, BINS)
    rows = np.array([mean_interval(column[np.isfinite(column)]) for column in ranks.T])
    correlations = np.array([cell.attrs[f"{quantity}_correlation"] for cell in cells], float)
    interval = mean_interval(correlations[np.isfinite(correlations)], least=-1.0)
    ends = ("", "_low", "_high")
    attributes = {f"correlation{end}": value for end, value in zip(ends, interval, strict=True)}
    attributes["correlated"] = int(np.isfinite(correlations).sum())
    columns = {f"rank{end}": ("bin", column) for end, column in zip(ends, rows.T, strict=True)}
    columns["cells"] = ("bin", np.isfinite(ranks).sum(axis=0))
    return xr.Dataset(columns, {"bin": np.arange(1, BINS + 1)}, attributes)


def mean_interval(values: Floats, least: float = 0.0) -> tuple[float, float, float]:
    """Return the mean of finite values, and its 95 % interval by Student's t, cut off below ``least``.

    NaN values are skipped. The mean is NaN without a value, the interval with fewer than two.
    """
    finite = np.asarray(values, float)
    finite = finite[np.isfinite(finite)]
    if not len(finite):
        return math.nan, math.nan, math.nan
    mean = float(finite.mean())
    if len(finite) < 2:
        return mean, math.nan, math.nan
    half = float(stats.t.ppf(0.5 + CONFIDENCE / 2, len(finite) - 1) * finite.std(ddof=1) / math.sqrt(len(finite)))
    return mean, max(mean - half, least), mean + half


#: least number of pairs for a rank correlation
LEAST_PAIRS = 4


def spearman(x: ArrayLike, y: ArrayLike) -> float:
    """Return Spearman's rank correlation; ties have their mean rank (Kendall and Gibbons, "Rank Correlation Methods").

    It is NaN for fewer than 4 pairs, or where one of the two does not vary.
    """
    a, b = stats.rankdata(x), stats.rankdata(y)
    if len(a) < LEAST_PAIRS or np.ptp(a) == 0 or np.ptp(b) == 0:
        return math.nan
    a, b = a - a.mean(), b - b.mean()
    return float(np.clip(a @ b / math.sqrt((a @ a) * (b @ b)), -1.0, 1.0))
