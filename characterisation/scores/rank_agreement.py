"""Does a score put views in the order of their true errors, and tell which can be measured? Rank statistics.

Signal chain: score of every view and its true error -> Spearman's rank correlation; score and *can be measured or not*
-> area under the ROC curve.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import rankdata

Floats = NDArray[np.float64]

#: with fewer pairs a rank correlation says nothing
LEAST_PAIRS = 4


def spearman(x: ArrayLike, y: ArrayLike) -> float:
    """Spearman's rank correlation, ties having their mean rank (Kendall and Gibbons, "Rank Correlation Methods").

    NaN for fewer than 4 pairs, or where one of the two does not vary.
    """
    a, b = rankdata(x), rankdata(y)
    if len(a) < LEAST_PAIRS or np.ptp(a) == 0 or np.ptp(b) == 0:
        return math.nan
    a, b = a - a.mean(), b - b.mean()
    return float(np.clip(a @ b / math.sqrt((a @ a) * (b @ b)), -1.0, 1.0))


def roc_area(score: Floats, measurable: NDArray[np.bool_]) -> float:
    """Area under the ROC curve of a score that should tell measurable views from the others.

    The chance that a measurable view scores higher than one that is not, a tie counting as half (Mann and Whitney's U
    over its greatest value; Hanley and McNeil, Radiology 143 (1982) 29-36). Views said to be impossible, NaN or -inf,
    score lowest. NaN, not defined, where all views are of one kind.
    """
    yes, no = int(measurable.sum()), int((~measurable).sum())
    if yes == 0 or no == 0:
        return math.nan
    ranks = rankdata(np.where(score > -np.inf, score, -np.inf))
    return float((ranks[measurable].sum() - yes * (yes + 1) / 2) / (yes * no))
