"""Test whether a score orders views by their true errors, and identifies the measurable ones, by rank statistics.

Signal chain: score of every view and its true error -> Spearman's rank correlation; score, and whether the view can be
measured -> area under the ROC curve.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import rankdata

Floats = NDArray[np.float64]

#: least number of pairs for a rank correlation
LEAST_PAIRS = 4


def spearman(x: ArrayLike, y: ArrayLike) -> float:
    """Return Spearman's rank correlation; ties have their mean rank (Kendall and Gibbons, "Rank Correlation Methods").

    It is NaN for fewer than 4 pairs, or where one of the two does not vary.
    """
    a, b = rankdata(x), rankdata(y)
    if len(a) < LEAST_PAIRS or np.ptp(a) == 0 or np.ptp(b) == 0:
        return math.nan
    a, b = a - a.mean(), b - b.mean()
    return float(np.clip(a @ b / math.sqrt((a @ a) * (b @ b)), -1.0, 1.0))


def roc_area(score: Floats, measurable: NDArray[np.bool_]) -> float:
    """Return the area under the ROC curve of a score that separates measurable views from the others.

    It is the probability that a measurable view scores higher than another, a tie counting as half (Mann and Whitney's
    U over its greatest value; Hanley and McNeil, Radiology 143 (1982) 29-36). Views predicted to be impossible, NaN or
    -inf, score lowest. The area is NaN, not defined, where all views are of one kind.
    """
    known = np.where(score > -np.inf, score, -np.inf)
    yes, no = known[measurable, None], known[~measurable]
    if not yes.size or not no.size:
        return math.nan
    return float((np.count_nonzero(yes > no) + np.count_nonzero(yes == no) / 2) / (yes.size * no.size))
