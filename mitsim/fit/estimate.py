r"""The estimator: width of the lobe and power of the projector from the blocks of some views.

Signal chain: blocks (:mod:`mitsim.fit.observation`) -> scan of alpha, the two amplitudes solved for at each -> weighted
Gauss-Newton from every local minimum, the Jacobian by forward-mode differentiation -> noise and grain from what the
best one predicts, and again -> covariance, jackknife.

    mean electrons of a pixel = L (a_s S(alpha) + a_w F0)      L = unit light, S = pi f of the lobe, F0 of the metal
    p = a_s + a_w, relative power of the projector             w = a_w / p, wide-angle share

The model is linear in a_s and a_w, so no start but that of alpha is needed. Of a diffuse sheet there is one
amplitude, albedo times relative power; light of a room adds one more. Weights come from the prediction, never from
the datum itself: noise must not choose its own weight.

**Grain** C is the relative standard deviation of a pixel that the imager's noise does not explain: speckle, and dots
of an unknown pattern. It is estimated inside the blocks; the variance of a block's mean over n pixels is

    V = sum(v + C^2 mu^2) / n^2 + row / rows + column / columns

**Uncertainty.** Two estimates, and the larger is reported: (J^T J)^-1 times the reduced chi-square where that is over
1; and the jackknife over captures, (n-1)/n sum (q_i - mean q)^2 of the results without one of them (Efron & Stein,
Ann. Statist. 9, 1981), which knows of errors that all blocks of a pose share. Of fewer than three captures the
quarters of each view are left out instead: errors that vary over the coupon are seen, those of the pose are not.
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
from mitsim.scene.differentiable import Directions, SpecularLobe

#: alphas of the scan
_SCAN = 16
#: rounds of weights and fit
_ROUNDS = 3
#: relative grain with which the first weights are made
_FIRST_GRAIN = 0.1
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
class Residual:
    """What one view's blocks [e-] are, and what was predicted: ``measured``, ``predicted``, ``sigma`` (size,)."""

    view: View
    measured: Floats = field(repr=False)
    predicted: Floats = field(repr=False)
    sigma: Floats = field(repr=False)
    pixels: Floats = field(repr=False)

    @property
    def in_noise(self) -> Floats:
        """Measured less predicted, in standard deviations of the block's noise."""
        return np.asarray((self.measured - self.predicted) / self.sigma)

    @property
    def rms_dn(self) -> float:
        """Root mean square of the difference [DN]."""
        if not self.view.size:
            return float("nan")
        return float(np.sqrt(np.mean((self.measured - self.predicted) ** 2)) * self.view.noise.gain)

    @property
    def rms_relative(self) -> float:
        """Root mean square of the difference over the root mean square of the prediction [1]."""
        if not self.view.size:
            return float("nan")
        return float(np.sqrt(np.mean((self.measured - self.predicted) ** 2) / np.mean(self.predicted**2)))

    @property
    def rms_in_noise(self) -> float:
        """Root mean square of :attr:`in_noise` [1]."""
        return float(np.sqrt(np.mean(self.in_noise**2))) if self.view.size else float("nan")


@dataclass(frozen=True)
class Fit:
    """What was found.

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
    problem = _Problem(views, finish)
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


class _Problem:
    """All views, their blocks one after the other.

    Parameters are (log alpha, a_s, a_w) of a metal, (a_w,) of a diffuse sheet, then the light of the room if any.
    """

    def __init__(self, views: Sequence[View], finish: MetalFinish | None) -> None:
        self.views, self.finish = list(views), finish
        self.starts = np.cumsum([0, *(view.size for view in self.views)])
        self.count = int(self.starts[-1])
        self.capture = np.repeat([view.capture for view in self.views], [view.size for view in self.views])

        def joined(name: str) -> Floats:
            return np.concatenate([np.asarray(getattr(view, name), float) for view in self.views])

        if not self.count:
            return
        self.unit, self.electrons = joined("unit"), joined("electrons")
        self.block = np.concatenate([view.block + at for view, at in zip(self.views, self.starts, strict=False)])
        self.counts = np.bincount(self.block, minlength=self.count).astype(float)
        self.measured = self.means(self.electrons)
        self.wide = self.unit * (1.0 if finish is None else finish.normal_reflectance)
        ambient = joined("ambient")
        self.lit_room = bool(ambient.any())
        #: what is linear and does not hang on alpha: pixels, and means of blocks (blocks, columns)
        self.linear = np.stack([self.wide, ambient] if self.lit_room else [self.wide], axis=1)
        self.linear_means = np.stack([self.means(column) for column in self.linear.T], axis=1)
        self.first_linear = 0 if finish is None else 2
        if finish is not None:
            self.lobe = SpecularLobe(finish.index)
            self.directions = Directions(joined("view"), joined("lamp"))
        self._last: tuple[float, Floats, Floats] | None = None

    def means(self, values: Floats) -> Floats:
        """Of each block."""
        return np.asarray(np.bincount(self.block, values, self.count) / self.counts)

    def specular(self, x: float) -> tuple[Floats, Floats]:
        """L S of every pixel [e-] at log alpha x, and its derivative; the last answer is kept."""
        assert self.finish is not None
        if self._last is None or self._last[0] != x:
            value, slope = self.lobe.reflectance_and_slope(self.finish.scatter, x, self.directions)
            self._last = (x, self.unit * value, self.unit * slope)
        return self._last[1], self._last[2]

    def pixels(self, values: Floats) -> Floats:
        """Predicted electrons of every pixel."""
        predicted = self.linear @ values[self.first_linear :]
        return predicted if self.finish is None else predicted + self.specular(values[0])[0] * values[1]

    def residual(self, values: Floats, variance: Floats) -> Floats:
        """Predicted less measured, in standard deviations."""
        return np.asarray((self.means(self.pixels(values)) - self.measured) / np.sqrt(variance))

    def jacobian(self, values: Floats, variance: Floats) -> Floats:
        """Of :meth:`residual`, (blocks, parameters)."""
        columns = self.linear_means
        if self.finish is not None:
            light, slope = self.specular(values[0])
            columns = np.column_stack([self.means(slope) * values[1], self.means(light), columns])
        return np.asarray(columns / np.sqrt(variance)[:, None])

    def results(self, values: Floats) -> tuple[Floats, Floats]:
        """(log p, log alpha, w) of a metal, (log p,) of a sheet, then the room; and their derivatives by parameters."""
        slopes = np.eye(len(values))
        if self.finish is None:
            slopes[0, 0] = 1.0 / values[0]
            return np.array([np.log(values[0]), *values[1:]]), slopes
        x, lobe, wide, *room = values
        power = lobe + wide
        slopes[:3, :3] = [
            [0.0, 1 / power, 1 / power],
            [1.0, 0.0, 0.0],
            [0.0, -wide / power**2, lobe / power**2],
        ]
        return np.array([np.log(power), x, wide / power, *room]), slopes

    def variance(self, values: Floats) -> tuple[Floats, float]:
        """Of the blocks' means [e-^2], and the grain, as the prediction has them."""
        predicted = self.pixels(values)
        ends = np.cumsum([0, *(len(view.block) for view in self.views)])
        noise = np.concatenate(
            [view.noise.variance(predicted[a:b]) for view, a, b in zip(self.views, ends[:-1], ends[1:], strict=True)]
        )
        noise_mean, square = self.means(noise), self.means(predicted**2)
        # spread inside a block about its own mean, less what the imager explains
        off = self.electrons - predicted
        off -= self.means(off)[self.block]
        spread = self.means(off**2) * self.counts / np.maximum(self.counts - 1, 1) - noise_mean
        trust = self.counts * (square / (noise_mean + _FIRST_GRAIN**2 * square)) ** 2
        known = square > 0
        ratio = np.sum((trust * spread)[known] / square[known]) / max(float(np.sum(trust[known])), 1e-300)
        grain = float(np.sqrt(max(ratio, 0.0)))
        shared = np.concatenate(
            [np.full(view.size, (view.noise.row + view.noise.column) / view.width) for view in self.views]
        )
        return (noise_mean + grain**2 * square) / self.counts + shared, grain

    def neighbours(self, residual: Floats) -> float:
        """Correlation of the residuals of blocks that lie side by side in a view."""
        products, squares = 0.0, 0.0
        pairs = 0
        for view, at in zip(self.views, self.starts, strict=False):
            mine = {(int(r), int(c)): residual[at + i] for i, (r, c) in enumerate(view.grid)}
            for (r, c), value in mine.items():
                for beside in ((r + 1, c), (r, c + 1)):
                    if beside in mine:
                        products += value * mine[beside]
                        squares += 0.5 * (value**2 + mine[beside] ** 2)
                        pairs += 1
        return float(products / squares) if pairs and squares > 0 else float("nan")

    def quarters(self) -> NDArray[np.int64]:
        """Number of each block's quarter of its view, about the middle of the view's blocks."""
        out = np.empty(self.count, np.int64)
        for number, (view, at) in enumerate(zip(self.views, self.starts, strict=False)):
            if view.size:
                lower, right = (view.grid > np.median(view.grid, axis=0)).T
                out[at : at + view.size] = 4 * number + 2 * lower + right
        return out

    def by_view(self, values: Floats, variance: Floats) -> tuple[Residual, ...]:
        """Residuals, view by view."""
        pixels = self.pixels(values)
        means = self.means(pixels)
        out, first = [], 0
        for view, at in zip(self.views, self.starts, strict=False):
            own = slice(at, at + view.size)
            last = first + len(view.block)
            out.append(Residual(view, self.measured[own], means[own], np.sqrt(variance[own]), pixels[first:last]))
            first = last
        return tuple(out)


def _first(problem: _Problem, use: NDArray[np.bool_]) -> Floats:
    """Parameters to begin with: the best of all local minima along alpha, by Gauss-Newton from each."""
    measured = np.maximum(problem.measured, 0.0)
    noise = np.concatenate(
        [
            view.noise.variance(measured[a : a + view.size])
            for view, a in zip(problem.views, problem.starts, strict=False)
        ]
    )
    variance = (noise + (_FIRST_GRAIN * measured) ** 2) / problem.counts + (0.02 * measured) ** 2
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


def _refine(problem: _Problem, start: Floats, variance: Floats, use: NDArray[np.bool_]) -> Floats:
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


def _jackknife(problem: _Problem, values: Floats, variance: Floats) -> Floats:
    """Standard uncertainties of the results by leaving out one capture, or one quarter of a view, at a time."""
    group = problem.capture if len(np.unique(problem.capture)) >= _FEWEST_CAPTURES else problem.quarters()
    without = np.array(
        [problem.results(_refine(problem, values, variance, group != left_out))[0] for left_out in np.unique(group)]
    )
    count = len(without)
    return np.asarray(np.sqrt((count - 1) / count * ((without - without.mean(axis=0)) ** 2).sum(axis=0)))
