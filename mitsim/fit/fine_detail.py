"""The noise of an image from its finest detail: what changes sign from pixel to pixel, which few lenses pass.

Signal chain: image -> weights 1 -4 6 -4 1 along both axes, of unit gain for white noise -> squares, by level of the
local mean -> robust variance of every level -> a + b mu by weighted least squares.

The transfer of the weights for each axis is (2 - 2 cos w)^4 / 70: 0.014 of full strength at a period of 6 px, so
of edges and dots little is left, and what is left stands out and is passed over by the median.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import correlate1d, uniform_filter

Floats = NDArray[np.float64]

#: weights along either axis, of unit gain for white noise
FINEST = np.array([1.0, -4.0, 6.0, -4.0, 1.0]) / np.sqrt(70.0)

#: median of chi-square with one degree of freedom
_MEDIAN_SQUARE = 0.45493642311957283

#: bins of equal count by local mean; pixels without which there is one bin
_BINS, _PIXELS_PER_BIN = 8, 400

#: side of the window of the local mean [px]
_MEAN_PX = 5


def finest_detail(image: Floats) -> Floats:
    """Filter an image (H, W): white noise keeps its variance, and shapes are gone."""
    return np.asarray(correlate1d(correlate1d(np.asarray(image, float), FINEST, axis=0), FINEST, axis=1))


def level_variances(image: Floats, there: NDArray[np.bool_]) -> tuple[Floats, Floats, Floats]:
    """Mean level, variance of the noise and count of independent pixels (n,) of the bins of an image's pixels."""
    mean, squares = uniform_filter(np.asarray(image, float), _MEAN_PX), finest_detail(image) ** 2
    rim = _MEAN_PX // 2
    if min(there.shape) > 4 * _MEAN_PX:  # at the image's own rim the weights meet mirrored pixels
        there = there & np.pad(np.ones((there.shape[0] - 2 * rim, there.shape[1] - 2 * rim), bool), rim)
    level, square = mean[there], squares[there]
    bins = int(np.clip(len(level) // _PIXELS_PER_BIN, 1, _BINS))
    edges = np.quantile(level, np.linspace(0, 1, bins + 1))
    where = np.clip(np.searchsorted(edges, level, side="right") - 1, 0, bins - 1)
    used = [index for index in range(bins) if (where == index).sum() >= min(_PIXELS_PER_BIN, len(level)) // 4]
    levels = np.array([float(np.median(level[where == index])) for index in used])
    variances = np.array([float(np.median(square[where == index])) / _MEDIAN_SQUARE for index in used])
    counts = np.array([float((where == index).sum()) for index in used])
    return levels, variances, counts


def noise_of_levels(image: Floats, there: NDArray[np.bool_]) -> Callable[[Floats], Floats]:
    """Variance of the noise of an image as a function of the level, never under 0."""
    levels, variances, counts = level_variances(image, there)
    if len(levels) < 3 or np.ptp(levels) <= 0:
        flat = float(np.median(variances)) if len(variances) else 0.0
        return lambda level: np.full(np.shape(level), flat)
    weight = np.sqrt(counts) / np.maximum(variances, 1e-12)
    design = np.stack([np.ones_like(levels), levels], axis=1)
    (offset, slope), *_ = np.linalg.lstsq(design * weight[:, None], variances * weight, rcond=None)
    return lambda level: np.maximum(offset + slope * np.asarray(level, float), 0.0)
