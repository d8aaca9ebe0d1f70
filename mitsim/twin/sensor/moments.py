"""Estimate parameters of a simulator from features of one recording: the method of simulated moments.

Signal chain: features m of the recording and their covariance S -> features m(theta) of simulated images, with the same
random numbers at every theta -> damped Gauss-Newton on

    (m - m(theta))^T W (m - m(theta)) + (theta - theta_0)^T P^-1 (theta - theta_0),      W = (S + S_sim / n)^-1

-> theta and its covariance (J^T W J + P^-1)^-1. The mean of n simulations with independent random numbers keeps their
noise small, and W includes it (McFadden, Econometrica 57 (1989) 995). P is wide: a factor of about e around the sensor
file's values. If the uncertainty of a parameter is not well below that of P, the recording does not determine it.

A parameter may be held at its start, with P as its uncertainty. The covariance of the others then includes it, and the
square of the change that the recording suggests instead of the held value.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from characterisation.files.arrays import Floats
from characterisation.words.progress import say_progress

#: features (n,) and their covariance (n, n) of simulation number i at parameters (k,)
Simulate = Callable[[Floats, int], tuple[Floats, Floats]]

#: largest number of rounds of the fit; chosen
_ROUNDS = 8

#: lengths of a step that are tried, each half of the one before, until it improves the fit; chosen
_HALVINGS = 4

#: change of each parameter in standard uncertainties, or of chi-square, below which the fit ends; chosen
_ENOUGH = 0.02

#: largest uncertainty of a determined parameter, as a share of the prior's standard deviation
DETERMINED_SHARE = 0.35


@dataclass(frozen=True)
class MomentFit:
    """Parameters (k,), their ``covariance`` (k, k) and whether they are ``determined``; chi-square, freedom.

    ``off`` (n,) are the features of the recording less those of the simulation.
    """

    values: Floats
    covariance: Floats
    determined: NDArray[np.bool_]
    chi_square: float
    freedom: int
    off: Floats


@dataclass(frozen=True)
class Prior:
    """Prior of parameters (k,): mean, sigma, steps, bounds, and the ``first``; those ``held`` stay at their mean."""

    start: Floats
    spread: Floats
    step: Floats
    low: Floats
    high: Floats
    first: Floats | None = None
    held: NDArray[np.bool_] | None = None

    @property
    def free(self) -> NDArray[np.bool_]:
        """Return which parameters (k,) are not held."""
        return np.ones(len(self.start), bool) if self.held is None else ~self.held


def match_moments(
    real: Floats, covariance: Floats, simulate: Simulate, prior: Prior, draws: int = 2, label: str = ""
) -> MomentFit:
    """Find the parameters at which the mean of simulations reproduces the finite features (n,) of a recording.

    Progress messages begin with ``label``; there are none without it.
    """

    def figures(theta: Floats) -> tuple[Floats, Floats]:
        simulations = [simulate(theta, number) for number in range(draws)]
        return np.mean([m for m, _ in simulations], axis=0), np.mean([s for _, s in simulations], axis=0)

    inverse_prior = np.diag(prior.spread**-2.0)
    theta = np.clip(prior.start if prior.first is None else prior.first, prior.low, prior.high)
    seen, spread = figures(theta)
    weight = np.linalg.pinv(covariance + spread / draws)

    def cost(at: Floats, features: Floats) -> float:
        off, moved = real - features, at - prior.start
        return float(off @ weight @ off + moved @ inverse_prior @ moved)

    jacobian = np.zeros((len(real), len(theta)))
    for number in range(1, _ROUNDS + 1):
        start = time.monotonic()
        for index, step in enumerate(prior.step):
            other = theta.copy()
            # inwards if a bound is near
            other[index] += step if theta[index] + step <= prior.high[index] else -step
            jacobian[:, index] = (figures(other)[0] - seen) / (other[index] - theta[index])
        if label:
            rounds = f"round {number} of at most {_ROUNDS}, about {time.monotonic() - start:.0f} s each"
            say_progress(f"{label}: {len(theta)} parameters, {rounds}")
        weight = np.linalg.pinv(covariance + spread / draws)
        normal = jacobian.T @ weight @ jacobian + inverse_prior
        pull = jacobian.T @ weight @ (real - seen) - inverse_prior @ (theta - prior.start)
        change = _bounded_step(normal, pull, theta, prior)
        length, before = 1.0, cost(theta, seen)
        for _ in range(_HALVINGS):
            tried = np.clip(theta + length * change, prior.low, prior.high)
            features, other_spread = figures(tried)
            if cost(tried, features) < before:
                break
            length /= 2
        else:
            break
        moved = np.abs(tried - theta) * np.sqrt(np.diag(normal))
        theta, seen, spread = tried, features, other_spread
        if float(moved.max()) < _ENOUGH or before - cost(theta, seen) < _ENOUGH:
            break
    weight = np.linalg.pinv(covariance + spread / draws)
    off = real - seen
    total = np.linalg.inv(jacobian.T @ weight @ jacobian + inverse_prior)
    missed = total @ np.where(prior.free, 0.0, jacobian.T @ weight @ off - inverse_prior @ (theta - prior.start))
    total = total + np.outer(missed, missed)
    determined = (np.sqrt(np.diag(total)) < DETERMINED_SHARE * prior.spread) & prior.free
    freedom = len(real) - int(determined.sum())
    return MomentFit(theta, np.asarray(total, float), determined, float(off @ weight @ off), freedom, off)


def _bounded_step(normal: Floats, pull: Floats, theta: Floats, prior: Prior) -> Floats:
    """Return the Gauss-Newton step of parameters not held by a bound, limited to the prior's standard deviation."""
    free = prior.free
    step = np.zeros(len(theta))
    for _ in range(len(theta)):
        step = np.zeros(len(theta))
        step[free] = np.linalg.solve(normal[np.ix_(free, free)], pull[free])
        held = free & (((theta <= prior.low) & (step < 0)) | ((theta >= prior.high) & (step > 0)))
        if not held.any():
            break
        free &= ~held
    return np.asarray(np.clip(step, -prior.spread, prior.spread))
