"""Narrow the prior of a finish by captures of a coupon, for ``[unknowns.finish.measured]`` of a study.

Signal chain: blocks of the views -> likelihood of alpha and wide-angle share at several tails of the lobe, the power
fitted at each -> blurred by the errors that the jackknife finds beyond the covariance -> times the priors that trials
draw from -> mean and standard deviation of alpha, wide-angle share and tail, in one-sigma ranges of their priors.

The likelihood is computed on a grid, since it is not normal: shares end at 0, and a lobe that no view shows leaves a
ridge of alpha and share. The weights of the blocks are those of the fit at the best estimate of the tail. Images show
the product of power and reflectance, so the prior of the reflectance stays.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import Akima1DInterpolator
from scipy.optimize import minimize_scalar

from characterisation.files.arrays import Floats
from mitsim.scene.surface.scatter import LARGEST_DEVIATION, Deviation, Scatter
from mitsim.twin.finish.estimate import Fit, FittedQuantity, best_values, refine
from mitsim.twin.finish.finish import LOG_ALPHA_RANGE, MetalFinish
from mitsim.twin.finish.observation import CouponView
from mitsim.twin.finish.problem import Problem

#: Beckmann shares that are fitted first [1], beside the most likely one: its likelihood may fall below that of another
#: lobe, narrower and with more power, within 0.05
_SHARES = (0.0, 0.1, 0.2, 0.35, 0.5, 0.75, 1.0)

#: error of that share; chosen: half of the smallest step
_SHARE_ERROR = 0.005

#: how often the steps of the share about the likely ones may be halved: the last are under the least standard deviation
_HALVINGS = 3

#: logarithm of the likelihood ratio to which a share is likely; chosen
_LIKELY = 2.0

#: largest fall of that logarithm over a step and those beside it; chosen: a step of 1.2 to 1.7 standard deviations of a
#: normal likelihood
_FALL = 3.0

#: standard deviation of alpha and wide-angle share at least; a posterior is no better than the model of the lobe.
#: Assumed
_LEAST_SIZE = 0.05

#: deviations from the best estimate in which a finish is drawn; the steps are a fifth of the least standard deviation
_GRID = np.linspace(-LARGEST_DEVIATION, LARGEST_DEVIATION, 601)

#: prior of a deviation on the grid
_PRIOR = np.exp(-0.5 * _GRID**2)

#: apparent deviations of the share: likelihoods are narrower than posteriors; chosen
_FINE_GRID = np.linspace(-LARGEST_DEVIATION, LARGEST_DEVIATION, 1201)

#: places of alpha at which the likelihood is computed: over the prior, and about the fit; chosen
_PLACES = 25

#: standard uncertainties about the fit that the second of them span; chosen
_AROUND = 5.0


@dataclass(frozen=True)
class FinishPosterior:
    """Centre and standard deviation of each property of a finish after captures, in one-sigma ranges of the prior.

    ``name`` of the finish: the id of its BSDF. None for a property that the scene states exactly.
    """

    name: str
    alpha: tuple[float, float] | None
    wide_angle: tuple[float, float] | None
    tail: tuple[float, float]

    def entries(self) -> dict[str, list[float]]:
        """Return the known properties as ``[unknowns.finish.measured.NAME]`` has them, rounded to 3 decimals."""
        pairs = {"alpha": self.alpha, "wide_angle": self.wide_angle, "tail": self.tail}
        return {key: [round(value, 3) for value in pair] for key, pair in pairs.items() if pair is not None}

    def toml(self) -> str:
        """Return the table for a study, as TOML."""
        lines = [f"{key} = {value}\n" for key, value in self.entries().items()]
        return f'[unknowns.finish.measured."{self.name}"]\n' + "".join(lines)


def finish_posterior(
    views: Sequence[CouponView], finish: MetalFinish, prior: Scatter, fit: Fit, name: str
) -> FinishPosterior:
    """Return the posterior of a coupon's finish; ``name`` is the id of its BSDF.

    ``fit`` is that of the views, whose jackknife bounds the uncertainties at each tail from below. ``prior`` is the
    scattering at the best estimate, which the scene gives.
    """
    assert fit.log_alpha is not None and fit.wide_angle is not None and prior.beckmann_range is not None
    problem = Problem(views, finish)
    start, variance, _ = best_values(problem)
    low, high = prior.wide_angle_range
    alpha_known, share_known = prior.alpha_factor <= 1, not 0 < low < prior.wide_angle < high
    alphas = np.log(prior.alpha_u) + (np.zeros(1) if alpha_known else _GRID * np.log(prior.alpha_factor))
    shares, apparent = (
        np.array([Deviation(wide_angle=z).share(prior.wide_angle, prior.wide_angle_range) for z in grid.tolist()])
        for grid in ((np.zeros(1), np.zeros(1)) if share_known else (_GRID, _FINE_GRID))
    )
    if not share_known:
        apparent = np.concatenate([-apparent[::-1], apparent])  # errors also lead to a share under 0
    of_share, by_covariance = _errors(shares, _blur(fit.wide_angle, shares), apparent), fit.log_alpha.by_covariance
    alpha_blur = _blur(fit.log_alpha, alphas)

    def refined(beckmann: float) -> tuple[Problem, Floats]:
        other = Problem(views, finish.with_beckmann(beckmann))
        return other, refine(other, start, variance)

    def misfit(beckmann: float) -> float:
        other, values = refined(beckmann)
        return float((other.residual(values, variance) ** 2).sum())

    def of_tail(beckmann: float) -> list[float]:
        """Return the logarithm of a tail's likelihood, then mean and variance of alpha, and of the share, with it."""
        other, values = refined(beckmann)
        around = values[0] + _AROUND * by_covariance * np.linspace(-1, 1, _PLACES)
        every = np.concatenate([np.linspace(alphas[0], alphas[-1], _PLACES), np.clip(around, alphas[0], alphas[-1])])
        place = np.unique(np.clip(every, *LOG_ALPHA_RANGE))
        cost = _chi_square(other, variance, place, apparent) / max(fit.reduced_chi_square, 1.0)
        of_alpha = _errors(alphas, alpha_blur, place)
        joint = of_alpha @ np.exp(-0.5 * (cost - cost.min())) @ of_share.T
        if not alpha_known:
            joint = joint * _PRIOR[:, None]
        if not share_known:
            joint = joint * _PRIOR
        logarithm = float(np.log(joint.sum()) - 0.5 * cost.min())
        return [logarithm, *_mean_and_variance(joint.sum(axis=1)), *_mean_and_variance(joint.sum(axis=0))]

    by_tail = np.array([Deviation(tail=z).beckmann(prior.beckmann, prior.beckmann_range) for z in _GRID.tolist()])
    # a spline through all shares would swing where the likelihood falls by hundreds from one to the next
    logarithm, *moments = Akima1DInterpolator(*_tabulated(of_tail, misfit))(by_tail).T
    alpha_mean, alpha_variance, share_mean, share_variance = moments
    weight = _PRIOR * np.exp(logarithm - logarithm.max())
    return FinishPosterior(
        name,
        None if alpha_known else _moments(alpha_mean, weight, alpha_variance),
        None if share_known else _moments(share_mean, weight, share_variance),
        _moments(_GRID, weight, np.zeros(len(_GRID))),
    )


def _tabulated(of_tail: Callable[[float], list[float]], misfit: Callable[[float], float]) -> tuple[Floats, Floats]:
    """Return Beckmann shares (n,), close together where ``misfit`` makes them likely, and their ``of_tail`` (n, 5)."""
    likeliest = minimize_scalar(misfit, bounds=(0, 1), method="bounded", options={"xatol": _SHARE_ERROR}).x
    table = {share: of_tail(share) for share in (*_SHARES, float(likeliest))}
    for _ in range(_HALVINGS):
        shares = np.array(sorted(table))
        logarithm = np.array([table[share][0] for share in shares])
        likely = np.maximum(logarithm[:-1], logarithm[1:])
        # the lowest of the four ends of a step and its neighbours
        ends = np.pad(logarithm, 1, mode="edge")
        lowest = np.min([ends[:-3], ends[1:-2], ends[2:-1], ends[3:]], axis=0)
        halved = (likely > logarithm.max() - _LIKELY) & (likely - lowest > _FALL)
        if not halved.any():
            break
        table |= {share: of_tail(share) for share in (shares[:-1] + shares[1:])[halved] / 2}
    shares = np.array(sorted(table))
    return shares, np.array([table[share] for share in shares])


def _chi_square(problem: Problem, variance: Floats, log_alphas: Floats, shares: Floats) -> Floats:
    """Return chi-square (alphas, shares) of lobes and wide-angle shares, each with its best power and room light."""
    weight = 1 / np.sqrt(variance)
    measured, wide, *room = weight * np.stack([problem.measured, *problem.linear_means.T])
    out = []
    for x in log_alphas.tolist():
        lobe = weight * problem.means(problem.specular(x)[0])
        mixed = np.stack([lobe, wide - lobe, measured])
        found = _left(mixed @ mixed.T, shares)[0]
        for light in room:
            along = mixed @ light / np.linalg.norm(light)
            left, power = _left(mixed @ mixed.T - np.outer(along, along), shares)
            lit = along[2] > power * (along[0] + shares * along[1])  # the room adds light
            found = np.where(lit, left, found)
        out.append(found)
    return np.array(out)


def _left(products: Floats, shares: Floats) -> tuple[Floats, Floats]:
    """Return the squares that the best power leaves, and that power, of shares (n,) of a mixture.

    ``products`` (3, 3) are those of the lobe, of the difference of wide light from the lobe, and of the measured means.
    """
    square = products[0, 0] + 2 * shares * products[0, 1] + shares**2 * products[1, 1]
    power = np.maximum((products[0, 2] + shares * products[1, 2]) / square, 0.0)
    return products[2, 2] - power**2 * square, power


def _blur(fitted: FittedQuantity, values: Floats) -> Floats:
    """Return the standard deviations (n,) of errors at values of a deviation that the covariance does not contain."""
    beyond = max(fitted.by_jackknife**2 - fitted.by_covariance**2, 0.0)
    least = _LEAST_SIZE * np.gradient(values, _GRID) if len(values) > 1 else np.zeros(1)
    return np.sqrt(beyond + least**2)


def _errors(true: Floats, sigma: Floats, apparent: Floats) -> Floats:
    """Return the probabilities (n, m) of apparent values, ascending, that normal errors make of true ones."""
    square = ((apparent - true[:, None]) / np.maximum(sigma, 1e-12)[:, None]) ** 2
    weight = np.exp(-0.5 * (square - square.min(axis=1, keepdims=True)))
    if len(apparent) > 1:
        weight *= np.gradient(apparent)
    return np.asarray(weight / weight.sum(axis=1, keepdims=True))


def _mean_and_variance(weight: Floats) -> tuple[float, float]:
    """Return mean and variance of a deviation with weights on the grid; 0 of one that is known."""
    if len(weight) == 1:
        return 0.0, 0.0
    mean = float(weight @ _GRID / weight.sum())
    return mean, float(weight @ (_GRID - mean) ** 2 / weight.sum())


def _moments(values: Floats, weight: Floats, variance: Floats) -> tuple[float, float]:
    """Return mean and standard deviation of values with their variances, all by tail, in the range of a study."""
    mean = float(weight @ values / weight.sum())
    size = float(np.sqrt(weight @ ((values - mean) ** 2 + np.maximum(variance, 0.0)) / weight.sum()))
    return float(np.clip(mean, -LARGEST_DEVIATION, LARGEST_DEVIATION)), float(np.clip(size, _LEAST_SIZE, 3.0))
