"""Is a predicted standard uncertainty as large as the errors that come? Share of errors inside 2 u.

Signal chain: true error of every repeat of every view, and the standard uncertainty u predicted of the view
-> z = error / u -> share of |z| up to 2 with its interval.

If u is right and the errors are normal, 95.45 % of them lie inside 2 u. An error that is the length of a small vector,
as that of an angle of nominally 0 deg, is never negative: its coverage is that of a Rayleigh variable,
1 - exp(-2) = 86.5 %, where u is the standard uncertainty of one component.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from characterisation.coupon.metrics import recovered_fraction

Floats = NDArray[np.float64]

#: errors are compared with so many standard uncertainties, and the share of a normal variable inside
COVERAGE_FACTOR = 2.0
NORMAL_COVERAGE = math.erf(COVERAGE_FACTOR / math.sqrt(2))


def coverage_interval(z: Floats, confidence: float = 0.95) -> tuple[float, float, float]:
    """Share of |z| up to 2, and its Clopper-Pearson interval.

    Repeats of one view share what is systematic in it, so they count as fewer trials than they are: p (1 - p) over the
    variance of p between views (Korn and Graubard, Survey Methodology 24 (1998) 193-201), at least one for each view
    and at most all. Where all lie inside, or none, the data do not tell, and each view counts as one.

    Parameters
    ----------
    z
        (views, repeats) with NaN for what is missing.

    Returns
    -------
    coverage, low, high
        NaN where there is no z.
    """
    known = np.isfinite(z)
    trials, inside = known.sum(axis=1), (known & (np.abs(z) <= COVERAGE_FACTOR)).sum(axis=1)
    total, views = int(trials.sum()), int((trials > 0).sum())
    if not total:
        return math.nan, math.nan, math.nan
    p = float(inside.sum() / total)
    effective = float(views)
    if 0 < p < 1 and views > 1:
        variance = views / (views - 1) * float(((inside - p * trials) ** 2).sum()) / total**2
        effective = float(np.clip(p * (1 - p) / variance, views, total)) if variance > 0 else float(total)
    _, low, high = recovered_fraction(p * effective, effective, confidence)
    return p, float(low), float(high)
