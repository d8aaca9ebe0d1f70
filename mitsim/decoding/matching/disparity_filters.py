"""Filter disparities as makers do: remove small regions that stand apart, and take the median of neighbours.

No filter fills a pixel: one without a match stays lost.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from mitsim.decoding.matching.evidence import nearest_value

Disparities = NDArray[np.float32]

#: steps of a disparity in which regions are compared [1/px]: those of OpenCV's matchers
_STEPS_PER_PX = 16

#: integer of a pixel without a disparity: disparities are clipped to stay above it
_NONE = np.iinfo(np.int16).min


def without_speckles(disparity: Disparities, most_px: int, range_px: float) -> Disparities:
    """Return disparities (h, w) without regions of up to ``most_px`` pixels; NaN is none.

    Neighbours within ``range_px`` of one another belong to one region.
    """
    finite = np.isfinite(disparity)
    if most_px == 0 or not finite.any():
        return disparity
    middle = np.float32(np.median(disparity[finite]))
    limit = np.float32(np.iinfo(np.int16).max)
    steps = np.clip(np.rint((disparity - middle) * _STEPS_PER_PX), -limit, limit)
    image = np.where(finite, steps, _NONE).astype(np.int16)
    cv2.filterSpeckles(image, _NONE, most_px, round(range_px * _STEPS_PER_PX))
    return np.where(image == _NONE, np.float32(np.nan), disparity)


def median_of_neighbours(disparity: Disparities, side: int) -> Disparities:
    """Return disparities (h, w) of which each is the median of a square of ``side`` pixels; 0 for no filter.

    A neighbour without a disparity counts as the nearest one that has one.
    """
    finite = np.isfinite(disparity)
    if side == 0 or not finite.any():
        return disparity
    filled = nearest_value(np.where(finite, disparity, 0).astype(np.float32), finite, 0.0)
    smooth = cv2.medianBlur(filled, side) if side <= 5 else median_filter(filled, side, mode="nearest")
    return np.where(finite, smooth, np.float32(np.nan)).astype(np.float32)
