"""Define the least-squares problem of a coupon's finish: blocks of all views, their prediction and its derivatives.

Signal chain: parameters -> electrons of every pixel -> means of the blocks -> residuals in standard deviations.

    mean electrons of a pixel = L (a_s S(alpha) + a_w F0)      L = unit light, S = pi f of the lobe, F0 of the metal

The model is linear in the amplitudes a_s and a_w. A diffuse sheet has one amplitude, albedo times relative power. Light
of a room adds another. Source of L and S: :mod:`mitsim.scene.differentiable`.

**Grain** C is the relative standard deviation of a pixel that the imager's noise does not explain. It comes from
speckle and from dots of an unknown pattern, and is estimated from the scatter inside the blocks. So is the correlation
rho of neighbouring pixels in it; at distance d it is rho^(d^2), as of speckle. The variance of a block's mean over n
pixels is the sum of independent contributions, with v the imager's noise (:mod:`mitsim.twin.finish.electrons`):

    V = sum(v + k C^2 mu^2) / n^2 + row / rows + column / columns
    k = product over both axes of (1 + 2 sum over d of rho^(d^2) (1 - d / width))
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from characterisation.files.arrays import Floats
from mitsim.scene.differentiable import Directions, SpecularLobe
from mitsim.twin.finish.finish import MetalFinish
from mitsim.twin.finish.observation import CouponView

#: largest correlation of neighbouring pixels in the grain, which falls to 1 / e at 4.4 px then
_MOST_CORRELATED = 0.95

#: grain for the initial weights
FIRST_GRAIN = 0.1


@dataclass(frozen=True)
class Residual:
    """Block means of one view [e-]: ``measured``, ``predicted`` and ``sigma`` (size,); ``pixels``: predicted pixels."""

    view: CouponView
    measured: Floats = field(repr=False)
    predicted: Floats = field(repr=False)
    sigma: Floats = field(repr=False)
    pixels: Floats = field(repr=False)

    @property
    def in_noise(self) -> Floats:
        """Measured minus predicted, in standard deviations of the block's noise."""
        return np.asarray((self.measured - self.predicted) / self.sigma)

    @property
    def rms_dn(self) -> float:
        """Root mean square of the difference [DN]."""
        return _rms(self.measured - self.predicted) * self.view.noise.gain

    @property
    def rms_relative(self) -> float:
        """Root mean square of the difference over the root mean square of the prediction [1]."""
        return _rms(self.measured - self.predicted) / _rms(self.predicted)

    @property
    def rms_in_noise(self) -> float:
        """Root mean square of :attr:`in_noise` [1]."""
        return _rms(self.in_noise)


def _rms(values: Floats) -> float:
    """Return the root mean square; NaN without values."""
    return float(np.sqrt(np.mean(values**2))) if len(values) else float("nan")


def _sum_of_correlations(neighbours: float, widths: NDArray[np.int64]) -> Floats:
    """Return the sums of the correlations rho^(d^2) of a pixel with those of its row in blocks of some ``widths``."""
    steps = np.arange(1, int(widths.max()))
    shares = np.maximum(1 - steps / widths[:, None], 0.0)
    return np.asarray(1 + 2 * shares @ neighbours ** (steps.astype(float) ** 2))


class Problem:
    """The blocks of all views, one view after the other, and their model.

    The parameters are (log alpha, a_s, a_w) for a metal and (a_w,) for a diffuse sheet. The light of the room follows,
    if there is any.
    """

    def __init__(self, views: Sequence[CouponView], finish: MetalFinish | None) -> None:
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
        #: pixels that have a neighbour in their block, along the columns and along the rows, and these neighbours
        self.pairs = self._neighbours_in_blocks()
        self.measured = self.means(self.electrons)
        self.wide = self.unit * (1.0 if finish is None else finish.normal_reflectance)
        ambient = joined("ambient")
        self.lit_room = bool(ambient.any())
        #: linear terms that do not depend on alpha: of pixels, and means of blocks (blocks, columns)
        self.linear = np.stack([self.wide, ambient] if self.lit_room else [self.wide], axis=1)
        self.linear_means = np.stack([self.means(column) for column in self.linear.T], axis=1)
        self.first_linear = 0 if finish is None else 2
        if finish is not None:
            self.lobe = SpecularLobe(finish.index)
            self.directions = Directions(joined("toward_camera"), joined("toward_projector"))
        self._last: tuple[float, Floats, Floats] | None = None

    def means(self, values: Floats) -> Floats:
        """Return the mean of pixel values in each block, (blocks,)."""
        return np.asarray(np.bincount(self.block, values, self.count) / self.counts)

    def specular(self, x: float) -> tuple[Floats, Floats]:
        """Return L S of every pixel [e-] at log alpha = x, and its derivative by x; the last result is cached."""
        assert self.finish is not None
        if self._last is None or self._last[0] != x:
            value, slope = self.lobe.reflectance_and_slope(self.finish.scatter, x, self.directions)
            self._last = (x, self.unit * value, self.unit * slope)
        return self._last[1], self._last[2]

    def pixels(self, values: Floats) -> Floats:
        """Return the predicted electrons [e-] of every pixel at the parameters ``values``."""
        predicted = self.linear @ values[self.first_linear :]
        return predicted if self.finish is None else predicted + self.specular(values[0])[0] * values[1]

    def residual(self, values: Floats, variance: Floats) -> Floats:
        """Return predicted minus measured block means, in standard deviations."""
        return np.asarray((self.means(self.pixels(values)) - self.measured) / np.sqrt(variance))

    def jacobian(self, values: Floats, variance: Floats) -> Floats:
        """Return the Jacobian of :meth:`residual`, (blocks, parameters)."""
        columns = self.linear_means
        if self.finish is not None:
            light, slope = self.specular(values[0])
            columns = np.column_stack([self.means(slope) * values[1], self.means(light), columns])
        return np.asarray(columns / np.sqrt(variance)[:, None])

    def results(self, values: Floats) -> tuple[Floats, Floats]:
        """Return the results, and their derivatives by the parameters (results, parameters).

        They are (log p, log alpha, w) for a metal and (log p,) for a diffuse sheet, then the light of the room.
        """
        slopes = np.eye(len(values))
        if self.finish is None:
            slopes[0, 0] = 1.0 / values[0]
            return np.array([np.log(values[0]), *values[1:]]), slopes
        x, lobe, wide, *room = values
        power = lobe + wide
        slopes[:3, :3] = [[0.0, 1 / power, 1 / power], [1.0, 0.0, 0.0], [0.0, -wide / power**2, lobe / power**2]]
        return np.array([np.log(power), x, wide / power, *room]), slopes

    def variance(self, values: Floats) -> tuple[Floats, float]:
        """Return the variance of the block means [e-^2], and the grain [1], at the predicted electrons."""
        predicted = self.pixels(values)
        by_view = zip(self.views, self._of_views(predicted), strict=True)
        noise = np.concatenate([view.noise.variance(pixels) for view, pixels in by_view])
        noise_mean, square = self.means(noise), self.means(predicted**2)
        # variance inside a block about its own mean, minus the noise of the imager
        off = self.electrons - predicted
        off -= self.means(off)[self.block]
        spread = self.means(off**2) * self.counts / np.maximum(self.counts - 1, 1) - noise_mean
        trust = self.counts * (square / (noise_mean + FIRST_GRAIN**2 * square)) ** 2
        lit = square > 0
        ratio = np.sum((trust * spread)[lit] / square[lit]) / max(float(np.sum(trust[lit])), 1e-300)
        grain = float(np.sqrt(max(ratio, 0.0)))
        sums = np.ones(self.count)
        widths = np.repeat([view.width for view in self.views], [view.size for view in self.views])
        for first, second in self.pairs if grain > 0 else ():
            block = self.block[first]
            count = np.bincount(block, minlength=self.count)
            weight = np.where(lit & (count > 0), trust, 0.0)
            product = np.bincount(block, off[first] * off[second], self.count) / np.maximum(count, 1)
            share = float(np.sum(weight * product / np.where(lit, square, 1.0)) / max(weight.sum(), 1e-300)) / ratio
            sums *= _sum_of_correlations(min(max(share, 0.0), _MOST_CORRELATED), widths)
        of_lines = [(view.noise.row + view.noise.column) / view.width for view in self.views]
        shared = np.repeat(of_lines, [view.size for view in self.views])
        return (noise_mean + sums * grain**2 * square) / self.counts + shared, grain

    def _of_views(self, pixels: Floats) -> list[Floats]:
        """Return the values of the pixels of each view."""
        return np.split(pixels, np.cumsum([len(view.block) for view in self.views[:-1]]))

    def _neighbours_in_blocks(self) -> list[tuple[NDArray[np.intp], NDArray[np.intp]]]:
        """Return the indices of pixels and of their neighbours in the same block, for both axes."""
        rows, columns = (np.concatenate([getattr(view, name) for view in self.views]) for name in ("rows", "columns"))
        steps = (1, int(columns.max()) + 2)
        position = (self.block * (int(rows.max()) + 2) + rows) * steps[1] + columns
        order = np.argsort(position)
        ordered = position[order]
        out = []
        for step in steps:
            at = np.minimum(np.searchsorted(ordered, position + step), len(ordered) - 1)
            first = np.flatnonzero(ordered[at] == position + step)
            out.append((first, order[at[first]]))
        return out

    def neighbours(self, residual: Floats) -> float:
        """Return the correlation of the residuals of neighbouring blocks in a view, NaN without neighbours."""
        products, squares = 0.0, 0.0
        for view, at in zip(self.views, self.starts, strict=False):
            mine = {(int(r), int(c)): residual[at + i] for i, (r, c) in enumerate(view.grid)}
            for (r, c), value in mine.items():
                for beside in ((r + 1, c), (r, c + 1)):
                    if beside in mine:
                        products += value * mine[beside]
                        squares += 0.5 * (value**2 + mine[beside] ** 2)
        return float(products / squares) if squares > 0 else float("nan")

    def quarters(self) -> NDArray[np.int64]:
        """Return the number of each block's quarter of its view, divided at the median row and column of the blocks."""
        out = np.empty(self.count, np.int64)
        for number, (view, at) in enumerate(zip(self.views, self.starts, strict=False)):
            if view.size:
                lower, right = (view.grid > np.median(view.grid, axis=0)).T
                out[at : at + view.size] = 4 * number + 2 * lower + right
        return out

    def by_view(self, values: Floats, variance: Floats) -> tuple[Residual, ...]:
        """Return the residuals of each view."""
        pixels = self.pixels(values)
        of_blocks = (self.measured, self.means(pixels), np.sqrt(variance))
        measured, predicted, sigma = (np.split(numbers, self.starts[1:-1]) for numbers in of_blocks)
        by_view = zip(self.views, measured, predicted, sigma, self._of_views(pixels), strict=True)
        return tuple(Residual(*row) for row in by_view)
