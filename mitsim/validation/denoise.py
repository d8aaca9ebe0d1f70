"""A recorded image less its noise, edges of the print kept.

Signal chain: image [e-] -> variance of its noise by level (:mod:`mitsim.fit.fine_detail`) -> cosine transform of the
8 x 8 window about every pixel -> coefficients under three standard deviations of the noise are set to 0 -> back, and
the mean of all windows that hold a pixel, each weighted by one over the coefficients that it kept.

The method is that of Yu and Sapiro (IPOL 1 (2011) 292) with the weights of Guleryuz (IEEE TIP 16 (2007) 3020). A filter
by local mean and variance (Lee, IEEE TPAMI 2 (1980) 165) would leave all noise at edges. In a twin that noise is part
of the print: both cameras see it, and the matcher takes it for texture.
"""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.fft import dct

from mitsim.fit.fine_detail import noise_of_levels

Floats = NDArray[np.float64]

#: side of a window [px]; standard deviations of the noise under which a coefficient is noise
_SIDE_PX, _THRESHOLD = 8, 3.0

#: the cosine transform of a column: a row for each coefficient
_COSINES = dct(np.eye(_SIDE_PX), axis=0, norm="ortho")


def denoised(image: Floats, mask: NDArray[np.bool_]) -> Floats:
    """An image (H, W) less its white noise, whose variance by level is found in the pixels ``mask``."""
    variance = noise_of_levels(image, mask)
    margin = _SIDE_PX - 1
    wide = np.pad(np.asarray(image, float), margin, mode="symmetric")
    total, weight = np.zeros(wide.shape), np.zeros(wide.shape)
    count = wide.shape[1] - margin
    band, shares = np.empty((_SIDE_PX, wide.shape[1])), np.empty(wide.shape[1])
    windows = sliding_window_view(band, count, axis=1)  # (row, column, window) of the windows beside each other
    for top in range(wide.shape[0] - margin):
        rows = np.s_[top : top + _SIDE_PX]
        np.matmul(_COSINES, wide[rows], out=band)  # of each column, which eight windows share
        coefficients = _COSINES @ windows
        spread = np.sqrt(variance(coefficients[0, 0] / _SIDE_PX))
        kept = np.abs(coefficients) >= _THRESHOLD * spread
        kept[0, 0] = True  # the mean of the window
        share = 1.0 / kept.sum(axis=(0, 1))
        coefficients *= kept
        coefficients *= share
        back = _COSINES.T @ coefficients
        band[:], shares[:] = 0.0, 0.0
        for offset in range(_SIDE_PX):
            columns = np.s_[offset : offset + count]
            band[:, columns] += back[:, offset]
            shares[columns] += share
        total[rows] += _COSINES.T @ band
        weight[rows] += shares
    inside = np.s_[margin : margin + image.shape[0], margin : margin + image.shape[1]]
    return np.asarray(total[inside] / weight[inside])
