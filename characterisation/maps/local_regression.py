"""Fit local lines to clustered data: an estimate at a place, with the contribution of every cluster to its variance.

Signal chain: places -> kernel weights of the data within a radius -> weighted least squares, or quasi-likelihood with a
log link, on the displacement from the place -> value there, and the weight l_i of every datum in it -> sums of l_i^2 by
datum and by cluster, which determine the variance.

A local constant is biased wherever the function has a slope and the data lie unevenly about the place. A local line is
unbiased to first order (Fan and Gijbels, Local Polynomial Modelling and Its Applications, 1996, ch. 3).

A positive quantity with multiplicative errors is fitted on a log scale by quasi-likelihood, with variance proportional
to the square of the mean (Fan, Heckman and Wand, J. Am. Stat. Assoc. 90 (1995) 141-150). The estimate is then a mean of
variances, not of their logarithms. The score is linear in y, and the information does not depend on the fit:

    sum w_i (y_i / mu_i - 1) x_i = 0,      mu_i = exp(beta . x_i),      information = sum w_i x_i x_i^T

The kernel is the biweight, (1 - u^2)^2 for u = distance / radius < 1.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from characterisation.files.arrays import Floats

#: (largest radius of the kernel, cell size): rows of one cluster and cell are joined, since a wide kernel needs no fine
#: data. Up to the first radius, rows are not joined
CELLS = ((0.1, 0.0), (0.2, 0.03), (0.4, 0.06), (np.inf, 0.12))

#: side of the squares whose places share their rows, over the smallest radius. The prior is about the middle of the
#: square, so that the side also moves, by up to some percent, the estimates that few data determine
TILE = 1.2

#: largest number of steps of Fisher scoring
SCORING_STEPS = 8

#: largest step in the logarithm
LARGEST_STEP = 1.5

#: scoring ends when all steps are smaller; the remaining error is then the square of the step
SMALL_STEP = 0.02


@dataclass(frozen=True)
class Observations:
    """Data of the regression, n rows sorted by ``cluster``."""

    position: Floats  # (n, 3) regressors; the first two determine the distance in the kernel
    value: Floats  # (n, k) the first column is fitted; its weights are applied to the others
    weight: Floats  # (n,) proportional to the inverse of the variance
    share: Floats  # (n,) number of independent rows that a row stands for
    cluster: NDArray[np.int64]  # (n,) whole numbers
    within: Floats  # (n,) variance of the first column among the rows that were joined to one

    def joined(self, cell: float) -> Observations:
        """Return the data with all rows of one cluster and square cell of the plane joined to one row at their mean."""
        if cell == 0:
            return self
        cells = np.floor(self.position[:, :2] / cell).astype(np.int64)
        cells -= cells.min(axis=0)
        across, along = cells.max(axis=0) + 1
        number, group = np.unique((self.cluster * across + cells[:, 0]) * along + cells[:, 1], return_inverse=True)
        weight = np.asarray(np.bincount(group, self.weight), float)

        def mean(columns: Floats) -> Floats:
            return np.column_stack([np.bincount(group, self.weight * column) / weight for column in columns.T])

        value = mean(self.value)
        within = mean((self.within + (self.value[:, 0] - value[group, 0]) ** 2)[:, None])[:, 0]
        share = np.asarray(np.bincount(group, self.share), float)
        return Observations(mean(self.position), value, weight, share, number // (across * along), within)


@dataclass(frozen=True)
class Slopes:
    """Prior knowledge of the slopes and bends of the function.

    ``mean`` (3,) and ``precision`` (3,) of the slopes, and the precision ``curvature`` of the second-order terms, whose
    prior mean is 0. Precisions are in units of weight.
    """

    mean: tuple[float, float, float]
    precision: tuple[float, float, float]
    curvature: float


@dataclass(frozen=True)
class LocalFit:
    """Fits, one for every radius and of the shape of the radii, ``estimate`` with k last; NaN where there is no weight.

    - ``estimate``: on the scale of the link.
    - ``independent``: sum of l_i^2 / share_i, the factor from the variance of one row to that of the estimate.
    - ``clustered``: sum over clusters of (sum of l_i)^2, the same factor for a variance common to each cluster.
    - ``scatter``: variance of one row about the line (relative, with the log link).
    - ``rows``: effective number of rows in the kernel.
    - ``weight``: sum of their weights.
    """

    estimate: Floats
    independent: Floats
    clustered: Floats
    scatter: Floats
    rows: Floats
    weight: Floats


def local_fit(
    data: Observations,
    at: Floats,
    radii: Floats,
    slopes: Slopes,
    link: Literal["identity", "log"] = "identity",
    clusters: NDArray[np.int64] | None = None,
    keep: Literal["own", "others"] = "others",
) -> LocalFit:
    """Fit a line about every place ``at`` (q, 3), with each of its ``radii`` (q, r) of the kernel.

    ``link`` says whether the line is that of the value or of its logarithm. With ``clusters`` (q,), one for every
    place, only this cluster (``keep="own"``) or only the others are used; without, all are.
    """
    estimate = np.full((*radii.shape, data.value.shape[1]), np.nan)
    sums = {name: np.full(radii.shape, np.nan) for name in ("independent", "clustered", "scatter", "rows", "weight")}
    smallest = 0.0
    for largest, cell in CELLS:
        which, rung = np.nonzero((radii > smallest) & (radii <= largest))
        smallest = largest
        if not len(which):
            continue
        coarse, radius = data.joined(cell), radii[which, rung]
        by_abscissa = np.argsort(coarse.position[:, 0], kind="stable")
        tiles, fits = _tiles(at[which, :2], TILE * radius.min()), []
        for chosen in tiles:
            positions = at[which[chosen]]
            part = _Tile(coarse, by_abscissa, positions, radius[chosen], slopes, link)
            fits.append(part.fit(radius[chosen], None if clusters is None else clusters[which[chosen]], keep))
        order = np.concatenate(tiles)
        estimate[which[order], rung[order]] = np.concatenate([fit.estimate for fit in fits])
        for name, values in sums.items():
            values[which[order], rung[order]] = np.concatenate([getattr(fit, name) for fit in fits])
    return LocalFit(estimate, **sums)


def _tiles(positions: Floats, side: float) -> list[NDArray[np.int64]]:
    """Return the indices of the positions in each square of the plane; those of a square share their data."""
    tile = np.unique(np.floor(positions / side), axis=0, return_inverse=True)[1].ravel()
    order = np.argsort(tile, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(tile[order])) + 1)


def _exp(values: Floats) -> Floats:
    """Return the exponential, limited so that it neither overflows nor underflows when squared."""
    return np.asarray(np.exp(np.clip(values, -300.0, 300.0)))


def _polynomial(positions: Floats) -> Floats:
    """Return the regressors (n, 7) of displacements (n, 3): 1, a, b, x, a^2, a b, b^2."""
    a, b = positions[:, 0], positions[:, 1]
    return np.column_stack([np.ones(len(positions)), positions, a * a, a * b, b * b])


class _Tile:
    """The places of one tile and the rows about them, arranged for matrix products."""

    def __init__(
        self, data: Observations, by_abscissa: NDArray[np.int64], at: Floats, radius: Floats, slopes: Slopes, link: str
    ) -> None:
        self.log = link == "log"
        self.away = np.array([0.0, *slopes.mean, 0.0, 0.0, 0.0])
        self.precision = np.array([0.0, *slopes.precision, *[slopes.curvature] * 3])
        low, high = at[:, :2].min(0) - radius.max(), at[:, :2].max(0) + radius.max()
        a, b = data.position.T[:2]
        first = np.searchsorted(a, low[0], "right", by_abscissa)
        strip = by_abscissa[first : np.searchsorted(a, high[0], "left", by_abscissa)]
        near = np.sort(strip[(b[strip] > low[1]) & (b[strip] < high[1])])  # sorted by cluster again
        middle = at.mean(axis=0)
        self.offset, self.design = _polynomial(at - middle), _polynomial(data.position[near] - middle)
        self.value, self.base, self.share = data.value[near], data.weight[near], data.share[near]
        self.cluster, self.within = data.cluster[near], data.within[near]
        self.starts = np.flatnonzero(np.concatenate([[True], self.cluster[1:] != self.cluster[:-1]]))

    def fit(self, radius: Floats, clusters: NDArray[np.int64] | None, keep: str) -> LocalFit:
        """Fit every place of the tile, see :func:`local_fit`."""
        here, x = self.offset, self.design
        if not len(x):
            return LocalFit(np.full((len(here), self.value.shape[1]), np.nan), *np.full((5, len(here)), np.nan))
        apart = (here[:, None, 1] - x[:, 1]) ** 2 + (here[:, None, 2] - x[:, 2]) ** 2
        weight: Floats = np.maximum(1.0 - apart / (radius**2)[:, None], 0.0) ** 2 * self.base
        if clusters is not None:
            weight[(self.cluster == clusters[:, None]) == (keep == "others")] = 0.0
        total: Floats = weight.sum(1)
        unknown = np.flatnonzero(~(total > 0))
        products = (x[:, :, None] * x[:, None, :]).reshape(len(x), -1)
        matrix = (weight @ products).reshape(-1, x.shape[1], x.shape[1]) + np.diag(self.precision)
        if len(unknown):
            matrix[unknown] = np.eye(x.shape[1])
        inverse = np.linalg.inv(matrix)
        with np.errstate(divide="ignore", invalid="ignore"):
            leverage = weight * (np.einsum("qij,qj->qi", inverse, here) @ x.T)
            fitted = leverage @ self.value
            if self.log:
                line = self._scored(weight, total, np.asarray(inverse, float))
                inverse_mean = _exp(-(line @ x.T))
                squared = (self.value[:, 0] * inverse_mean - 1.0) ** 2 + self.within * inverse_mean**2
            else:
                line = np.einsum("qij,qj->qi", inverse, weight @ (x * self.value[:, :1]) + self.precision * self.away)
                squared = (self.value[:, 0] - line @ x.T) ** 2 + self.within
            fitted[:, 0] = np.einsum("qi,qi->q", line, here)
            rows = total**2 / (weight**2 / self.share).sum(1)
            spread = (weight * squared).sum(1) / total * rows / np.maximum(rows - 4, 1)
        clustered = (np.add.reduceat(leverage, self.starts, axis=1) ** 2).sum(1)
        independent = (leverage**2 / self.share).sum(1)
        out = (fitted, independent, clustered, spread, rows, total)
        for values in out if len(unknown) else ():
            values[unknown] = np.nan
        return LocalFit(*out)

    def _scored(self, weight: Floats, total: Floats, inverse: Floats) -> Floats:
        """Return the coefficients (q, 7) of the log-linear fit, by Fisher scoring from the mean."""
        x, y, precision, away = self.design, self.value[:, 0], self.precision, self.away
        line = np.empty((len(weight), len(away)))
        line[:] = away
        line[:, 0] = np.log(np.maximum(weight @ y / np.where(total > 0, total, 1.0), 1e-300))
        for _ in range(SCORING_STEPS):
            excess = y * _exp(-(line @ x.T)) - 1.0
            step = np.einsum("qij,qj->qi", inverse, (weight * excess) @ x - precision * (line - away))
            change = np.abs(step @ x.T).max(1)
            line += step * np.minimum(1.0, LARGEST_STEP / np.maximum(change, 1e-12))[:, None]
            if change.max() < SMALL_STEP:
                break
        return line
