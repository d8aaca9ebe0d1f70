"""Test statements and choices of views with errors in worlds that were not used for them.

Signal chain: stated 95 % interval, and errors in other worlds -> share of them within, with its interval; errors of all
candidate views -> risk of each -> risk of the chosen view over that of the best, its regret.

The risk of a view is its root mean square error over the square root of the share of captures with a value, as in
:mod:`characterisation.statements.selection`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from characterisation.statements.coverage import Share, share

Floats = NDArray[np.float64]

#: number of random halves of the worlds, in which the best view is selected and compared
_HALVES = 200

#: number of resamples of a bootstrap
_RESAMPLES = 1000


def pooled_share(inside: ArrayLike, seed: int = 0) -> Share:
    """Return the share of true over measurements and worlds (m, w), NaN for missing values.

    The measurements of one world are not independent, so the interval is from a bootstrap over worlds (Efron 1979). If
    all or none are true, it is the exact interval of as many worlds.
    """
    each = np.asarray(inside, float)
    known, true = np.isfinite(each).sum(axis=0), np.nansum(each, axis=0)
    k, n = int(true.sum()), int(known.sum())
    if k in (0, n):
        bound = share(np.full(int((known > 0).sum()), k == n and n > 0))
        return Share(k, n, bound.low, bound.high)
    drawn = np.random.default_rng(seed).integers(len(known), size=(_RESAMPLES, len(known)))
    total = known[drawn].sum(axis=1)
    shares = true[drawn].sum(axis=1)[total > 0] / total[total > 0]
    low, high = np.quantile(shares, [0.025, 0.975])
    return Share(k, n, float(low), float(high))


def within(errors: ArrayLike, interval: tuple[float, float]) -> Floats:
    """Return whether errors (w,) lie in an interval: 1 or 0, NaN for missing values."""
    found = np.asarray(errors, float)
    low, high = interval
    return np.where(np.isfinite(found), (found >= low) & (found <= high), np.nan)


def falsely_accepted(errors: ArrayLike, guards: tuple[float, float]) -> Floats:
    """Return whether worlds (w,) accept a part with its value at a tolerance limit: 1 or 0, NaN for missing values.

    ``guards`` are the guard bands above the lower limit and below the upper one. A value at the upper limit is accepted
    if the error is at most minus the guard band there. A value at the lower limit is accepted if the error is at least
    the guard band there. The tolerance is at least as wide as both guard bands, so a world accepts at one limit at
    most. A rule of 95 % accepts in at most 5 % of the worlds at both limits together (ISO 14253-1:2017, 5).
    """
    found = np.asarray(errors, float)
    below, above = guards
    return np.where(np.isfinite(found), (found <= -above) | (found >= below), np.nan)


def true_risk(errors: ArrayLike) -> Floats:
    """Return the risk (v,) of views from errors (v, w), NaN for missing values; infinite without any value."""
    found = np.asarray(errors, float)
    known = np.isfinite(found)
    return _risk(np.where(known, found, 0.0) ** 2, known)


def _risk(square: Floats, known: NDArray[np.bool_]) -> Floats:
    """Return the risk (...) of squared errors (..., w), 0 where no value is known."""
    count = known.sum(axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        risk = np.sqrt(square.sum(axis=-1) / count / (count / known.shape[-1]))
    return np.where(count > 0, risk, np.inf)


@dataclass(frozen=True)
class Regret:
    """Excess of the risk of a chosen view over that of the best.

    ``risk`` of the chosen view and ``least`` risk of all views [unit of the measurement], and their ``ratio``. The
    least of many estimates is too low by chance, so ``ratio`` is too high. ``unbiased`` selects the best view in one
    half of the worlds and compares both views in the other half. It is the geometric mean over random halves, and
    ``middle`` their median, which no single half without a value of the best view can move. ``low`` and ``high`` are
    the 95 % interval of ``unbiased`` over the choice of worlds.
    """

    risk: float
    least: float
    best: int
    ratio: float
    unbiased: float
    middle: float
    low: float
    high: float


def regret(errors: ArrayLike, chosen: int, seed: int = 0, block: int = 1) -> Regret:
    """Return the regret of the view ``chosen`` (a row) from errors (v, w) of all views in the same worlds.

    Each ``block`` of successive worlds shares a draw, such as a finish. The halves and the resamples keep blocks
    together, since only blocks are independent. The number of worlds is a multiple of ``block``.
    """
    found = np.asarray(errors, float)
    risks = true_risk(found)
    rng = np.random.default_rng(seed)
    places = np.arange(found.shape[1]).reshape(-1, block)
    count = len(places)
    drawn = _halved(found, chosen, np.array([places[rng.permutation(count)] for _ in range(_HALVES)]))
    again = _halved(found, chosen, np.array([places[rng.integers(count, size=count)] for _ in range(_RESAMPLES)]))
    best = int(np.argmin(risks))
    ratio = float(risks[chosen] / risks[best]) if np.isfinite(risks[best]) else float("nan")
    low, high = np.quantile(again, [0.025, 0.975], method="nearest") if np.isfinite(again).any() else (np.inf, np.inf)
    return Regret(
        float(risks[chosen]),
        float(risks[best]),
        best,
        ratio,
        float(np.exp(drawn.mean())),
        float(np.exp(np.median(drawn))),
        float(np.exp(low)),
        float(np.exp(high)),
    )


def _halved(errors: Floats, chosen: int, orders: NDArray[np.int64]) -> Floats:
    """Return the logarithms (n,) of the regret in one half of the blocks, against the best view of the other half.

    ``orders`` (n, block, world) are the places of the worlds.
    """
    known = np.isfinite(errors)
    square = np.where(known, errors, 0.0) ** 2
    first, second = (half.reshape(len(orders), -1) for half in np.split(orders, [orders.shape[1] // 2], axis=1))
    best = np.argmin(_risk(square[:, first], known[:, first]), axis=0)
    risks = [
        _risk(square[view[:, None], second], known[view[:, None], second])
        for view in (np.full_like(best, chosen), best)
    ]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(np.isinf(risks).all(axis=0), 0.0, np.log(risks[0]) - np.log(risks[1]))
