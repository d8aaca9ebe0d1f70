r"""Estimate the width of the lobe and the power of the projector from the blocks of several views.

Signal chain: blocks (:mod:`mitsim.twin.finish.observation`) and their model (:mod:`mitsim.twin.finish.problem`) -> scan
of alpha, with the two amplitudes solved at each value -> weighted Gauss-Newton from every local minimum, with the
Jacobian from forward-mode differentiation -> noise and grain from the best prediction, and repetition -> covariance,
jackknife.

    p = a_s + a_w, relative power of the projector             w = a_w / p, wide-angle share

The model is linear in a_s and a_w, so only alpha needs an initial estimate. Weights follow from the prediction, not
from the measured values: noise would otherwise influence its own weight.

**Uncertainty.** The larger of two variances is reported. The first is that of least squares, (J^T J)^-1 times the
reduced chi-square if that exceeds 1. The second is that of the jackknife over n captures, (n-1)/n sum (q_i - mean q)^2
(Efron & Stein, Ann. Statist. 9, 1981). Here q_i is the result without capture i. The jackknife contains errors that all
blocks of a pose share. With fewer than three captures, the quarters of each view are left out instead. This contains
errors that vary over the coupon, but not those of the pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares, nnls

from characterisation.files.arrays import Floats
from characterisation.files.errors import InputError
from mitsim.twin.finish.finish import LOG_ALPHA_RANGE, MetalFinish
from mitsim.twin.finish.observation import CouponView
from mitsim.twin.finish.problem import FIRST_GRAIN, Problem, Residual

#: number of alphas in the scan
_SCAN = 16
#: number of repetitions of weights and fit
_ROUNDS = 3
#: least number of captures for a jackknife over captures
_FEWEST_CAPTURES = 3
#: least number of blocks to fit three parameters and their residual
FEWEST_BLOCKS = 12
#: all blocks
_ALL = slice(None)


@dataclass(frozen=True)
class FittedQuantity:
    """A fitted quantity: its value, and its standard uncertainties from covariance and jackknife."""

    value: float
    by_covariance: float
    by_jackknife: float

    @property
    def uncertainty(self) -> float:
        """The larger of the two standard uncertainties."""
        return max(self.by_covariance, self.by_jackknife)


@dataclass(frozen=True)
class Fit:
    """Result of a fit.

    - ``log_power``: natural logarithm of the relative power; for a diffuse sheet, of the power times the albedo.
    - ``log_alpha``: natural logarithm of alpha; ``wide_angle``: share [1]. Both are None for a diffuse sheet.
    - ``ambient``: light of the room in the middle of the image [e-/s], None if not fitted.
    - ``grain`` C [1]; ``neighbours``: correlation of the residuals of neighbouring blocks [1].
    - ``at_limit``: whether alpha reached an end of its range.
    """

    log_power: FittedQuantity
    log_alpha: FittedQuantity | None
    wide_angle: FittedQuantity | None
    ambient: FittedQuantity | None
    reduced_chi_square: float
    blocks: int
    pixels: int
    grain: float
    neighbours: float
    at_limit: bool
    residuals: tuple[Residual, ...] = field(repr=False)


def fit_views(views: Sequence[CouponView], finish: MetalFinish | None) -> Fit:
    """Fit alpha, the power and the wide-angle share of a coupon to its views.

    ``finish`` is the metal and process of the coupon, None for a diffuse sheet. Raises InputError if too few blocks on
    the coupon are free of saturation.
    """
    problem = Problem(views, finish)
    if problem.count < FEWEST_BLOCKS:
        whole = sum(view.whole for view in views)
        free = f"{problem.count} of {whole} blocks on the coupon free of saturation"
        hint = "shorter exposures, other poses, or smaller blocks"
        raise InputError("captures", "images", free, f"{FEWEST_BLOCKS} or more", hint)
    values, variance, grain = best_values(problem)
    residual, jacobian = problem.residual(values, variance), problem.jacobian(values, variance)
    degrees = max(problem.count - len(values), 1)
    chi_square = float(residual @ residual) / degrees
    covariance = np.linalg.pinv(jacobian.T @ jacobian) * max(chi_square, 1.0)
    results, slopes = problem.results(values)
    by_covariance = np.sqrt(np.einsum("ik,kl,il->i", slopes, covariance, slopes))
    by_jackknife = _jackknife(problem, values, variance)
    rows = np.stack([results, by_covariance, by_jackknife], axis=1).tolist()
    fitted, metal = [FittedQuantity(*row) for row in rows], finish is not None
    return Fit(
        fitted[0],
        fitted[1] if metal else None,
        fitted[2] if metal else None,
        fitted[-1] if problem.lit_room else None,
        chi_square,
        problem.count,
        len(problem.unit),
        grain,
        problem.neighbours(residual),
        bool(metal and np.abs(values[0] - LOG_ALPHA_RANGE).min() < 1e-3),
        problem.by_view(values, variance),
    )


def best_values(problem: Problem) -> tuple[Floats, Floats, float]:
    """Return the best parameters, the variance of the block means [e-^2] that weighs them, and the grain [1]."""
    values, grain = _first(problem), 0.0
    for _ in range(_ROUNDS):
        variance, grain = problem.variance(values)
        values = refine(problem, values, variance)
    return values, variance, grain


def _first(problem: Problem) -> Floats:
    """Return initial estimates of the parameters: the best local minimum along alpha, after Gauss-Newton from each."""
    measured = np.maximum(problem.measured, 0.0)
    by_view = zip(problem.views, np.split(measured, problem.starts[1:-1]), strict=True)
    noise = np.concatenate([view.noise.variance(means) for view, means in by_view])
    variance = (noise + (FIRST_GRAIN * measured) ** 2) / problem.counts + (0.02 * measured) ** 2
    weight = 1.0 / np.sqrt(variance)
    if problem.finish is None:
        return _amplitudes(problem.linear_means, problem.measured, weight)[0]
    starts, costs = [], []
    for x in np.linspace(*LOG_ALPHA_RANGE, _SCAN):
        light = problem.means(problem.specular(float(x))[0])
        amplitudes, misfit = _amplitudes(np.column_stack([light, problem.linear_means]), problem.measured, weight)
        starts.append(np.array([float(x), *amplitudes]))
        costs.append(misfit)
    lowest = [i for i in range(_SCAN) if costs[i] <= min(costs[max(i - 1, 0)], costs[min(i + 1, _SCAN - 1)])]
    refined = [refine(problem, starts[i], variance) for i in lowest]
    return min(refined, key=lambda v: float(np.sum(problem.residual(v, variance) ** 2)))


def _amplitudes(columns: Floats, measured: Floats, weight: Floats) -> tuple[Floats, float]:
    """Return the non-negative amplitudes of the weighted least-squares fit, and the norm of its residuals."""
    weighted = columns * weight[:, None]
    # columns of equal norm, so that the solver does not take a dim one for rounding errors
    scale = np.maximum(np.linalg.norm(weighted, axis=0), 1e-300)
    amplitudes, misfit = nnls(weighted / scale, measured * weight)
    return np.asarray(amplitudes / scale), float(misfit)


def refine(problem: Problem, start: Floats, variance: Floats, use: NDArray[np.bool_] | slice = _ALL) -> Floats:
    """Return the parameters of weighted least squares, by SciPy's ``trf`` method.

    Parameters
    ----------
    problem, start, variance, use
        ``variance`` (blocks,) of the block means [e-^2]; ``use`` (blocks,): which blocks count.
    """
    low, high, inner = np.zeros(len(start)), np.full(len(start), np.inf), start.copy()
    first = 0
    if problem.finish is not None:
        first, (low[0], high[0]) = 1, LOG_ALPHA_RANGE
        inner[0] = np.clip(inner[0], low[0] + 1e-4, high[0] - 1e-4)
    # start strictly inside the bounds: least amplitude, 1e-4 of the one that alone would explain the mean
    most = problem.measured.mean() / np.maximum(problem.linear_means.mean(axis=0), 1e-300)
    least = 1e-4 * np.abs(most if first == 0 else np.array([most[0], *most]))
    inner[first:] = np.maximum(inner[first:], least)

    def residual(values: Floats) -> Floats:
        return problem.residual(values, variance)[use]

    def jacobian(values: Floats) -> Floats:
        return problem.jacobian(values, variance)[use]

    limits = {"xtol": 1e-7, "ftol": 1e-11, "gtol": 1e-11}
    answer = least_squares(residual, inner, jacobian, (low, high), x_scale="jac", max_nfev=60, **limits)
    return np.asarray(answer.x, np.float64)


def _jackknife(problem: Problem, values: Floats, variance: Floats) -> Floats:
    """Return the jackknife's standard uncertainties of the results: one capture, or quarter of a view, is left out."""
    group = problem.capture if len(np.unique(problem.capture)) >= _FEWEST_CAPTURES else problem.quarters()
    kept = [group != left_out for left_out in np.unique(group)]
    without = np.array([problem.results(refine(problem, values, variance, use))[0] for use in kept])
    return np.asarray(np.sqrt((len(kept) - 1) / len(kept) * ((without - without.mean(axis=0)) ** 2).sum(axis=0)))
