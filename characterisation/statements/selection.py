"""Estimate which of several views has the lowest risk from few trials of each.

Signal chain: errors of the trials of each view, in common worlds, and a prior from the map -> risk of each view and
measurement with the covariance of its estimate -> samples of the risks -> the leading view, its expected loss, the
probability that it is the best or nearly so, and the views that still deserve a trial.

The risk of a view is the root mean square of its error over the square root of the share of trials with a value. If a
share p of N captures gives values, N p values of variance r^2 carry as much information as N values of variance r^2 /
p. A view that measures half the time and 4 % better loses to one that always measures.

The logarithms of the risks are assumed jointly normal. The logarithm of the root mean square of n normal errors has the
mean (digamma(n / 2) - log(n / 2)) / 2 relative to the true one, and the variance trigamma(n / 2) / 4. With the kurtosis
k of the errors both are (k - 1) / 2 times larger for large n, as the relative variance of a mean square is (k - 1) / n;
the variance is also for few trials (:func:`log_of_mean`). Few trials lack the rare large errors, so their kurtosis is
too small, and views differ in it: k - 1 is log-normal with the prior :data:`EXCESS`. Views with trials in the same
worlds (common random numbers) correlate as their squared errors do; so do the measurements of one trial.

An error of exactly 0 is that of a zone whose form is lost in the noise. Its size is unknown, and counts as the map's u:
its logarithm would outweigh the prior and the trials of all views.

The prior is the map's u with two errors: a factor common to all views, and another for each view. Trials update it
(normal update, e.g. Gelman et al., Bayesian Data Analysis, 3.5).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import digamma, polygamma

from characterisation.files.arrays import Floats

#: standard uncertainty of the logarithm of the map's u, common to all views
PRIOR_COMMON = 1.0

#: standard uncertainty of the logarithm of the map's u, of each view: root mean square over the measurements of five
#: raced open cases of scenes/parts. Structured light 0.74, active stereo 0.80 and time of flight 1.6 are of one or two
#: cases each, too few to tell them apart. Command: python tests/benchmarks/race_probabilities.py prior
PRIOR_OWN = 1.1

#: median of k - 1 of the errors of a view: of 97 series of at least 100 trials, one for each measurement of a stated
#: view of the open parts of scenes/parts/measured. For this and the two deviations below, halves of the parts give 3.9,
#: 1.2, 0.8 and 2.5, 1.2, 0.9. Command: python tests/benchmarks/race_probabilities.py kurtosis
EXCESS = 3.2

#: standard deviation of its logarithm between measurements, from the same series
EXCESS_OF_MEASUREMENTS = 1.2

#: standard deviation of its logarithm between the views of a measurement, from the same series
EXCESS_OF_VIEWS = 0.9

#: number of trials at which half of the tails' share of the bias of a logarithm is in effect: of one trial the bias is
#: -0.9, of 2, 4, 8 and 16 -0.5, -0.28, -0.17 and -0.11, over the same series
_TAILED_TRIALS = 5.0

#: number of degrees of freedom of the trials at which the variance of the logarithm of their k - 1 is 1
_EXCESS_DEGREES = 100.0

#: least k - 1 that trials can show: errors of nearly constant size have k = 1
_LEAST_EXCESS = 0.2

#: number of common trials at which the correlation of two views, or of two measurements, has the same weight as the
#: mean over all pairs
_SHRINKAGE = 20.0

#: correlation of two measurements where it is unknown
_USUAL_CORRELATION = 0.3

#: least distance of the map's probability from 0 and 1, since it is an estimate
_LEAST_CHANCE = 0.02

#: number of trials that the map's probability counts as
BELIEF = 2

#: largest logarithm of a ratio of risks that an expected loss counts
_LARGEST_LOSS = 2.0

_SAMPLES = 4000


@dataclass(frozen=True)
class Standing:
    """Current estimate of the views of a race for one measurement.

    ``risk`` (v,) is the posterior median, in the measurement's unit; ``leader`` the view of least expected loss.
    ``loss`` is that loss: the expected ratio of the leader's risk to the least of all, less 1. ``near`` (v,) is the
    probability that this ratio of a view is at most ``1 + margin``, ``confidence`` that of the leader. ``gain`` (v,) is
    the expected logarithm by which a view is better than the leader, 0 where it is worse.
    """

    risk: Floats
    leader: int
    loss: float
    near: Floats
    gain: Floats

    @property
    def confidence(self) -> float:
        """Return the probability that the leader is the best, or within the margin of it."""
        return float(self.near[self.leader])


def judge(samples: Floats, margin: float = 0.1) -> Standing:
    """Return the standing from samples (s, v) of the logarithms of the risks."""
    ahead = samples - samples.min(axis=1, keepdims=True)
    ratio = np.exp(np.minimum(ahead, _LARGEST_LOSS)).mean(axis=0)
    leader = int(np.argmin(ratio))
    near = (ahead <= np.log1p(margin)).mean(axis=0)
    gain = np.maximum(samples[:, [leader]] - samples, 0).mean(axis=0)
    return Standing(np.exp(np.median(samples, axis=0)), leader, float(ratio[leader] - 1), near, gain)


def sampled(mean: Floats, covariance: Floats, standard: Floats | None = None) -> Floats:
    """Return samples (s, v) of jointly normal logarithms, from ``standard`` (s, v) normal deviates; always the same."""
    if standard is None:
        standard = deviates(1, len(mean))[0]
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(mean + standard @ ((vectors * np.sqrt(np.clip(values, 0, None))) @ vectors.T))


def deviates(measurements: int, views: int) -> Floats:
    """Return independent normal deviates (measurement, s, view), the same at every call."""
    return np.random.default_rng(0).standard_normal((measurements, _SAMPLES, views))


def joint_samples(errors: ArrayLike, prior_risk: ArrayLike, prior_chance: ArrayLike) -> Floats:
    """Return samples (m, s, v) of the logarithms of the risks of all measurements and views.

    The arguments are those of :func:`posterior`, with the measurement as first dimension.
    """
    every, risk, chance = (np.asarray(values, float) for values in (errors, prior_risk, prior_chance))
    independent = deviates(*every.shape[:2])
    standard = np.tensordot(np.linalg.cholesky(_between_measurements(every)), independent, 1)
    return np.stack(
        [sampled(*posterior(every[m], risk[m], chance[m]), standard=standard[m]) for m in range(len(every))]
    )


def posterior(errors: ArrayLike, prior_risk: ArrayLike, prior_chance: ArrayLike) -> tuple[Floats, Floats]:
    """Return the mean (v,) and covariance (v, v) of the logarithms of the risks of views, from their trials.

    ``errors`` (v, n) are by view and world: NaN for a trial without a value, infinite where the view had no trial in
    that world. ``prior_risk`` and ``prior_chance`` (v,) are the map's u, and its probability that the measurement is
    possible.
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
    counted = np.flatnonzero(counts)
    if not len(counted):
        return prior_mean + loss, prior + np.diag(loss_variance)
    sized = np.where(every == 0, np.asarray(prior_risk, float)[:, None], every)
    square = np.where(valued, np.where(valued, sized, 0.0) ** 2, np.nan)[counted]
    moment = np.maximum(np.nanmean(square, axis=1), 1e-300)
    low, spread = log_of_mean(counts[counted], _excess(square / moment[:, None], counts[counted]))
    data = np.outer(spread, spread) * _correlation(square / moment[:, None])
    observed = 0.5 * np.log(moment) - low
    gain = prior[:, counted] @ np.linalg.inv(prior[np.ix_(counted, counted)] + data)
    mean = prior_mean + gain @ (observed - prior_mean[counted])
    covariance = prior - gain @ prior[counted]
    return mean + loss, (covariance + covariance.T) / 2 + np.diag(loss_variance)


def chance_after(expected: Floats, errors: Floats) -> Floats:
    """Return the probability (..., v) of a value after trials with errors (..., v, n), ``expected`` (..., v) before.

    Errors are NaN for a trial without a value, infinite for a view without that trial. The map's probability counts as
    :data:`BELIEF` trials.
    """
    tried, valued = (~np.isinf(errors)).sum(axis=-1), np.isfinite(errors).sum(axis=-1)
    return np.asarray((valued + BELIEF * expected) / (tried + BELIEF))


def log_of_mean(count: NDArray[np.integer], excess: float) -> tuple[Floats, Floats]:
    """Return the mean and standard deviation of the log of a root mean square from ``count`` trials over the true one.

    ``excess`` is k - 1 of the errors.
    """
    half = np.asarray(count, float) / 2
    tails = excess / 2
    low = (digamma(half) - np.log(half)) / 2 * (1 + (tails - 1) * half / (half + _TAILED_TRIALS / 2))
    return low, np.sqrt(polygamma(1, half) / 4 * tails)


def _excess(relative: Floats, counts: NDArray[np.integer]) -> float:
    """Return the expected k - 1 of the errors of a view, from squares (v, n) relative to their means.

    The trials of all views update the median of the measurement. Between views k - 1 differs as in the prior, of which
    the trials of a view tell little.
    """
    weight = np.maximum(counts - 1, 0)
    degrees, prior = weight.sum() / _EXCESS_DEGREES, 1 / EXCESS_OF_MEASUREMENTS**2
    shown = 1.0
    if weight.any():
        fourth = np.nanmean(relative**2, axis=1) * (counts + 2) / counts  # unbiased for normal errors
        shown = max(float((fourth * weight).sum() / weight.sum()) - 1, _LEAST_EXCESS)
    median = (degrees * np.log(shown) + prior * np.log(EXCESS)) / (degrees + prior)
    return float(np.exp(median + (EXCESS_OF_VIEWS**2 + 1 / (degrees + prior)) / 2))


def _correlation(relative: Floats) -> Floats:
    """Return the correlation (v, v) of the views' squared errors over the worlds that they share.

    The correlation of a pair from few worlds is mostly chance, which would make the leader appear too certain. It is
    therefore shrunk toward the mean over all pairs.
    """
    finite = np.isfinite(relative)
    off = np.where(finite, relative - np.nanmean(relative, axis=1, keepdims=True), 0.0)
    square = (off**2) @ finite.T  # for the first of a pair, over their common worlds
    size = np.sqrt(square * square.T)
    raw = np.divide(off @ off.T, size, out=np.zeros_like(size), where=size > 0)
    common = finite.astype(float) @ finite.T
    pairs = ~np.eye(len(raw), dtype=bool)
    mean = float((raw * common)[pairs].sum() / max(common[pairs].sum(), 1.0)) if len(raw) > 1 else 0.0
    raw = (common * raw + _SHRINKAGE * max(mean, 0.0)) / (common + _SHRINKAGE)
    smaller = np.maximum(np.minimum.outer(np.diag(common), np.diag(common)), 1.0)
    raw *= np.minimum(common / smaller, 1.0)  # worlds of one view alone give no correlation
    np.fill_diagonal(raw, 1.0)
    return _valid(raw)


def _between_measurements(errors: Floats) -> Floats:
    """Return the correlation (m, m) of the measurements' squared errors (m, v, n) over views and worlds.

    That of a pair is shrunk toward :data:`_USUAL_CORRELATION`. A view with one trial tells nothing.
    """
    finite = np.isfinite(errors)
    count = finite.sum(axis=2, keepdims=True)
    finite &= count > 1
    square = np.where(finite, errors, 0.0) ** 2
    mean = square.sum(axis=2, keepdims=True) / np.maximum(count, 1)
    off = np.divide(square, mean, out=np.ones_like(square), where=finite & (mean > 0)) - 1
    off, both = off.reshape(len(errors), -1), finite.reshape(len(errors), -1).astype(float)
    size = np.sqrt((off**2 @ both.T) * (off**2 @ both.T).T)
    raw = np.divide(off @ off.T, size, out=np.zeros_like(size), where=size > 0)
    common = both @ both.T
    raw = (common * raw + _SHRINKAGE * _USUAL_CORRELATION) / (common + _SHRINKAGE)
    np.fill_diagonal(raw, 1.0)
    return _valid(raw)


def _valid(correlation: Floats) -> Floats:
    """Return the correlation matrix next to one from pairs, whose least eigenvalue may be negative."""
    values, vectors = np.linalg.eigh(correlation)
    fixed = (vectors * np.clip(values, 1e-6, None)) @ vectors.T
    scale = np.sqrt(np.diag(fixed))
    return np.asarray(fixed / np.outer(scale, scale))
