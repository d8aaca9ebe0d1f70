"""Newton's polynomials of images: for each pixel the inverse depth w as a function of a projector coordinate u.

Signal chain: coordinate u at Chebyshev points of the inverse depth -> divided differences of each pixel -> w(u) and
dw/du by Horner's scheme.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from characterisation.files.arrays import Floats
from characterisation.files.threads import in_threads
from mitsim.decoding.blocks import row_bands


def polynomial(
    coordinate: Callable[[Floats, Floats], Floats], ray: Floats, low: Floats, high: Floats, count: int
) -> tuple[Floats, Floats]:
    """Return Newton's polynomial w(u) through ``count`` exact points of each ray: its nodes and divided differences.

    Parameters
    ----------
    coordinate
        Coordinate u (h, W) of points at an inverse depth (h, W) on rays (h, W, 3), of any rows of the image.
    ray
        (H, W, 3) rays.
    low, high
        (H, W) ends of the inverse depths.
    count
        Number of points, K.

    See Also
    --------
    evaluate : the polynomial at a coordinate
    """
    # Chebyshev-Lobatto points, which include both ends
    fraction = (1 - np.cos(np.pi * np.arange(count) / (count - 1))) / 2
    nodes, differences = np.empty((count, *low.shape)), np.empty((count, *low.shape))

    @np.errstate(invalid="ignore", divide="ignore")
    def solve(rows: slice) -> None:
        u, w = nodes[:, rows], differences[:, rows]
        w[:] = low[rows] + (high[rows] - low[rows]) * fraction[:, None, None]
        for node, inverse_depth in zip(u, w, strict=True):
            node[:] = coordinate(inverse_depth, ray[rows])
        for order in range(1, count):
            for k in range(count - 1, order - 1, -1):  # in place: w[k - 1] is still that of the order before
                w[k] -= w[k - 1]
                w[k] /= u[k] - u[k - order]

    in_threads(solve, row_bands(*low.shape))
    return nodes, differences


def evaluate(nodes: Floats, differences: Floats, u: Floats) -> tuple[Floats, Floats]:
    """Return w(u) and dw/du by Horner's scheme.

    ``nodes`` and ``differences`` (K, ...) are those of :func:`polynomial`, ``u`` (...) [projector px].
    """
    value, slope = differences[-1].copy(), np.zeros_like(u)
    for node, difference in zip(nodes[-2::-1], differences[-2::-1], strict=True):
        step = u - node
        slope *= step
        slope += value
        value *= step
        value += difference
    return value, slope


def monotony(nodes: Floats, least_change: float) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return where (H, W) the coordinates of nodes only rise or only fall, and where they change by over the least."""
    monotonic, changes = np.empty(nodes.shape[1:], bool), np.empty(nodes.shape[1:], bool)

    @np.errstate(invalid="ignore")
    def judge(rows: slice) -> None:
        change = np.diff(nodes[:, rows], axis=0)
        monotonic[rows] = (change > 0).all(axis=0) | (change < 0).all(axis=0)
        changes[rows] = np.ptp(nodes[:, rows], axis=0) > least_change

    in_threads(judge, row_bands(*nodes.shape[1:]))
    return monotonic, changes
