"""Where the rays of a pixel pass through the lenses of camera and projector.

Signal chain: raster of a pixel -> the same raster on the disc of the camera's lens, turned by 90 deg -> that of the
projector's lens, in the order that leaves no correlation and blurs an edge out of focus as discs do.

A sample is a cell z of the pixel's raster, a place L in the camera's lens and a place P in the projector's. Out of
focus it sees the pattern at z + c L + p P, where c and p, radii of the two blurs in pixels, change sign at the planes
of focus. For the mean over n samples to be that over pixel and discs, these sums must fill the convolution of a square
and two discs evenly for *every* c and p, and have its second moments: what is wrong with them widens or narrows the
blur. And where the light depends on P, as on a face that is turned away, a correlation of P with z or L would move the
pattern.

If L is z on the disc turned by 90 deg, cov(z, L) = 0 and z + c L is again a raster, turned and stretched, whatever c.
For P no second such map exists. Many orders are drawn, places are exchanged in each while that lowers its correlations
with z and L, and of those where least is left one is taken by the distribution of the sums as edges in all directions
see it (the mean square difference of the cumulative distributions along lines, a sliced Cramer-von Mises distance).
Opposite cells have opposite places: defocus blurs a pattern but does not shift it.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import permutations, product

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

Floats = NDArray[np.float64]

#: radii of the two blurs [px] for which places are chosen
_BLURS = ((0.15, 0.1), (0.45, 0.45), (0.45, -0.45), (0.0, 0.45), (0.9, 0.9))

#: edges that are looked at: directions, places along a line [px], points that stand for the wanted distribution
_DIRECTIONS, _LINE, _POINTS = 8, np.linspace(-2.5, 2.5, 101), 1 << 13

#: orders that are drawn, exchanges tried in each, and of how many the blur is looked at
_ORDERS, _EXCHANGES, _UNCORRELATED = 1024, 800, 32

#: up to so many places in half of a pixel, of 9 samples, all orders are looked at
_ALL_TRIED = 4

#: what the largest correlation counts beside the fault of the blur
_CORRELATED = 0.3


@lru_cache(maxsize=32)
def aperture_samples(count: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Places (2, count) in the unit discs of camera and projector lens, one pair for each cell of a pixel's raster.

    ``count`` is a square number; cells run row by row.
    """
    side, half = round(np.sqrt(count)), count // 2
    i = np.arange(count)
    square = (np.stack([i % side, i // side]) + 0.5) / side * 2 - 1
    places = _on_disc(square)
    if count > 1:  # of a raster's middles as of a whole disc: <r^2> = 1/2
        places *= np.sqrt(0.5 / (places**2).sum(axis=0).mean())
    camera = np.stack([-places[1], places[0]])
    cells = square[:, :half] / 2
    if count > 1:
        cells = cells / np.sqrt(1 - side**-2)  # as the raster is spread in transport
    if half == 0:
        return _whole(camera[:, :0], count), _whole(camera[:, :0], count)
    wanted = _wanted()
    # rows of variance 1: 1/12 along a pixel's side, 1/4 along a disc's diameter
    rest = np.concatenate([cells * np.sqrt(12), camera[:, :half] * 2]) / half
    orders = _all_orders(places[:, :half]) if half <= _ALL_TRIED else _uncorrelated(rest, places[:, :half])

    def fault(order: Floats) -> float:
        worst = float(np.abs(rest @ order.T * 2).max())
        return _misfit(cells, camera[:, :half], order, wanted) + _CORRELATED * worst

    projector = min(orders, key=fault)
    return _whole(camera[:, :half], count), _whole(projector, count)


def _all_orders(places: Floats) -> list[Floats]:
    """Every order of ``places`` (2, half), each place or its opposite."""
    half = places.shape[1]
    signs = [np.array(one) for one in product((1.0, -1.0), repeat=half)]
    return [places[:, list(order)] * sign for order in permutations(range(half)) for sign in signs]


def _uncorrelated(rest: Floats, places: Floats) -> list[Floats]:
    """Orders of ``places`` (2, half), some turned to the opposite place, that correlate least with ``rest`` (4, half).

    Correlations are those over all samples: the other half, opposite in everything, has the same products.
    """
    half = places.shape[1]
    rng = np.random.default_rng(2 * half)
    order = rng.permuted(np.tile(np.arange(half), (_ORDERS, 1)), axis=1)
    drawn = places.T[order] * rng.choice([-1.0, 1.0], (_ORDERS, half, 1))
    correlation = np.einsum("rh,ohc->orc", rest, drawn * 2)
    rows = np.arange(_ORDERS)
    for _ in range(min(_EXCHANGES, 40 * half)):
        one, other = rng.integers(0, half, (2, _ORDERS))
        turn = np.where((one == other) | (rng.random(_ORDERS) < 0.5), -1.0, 1.0)[:, None]
        before = drawn[rows, one], drawn[rows, other]
        after = before[1] * turn, np.where((one == other)[:, None], before[1] * turn, before[0])
        change = np.einsum("ro,oc->orc", rest[:, one], (after[0] - before[0]) * 2)
        change += np.einsum("ro,oc->orc", rest[:, other] * (one != other), (after[1] - before[1]) * 2)
        better = ((correlation + change) ** 2).sum(axis=(1, 2)) < (correlation**2).sum(axis=(1, 2))
        drawn[rows[better], one[better]] = after[0][better]
        drawn[rows[better], other[better]] = after[1][better]
        correlation[better] += change[better]
    least = np.argsort((correlation**2).sum(axis=(1, 2)), kind="stable")[:_UNCORRELATED]
    return [drawn[k].T for k in least]


def _whole(part: Floats, count: int) -> NDArray[np.float32]:
    return np.concatenate([part, np.zeros((2, count % 2)), -part[:, ::-1]], axis=1).astype(np.float32)


def _on_disc(square: Floats) -> Floats:
    """Shirley and Chiu's concentric map of [-1, 1]^2 (J. Graphics Tools 2(3), 1997): equal areas stay equal."""
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
def _wanted() -> Floats:
    """Cumulative distributions (blurs, directions, places) of square * disc * disc."""
    u = qmc.Sobol(6, seed=1).random(_POINTS).T
    pixel = u[:2] - 0.5
    lenses = [np.sqrt(u[k]) * np.stack([np.cos(2 * np.pi * u[k + 1]), np.sin(2 * np.pi * u[k + 1])]) for k in (2, 4)]
    sums = [pixel + c * lenses[0] + p * lenses[1] for c, p in _BLURS]
    along = [_directions() @ s for s in sums]
    return np.array([[np.searchsorted(np.sort(line), _LINE) / _POINTS for line in lines] for lines in along])


def _misfit(cells: Floats, camera: Floats, projector: Floats, wanted: Floats) -> float:
    """Distance of the sums from what is wanted; of one half of the samples, the other lies opposite."""
    sums = np.array([cells + c * camera + p * projector for c, p in _BLURS])
    along = _directions() @ sums  # (blurs, directions, half)
    along = np.concatenate([along, -along], axis=-1)
    cumulative = (along[..., None] < _LINE).mean(axis=-2)
    edges = np.sqrt(((cumulative - wanted) ** 2).mean(axis=(1, 2)))
    # second moments of square, disc and disc: 1/12 + c^2/4 + p^2/4 along every direction
    moments = np.array([1 / 12 + (c * c + p * p) / 4 for c, p in _BLURS])[:, None]
    spread = np.abs((along**2).mean(axis=-1) / moments - 1).mean(axis=1)
    return float((edges + 0.1 * spread).sum())
