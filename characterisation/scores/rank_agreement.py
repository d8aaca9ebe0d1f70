"""Does a score put views in the order of their true errors? Rank statistics of one score against one truth.

Signal chain: score of every view, higher is better, and its true error -> ten bins of equal numbers of views, best
first, and the views said to be impossible apart -> Spearman's rank correlation with its interval; and area under the
ROC curve of *can be measured or not*.

Two ends meet here that have no number. A score of NaN or -inf says that the measurement is impossible from that view:
it ranks below every other score. A true error of NaN says that it was impossible: it ranks above every other error.
Views at either end are tied with one another.

Every correlation is of the score with *minus* the error, so that 1 is a perfect score and -1 a reversed one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import rankdata

Floats = NDArray[np.float64]
Seed = int | Sequence[int]

#: the talk's bins "at 10 % intervals"; the bin after the last holds the views said to be impossible
DECILES = 10
IMPOSSIBLE = DECILES

#: with fewer pairs a rank correlation says nothing
LEAST_PAIRS = 4

#: resamples of the bootstrap: the ends of a normal 95 % interval then scatter by 2 % of its width,
#: sqrt(0.025 0.975 / 1000) / phi(1.96) = 0.085 of its 3.92 standard deviations
RESAMPLES = 1000

#: resamples that are held in memory together
_AT_ONCE = 200


def said_possible(score: Floats) -> NDArray[np.bool_]:
    """Which views a score says to be possible: neither NaN nor -inf."""
    return np.asarray(score > -np.inf)


def deciles(score: Floats, seed: Seed = 0) -> NDArray[np.int64]:
    """Number of the bin of every view, by its score.

    Parameters
    ----------
    score
        (views,), higher is better; NaN or -inf where the view is said to be impossible.
    seed
        Views of equal score are put in a random order; the same seed gives the same.

    Returns
    -------
    ndarray
        (views,) 0, the best tenth of the possible views, to 9, the worst; and :data:`IMPOSSIBLE`. The bins' numbers of
        views differ by one at most; of fewer than ten possible views some bins are empty, never the first.
    """
    possible = np.flatnonzero(said_possible(score))
    draw = np.random.default_rng(seed).random(len(score))
    best_first = possible[np.lexsort((draw[possible], -score[possible]))]
    bins = np.full(len(score), IMPOSSIBLE, np.int64)
    bins[best_first] = np.arange(len(best_first)) * DECILES // max(len(best_first), 1)
    return bins


def agreement_ranks(score: Floats, error: Floats) -> tuple[Floats, Floats]:
    """Ranks (views,) of the scores and of minus the errors, 1 is worst, ties have their mean rank.

    The impossible scores, and the errors that nobody could measure, are tied at the worst rank.
    """
    scores = rankdata(np.where(said_possible(score), score, -np.inf))
    errors = rankdata(-np.where(np.isnan(error), np.inf, error))
    return np.asarray(scores, float), np.asarray(errors, float)


def spearman(x: ArrayLike, y: ArrayLike) -> float:
    """Spearman's rank correlation, ties having their mean rank (Kendall and Gibbons, "Rank Correlation Methods").

    NaN for fewer than 4 pairs, or where one of the two does not vary.
    """
    a, b = rankdata(x), rankdata(y)
    if len(a) < LEAST_PAIRS or np.ptp(a) == 0 or np.ptp(b) == 0:
        return math.nan
    a, b = a - a.mean(), b - b.mean()
    return float(np.clip(a @ b / math.sqrt((a @ a) * (b @ b)), -1.0, 1.0))


def spearman_interval(
    x: ArrayLike, y: ArrayLike, seed: Seed = 0, confidence: float = 0.95, resamples: int = RESAMPLES
) -> tuple[float, float]:
    """Interval of Spearman's rank correlation: percentiles of the bootstrap over the pairs (Efron, 1979).

    It takes the pairs as independent. Neighbouring views are not: what is systematic in their errors they share, and
    the interval is then too narrow. NaN where the correlation has no value.
    """
    a, b = rankdata(x), rankdata(y)
    if math.isnan(spearman(a, b)):
        return math.nan, math.nan
    draw, count = np.random.default_rng(seed), len(a)
    parts = []
    for first in range(0, resamples, _AT_ONCE):
        times = draw.multinomial(count, np.full(count, 1 / count), size=min(_AT_ONCE, resamples - first))
        p, q = (_resampled_ranks(ranks, times) - (count + 1) / 2 for ranks in (a, b))
        variances = (times * p**2).sum(axis=1) * (times * q**2).sum(axis=1)
        varied = variances > 0  # a resample of one view, drawn again and again, has no correlation
        parts.append((times * p * q).sum(axis=1)[varied] / np.sqrt(variances[varied]))
    found = np.concatenate(parts)
    tail = (1 - confidence) / 2
    low, high = np.quantile(found, [tail, 1 - tail]) if len(found) else (math.nan, math.nan)
    return float(low), float(high)


def roc_area(score: Floats, measurable: NDArray[np.bool_]) -> float:
    """Area under the ROC curve of a score that should tell measurable views from the others.

    The chance that a measurable view scores higher than one that is not, a tie counting as half (Mann and Whitney's U
    over its greatest value; Hanley and McNeil, Radiology 143 (1982) 29-36). Views said to be impossible score lowest.
    NaN, not defined, where all views are of one kind.
    """
    yes, no = int(measurable.sum()), int((~measurable).sum())
    if yes == 0 or no == 0:
        return math.nan
    ranks, _ = agreement_ranks(score, np.zeros(len(measurable)))
    return float((ranks[measurable].sum() - yes * (yes + 1) / 2) / (yes * no))


def roc_curve(score: Floats, measurable: NDArray[np.bool_]) -> tuple[Floats, Floats]:
    """ROC curve: shares of the unmeasurable and of the measurable views that score at least so much.

    Returns
    -------
    false, true
        Both from 0 to 1, one point for each value of the score, best first; views said to be impossible are the last.
        Empty where all views are of one kind.
    """
    yes, no = int(measurable.sum()), int((~measurable).sum())
    if yes == 0 or no == 0:
        return np.empty(0), np.empty(0)
    ranks, _ = agreement_ranks(score, np.zeros(len(measurable)))
    values = np.unique(ranks)[::-1]
    reached = ranks[None] >= values[:, None]
    false, true = reached[:, ~measurable].sum(axis=1) / no, reached[:, measurable].sum(axis=1) / yes
    return np.append(0.0, false), np.append(0.0, true)


def _resampled_ranks(values: Floats, times: NDArray[np.int64]) -> Floats:
    """Ranks (resamples, n) of values (n,) that are there ``times`` (resamples, n) times; ties have their mean rank."""
    order = np.argsort(values, kind="stable")
    _, first, group = np.unique(values[order], return_index=True, return_inverse=True)
    sizes = np.add.reduceat(times[:, order], first, axis=1)
    ranks = np.empty(times.shape)
    ranks[:, order] = (np.cumsum(sizes, axis=1) - (sizes - 1) / 2)[:, group]
    return ranks
