"""What trials of a measurement say of its error: bias, standard uncertainty, coverage interval, numerical tolerance.

Signal chain: errors of all trials -> bias and standard deviation -> 95 % coverage interval -> how well the trials
determine these numbers -> whether that is good enough -> verdict against a tolerance.

An error is the measured value less the true one. If a user measures y, the true value lies in
[y - high, y - low] with the coverage probability, where [low, high] is the interval of the error (JCGM 101:2008, 5.5).
The bias is what is the same in every trial. It may be subtracted: a correction for a recognised systematic effect (JCGM
100:2008, 3.2.3), whose own uncertainty is that of a mean.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import t

from characterisation.statements.budget import BudgetLine

Floats = NDArray[np.float64]

#: coverage probability of the intervals
COVERAGE = 0.95

#: a measurement fits a tolerance if its 95 % interval takes at most this share of it: the 4 : 1 test uncertainty ratio
#: of ANSI/NCSL Z540.3
FITTING_SHARE = 0.25

#: parts that trials are divided into, to see how far their results still move
BLOCKS = 10

Verdict = Literal["fits", "does not fit", "not decided", "no tolerance"]


@dataclass(frozen=True)
class Statement:
    """The statement of one measurement from one view; in the measurement's unit (mm or deg).

    Parameters
    ----------
    trials, without_value
        Number of trials, and the share of them that gave no value.
    bias, bias_uncertainty
        Mean error, and its standard uncertainty from the finite number of trials.
    standard_uncertainty
        Standard deviation of the error about the bias: what is left if the user subtracts the bias, together with
        ``bias_uncertainty``.
    interval, interval_corrected
        95 % coverage interval of the error, (low, high); the same after the bias was subtracted.
    moved
        Standard errors of bias, standard uncertainty, low and high end from the finite number of trials.
    numerical_tolerance, settled
        delta of JCGM 101, 7.9.2 for one significant digit of the standard uncertainty, and whether twice every one of
        ``moved`` is below it.
    repeatability
        Standard deviation between captures of one day, from ``repeats``; NaN if nobody asked.
    budget
        Variance by group of unknowns, largest first; empty if nobody asked.
    tolerance, share_of_tolerance, share_interval, verdict
        Tolerance, half-width of the 95 % interval over it with its own 95 % interval, and the verdict.
    """

    measurement: str
    unit: str
    trials: int
    without_value: float
    bias: float
    bias_uncertainty: float
    standard_uncertainty: float
    interval: tuple[float, float]
    interval_corrected: tuple[float, float]
    moved: tuple[float, float, float, float]
    numerical_tolerance: float
    settled: bool
    repeatability: float
    budget: tuple[BudgetLine, ...]
    tolerance: float | None
    share_of_tolerance: float | None
    share_interval: tuple[float, float] | None
    verdict: Verdict

    @property
    def root_mean_square(self) -> float:
        """Root mean square error without correction."""
        return math.hypot(self.bias, self.standard_uncertainty)

    def after_repeats(self, captures: int) -> float:
        """Standard uncertainty of the mean of several captures of one day: what they share does not average out."""
        within = min(self.repeatability**2, self.standard_uncertainty**2)
        return math.sqrt(self.standard_uncertainty**2 - within * (1 - 1 / captures))


def statement(
    measurement: str, unit: str, errors: ArrayLike, tolerance: float | None = None,
    budget: tuple[BudgetLine, ...] = (), repeats: ArrayLike = (),
) -> Statement:  # fmt: skip
    """State a measurement from the errors (n,) of independent trials, NaN where a trial gave no value.

    ``repeats`` (m,) are errors of a second capture of the day of the first m trials.
    """
    every = np.asarray(errors, float)
    second = np.asarray(repeats, float)
    square = (every[: len(second)] - second) ** 2 / 2
    square = square[np.isfinite(square)]
    repeatability = math.sqrt(float(square.mean())) if len(square) else math.nan
    known = every[np.isfinite(every)]
    count = len(known)
    if count < 2:
        nan = math.nan
        return Statement(
            measurement, unit, len(every), 1 - count / max(len(every), 1), nan, nan, nan, (nan, nan), (nan, nan),
            (nan, nan, nan, nan), nan, False, repeatability, budget, tolerance, None, None,
            "no tolerance" if tolerance is None else "not decided",
        )  # fmt: skip
    bias, spread = float(known.mean()), float(known.std(ddof=1))
    low, high = coverage_interval(known)
    moved = standard_errors(known, lambda part: np.array([part.mean(), part.std(ddof=1), *coverage_interval(part)]))
    delta = numerical_tolerance(spread)
    share = shares = None
    verdict: Verdict = "no tolerance"
    if tolerance is not None:
        half = max(abs(low), abs(high))
        share = half / tolerance
        # of a scale that few trials determine only the order is known: an interval of its logarithm
        factor = math.exp(float(t.ppf(0.975, BLOCKS - 1)) * max(moved[2:]) / half) if half > 0 else 1.0
        shares = (share / factor, share * factor)
        verdict = (
            "fits" if shares[1] <= FITTING_SHARE else "does not fit" if shares[0] > FITTING_SHARE else "not decided"
        )
    return Statement(
        measurement, unit, len(every), 1 - count / len(every), bias, spread / math.sqrt(count), spread,
        (low, high), (low - bias, high - bias), (float(moved[0]), float(moved[1]), float(moved[2]), float(moved[3])),
        delta, bool((2 * moved < delta).all()), repeatability, budget, tolerance, share, shares, verdict,
    )  # fmt: skip


def coverage_interval(errors: Floats, coverage: float = COVERAGE) -> tuple[float, float]:
    """Probabilistically symmetric coverage interval of a next trial, from the errors (n,) of earlier ones.

    The order statistics number (n + 1) (1 +- coverage) / 2, linear in between: of all continuous distributions a next
    trial lies between them with exactly the coverage probability in the mean (Wilks 1941). Fewer trials than
    2 / (1 - coverage) - 1 have no such order statistics; then it is mean +- t s sqrt(1 + 1/n), exact for normal
    errors.
    """
    count = len(errors)
    tail = (1 - coverage) / 2
    if (count + 1) * tail < 1:
        half = float(t.ppf(1 - tail, count - 1)) * float(errors.std(ddof=1)) * math.sqrt(1 + 1 / count)
        return float(errors.mean()) - half, float(errors.mean()) + half
    low, high = np.quantile(errors, [tail, 1 - tail], method="weibull")
    return float(low), float(high)


def standard_errors(errors: Floats, numbers: Callable[[Floats], Floats]) -> Floats:
    """Standard errors of ``numbers`` of the errors (n,), by a jackknife that leaves out a tenth at a time.

    Every tenth trial belongs to one block, whatever order the trials came in (Efron & Tibshirani 1993, 11.5, grouped).
    """
    blocks = min(BLOCKS, len(errors))
    index = np.arange(len(errors)) % blocks
    if len(errors) < 3:
        return np.full(len(numbers(errors)), np.inf)
    left = np.array([numbers(errors[index != block]) for block in range(blocks)])
    return np.asarray(np.sqrt((blocks - 1) / blocks * ((left - left.mean(axis=0)) ** 2).sum(axis=0)))


def numerical_tolerance(uncertainty: float, digits: int = 1) -> float:
    """Numerical tolerance delta of an uncertainty: half of the last of its significant digits (JCGM 101, 7.9.2)."""
    if not uncertainty > 0:
        return 0.0
    power = math.floor(math.log10(uncertainty)) - (digits - 1)
    if round(uncertainty / 10.0**power) >= 10**digits:  # 0.0996 is 0.1
        power += 1
    return float(0.5 * 10.0**power)
