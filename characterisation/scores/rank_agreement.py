"""Test whether a score orders views by their true errors: Spearman's rank correlation of score and error."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import rankdata

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
