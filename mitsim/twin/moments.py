"""Parameters of a simulator from figures of one recording: the method of simulated moments.

Signal chain: figures m of the recording, their covariance S -> figures m(theta) of simulated ones, the same random
numbers at every theta -> Gauss-Newton with damping on

    (m - m(theta))^T W (m - m(theta)) + (theta - theta_0)^T P^-1 (theta - theta_0),      W = (S + S_sim / n)^-1

-> theta and its covariance (J^T W J + P^-1)^-1. n simulations with other random numbers each are averaged, so that what
chance they add is small, and it is counted (McFadden, Econometrica 57 (1989) 995). P is wide: a factor of e or so about
what the sensor file says. A parameter whose uncertainty is not well under that of P is one that the recording does not
tell.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mitsim.progress import say_progress

Floats = NDArray[np.float64]

#: figures (n,) and their covariance (n, n) of simulations at parameters (k,), number i of the random numbers
Simulate = Callable[[Floats, int], tuple[Floats, Floats]]

_ROUNDS, _HALVINGS, _ENOUGH = 8, 4, 0.02

#: share of the prior's standard deviation, over which the recording has not told a parameter
TOLD_SHARE = 0.35


@dataclass(frozen=True)
class Found:
    """Parameters (k,), their ``covariance`` (k, k), which are ``told``; chi-square and the degrees of freedom."""

    values: Floats
    covariance: Floats
    told: NDArray[np.bool_]
    chi_square: float
    freedom: int


@dataclass(frozen=True)
class Prior:
    """Where parameters (k,) are believed to be, how well, steps of derivatives, bounds; the fit begins at ``first``."""

    start: Floats
    spread: Floats
    step: Floats
    low: Floats
    high: Floats
    first: Floats | None = None


def match_moments(
    real: Floats, covariance: Floats, simulate: Simulate, prior: Prior, draws: int = 2, label: str = ""
) -> Found:
    """Find the parameters at which simulations have the figures of a recording.

    Parameters
    ----------
    real, covariance
        Figures (n,) of the recording, finite, and their covariance (n, n).
    simulate
        The forward model.
    draws
        Simulations that are averaged.
    label
        Tells progress under this name: at the first derivatives how long a round takes.
    """

    def figures(theta: Floats) -> tuple[Floats, Floats]:
        each = [simulate(theta, number) for number in range(draws)]
        return np.mean([m for m, _ in each], axis=0), np.mean([s for _, s in each], axis=0)

    inverse_prior = np.diag(prior.spread**-2.0)
    theta = np.clip(prior.start if prior.first is None else prior.first, prior.low, prior.high)
    seen, spread = figures(theta)
    weight = np.linalg.pinv(covariance + spread / draws)

    def cost(at: Floats, found: Floats) -> float:
        off, moved = real - found, at - prior.start
        return float(off @ weight @ off + moved @ inverse_prior @ moved)

    jacobian = np.zeros((len(real), len(theta)))
    for number in range(1, _ROUNDS + 1):
        start = time.monotonic()
        for index, step in enumerate(prior.step):
            other = theta.copy()
            # toward the inside, where a bound is near
            other[index] += step if theta[index] + step <= prior.high[index] else -step
            jacobian[:, index] = (figures(other)[0] - seen) / (other[index] - theta[index])
        if label:
            each = f"{time.monotonic() - start:.0f} s each"
            say_progress(f"{label}: {len(theta)} parameters, round {number} of at most {_ROUNDS}, about {each}")
        weight = np.linalg.pinv(covariance + spread / draws)
        normal = jacobian.T @ weight @ jacobian + inverse_prior
        pull = jacobian.T @ weight @ (real - seen) - inverse_prior @ (theta - prior.start)
        change = _bounded_step(normal, pull, theta, prior)
        length, before = 1.0, cost(theta, seen)
        for _ in range(_HALVINGS):
            tried = np.clip(theta + length * change, prior.low, prior.high)
            found, other_spread = figures(tried)
            if cost(tried, found) < before:
                break
            length /= 2
        else:
            break
        moved = np.abs(tried - theta) * np.sqrt(np.diag(normal))
        theta, seen, spread = tried, found, other_spread
        if float(moved.max()) < _ENOUGH or before - cost(theta, seen) < _ENOUGH:
            break
    weight = np.linalg.pinv(covariance + spread / draws)
    total = np.linalg.inv(jacobian.T @ weight @ jacobian + inverse_prior)
    off = real - seen
    told = np.sqrt(np.diag(total)) < TOLD_SHARE * prior.spread
    return Found(theta, np.asarray(total, float), told, float(off @ weight @ off), len(real) - int(told.sum()))


def _bounded_step(normal: Floats, pull: Floats, theta: Floats, prior: Prior) -> Floats:
    """Gauss-Newton step of the parameters that are not held by a bound, none longer than a prior's deviation."""
    free = np.ones(len(theta), bool)
    step = np.zeros(len(theta))
    for _ in range(len(theta)):
        step = np.zeros(len(theta))
        step[free] = np.linalg.solve(normal[np.ix_(free, free)], pull[free])
        held = free & (((theta <= prior.low) & (step < 0)) | ((theta >= prior.high) & (step > 0)))
        if not held.any():
            break
        free &= ~held
    return np.asarray(np.clip(step, -prior.spread, prior.spread))
