"""Decide from trials which readings a rule accepts, with which risks, and whether a measurement is suitable.

Signal chain: errors of all trials, tolerance and rule -> guard band -> accepted readings -> probabilities of a false
accept and a false reject -> whether the demand of the rule is met, and the standard uncertainty that would meet it.

A reading is y = x + e, with the value x of a part and an error e. The errors are those of the trials, without a fitted
distribution, so heavy tails are included. They were drawn on a part of nominal values, and are assumed equal over the
whole tolerance.

The value of a zone is the size of a vector, to which the error adds as a vector. Its errors are those of a part at the
limit of the tolerance, deviating in random directions (:mod:`characterisation.statements.one_sided`). JCGM 106 uses
the readings of each trial at all values x; the risks are then means of G over the parts that a trial accepts. Angles of
nominally 90 deg are at most 90 deg. Only their lower limit can be exceeded, and JCGM 106 uses their deviations from 90
deg, of which G is that of both signs.

- ISO 14253-1: y is accepted if lower + U <= y <= upper - U. The expanded uncertainty U is the end of the 95 % coverage
  interval of the error that is larger in absolute value. It therefore contains a bias that is not subtracted (ISO/TS
  15530-4, 8; JCGM 100, F.2.4.5). With ``subtract_bias``, the interval is that of the corrected reading, and each limit
  uses its own end.
- JCGM 106:2012, 9.5: the guard band w >= 0 is the smallest for which the global consumer's risk is at most the stated
  one. This risk is the probability that a part does not conform and is accepted. For one error e and the distribution
  function G of the process,

      R_C(e) = G(min(lower, b - e)) - G(a - e)  +  G(b - e) - G(max(upper, a - e)),  each part if positive,

  with acceptance limits a, b. The risk is the mean over the trials, eq. (17) there; R_P, eq. (18), likewise.
- Simple acceptance, JCGM 106, 8.2: a = lower, b = upper.

A true value *at* a limit is the worst case. Just outside the limit, a part is falsely accepted with the probability
that its reading is accepted. Just inside, it is falsely rejected with the complementary probability.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.stats import norm

from characterisation.files.arrays import Floats
from characterisation.statements.coverage import (
    COVERAGE,
    coverage_interval,
    expanded_interval,
    expanded_uncertainty,
    factor_of_limits,
    share,
    standard_errors,
)
from characterisation.statements.global_risks import Errors, global_risks, limited_below
from characterisation.statements.one_sided import OneSidedErrors, stated_errors, without_bias
from characterisation.statements.tolerance import Tolerance

#: least number of trials whose order statistics give the coverage interval
FEW = round(2 / (1 - COVERAGE)) - 1

#: errors with a normal distribution, a mean of 0 and a standard deviation of 1
_NORMAL = norm.ppf((np.arange(1000) + 0.5) / 1000)
_NORMAL /= _NORMAL.std(ddof=1)

Verdict = Literal["fits", "does not fit", "undecidable", "not decided", "no tolerance"]


@dataclass(frozen=True)
class Decided:
    """Decision on a measurement and its tolerance, by a rule; in the measurement's unit.

    Parameters
    ----------
    rule
        In words.
    accepted
        Accepted readings, from and to (for a zone: from -inf), with the bias subtracted if the rule says so; None if no
        reading is accepted.
    demand, demand_interval
        The demand of the rule as a ratio, at most 1 if the measurement is suitable, with its 95 % interval from the
        finite number of trials. ISO 14253-1: share of the tolerance that the guard band takes, over ``guard_share``.
        JCGM 106: the producer's risk over the stated one. Simple acceptance: the required ratio over the actual one.
    verdict
        - ``fits``: the demand is met.
        - ``does not fit``: the demand is not met.
        - ``undecidable``: no reading can be accepted, also at the low end of the 95 % interval of the expanded
          uncertainty, or with JCGM 106 of the risk that the largest guard band leaves; or no value was measured.
        - ``not decided``: too few trials to decide, such as a single one with a value, or less than five without one.
    fits_corrected
        Whether it fits if the bias is subtracted.
    needed
        Largest standard uncertainty that fits, for a sensor without bias and with the same distribution of errors.
    false_accept, false_accept_interval
        Probability of accepting a part whose value lies just outside the tolerance, at the worse limit; its 95 %
        interval from the number of trials.
    false_reject, false_reject_nominal
        Probability of rejecting a part whose value lies just inside, at the worse limit; or in the middle of the
        tolerance (for a zone: a perfect part).
    consumer_risk, producer_risk
        Global risks over the parts of the process; None without a process.
    """

    rule: str
    accepted: tuple[float, float] | None
    demand: float
    demand_interval: tuple[float, float]
    verdict: Verdict
    fits_corrected: bool
    needed: float
    false_accept: float
    false_accept_interval: tuple[float, float]
    false_reject: float
    false_reject_nominal: float
    consumer_risk: float | None
    producer_risk: float | None


def mostly_lost(trials: int) -> bool:
    """Return whether so many trials, all without a value, show that at least half of all have none, with 95 %."""
    return 0.5**trials <= 0.05


def decide(
    errors: Errors, tolerance: Tolerance, lost: int | None = None, related: NDArray[np.int64] | None = None
) -> Decided:
    """Decide from the errors of trials with a value whether a measurement fits its tolerance.

    Parameters
    ----------
    errors
        (n,) of trials with a value.
    tolerance
        Tolerance and rule.
    lost
        Number of trials without a value; by default enough to call a measurement without any undecidable.
    related
        (n,) whole numbers: trials with the same number have draws in common. By default all are independent.
    """
    rule = tolerance.rule
    if len(errors) < 2:
        nan = math.nan
        few = len(errors) > 0 or (lost is not None and not mostly_lost(lost))
        unsure: Verdict = "not decided" if few else "undecidable"
        return Decided(rule.in_words, None, nan, (nan, nan), unsure, False, nan, nan, (nan, nan), nan, nan, None, None)
    bias = float(stated_errors(errors).mean())
    taken: Errors = without_bias(errors, bias) if rule.subtract_bias else errors
    limits = acceptance(taken, tolerance)
    asked = demand(taken, tolerance)
    low, high = _demand_interval(taken, tolerance, asked, related)
    corrected = demand(without_bias(errors, bias), tolerance) if not rule.subtract_bias else asked
    verdict: Verdict = "not decided"
    if high <= 1:
        verdict = "fits"
    elif low > 1:
        hopeless = limits is None and _hopeless(errors, tolerance, low, related)
        verdict = "undecidable" if hopeless else "does not fit"
    edges = [edge for edge in (tolerance.lower, tolerance.upper) if math.isfinite(edge)]
    if limited_below(taken, tolerance):
        edges = [tolerance.lower]
    through = [share(_within(edge + _errors_at(taken, edge), limits)) for edge in edges]
    worst = max(through, key=lambda probability: probability.value)
    risks = None if rule.rule != "jcgm_106" else global_risks(taken, tolerance, limits)
    return Decided(
        rule.in_words,
        limits,
        asked,
        (low, high),
        verdict,
        corrected <= 1,
        needed(errors, tolerance),
        worst.value,
        (worst.low, worst.high),
        1 - min(probability.value for probability in through),
        1 - float(_within(tolerance.middle + _errors_at(taken, tolerance.middle), limits).mean()),
        *(risks or (None, None)),
    )


def _hopeless(errors: Errors, tolerance: Tolerance, low: float, related: NDArray[np.int64] | None) -> bool:
    """Return whether surely no reading is accepted, by the ``low`` end of the demand; of JCGM 106 by the risk left."""
    rule = tolerance.rule
    if rule.rule != "jcgm_106":
        return low >= (1 / rule.largest_share if rule.rule == "iso_14253_1" else rule.least_ratio)
    assert rule.consumer_risk is not None
    narrowest, most = (tolerance.lower + tolerance.size, tolerance.upper - tolerance.size), rule.consumer_risk

    def left(part: Errors) -> float:
        bias = float(stated_errors(part).mean()) if rule.subtract_bias else 0.0
        return global_risks(without_bias(part, bias), tolerance, narrowest)[0] / most

    return _risk_interval(errors, left, related)[0] >= 1


def _errors_at(errors: Errors, value: float) -> Floats:
    """Return the errors (n,) of parts of a value."""
    return errors.at(abs(errors.fold - value)) if isinstance(errors, OneSidedErrors) else errors


def acceptance(errors: Errors, tolerance: Tolerance) -> tuple[float, float] | None:
    """Return the readings, from and to, that the rule of the tolerance accepts; None if there are none."""
    lower, upper, rule = tolerance.lower, tolerance.upper, tolerance.rule
    folds = limited_below(errors, tolerance)
    if folds and not rule.subtract_bias:
        upper = 90.0  # no reading lies above; one minus its bias may
    if rule.rule == "simple_acceptance":
        return (lower, upper) if expanded_uncertainty(stated_errors(errors)) < tolerance.size else None
    if rule.rule == "jcgm_106":
        guard = _least_guard(errors, tolerance)
        below = above = guard
    elif rule.subtract_bias:
        low, high = coverage_interval(stated_errors(errors))
        below, above = max(high, 0.0), max(-low, 0.0)
    else:
        below = above = expanded_uncertainty(stated_errors(errors))
    most = max(upper - above, 90.0) if folds else upper - above
    room = most - lower - below if math.isfinite(lower) else most
    return (lower + below, most) if room > 0 else None


def demand(errors: Errors, tolerance: Tolerance) -> float:
    """Return the demand of the rule, at most 1 where the measurement fits; see :class:`Decided`."""
    rule = tolerance.rule
    if rule.rule == "iso_14253_1":
        return expanded_uncertainty(stated_errors(errors)) / tolerance.size / rule.largest_share
    if rule.rule == "simple_acceptance":
        return expanded_uncertainty(stated_errors(errors)) / tolerance.size * rule.least_ratio
    assert rule.producer_risk is not None
    return global_risks(errors, tolerance, acceptance(errors, tolerance))[1] / rule.producer_risk


def needed(errors: Errors, tolerance: Tolerance) -> float:
    """Return the largest standard uncertainty that fits, for errors without bias.

    The distribution of the errors is that of ``errors``, scaled; for fewer than :data:`FEW` trials it is normal. The
    result is about a sensor, so it does not contain that a few trials determine an interval badly.
    """
    u = float(stated_errors(errors).std(ddof=1))
    if not u > 0:
        return math.nan
    if len(errors) < FEW:
        errors = u * _NORMAL
    unbiased = replace(tolerance, rule=tolerance.rule.model_copy(update={"subtract_bias": False}))
    if tolerance.rule.rule != "jcgm_106" and not isinstance(errors, OneSidedErrors):
        return u / demand(errors - errors.mean(), unbiased)  # the demand is proportional to the errors

    def over(logarithm: float) -> float:
        return demand(_scaled_without_bias(errors, math.exp(logarithm)), unbiased) - 1

    low, high = (math.log(tolerance.size / u * factor) for factor in (1e-4, 10.0))
    if over(high) <= 0:
        return math.inf  # so few parts conform that rejecting all meets the demand
    factor = math.exp(float(brentq(over, low, high, xtol=1e-4)))
    if isinstance(errors, OneSidedErrors):  # its standard deviation is not proportional to the vectors
        return float(errors.scaled(factor).stated.std(ddof=1))
    return u * factor


def _scaled_without_bias(errors: Errors, factor: float) -> Errors:
    if isinstance(errors, OneSidedErrors):
        scaled = errors.scaled(factor)
        return scaled.corrected(float(scaled.stated.mean()))
    return np.asarray(factor * (errors - errors.mean()))


def _least_guard(errors: Errors, tolerance: Tolerance) -> float:
    """Return the least guard band, up to the whole tolerance, with at most the stated consumer's risk."""
    most = tolerance.rule.consumer_risk
    assert most is not None

    def over(guard: float) -> float:
        limits = (tolerance.lower + guard, tolerance.upper - guard)
        return global_risks(errors, tolerance, limits)[0] - most

    if over(0.0) <= 0:
        return 0.0
    if over(tolerance.size) >= 0:
        return tolerance.size
    return float(brentq(over, 0.0, tolerance.size, xtol=1e-9 * tolerance.size))


def _within(readings: Floats, limits: tuple[float, float] | None) -> Floats:
    if limits is None:
        return np.zeros(len(readings))
    return np.asarray((readings >= limits[0]) & (readings <= limits[1]), float)


def _demand_interval(
    errors: Errors, tolerance: Tolerance, asked: float, related: NDArray[np.int64] | None
) -> tuple[float, float]:
    """Return the 95 % interval of the demand; that of a risk is symmetric in its logarithm."""
    if not asked > 0:
        return 0.0, 0.0
    stated = stated_errors(errors)
    if tolerance.rule.rule != "jcgm_106":  # the demand is proportional to the expanded uncertainty
        ratio, (low, high) = asked / expanded_uncertainty(stated), expanded_interval(stated, related)
        return ratio * low, ratio * high

    return _risk_interval(errors, lambda part: demand(part, tolerance), related)


def _risk_interval(
    errors: Errors, risk: Callable[[Errors], float], related: NDArray[np.int64] | None
) -> tuple[float, float]:
    """Return the 95 % interval of a risk of trials, symmetric in its logarithm."""
    value = risk(errors)
    if not value > 0:
        return 0.0, 0.0

    def without_block(chosen: Floats) -> Floats:
        kept = chosen.astype(int)
        return np.array([risk(errors.part(kept) if isinstance(errors, OneSidedErrors) else errors[kept])])

    moved = float(standard_errors(np.arange(len(errors), dtype=float), without_block, related)[0])
    factor = factor_of_limits(moved / value)
    return value / factor, value * factor
