"""Which pixels of an image bilinear interpolation needs, and whether the camera read them out."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mitsim.sensor.roi import Roi


def reach(positions: NDArray[np.float32], width: int, height: int) -> Roi:
    """Return the region of an image that interpolation at ``positions`` (2, ...), column and row, needs.

    It ends where the image does, so that positions beyond the image are treated as in the whole image.
    """
    edges = []
    for each, size in zip(positions, (width, height), strict=True):
        low, high = (float(np.clip(end, 0, size)) for end in (each.min(), each.max()))  # a fisheye's may be infinite
        first = min(max(int(low) - 1, 0), size - 1)
        edges.append((first, max(min(int(np.ceil(high)) + 2, size), first + 1)))
    (left, right), (top, bottom) = edges
    return Roi.between(left, top, right, bottom)


def has_been_read(positions: NDArray[np.float32], read_out: Roi, width: int, height: int) -> NDArray[np.bool_]:
    """Whether interpolation at ``positions`` (2, ...), column and row, needs only pixels that were read out.

    Where the region ends with the image, half a pixel more counts, as it does for whole images.
    """
    column, row = positions
    within = column >= (read_out.left if read_out.left > 0 else -0.5)
    within &= column <= (read_out.right - 1 if read_out.right < width else width - 0.5)
    within &= row >= (read_out.top if read_out.top > 0 else -0.5)
    within &= row <= (read_out.bottom - 1 if read_out.bottom < height else height - 0.5)
    return np.asarray(within)
