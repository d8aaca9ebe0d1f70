"""Compute how much discs of pixels overlap, and how many of them are independent.

Signal chain: centres and radius [px] -> shared area of each pair of discs -> weight of each disc.

Two discs that share pixels share noise. Consider a quantity with independent values in each pixel, and its means over
two discs of radius r at distance d. The two means correlate by the share of their area that the discs have in common.
The common area is a lens:

    c(d) = (2 / pi) (arccos(x) - x sqrt(1 - x^2)),    x = d / (2 r)

This is the autocorrelation of a disc. In optics it is the transfer function of a round aperture (Goodman, "Introduction
to Fourier Optics", 6.3). The same holds for sample variances, because their terms are squares of the same pixels. The
plane fit changes this by a term of order 3 / n.

The mean of n values of equal variance s^2 and correlation matrix C has the variance s^2 / n_eff, where

    n_eff = n^2 / (sum of all C_ij)

(Bayley and Hammersley, J. R. Stat. Soc. Suppl. 8 (1946) 184-197, for a series).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from characterisation.files.arrays import Floats


def disc_offsets(radius_px: float) -> NDArray[np.int64]:
    """Return the pixel offsets (n, 2) as (row, column) of a disc about a pixel."""
    reach = int(np.floor(radius_px))
    rows, columns = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    inside = rows**2 + columns**2 <= radius_px**2
    return np.asarray(np.stack([rows[inside], columns[inside]], axis=-1))


def lens_share(distance: ArrayLike, radius: float) -> Floats:
    """Return the common area of two discs of one radius [px] at a distance (...) [px], divided by the area of one."""
    x = np.clip(np.asarray(distance, float) / (2.0 * radius), 0.0, 1.0)
    return np.asarray(2.0 / np.pi * (np.arccos(x) - x * np.sqrt(1.0 - x**2)))


def independent_share(centres: ArrayLike, radius: float) -> Floats:
    """Return weights (p,) of discs about ``centres`` (p, 2) [px]: 1 for an isolated disc, less for overlapping ones.

    With these weights, a weighted mean of values of equal variance s^2 has the variance s^2 / (sum of the weights), for
    any overlaps. The weight w of a disc is 1 / (sum of its row of C). In every connected group of discs, the weights
    are then scaled by (sum of w) / (w^T C w), which makes the variance exact.

    Pixels are assumed to be independent.
    """
    centres = np.asarray(centres, float).reshape(-1, 2)
    count = len(centres)
    pairs = cKDTree(centres).query_pairs(2.0 * radius, output_type="ndarray") if count else np.empty((0, 2), np.intp)
    share = lens_share(np.linalg.norm(centres[pairs[:, 0]] - centres[pairs[:, 1]], axis=-1), radius)
    if not share.any():
        return np.ones(count)
    first, second = pairs[share > 0].T
    share = share[share > 0]
    weight = 1.0 / (1.0 + np.bincount(first, share, count) + np.bincount(second, share, count))
    groups, group = connected_components(coo_matrix((share, (first, second)), (count, count)), directed=False)
    shared = np.bincount(group[first], share * weight[first] * weight[second], groups)
    variance = np.bincount(group, weight**2, groups) + 2.0 * shared
    return np.asarray(weight * (np.bincount(group, weight, groups) / variance)[group])
