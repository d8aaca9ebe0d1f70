"""Test the size of predicted standard uncertainties: the share of errors within 2 u.

Signal chain: true error of every repeat of every view, and the predicted standard uncertainty u of the view -> z =
error / u -> share of |z| up to 2 with its interval.

If u is right and the errors are normal, 95.45 % of them lie within 2 u. The length of a small vector is never negative,
such as the error of an angle of nominally 0 deg. If u is the standard uncertainty of one component, it has the coverage
of a Rayleigh variable, 1 - exp(-2) = 86.5 %.
"""

from __future__ import annotations

import math

import numpy as np

from characterisation.coupon.metrics import recovered_fraction
from characterisation.files.arrays import Floats

#: number of standard uncertainties with which errors are compared, and the share of a normal variable within them
COVERAGE_FACTOR = 2.0
NORMAL_COVERAGE = math.erf(COVERAGE_FACTOR / math.sqrt(2))


def coverage_interval(z: Floats) -> tuple[float, float, float]:
    """Return the share of |z| up to 2, and the ends of its 95 % Clopper-Pearson interval; NaN without any z.

    ``z`` (views, repeats) is NaN for missing values. Repeats of one view have systematic errors in common, so they
    count as fewer trials. The effective number is p (1 - p) over the variance of p between views (Korn and Graubard,
    Survey Methodology 24 (1998) 193-201), but at least the number of views and at most that of all trials. Where all
    errors or none lie within 2 u, this variance is unknown, and each view counts as one trial.
    """
    finite = np.isfinite(z)
    trials, inside = finite.sum(axis=1), (finite & (np.abs(z) <= COVERAGE_FACTOR)).sum(axis=1)
    total, views = int(trials.sum()), int((trials > 0).sum())
    if not total:
        return math.nan, math.nan, math.nan
    p = float(inside.sum() / total)
    effective = float(views)
    if 0 < p < 1 and views > 1:
        variance = views / (views - 1) * float(((inside - p * trials) ** 2).sum()) / total**2
        effective = float(np.clip(p * (1 - p) / variance, views, total)) if variance > 0 else float(total)
    _, low, high = recovered_fraction(p * effective, effective)
    return p, float(low), float(high)
