"""Estimate the noise of an image from its finest detail, at spatial frequencies that few lenses transmit.

Signal chain: image -> filter with weights 1 -4 6 -4 1 along both axes, which keeps the variance of white noise ->
squares, in bins of the local mean -> robust variance of every bin -> a + b mu by weighted least squares.

The power transfer of the weights along one axis is (2 - 2 cos w)^4 / 70, with w the angular frequency; its mean over w
is 1. At a period of 6 px it is 0.014, so little remains of edges and dots. The median suppresses this remainder.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import correlate1d, uniform_filter

from characterisation.files.arrays import Floats

#: weights along each axis, which keep the variance of white noise
FINEST = np.array([1.0, -4.0, 6.0, -4.0, 1.0]) / np.sqrt(70.0)

#: median of chi-square with one degree of freedom
MEDIAN_SQUARE = 0.45493642311957283

#: largest number of bins of equal count by local mean; chosen
_BINS = 8

#: least number of pixels for each of several bins; chosen
_PIXELS_PER_BIN = 400

#: side of the window of the local mean [px]
_MEAN_PX = 5


def finest_detail(image: Floats) -> Floats:
    """Return an image (H, W) after a filter that keeps the variance of white noise and suppresses coarser detail."""
    return np.asarray(correlate1d(correlate1d(np.asarray(image, float), FINEST, axis=0), FINEST, axis=1))


def level_variances(image: Floats, mask: NDArray[np.bool_]) -> tuple[Floats, Floats, Floats]:
    """Return level, noise variance and number of pixels (n,) of bins of an image's pixels by their local mean.

    ``mask`` (H, W) selects the pixels. The level of a bin is the median of the local means. The variance is the median
    of the squared detail over 0.455, the median of chi-square with one degree of freedom.
    """
    mean, squares = uniform_filter(np.asarray(image, float), _MEAN_PX), finest_detail(image) ** 2
    rim = _MEAN_PX // 2
    if min(mask.shape) > 4 * _MEAN_PX:  # at the image's edges the filter uses mirrored pixels
        mask = mask & np.pad(np.ones((mask.shape[0] - 2 * rim, mask.shape[1] - 2 * rim), bool), rim)
    level, square = mean[mask], squares[mask]
    bins = int(np.clip(len(level) // _PIXELS_PER_BIN, 1, _BINS))
    edges = np.quantile(level, np.linspace(0, 1, bins + 1))
    where = np.clip(np.searchsorted(edges, level, side="right") - 1, 0, bins - 1)
    used = [index for index in range(bins) if (where == index).sum() >= min(_PIXELS_PER_BIN, len(level)) // 4]
    levels = np.array([float(np.median(level[where == index])) for index in used])
    variances = np.array([float(np.median(square[where == index])) / MEDIAN_SQUARE for index in used])
    counts = np.array([float((where == index).sum()) for index in used])
    return levels, variances, counts


def noise_of_levels(image: Floats, mask: NDArray[np.bool_]) -> Callable[[Floats], Floats]:
    """Return a function of the level that gives the noise variance of an image, never below 0."""
    levels, variances, counts = level_variances(image, mask)
    if len(levels) < 3 or np.ptp(levels) <= 0:
        flat = float(np.median(variances)) if len(variances) else 0.0
        return lambda level: np.full(np.shape(level), flat)
    weight = np.sqrt(counts) / np.maximum(variances, 1e-12)
    design = np.stack([np.ones_like(levels), levels], axis=1)
    (offset, slope), *_ = np.linalg.lstsq(design * weight[:, None], variances * weight, rcond=None)
    return lambda level: np.maximum(offset + slope * np.asarray(level, float), 0.0)
