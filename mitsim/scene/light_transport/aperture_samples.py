"""Choose the positions at which the rays of a pixel pass through the lenses of camera and projector.

Signal chain: raster of a pixel -> the same raster on the disc of the camera's lens, rotated by 90 deg -> the same
positions on the projector's lens, in the order that correlates least and blurs an edge as discs do.

A sample has a position z in the pixel, L in the camera's lens and P in the projector's. Out of focus it sees the
pattern at z + c L + p P. The radii c and p of the two blurs [px] change sign at the planes of focus. The mean over n
samples should equal the mean over the pixel and both discs. These sums must therefore fill the convolution of a square
and two discs evenly for *every* c and p, and have its second moments. Otherwise the blur is too wide or too narrow. On
a face that is turned away, the light depends on P. A correlation of P with z or L would then shift the pattern.

L is z mapped to the disc and rotated by 90 deg. Then cov(z, L) = 0, and z + c L is a raster for every c, rotated and
stretched. No second map of this kind exists for P, so its order is searched:

1. Many orders are drawn at random.
2. In each, positions are exchanged as long as this lowers the correlations with z and L.
3. The orders with the least correlation are kept.
4. Of these, the one with the lowest cost is taken. The cost is mainly the mean square difference between the cumulative
   distributions of the sums and of the convolution, along lines in all directions (a sliced Cramer-von Mises distance).

Opposite cells have opposite positions, so defocus blurs a pattern but does not shift it.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import permutations, product

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

from characterisation.files.arrays import Floats

#: radii (c, p) of the two blurs [px] for which the order is optimised
_BLURS = ((0.15, 0.1), (0.45, 0.45), (0.45, -0.45), (0.0, 0.45), (0.9, 0.9))

#: directions of the lines of the cost
_DIRECTIONS = 8

#: positions along a line [px]
_LINE = np.linspace(-2.5, 2.5, 101)

#: points of the target distribution
_POINTS = 1 << 13

#: orders drawn
_ORDERS = 1024

#: exchanges tried in each order
_EXCHANGES = 800

#: orders kept
_KEPT = 32

#: up to this number of positions in half of a pixel (9 samples), all orders are compared
_ALL_TRIED = 4

#: weight of the largest correlation in the cost
_CORRELATION_WEIGHT = 0.3


@lru_cache(maxsize=32)
def aperture_samples(count: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return positions (2, count) in the unit discs of both lenses, a pair for each cell of a pixel's square raster."""
    side, half = round(np.sqrt(count)), count // 2
    i = np.arange(count)
    square = (np.stack([i % side, i // side]) + 0.5) / side * 2 - 1
    positions = _on_disc(square)
    if count > 1:  # the mean square radius of a disc is 1/2
        positions *= np.sqrt(0.5 / (positions**2).sum(axis=0).mean())
    camera = np.stack([-positions[1], positions[0]])
    cells = square[:, :half] / 2
    if count > 1:
        cells = cells / np.sqrt(1 - side**-2)  # the raster is stretched as in transport
    if half == 0:
        return _with_opposites(camera[:, :0], count), _with_opposites(camera[:, :0], count)
    target = _target_distributions()
    # rows of variance 1: it is 1/12 along the side of a pixel, 1/4 along the diameter of a disc
    fixed = np.concatenate([cells * np.sqrt(12), camera[:, :half] * 2]) / half
    orders = _all_orders(positions[:, :half]) if half <= _ALL_TRIED else _uncorrelated(fixed, positions[:, :half])

    def cost(order: Floats) -> float:
        correlation = float(np.abs(fixed @ order.T * 2).max())
        return _misfit(cells, camera[:, :half], order, target) + _CORRELATION_WEIGHT * correlation

    projector = min(orders, key=cost)
    return _with_opposites(camera[:, :half], count), _with_opposites(projector, count)


def _all_orders(positions: Floats) -> list[Floats]:
    """Return every order of ``positions`` (2, half), each position or its opposite."""
    half = positions.shape[1]
    signs = [np.array(choice) for choice in product((1.0, -1.0), repeat=half)]
    return [positions[:, list(order)] * sign for order in permutations(range(half)) for sign in signs]


def _uncorrelated(fixed: Floats, positions: Floats) -> list[Floats]:
    """Return the orders of ``positions`` (2, half), or their opposites, that correlate least with ``fixed`` (4, half).

    The correlations are those over all samples: the other half is opposite in everything and has the same products.
    """
    half = positions.shape[1]
    rng = np.random.default_rng(2 * half)
    order = rng.permuted(np.tile(np.arange(half), (_ORDERS, 1)), axis=1)
    orders = positions.T[order] * rng.choice([-1.0, 1.0], (_ORDERS, half, 1))
    correlation = np.einsum("rh,ohc->orc", fixed, orders * 2)
    rows = np.arange(_ORDERS)
    for _ in range(min(_EXCHANGES, 40 * half)):
        first, second = rng.integers(0, half, (2, _ORDERS))
        sign = np.where((first == second) | (rng.random(_ORDERS) < 0.5), -1.0, 1.0)[:, None]
        before = orders[rows, first], orders[rows, second]
        after = before[1] * sign, np.where((first == second)[:, None], before[1] * sign, before[0])
        change = np.einsum("ro,oc->orc", fixed[:, first], (after[0] - before[0]) * 2)
        change += np.einsum("ro,oc->orc", fixed[:, second] * (first != second), (after[1] - before[1]) * 2)
        better = ((correlation + change) ** 2).sum(axis=(1, 2)) < (correlation**2).sum(axis=(1, 2))
        orders[rows[better], first[better]] = after[0][better]
        orders[rows[better], second[better]] = after[1][better]
        correlation[better] += change[better]
    least = np.argsort((correlation**2).sum(axis=(1, 2)), kind="stable")[:_KEPT]
    return [orders[k].T for k in least]


def _with_opposites(half: Floats, count: int) -> NDArray[np.float32]:
    """Return the positions of one half, of the centre if ``count`` is odd, and of the opposite half."""
    return np.concatenate([half, np.zeros((2, count % 2)), -half[:, ::-1]], axis=1).astype(np.float32)


def _on_disc(square: Floats) -> Floats:
    """Map the square [-1, 1]^2 to the unit disc with equal areas (Shirley and Chiu, J. Graphics Tools 2(3), 1997)."""
    x, y = square
    wide = np.abs(x) > np.abs(y)
    radius = np.where(wide, x, y)
    ratio = np.where(wide, y, x) / np.where(radius == 0, 1.0, radius)
    angle = np.where(wide, np.pi / 4 * ratio, np.pi / 2 - np.pi / 4 * ratio)
    return np.asarray(radius * np.stack([np.cos(angle), np.sin(angle)]))


def _directions() -> Floats:
    angle = (np.arange(_DIRECTIONS) + 0.1) * np.pi / _DIRECTIONS
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


@lru_cache(maxsize=1)
def _target_distributions() -> Floats:
    """Return the cumulative distributions (blurs, directions, positions) of square * disc * disc along lines."""
    u = qmc.Sobol(6, seed=1).random(_POINTS).T
    pixel = u[:2] - 0.5
    lenses = [np.sqrt(u[k]) * np.stack([np.cos(2 * np.pi * u[k + 1]), np.sin(2 * np.pi * u[k + 1])]) for k in (2, 4)]
    sums = [pixel + c * lenses[0] + p * lenses[1] for c, p in _BLURS]
    along = [_directions() @ s for s in sums]
    return np.array([[np.searchsorted(np.sort(line), _LINE) / _POINTS for line in lines] for lines in along])


def _misfit(cells: Floats, camera: Floats, projector: Floats, target: Floats) -> float:
    """Return the distance of the sums from the target, for one half of the samples; the other half is opposite.

    For each blur, this is the root mean square difference of the cumulative distributions, plus a tenth of the mean
    relative error of the second moments.
    """
    sums = np.array([cells + c * camera + p * projector for c, p in _BLURS])
    along = _directions() @ sums  # (blurs, directions, half)
    along = np.concatenate([along, -along], axis=-1)
    cumulative = (along[..., None] < _LINE).mean(axis=-2)
    edges = np.sqrt(((cumulative - target) ** 2).mean(axis=(1, 2)))
    # second moments of square, disc and disc: 1/12 + c^2/4 + p^2/4 along every direction
    moments = np.array([1 / 12 + (c * c + p * p) / 4 for c, p in _BLURS])[:, None]
    spread = np.abs((along**2).mean(axis=-1) / moments - 1).mean(axis=1)
    return float((edges + 0.1 * spread).sum())
