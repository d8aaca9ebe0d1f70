"""Compute the modulation of blurred stripes, and the blur from stripes of several widths.

    mean |on - off| / (white - black) = (8 / pi^2) sum over odd n of exp(-pi^2 s^2 n^2 / (2 w^2)) / n^2

with s the standard deviation of the blur and w the width of a stripe, in the same pixels: the Fourier series of a
square wave after a Gaussian blur. The reflectance of a print cancels in the ratio.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

Floats = NDArray[np.float64]

#: terms of the series
_HARMONICS = np.arange(1, 40, 2)


def modulation(blur: float, width: Floats) -> Floats:
    """Return the mean modulation of stripes of a width (...) [px] after a Gaussian blur [px], 1 for sharp ones."""
    w = np.asarray(width, float)[..., None]
    fall = np.exp(-((np.pi * blur * _HARMONICS / w) ** 2) / 2)
    return np.asarray((fall / _HARMONICS**2).sum(axis=-1) / (1.0 / _HARMONICS**2).sum())


def fitted_blur(width: Floats, ratio: Floats) -> float:
    """Return the blur [px] of stripes of widths (n,) [px] with a modulation (n,).

    The fit allows a common loss of modulation, which light scattered far by the lenses causes.
    """
    found = least_squares(
        lambda x: x[1] * modulation(float(x[0]), width) - ratio, [1.0, 0.9], bounds=([0.05, 0.3], [20.0, 1.0])
    )
    return float(found.x[0])
