"""Fit the position of the least of three costs between whole disparities.

A parabola suits costs that are smooth at their minimum, and two lines of equal slope suit absolute differences
(Shimizu and Okutomi, ICCV 2001; Haller and Nedevschi, IEEE Trans. Image Processing 21(2), 2012). Both are biased toward
whole or half pixels where the cost has another shape, so that the choice is a property of a decoder.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

SubPixelFit = Literal["parabola", "equiangular"]


def offset_of_minimum(
    lower: NDArray[Any], least: NDArray[Any], upper: NDArray[Any], fit: SubPixelFit
) -> NDArray[np.float32]:
    """Return the offset [px], -0.5 to 0.5, of the minimum from the middle one of three costs.

    Parameters
    ----------
    lower, least, upper
        Costs at one disparity less, at the least cost, and at one disparity more.
    fit
        ``parabola``: (l - u) / (2 (l + u - 2 m)). ``equiangular``: two lines of opposite slope,
        (l - u) / (2 (max(l, u) - m)).
    """
    below, above = (np.subtract(cost, least, dtype=np.float32) for cost in (lower, upper))
    width = below + above if fit == "parabola" else np.maximum(below, above)
    with np.errstate(divide="ignore", invalid="ignore"):
        offset = (below - above) / (2 * width)
    return np.asarray(np.where(width > 0, np.clip(offset, -0.5, 0.5), 0), np.float32)
