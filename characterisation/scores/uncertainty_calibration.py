"""Is a predicted standard uncertainty as large as the errors that come? Its coverage, and the distribution of z.

Signal chain: true error of every repeat of every view, and the standard uncertainty u predicted of the view
-> z = error / u -> share of |z| up to 2 with its interval; root mean square, mean and shape of z; and the same by
decile of u, with the root mean square of the error beside u.

If u is right and the errors are normal, 95.45 % of them lie inside 2 u and z has a root mean square of 1. An error that
is the length of a small vector, as that of an angle of nominally 0 deg, is never negative: its z cannot be normal, and
its coverage is that of a Rayleigh variable, 1 - exp(-2) = 86.5 %, where u is the standard uncertainty of one component.

Repeats that the measurement failed in, and views without a prediction, take no part here: whether they were foretold is
what the ROC curve is for.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import normaltest

from characterisation.coupon.metrics import recovered_fraction
from characterisation.scores.rank_agreement import DECILES, Seed, deciles

Floats = NDArray[np.float64]

#: errors are held against so many standard uncertainties, and the share of a normal variable inside
COVERAGE_FACTOR = 2.0
NORMAL_COVERAGE = math.erf(COVERAGE_FACTOR / math.sqrt(2))

#: D'Agostino and Pearson's test is a large-sample one
LEAST_FOR_NORMALITY = 20

#: z that vary by less, relative to their size, are the same to rounding
_LEAST_VARIATION = 1e-9


@dataclass(frozen=True)
class Calibration:
    """How true errors compare with their predicted standard uncertainties.

    ``views`` and ``trials``, views times repeats, that have both; ``coverage`` share of the trials with |z| up to 2,
    and its 95 % interval ``low``, ``high``; ``z_rms`` root mean square of z, over 1 where u is too small; ``z_mean``;
    ``skewness`` and ``excess_kurtosis`` of z, 0 for a normal variable; ``p_normal`` of D'Agostino and Pearson's test
    on one z of each view, NaN for fewer than 20 views. All are NaN where they have no value.
    """

    views: int
    trials: int
    coverage: float
    low: float
    high: float
    z_rms: float
    z_mean: float
    skewness: float
    excess_kurtosis: float
    p_normal: float


@dataclass(frozen=True)
class CalibrationDeciles:
    """The same by decile of u, smallest u first; arrays (10,), NaN where a bin is empty.

    ``uncertainty`` and ``error``: root mean squares over the trials [unit of the measurement].
    """

    views: NDArray[np.int64]
    uncertainty: Floats
    error: Floats
    coverage: Floats
    low: Floats
    high: Floats


def calibrate(z: Floats) -> Calibration:
    """Coverage and distribution of z.

    Parameters
    ----------
    z
        (views, repeats) true error over predicted standard uncertainty, NaN where either is missing.
    """
    z = z[np.isfinite(z).any(axis=1)]
    if not len(z):
        return Calibration(0, 0, *(math.nan,) * 8)
    every = z[np.isfinite(z)]
    first = np.take_along_axis(z, np.isfinite(z).argmax(axis=1)[:, None], axis=1)[:, 0]
    m2, m3, m4 = (float(((every - every.mean()) ** power).mean()) for power in (2, 3, 4))
    shaped = m2 > (_LEAST_VARIATION * np.abs(every).max()) ** 2
    varied = np.ptp(first) > _LEAST_VARIATION * np.abs(first).max()
    testable = varied and len(first) >= LEAST_FOR_NORMALITY
    return Calibration(
        len(z), len(every), *coverage_interval(z),
        z_rms=float(np.sqrt((every**2).mean())), z_mean=float(every.mean()),
        skewness=m3 / m2**1.5 if shaped else math.nan, excess_kurtosis=m4 / m2**2 - 3 if shaped else math.nan,
        p_normal=float(normaltest(first).pvalue) if testable else math.nan,
    )  # fmt: skip


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


def calibrate_by_decile(error: Floats, uncertainty: Floats, seed: Seed = 0) -> CalibrationDeciles:
    """Errors beside uncertainties, in ten bins of equal numbers of views by u.

    Parameters
    ----------
    error
        (views, repeats) true error, NaN where it could not be measured.
    uncertainty
        (views,) predicted standard uncertainty, in the same unit, NaN where there is none.
    seed
        Views of equal u are put in a random order.
    """
    usable = np.isfinite(error).any(axis=1) & (uncertainty > 0)
    error, uncertainty = error[usable], uncertainty[usable]
    bins = deciles(-uncertainty, seed)
    rows = []
    for number in range(DECILES):
        e, u = error[bins == number], uncertainty[bins == number]
        known = np.isfinite(e)
        every_u = np.broadcast_to(u[:, None], e.shape)[known]
        rows.append((len(u), _rms(every_u), _rms(e[known]), *coverage_interval(e / u[:, None])))
    views, *columns = (np.array(column) for column in zip(*rows, strict=True))
    return CalibrationDeciles(views, *columns)


def _rms(values: Floats) -> float:
    return float(np.sqrt((values**2).mean())) if len(values) else math.nan
