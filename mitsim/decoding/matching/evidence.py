"""Determine from the rectified images why a pixel has no point: its contrast, and its saturation.

Signal chain: rectified images [DN] -> conditions of each pixel -> status.

The conditions of a pixel without a point are tested in this order: outside an image, saturated, without contrast, out
of range, hidden from the second camera. If none holds, its match is ambiguous.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from characterisation.point_cloud import Status

#: least share of a block at full scale for which the block counts as saturated
SATURATED_SHARE = 0.25


def block_deviation(image: NDArray[np.uint8] | NDArray[np.float32], block: int) -> NDArray[np.float64]:
    """Return the standard deviation [DN] in a square block around each pixel of ``image`` (H, W) [DN]."""
    size = (block, block)
    mean = cv2.boxFilter(image, cv2.CV_64F, size, borderType=cv2.BORDER_REPLICATE)
    square = cv2.sqrBoxFilter(image, cv2.CV_64F, size, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(np.sqrt(np.maximum(square - mean * mean, 0)))


def block_saturated(full: NDArray[np.uint8], block: int) -> NDArray[np.bool_]:
    """Return whether at least a quarter of the block around each pixel is saturated.

    ``full`` (H, W) is 255 where a pixel is at full scale, else 0.
    """
    share = cv2.boxFilter(full, cv2.CV_32F, (block, block), borderType=cv2.BORDER_REPLICATE)
    return np.asarray(share >= 255 * SATURATED_SHARE)


def nearest_value(values: NDArray[np.float32], valid: NDArray[np.bool_], fallback: float) -> NDArray[np.float32]:
    """Return the value (H, W) of each pixel, or of the nearest ``valid`` pixel; ``fallback`` if none is valid."""
    if not valid.any():
        return np.full(values.shape, fallback, np.float32)
    _, labels = cv2.distanceTransformWithLabels(
        (~valid).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    value_of_label = np.empty(int(labels.max()) + 1, np.float32)
    value_of_label[labels[valid]] = values[valid]
    return np.asarray(value_of_label[labels])


def right_property(
    property_of_right: NDArray[np.bool_], columns: NDArray[np.integer], disparity: NDArray[np.float32]
) -> NDArray[np.bool_]:
    """Return a property (H, W) of the right strip where left ``columns`` (w,) match; False for a match outside it.

    ``disparity`` (h, w) is at the left columns [px].
    """
    right_column = np.rint(columns - disparity).astype(np.intp)
    inside = (right_column >= 0) & (right_column < property_of_right.shape[1])
    return np.asarray(inside & np.take_along_axis(property_of_right, np.where(inside, right_column, 0), axis=1))


def first_reason(
    valid: NDArray[np.bool_], evidence: list[tuple[Status, NDArray[np.bool_]]], otherwise: Status
) -> NDArray[np.uint8]:
    """Return the status of each pixel: ``VALID``, or the first in ``evidence`` that holds, or ``otherwise``."""
    status = np.select([valid, *(mask for _, mask in evidence)], [Status.VALID, *(s for s, _ in evidence)], otherwise)
    return status.astype(np.uint8)
