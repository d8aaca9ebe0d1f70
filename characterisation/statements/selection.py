"""Estimate which of several views has the lowest risk from few trials of each.

Signal chain: errors of the trials of each view, in common worlds, and a prior from the map -> risk of each view with
the covariance of its estimate -> samples of the risks -> the leading view, the probability that it is the best or
nearly so, and the views that still deserve a trial.

The risk of a view is the root mean square of its error over the square root of the share of trials with a value. If a
share p of N captures gives values, N p values of variance r^2 carry as much information as N values of variance r^2 /
p. A view that measures half the time and 4 % better loses to one that always measures.

The logarithms of the risks are assumed jointly normal. The variance of the log of a root mean square from n trials is
(kurtosis - 1) / (4 n). Views with trials in the same worlds (common random numbers) correlate as their squared errors
do. The prior is the map's u with two errors: a factor common to all views, and another for each view. Trials update it
(normal update, e.g. Gelman et al., Bayesian Data Analysis, 3.5).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

#: standard uncertainty of the logarithm of the map's u, common to all views
PRIOR_COMMON = 1.0

#: standard uncertainty of the logarithm of the map's u, of each view
PRIOR_OWN = 0.7

#: least kurtosis of errors: that of a uniform distribution
_LEAST_KURTOSIS = 1.8

#: kurtosis of errors where it is unknown: that of a normal distribution
_USUAL_KURTOSIS = 3.0

#: number of common trials at which the correlation of two views has the same weight as the mean over all pairs
_SHRINKAGE = 20.0

#: least distance of the map's probability from 0 and 1, since it is an estimate
_LEAST_CHANCE = 0.02

#: number of trials that the map's probability counts as
BELIEF = 2

_SAMPLES = 4000


@dataclass(frozen=True)
class Standing:
    """Current estimate of the views of a race for one measurement.

    ``risk`` (v,) is the posterior median, in the measurement's unit; ``leader`` the view with the least. ``confidence``
    is the probability that the leader's risk is at most ``1 + margin`` times the least of all. ``chance`` (v,) is the
    probability that a view is better than the leader by more than the margin.
    """

    risk: Floats
    leader: int
    confidence: float
    chance: Floats


def judge(samples: Floats, margin: float = 0.1) -> Standing:
    """Return the standing from samples (s, v) of the logarithms of the risks."""
    centre = np.median(samples, axis=0)
    leader = int(np.argmin(centre))
    ahead = samples[:, leader] - samples.min(axis=1) <= np.log1p(margin)
    chance = (samples < (samples[:, [leader]] - np.log1p(margin))).mean(axis=0)
    return Standing(np.exp(centre), leader, float(ahead.mean()), chance)


def sampled(mean: Floats, covariance: Floats, seed: int = 0) -> Floats:
    """Return samples (s, v) of jointly normal logarithms, the same for the same seed."""
    values, vectors = np.linalg.eigh(covariance)
    standard = np.random.default_rng(seed).standard_normal((_SAMPLES, len(mean)))
    return np.asarray(mean + (standard * np.sqrt(np.clip(values, 0, None))) @ vectors.T)


def posterior(errors: ArrayLike, prior_risk: ArrayLike, prior_chance: ArrayLike) -> tuple[Floats, Floats]:
    """Return the mean (v,) and covariance (v, v) of the logarithms of the risks of views, from their trials.

    Parameters
    ----------
    errors
        (v, n) by view and world; NaN for a trial without a value, infinite where the view had no trial in that world.
    prior_risk, prior_chance
        (v,) the map's u, and its probability that the measurement is possible.
    """
    every = np.asarray(errors, float)
    tried, valued = ~np.isinf(every), np.isfinite(every)
    u = np.log(np.asarray(prior_risk, float))
    possible = chance_after(np.clip(prior_chance, _LEAST_CHANCE, 1 - _LEAST_CHANCE), every)
    loss = -0.5 * np.log(possible)
    loss_variance = (1 - possible) / (4 * possible * (tried.sum(axis=1) + BELIEF))
    prior_mean = u + np.zeros(len(every))
    prior = np.eye(len(every)) * PRIOR_OWN**2 + PRIOR_COMMON**2
    counts = valued.sum(axis=1)
    some = np.flatnonzero(counts)
    if not len(some):
        return prior_mean + loss, prior + np.diag(loss_variance)
    square = np.where(valued, np.where(valued, every, 0.0) ** 2, np.nan)[some]
    moment = np.maximum(np.nanmean(square, axis=1), 1e-300)
    kurtosis = _kurtosis(square / moment[:, None], counts[some])
    spread = np.sqrt((kurtosis - 1) / (4 * counts[some]))
    data = np.outer(spread, spread) * _correlation(square / moment[:, None])
    # on average, the log of a mean of few squares is too low by half its relative variance
    observed = 0.5 * np.log(moment) + spread**2
    gain = prior[:, some] @ np.linalg.inv(prior[np.ix_(some, some)] + data)
    mean = prior_mean + gain @ (observed - prior_mean[some])
    covariance = prior - gain @ prior[some]
    return mean + loss, (covariance + covariance.T) / 2 + np.diag(loss_variance)


def chance_after(expected: Floats, errors: Floats) -> Floats:
    """Return the probability (..., v) of a value after trials with errors (..., v, n), ``expected`` (..., v) before.

    Errors are NaN for a trial without a value, infinite for a view without that trial. The map's probability counts as
    :data:`BELIEF` trials.
    """
    tried, valued = (~np.isinf(errors)).sum(axis=-1), np.isfinite(errors).sum(axis=-1)
    return np.asarray((valued + BELIEF * expected) / (tried + BELIEF))


def _kurtosis(relative: Floats, counts: NDArray[np.integer]) -> float:
    """Return the kurtosis common to the errors of all views, from squares (v, n) relative to their means."""
    weight = np.maximum(counts - 1, 0)
    if weight.sum() < 8:
        return _USUAL_KURTOSIS
    fourth = np.nanmean(relative**2, axis=1) * (counts + 2) / counts  # unbiased for normal errors
    return float(max((fourth * weight).sum() / weight.sum(), _LEAST_KURTOSIS))


def _correlation(relative: Floats) -> Floats:
    """Return the correlation (v, v) of the views' squared errors over the worlds that they share.

    The correlation of a pair from few worlds is mostly chance, which would make the leader appear too certain. It is
    therefore shrunk toward the mean over all pairs.
    """
    known = np.isfinite(relative)
    off = np.where(known, relative - np.nanmean(relative, axis=1, keepdims=True), 0.0)
    square = (off**2) @ known.T  # for the first of a pair, over their common worlds
    size = np.sqrt(square * square.T)
    raw = np.divide(off @ off.T, size, out=np.zeros_like(size), where=size > 0)
    common = known.astype(float) @ known.T
    pairs = ~np.eye(len(raw), dtype=bool)
    mean = float((raw * common)[pairs].sum() / max(common[pairs].sum(), 1.0)) if len(raw) > 1 else 0.0
    raw = (common * raw + _SHRINKAGE * max(mean, 0.0)) / (common + _SHRINKAGE)
    smaller = np.maximum(np.minimum.outer(np.diag(common), np.diag(common)), 1.0)
    raw *= np.minimum(common / smaller, 1.0)  # worlds of one view alone give no correlation
    np.fill_diagonal(raw, 1.0)
    values, vectors = np.linalg.eigh(raw)  # pairs of different worlds need not give a valid matrix
    fixed = (vectors * np.clip(values, 1e-6, None)) @ vectors.T
    scale = np.sqrt(np.diag(fixed))
    return np.asarray(fixed / np.outer(scale, scale))
