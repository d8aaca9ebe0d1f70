"""Narrow the prior of a finish by captures of a coupon, for ``[unknowns.finish.measured]`` of a study.

Signal chain: blocks of the views -> fits of alpha, power and wide-angle share at several tails of the lobe -> weight of
each tail, from its prior and its chi-square -> mean and standard deviation of alpha, wide-angle share and tail, in
one-sigma ranges of their priors.

The tail is not among the parameters of a fit (:mod:`mitsim.twin.finish.estimate`), since few captures determine it. The
fits here keep the weights of the fit at the best estimate of the tail. Alpha depends on the tail: its variance is the
mean of the variances of the fits plus the variance of the fitted values. Images show the product of power and
reflectance, so the prior of the reflectance stays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from characterisation.files.arrays import Floats
from mitsim.scene.surface.processes import LARGEST_WIDE_ANGLE
from mitsim.scene.surface.scatter import LARGEST_DEVIATION, Deviation, Scatter
from mitsim.twin.finish.estimate import Fit, best_values, refine
from mitsim.twin.finish.finish import MetalFinish
from mitsim.twin.finish.observation import CouponView
from mitsim.twin.finish.problem import Problem

#: Beckmann shares that are fitted [1]; chi-square and results are smooth between them
_SHARES = (0.0, 0.1, 0.2, 0.35, 0.5, 0.75, 1.0)

#: standard deviation that is written at least; a posterior is no better than the model of the lobe. Assumed
_LEAST_SIZE = 0.05


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
    """Return the posterior of a coupon's finish.

    Parameters
    ----------
    views, finish, fit
        Views of the coupon, metal and process, and the fit of these views (:func:`fit_views`), whose jackknife bounds
        the uncertainties at each tail from below.
    prior
        Scattering of the coupon at the best estimate, which the scene gives.
    name
        Id of the BSDF in the scene.
    """
    assert fit.log_alpha is not None and fit.wide_angle is not None and prior.beckmann_range is not None
    problem = Problem(views, finish)
    start, variance, _ = best_values(problem)
    scale = max(fit.reduced_chi_square, 1.0)
    results, cost = [], []
    for share in _SHARES:
        other = Problem(views, finish.with_beckmann(share))
        values = refine(other, start, variance, np.ones(other.count, bool))
        results.append(other.results(values)[0][1:3])
        cost.append(float(np.sum(other.residual(values, variance) ** 2)) / scale)
    grid = np.linspace(-LARGEST_DEVIATION, LARGEST_DEVIATION, 601)
    shares = np.array([Deviation(tail=tail).beckmann(prior.beckmann, prior.beckmann_range) for tail in grid.tolist()])
    chi_square = CubicSpline(_SHARES, np.array(cost))(shares)
    weight = np.exp(-0.5 * (chi_square - chi_square.min() + grid**2))
    weight /= weight.sum()
    log_alpha, wide = CubicSpline(_SHARES, np.array(results))(shares).T
    alpha_pair = wide_pair = None
    if prior.alpha_factor > 1:
        unit = np.log(prior.alpha_factor)
        alpha_pair = _moments((log_alpha - np.log(prior.alpha_u)) / unit, weight, fit.log_alpha.uncertainty / unit)
    low, high = prior.wide_angle_range
    if 0 < low < prior.wide_angle < high:
        unit = (_log_odds(np.array(high)) - _log_odds(np.array(low))) / 2
        off = (_log_odds(wide) - _log_odds(np.array(prior.wide_angle))) / unit
        value = float(np.clip(fit.wide_angle.value, 1e-3, LARGEST_WIDE_ANGLE - 1e-3))
        slope = LARGEST_WIDE_ANGLE / (value * (LARGEST_WIDE_ANGLE - value))
        wide_pair = _moments(off, weight, fit.wide_angle.uncertainty * slope / float(unit))
    return FinishPosterior(name, alpha_pair, wide_pair, _moments(grid, weight, 0.0))


def _log_odds(share: Floats) -> Floats:
    inside = np.clip(share, 1e-3, LARGEST_WIDE_ANGLE - 1e-3)
    return np.asarray(np.log(inside / (LARGEST_WIDE_ANGLE - inside)))


def _moments(values: Floats, weight: Floats, uncertainty: float) -> tuple[float, float]:
    """Return mean and standard deviation of values of a standard ``uncertainty``, in the range of a study."""
    mean = float(weight @ values)
    size = float(np.sqrt(weight @ (values - mean) ** 2 + uncertainty**2))
    return float(np.clip(mean, -LARGEST_DEVIATION, LARGEST_DEVIATION)), float(np.clip(size, _LEAST_SIZE, 3.0))
