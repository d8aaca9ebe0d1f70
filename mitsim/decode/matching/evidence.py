"""What the rectified images themselves say about a pixel: how much pattern is there, and is it blown out.

A pixel without a point is asked, in this order: was it outside an image, saturated, without contrast, out of range,
hidden from the second camera; only then is its match called ambiguous.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from characterisation.point_cloud import Status

#: share of a block at full scale from which on the block counts as blown out
SATURATED_SHARE = 0.25


def block_deviation(image: NDArray[np.uint8] | NDArray[np.float32], block: int) -> NDArray[np.float64]:
    """Standard deviation [DN] in a square block around each pixel of ``image`` (H, W)."""
    size = (block, block)
    mean = cv2.boxFilter(image, cv2.CV_64F, size, borderType=cv2.BORDER_REPLICATE)
    square = cv2.sqrBoxFilter(image, cv2.CV_64F, size, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(np.sqrt(np.maximum(square - mean * mean, 0)))


def block_saturated(full: NDArray[np.uint8], block: int) -> NDArray[np.bool_]:
    """Blocks of which a quarter or more is at full scale; ``full`` (H, W) is 255 where a pixel is."""
    share = cv2.boxFilter(full, cv2.CV_32F, (block, block), borderType=cv2.BORDER_REPLICATE)
    return np.asarray(share >= 255 * SATURATED_SHARE)


def nearest_value(values: NDArray[np.float32], known: NDArray[np.bool_], fallback: float) -> NDArray[np.float32]:
    """Each pixel's own value where ``known``, else that of the nearest known pixel; ``fallback`` if none is known."""
    if not known.any():
        return np.full(values.shape, fallback, np.float32)
    _, labels = cv2.distanceTransformWithLabels(
        (~known).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    by_label = np.empty(int(labels.max()) + 1, np.float32)
    by_label[labels[known]] = values[known]
    return np.asarray(by_label[labels])


def at_right(
    property_of_right: NDArray[np.bool_], columns: NDArray[np.integer], disparity: NDArray[np.float32], outside: bool
) -> NDArray[np.bool_]:
    """Look a property (h, W) of the right strip up where left ``columns`` (w,) are seen at ``disparity`` (h, w)."""
    place = np.rint(columns - disparity).astype(np.intp)
    within = (place >= 0) & (place < property_of_right.shape[1])
    looked_up = np.take_along_axis(property_of_right, np.where(within, place, 0), axis=1)
    return np.where(within, looked_up, outside)


def reasons(
    valid: NDArray[np.bool_], evidence: list[tuple[Status, NDArray[np.bool_]]], otherwise: Status
) -> NDArray[np.uint8]:
    """Status per pixel: ``VALID``, or the first piece of evidence that holds, or ``otherwise``."""
    status = np.select([valid, *(mask for _, mask in evidence)], [Status.VALID, *(s for s, _ in evidence)], otherwise)
    return status.astype(np.uint8)
