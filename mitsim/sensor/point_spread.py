"""Point spread of a lens on whole pixels: a Gaussian whose variance is what was asked for, however narrow it is.

Signal chain: standard deviation sigma [px] -> discrete Gaussian T(n; sigma^2) = exp(-sigma^2) I_n(sigma^2), I_n the
modified Bessel function -> one row of weights, applied along rows and columns.

A Gaussian sampled at whole pixels is too narrow below some 0.7 px: of 0.4 px it makes 0.28. The discrete Gaussian has
variance sigma^2 exactly, and two in a row are one of the summed variances. T. Lindeberg, Scale-space for discrete
signals, IEEE TPAMI 12 (1990) 234-254, section IV.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import ive


def point_spread(sigma: float) -> NDArray[np.float64]:
    """Weights (2 r + 1,) of a point spread of ``sigma`` [px], summing to 1.

    r is 4 sigma and a pixel, rounded, and 2 at least. Beyond it lies less than 3e-4 of it, and 1 % of the variance.
    """
    reach = max(int(4.0 * sigma + 0.5) + 1, 2)
    weights = ive(np.abs(np.arange(-reach, reach + 1)), sigma**2)
    return np.asarray(weights / weights.sum(), np.float64)
