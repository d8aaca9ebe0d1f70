"""Compute the point spread of a lens on whole pixels, with exact variance at any width.

Signal chain: standard deviation sigma [px] -> discrete Gaussian T(n; sigma^2) = exp(-sigma^2) I_n(sigma^2), I_n the
modified Bessel function -> one row of weights, applied along rows and columns.

A Gaussian sampled at whole pixels is too narrow for sigma below about 0.7 px: 0.4 px becomes 0.28 px. The discrete
Gaussian has exactly the variance sigma^2, and the variances of two in succession add. T. Lindeberg, Scale-space for
discrete signals, IEEE TPAMI 12 (1990) 234-254, section IV.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import ive


def point_spread(sigma: float) -> NDArray[np.float64]:
    """Return the weights (2 r + 1,) of a point spread of ``sigma`` [px]; they sum to 1.

    r is 4 sigma plus one pixel, rounded, and at least 2. Less than 3e-4 of the weight and 1 % of the variance lie
    beyond.
    """
    reach = max(int(4.0 * sigma + 0.5) + 1, 2)
    weights = ive(np.abs(np.arange(-reach, reach + 1)), sigma**2)
    return np.asarray(weights / weights.sum(), np.float64)


def kept_variance(sigma: float) -> float:
    """Return the share [1] of the variance of white noise that a point spread along one axis leaves: sum of w^2."""
    return float((point_spread(sigma) ** 2).sum())
