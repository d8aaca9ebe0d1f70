"""Estimate the correlation between residuals of neighbouring pixels.

Signal chain: residuals along the rays on the pixel grid, with gaps -> mean product of all pairs at each lag ->
autocorrelation rho(h) -> correlation length.

rho is averaged over all lags of equal length. The correlation length is the length at which this average first falls
below 1/e, by linear interpolation. For independent pixels the rule gives 1 - 1/e = 0.63 px.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from characterisation.files.arrays import Floats

#: largest lag that is evaluated [px]
LARGEST_LAG = 8


@dataclass(frozen=True)
class Autocorrelation:
    """Autocorrelation of a field on the pixel grid.

    ``values`` (2 k + 1, 2 k + 1) is rho at the lags (row, column) from -k to k: 1 in the middle, NaN where unknown.
    ``pairs``, of the same shape, is the number of pairs of pixels at each lag.
    """

    values: Floats
    pairs: Floats

    def radial(self) -> tuple[Floats, Floats]:
        """Return lengths of lags [px], and the mean of rho over the pairs of each length; (m,) each."""
        reach = len(self.values) // 2
        row, column = np.mgrid[-reach : reach + 1, -reach : reach + 1]
        square = row**2 + column**2
        usable = np.isfinite(self.values) & (square <= reach**2) & (self.pairs > 0)
        lengths, ring = np.unique(square[usable], return_inverse=True)
        total = np.bincount(ring, (self.pairs * self.values)[usable], len(lengths))
        return np.sqrt(lengths), total / np.bincount(ring, self.pairs[usable], len(lengths))

    def length(self) -> float:
        """Return the correlation length [px]; NaN if the field is unknown or rho stays above 1/e to the largest lag."""
        distance, rho = self.radial()
        level = np.exp(-1.0)
        below = np.flatnonzero(rho < level)
        if not len(below):
            return float("nan")
        last = below[0] - 1
        share = (rho[last] - level) / (rho[last] - rho[last + 1])
        return float(distance[last] + share * (distance[last + 1] - distance[last]))


def autocorrelation(field: NDArray[np.floating], reach: int = LARGEST_LAG) -> Autocorrelation:
    """Return the autocorrelation of a field (height, width) about its mean; NaN in the field marks missing values.

    It is normalised by the number of pairs of each lag, so that gaps and borders do not bias it. Subtracting the mean
    lowers it by about its sum over lags divided by the number of pixels.
    """
    field = np.asarray(field, float)
    present = np.isfinite(field)
    reach = min(reach, *(side - 1 for side in field.shape))
    filled = np.where(present, field - (np.mean(field[present]) if present.any() else 0.0), 0.0)
    shape = [scipy.fft.next_fast_len(side + reach, real=True) for side in field.shape]

    def sums(values: Floats) -> Floats:
        circular = scipy.fft.irfft2(np.abs(scipy.fft.rfft2(values, shape)) ** 2, shape)
        lags = np.arange(-reach, reach + 1)
        return np.asarray(circular[np.ix_(lags, lags)])

    pairs = np.rint(sums(present.astype(float)))
    with np.errstate(divide="ignore", invalid="ignore"):
        covariance = np.where(pairs > 0, sums(filled) / pairs, np.nan)
        return Autocorrelation(covariance / covariance[reach, reach], pairs)
