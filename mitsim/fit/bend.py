"""The bend of a sheet that should be flat: a low-order surface over its plane.

Signal chain: points of the cloud in the plane's frame -> medians of the cells of a raster -> Legendre polynomials of
total degree d by least squares, for every d that is tried -> the d whose leave-one-out error is smallest -> heights.

The leave-one-out error is PRESS, sum of (r_i / (1 - h_ii))^2, h the leverages (Allen, Technometrics 16 (1974) 125): a
higher degree wins only if it predicts cells that it has not seen. So a flat plate stays flat, but for its noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial.legendre import legvander2d
from numpy.typing import NDArray

Floats = NDArray[np.float64]

#: total degrees that are tried; cells of the raster along the longer side, and points that one must hold
DEGREES, _CELLS, _LEAST = (1, 2, 3, 4, 5, 6), 28, 20

#: cells for each coefficient, below which a degree is not tried
_CELLS_PER_TERM = 5


@dataclass(frozen=True)
class Bend:
    """Heights over the plane z = 0 of a place.

    ``middle``, ``half`` (2,) [mm] of the extent in x and y; ``coefficients`` (k,) [mm] of the Legendre polynomials of
    total degree ``degree``; ``rms`` [mm] of the heights at the cells that it was fitted to.
    """

    middle: Floats
    half: Floats
    degree: int
    coefficients: Floats
    rms: float

    def heights(self, xy: Floats) -> Floats:
        """Heights (...) [mm] at places (..., 2) [mm] of the plane; beyond the extent the nearest edge goes on."""
        return np.asarray(_terms((xy - self.middle) / self.half, self.degree) @ self.coefficients)


def fit_bend(points: Floats) -> Bend | None:
    """Fit the bend of points (n, 3) [mm] in the frame of their plane, its normal z; None of too few."""
    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    cell = float((high - low).max()) / _CELLS
    if not cell > 0:
        return None
    places, heights = _cell_medians(points, low, cell)
    if len(heights) < _CELLS_PER_TERM * 3:
        return None
    middle, half = (low + high) / 2, np.maximum((high - low) / 2, cell)
    best: tuple[float, int, Floats] | None = None
    for degree in DEGREES:
        terms = _terms((places - middle) / half, degree)
        if len(heights) < _CELLS_PER_TERM * terms.shape[1]:
            break
        q, r = np.linalg.qr(terms)
        coefficients = np.linalg.solve(r, q.T @ heights)
        left_out = (heights - terms @ coefficients) / (1 - np.minimum((q**2).sum(axis=1), 0.99))
        # the median square, not the mean: a cell that a matcher got wrong must not choose the degree
        error = float(np.median(left_out**2))
        if best is None or error < best[0]:
            best = error, degree, coefficients
    assert best is not None
    _, degree, coefficients = best
    rms = float(np.sqrt(np.mean((_terms((places - middle) / half, degree) @ coefficients) ** 2)))
    return Bend(middle, half, degree, coefficients, rms)


def _cell_medians(points: Floats, low: Floats, cell: float) -> tuple[Floats, Floats]:
    """Middles (m, 2) of the cells that hold enough points, and their median heights (m,)."""
    columns, rows = np.floor((points[:, :2] - low) / cell).astype(int).T
    number = rows * (columns.max() + 1) + columns
    order = np.lexsort((points[:, 2], number))
    labels, first, counts = np.unique(number[order], return_index=True, return_counts=True)
    kept = counts >= _LEAST
    labels, first, counts = labels[kept], first[kept], counts[kept]
    heights = points[order, 2][first + counts // 2]
    row, column = np.divmod(labels, columns.max() + 1)
    return low + (np.stack([column, row], axis=1) + 0.5) * cell, heights


def _terms(places: Floats, degree: int) -> Floats:
    """Legendre polynomials (..., k) of total degree up to ``degree`` at places (..., 2) in -1..1."""
    inside = np.clip(places, -1.0, 1.0)
    every = legvander2d(inside[..., 0], inside[..., 1], [degree, degree])
    power = np.add.outer(np.arange(degree + 1), np.arange(degree + 1)).reshape(-1)
    return np.asarray(every[..., power <= degree])
