"""Fit the bend of a nominally flat sheet, a low-order surface over its plane.

Signal chain: points of the cloud in the plane's frame -> median heights of square cells -> Legendre polynomials of
total degree d by least squares, for several d -> degree with the smallest leave-one-out error -> heights.

The leave-one-out residuals are r_i / (1 - h_ii), with h_ii the leverages (Allen, Technometrics 16 (1974) 125). Allen's
PRESS is the sum of their squares. The median of the squares is used here, so that a few wrong cells do not choose the
degree. A higher degree is chosen only if it predicts cells that were not used in its fit. So a flat plate stays flat
within its noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial.legendre import legvander2d
from numpy.typing import NDArray

Floats = NDArray[np.float64]

#: total degrees; number of cells along the longer side, and least number of points in a cell
DEGREES, _CELLS, _LEAST = (1, 2, 3, 4, 5, 6), 28, 20

#: least number of cells for each coefficient of a degree
_CELLS_PER_TERM = 5


@dataclass(frozen=True)
class Bend:
    """Heights over the plane z = 0 of a place.

    - ``middle``, ``half`` (2,) [mm]: centre and half the size of the extent in x and y.
    - ``coefficients`` (k,) [mm] of the Legendre polynomials up to the total degree ``degree``.
    - ``rms`` [mm] of the heights at the fitted cells.
    """

    middle: Floats
    half: Floats
    degree: int
    coefficients: Floats
    rms: float

    def heights(self, xy: Floats) -> Floats:
        """Return heights (...) [mm] at points (..., 2) [mm] of the plane; outside the extent, those of its edge."""
        return np.asarray(_terms((xy - self.middle) / self.half, self.degree) @ self.coefficients)


def fit_bend(points: Floats) -> Bend | None:
    """Fit the bend of points (n, 3) [mm] in the frame of their plane, with z along its normal; None for too few."""
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
        # the median square, not the sum: a false match in a cell must not choose the degree
        error = float(np.median(left_out**2))
        if best is None or error < best[0]:
            best = error, degree, coefficients
    assert best is not None
    _, degree, coefficients = best
    rms = float(np.sqrt(np.mean((_terms((places - middle) / half, degree) @ coefficients) ** 2)))
    return Bend(middle, half, degree, coefficients, rms)


def _cell_medians(points: Floats, low: Floats, cell: float) -> tuple[Floats, Floats]:
    """Return the centres (m, 2) of the cells with enough points, and their median heights (m,), all in mm."""
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
    """Return Legendre polynomials (..., k) up to the total degree ``degree`` at points (..., 2) in -1..1."""
    inside = np.clip(places, -1.0, 1.0)
    every = legvander2d(inside[..., 0], inside[..., 1], [degree, degree])
    power = np.add.outer(np.arange(degree + 1), np.arange(degree + 1)).reshape(-1)
    return np.asarray(every[..., power <= degree])
