"""Determine the pixels that bilinear interpolation needs, and whether the camera has read them out."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from characterisation.region_of_interest import Roi


def needed_region(positions: NDArray[np.float32], width: int, height: int) -> Roi:
    """Return the region, clipped to the image, that interpolation needs at positions (2, ...), column and row [px]."""
    limits = []
    for coordinates, size in zip(positions, (width, height), strict=True):
        # the positions of a fisheye camera may be infinite
        low, high = (float(np.clip(end, 0, size)) for end in (coordinates.min(), coordinates.max()))
        first = min(max(int(low) - 1, 0), size - 1)
        limits.append((first, max(min(int(np.ceil(high)) + 2, size), first + 1)))
    (left, right), (top, bottom) = limits
    return Roi.between(left, top, right, bottom)


def was_read_out(positions: NDArray[np.float32], read_out: Roi, width: int, height: int) -> NDArray[np.bool_]:
    """Return whether interpolation at positions needs only pixels that were read out.

    Where the region ends at the edge of the image, positions up to half a pixel beyond it are included, as in whole
    images.

    ``positions``: (2, ...) columns and rows [px]. ``read_out``: region of the image that was read out. ``width``,
    ``height``: size of the image [px].
    """
    column, row = positions
    inside = column >= (read_out.left if read_out.left > 0 else -0.5)
    inside &= column <= (read_out.right - 1 if read_out.right < width else width - 0.5)
    inside &= row >= (read_out.top if read_out.top > 0 else -0.5)
    inside &= row <= (read_out.bottom - 1 if read_out.bottom < height else height - 0.5)
    return np.asarray(inside)
