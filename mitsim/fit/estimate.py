r"""The estimator: width of the lobe and power of the projector from the blocks of some views.

Signal chain: blocks (:mod:`mitsim.fit.observation`) and their model (:mod:`mitsim.fit.problem`) -> scan of alpha, the
two amplitudes solved for at each -> weighted Gauss-Newton from every local minimum, the Jacobian by forward-mode
differentiation -> noise and grain from the best prediction, and again -> covariance, jackknife.

    p = a_s + a_w, relative power of the projector             w = a_w / p, wide-angle share

The model is linear in a_s and a_w, so only alpha needs a start. Weights come from the prediction, never from the datum
itself: noise must not choose its own weight.

**Uncertainty.** Two estimates, and the larger is reported: (J^T J)^-1 times the reduced chi-square where that is over
1; and the jackknife over captures, (n-1)/n sum (q_i - mean q)^2 of the results without one of them (Efron & Stein,
Ann. Statist. 9, 1981), which includes errors that all blocks of a pose share. With fewer than three captures the
quarters of each view are left out instead: that includes errors that vary over the coupon, but not those of the pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares, nnls

from mitsim.errors import InputError
from mitsim.fit.finish import LOG_ALPHA_RANGE, MetalFinish
from mitsim.fit.observation import Floats, View
from mitsim.fit.problem import FIRST_GRAIN, Problem, Residual

#: alphas of the scan
_SCAN = 16
#: rounds of weights and fit
_ROUNDS = 3
#: fewer captures than this say nothing of their spread
_FEWEST_CAPTURES = 3
#: fewer blocks than this cannot carry three parameters and their residual
FEWEST_BLOCKS = 12


@dataclass(frozen=True)
class Parameter:
    """A fitted quantity: its value, standard uncertainty by covariance and by jackknife."""

    value: float
    by_covariance: float
    by_jackknife: float

    @property
    def uncertainty(self) -> float:
        """The larger of the two."""
        return max(self.by_covariance, self.by_jackknife)


@dataclass(frozen=True)
class Fit:
    """Result of a fit.

    ``log_alpha`` natural logarithm (None of a diffuse sheet), ``log_power`` of the relative power, times the albedo of
    a diffuse sheet; ``wide_angle`` share (None of a diffuse sheet); ``ambient`` light of the room in the middle of the
    image [e-/s] (None where there is none); ``reduced_chi_square`` of ``blocks``; ``grain`` C [1];
    ``neighbours`` correlation of the residuals of neighbouring blocks [1]; ``at_limit`` whether alpha ran to the end
    of its range; ``residuals`` by view; ``pixels`` compared.
    """

    log_power: Parameter
    log_alpha: Parameter | None
    wide_angle: Parameter | None
    ambient: Parameter | None
    reduced_chi_square: float
    blocks: int
    pixels: int
    grain: float
    neighbours: float
    at_limit: bool
    residuals: tuple[Residual, ...] = field(repr=False)


def fit_views(views: Sequence[View], finish: MetalFinish | None, where: str = "captures") -> Fit:
    """Fit what is not known of a coupon to its views; ``finish`` is None for a diffuse sheet.

    Raises
    ------
    InputError
        If too few blocks are neither saturated nor beside the coupon.
    """
    problem = Problem(views, finish)
    if problem.count < FEWEST_BLOCKS:
        whole = sum(view.whole for view in views)
        raise InputError(
            where,
            "images",
            f"{problem.count} of {whole} blocks on the coupon free of saturation",
            f"{FEWEST_BLOCKS} or more",
            "shorter exposures, other poses, or smaller blocks",
        )
    every = np.ones(problem.count, bool)
    values = _first(problem, every)
    grain = 0.0
    for _ in range(_ROUNDS):
        variance, grain = problem.variance(values)
        values = _refine(problem, values, variance, every)
    residual, jacobian = problem.residual(values, variance), problem.jacobian(values, variance)
    degrees = max(problem.count - len(values), 1)
    chi_square = float(residual @ residual) / degrees
    covariance = np.linalg.pinv(jacobian.T @ jacobian) * max(chi_square, 1.0)
    results, slopes = problem.results(values)
    by_covariance = np.sqrt(np.einsum("ik,kl,il->i", slopes, covariance, slopes))
    by_jackknife = _jackknife(problem, values, variance)
    found = [
        Parameter(float(v), float(c), float(j)) for v, c, j in zip(results, by_covariance, by_jackknife, strict=True)
    ]
    metal = finish is not None
    return Fit(
        found[0],
        found[1] if metal else None,
        found[2] if metal else None,
        found[-1] if problem.lit_room else None,
        chi_square,
        problem.count,
        len(problem.unit),
        grain,
        problem.neighbours(residual),
        bool(metal and np.abs(values[0] - LOG_ALPHA_RANGE).min() < 1e-3),
        problem.by_view(values, variance),
    )


def _first(problem: Problem, use: NDArray[np.bool_]) -> Floats:
    """Parameters to begin with: the best of all local minima along alpha, by Gauss-Newton from each."""
    measured = np.maximum(problem.measured, 0.0)
    noise = np.concatenate(
        [
            view.noise.variance(measured[a : a + view.size])
            for view, a in zip(problem.views, problem.starts, strict=False)
        ]
    )
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
    refined = [_refine(problem, starts[i], variance, use) for i in lowest]
    return min(refined, key=lambda v: float(np.sum(problem.residual(v, variance)[use] ** 2)))


def _amplitudes(columns: Floats, measured: Floats, weight: Floats) -> tuple[Floats, float]:
    """Amplitudes of 0 or more that fit best, and the misfit that they leave."""
    weighted = columns * weight[:, None]
    # of like size, or the solver takes a dim column for rounding
    scale = np.maximum(np.linalg.norm(weighted, axis=0), 1e-300)
    amplitudes, misfit = nnls(weighted / scale, measured * weight)
    return np.asarray(amplitudes / scale), float(misfit)


def _refine(problem: Problem, start: Floats, variance: Floats, use: NDArray[np.bool_]) -> Floats:
    """Weighted least squares over the blocks of ``use``: trust-region Gauss-Newton (SciPy's ``trf``)."""
    low, high, inner = np.zeros(len(start)), np.full(len(start), np.inf), start.copy()
    first = 0
    if problem.finish is not None:
        first, (low[0], high[0]) = 1, LOG_ALPHA_RANGE
        inner[0] = np.clip(inner[0], low[0] + 1e-4, high[0] - 1e-4)
    # strictly inside the bounds: an amplitude of 0 is given a ten-thousandth of what it would need to explain all
    most = problem.measured.mean() / np.maximum(problem.linear_means.mean(axis=0), 1e-300)
    least = 1e-4 * np.abs(most if first == 0 else np.array([most[0], *most]))
    inner[first:] = np.maximum(inner[first:], least)
    answer = least_squares(
        lambda v: problem.residual(v, variance)[use],
        inner,
        jac=lambda v: problem.jacobian(v, variance)[use],
        bounds=(low, high),
        x_scale="jac",
        xtol=1e-7,
        ftol=1e-11,
        gtol=1e-11,
        max_nfev=60,
    )
    return np.asarray(answer.x, np.float64)


def _jackknife(problem: Problem, values: Floats, variance: Floats) -> Floats:
    """Standard uncertainties of the results by leaving out one capture, or one quarter of a view, at a time."""
    group = problem.capture if len(np.unique(problem.capture)) >= _FEWEST_CAPTURES else problem.quarters()
    without = np.array(
        [problem.results(_refine(problem, values, variance, group != left_out))[0] for left_out in np.unique(group)]
    )
    count = len(without)
    return np.asarray(np.sqrt((count - 1) / count * ((without - without.mean(axis=0)) ** 2).sum(axis=0)))
