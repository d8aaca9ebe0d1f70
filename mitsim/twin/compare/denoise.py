"""Remove the noise of a recorded image, and keep the edges of the print.

Signal chain: image [e-] -> variance of its noise by level (:mod:`mitsim.twin.finish.fine_detail`) -> cosine transform
of the 8 x 8 window about every pixel -> coefficients under three standard deviations of the noise are set to 0 -> back,
and the mean of all windows that hold a pixel, each weighted by one over the coefficients that it kept.

The method is that of Yu and Sapiro (IPOL 1 (2011) 292) with the weights of Guleryuz (IEEE TIP 16 (2007) 3020). A filter
by local mean and variance (Lee, IEEE TPAMI 2 (1980) 165) would leave all noise at edges. In a twin that noise is part
of the print: both cameras see it, and the matcher takes it for texture.
"""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.fft import dct

from characterisation.files.arrays import Floats
from mitsim.twin.finish.fine_detail import noise_of_levels

#: side of a window [px]; chosen
_SIDE_PX = 8

#: standard deviations of the noise under which a coefficient is noise; chosen
_THRESHOLD = 3.0

#: the cosine transform of a column: a row for each coefficient
_COSINES = dct(np.eye(_SIDE_PX), axis=0, norm="ortho")


def denoised(image: Floats, mask: NDArray[np.bool_]) -> Floats:
    """Return an image (H, W) without white noise, whose variance by level is estimated in the pixels ``mask``."""
    variance = noise_of_levels(image, mask)
    margin = _SIDE_PX - 1
    wide = np.pad(np.asarray(image, float), margin, mode="symmetric")
    total = np.zeros(wide.shape)
    height, width = image.shape
    count = width + margin
    band, shares = np.empty((_SIDE_PX, wide.shape[1])), np.empty((height + margin, count))
    beside = sliding_window_view(band, count, axis=1).swapaxes(0, 1)  # (column, row, window), windows beside each other
    windows, kept = np.empty(beside.shape), np.empty(beside.shape, bool)
    for top in range(height + margin):
        rows = np.s_[top : top + _SIDE_PX]
        np.matmul(_COSINES, wide[rows], out=band)  # of each column, which eight windows share
        windows[:] = beside
        coefficients = (_COSINES @ windows.reshape(_SIDE_PX, -1)).reshape(windows.shape)
        spread = np.sqrt(variance(coefficients[0, 0] / _SIDE_PX))
        np.greater_equal(np.abs(coefficients), _THRESHOLD * spread, out=kept)
        kept[0, 0] = True  # the mean of the window
        share = 1.0 / kept.reshape(-1, count).sum(axis=0, dtype=np.uint8)
        coefficients *= kept
        coefficients *= share
        back = (_COSINES.T @ coefficients.reshape(_SIDE_PX, -1)).reshape(windows.shape)
        band[:] = 0.0
        for offset in range(_SIDE_PX):
            band[:, offset : offset + count] += back[offset]
        total[rows] += _COSINES.T @ band
        shares[top] = share
    of_rows = np.sum([shares[first : first + height] for first in range(_SIDE_PX)], axis=0)
    weight = np.sum([of_rows[:, first : first + width] for first in range(_SIDE_PX)], axis=0)
    return np.asarray(total[margin : margin + height, margin : margin + width] / weight)
