"""Region of interest: a rectangle of pixels of an image, as a camera reads one out.

One class serves the renderer, the decoders and the measurements, for camera images and for the grids of clouds.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from characterisation.files.errors import InputError


@dataclass(frozen=True)
class Roi:
    """``width`` x ``height`` pixels whose first column is ``left`` and whose first row is ``top``.

    Settings of captures and options of commands write it as these four numbers, in this order.
    """

    left: int
    top: int
    width: int
    height: int

    @classmethod
    def whole(cls, width: int, height: int) -> Roi:
        """All pixels of an image."""
        return cls(0, 0, width, height)

    @classmethod
    def between(cls, left: float, top: float, right: float, bottom: float) -> Roi:
        """From its edges, whole numbers.

        Parameters
        ----------
        left, top
            First column and row, whole numbers.
        right, bottom
            First column and row after the region.

        See Also
        --------
        whole : all pixels of an image
        """
        return cls(int(left), int(top), int(right) - int(left), int(bottom) - int(top))

    @classmethod
    def around(cls, mask: NDArray[np.bool_]) -> Roi | None:
        """Return the smallest region that holds all pixels of a mask (H, W), None if the mask has none."""
        rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
        return cls.between(columns[0], rows[0], columns[-1] + 1, rows[-1] + 1) if len(rows) else None

    @property
    def right(self) -> int:
        """First column after the region."""
        return self.left + self.width

    @property
    def bottom(self) -> int:
        """First row after the region."""
        return self.top + self.height

    @property
    def slices(self) -> tuple[slice, slice]:
        """Rows and columns, to index an image (H, W) with."""
        return slice(self.top, self.bottom), slice(self.left, self.right)

    def pixels(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Columns and rows (height, width) of all its pixels."""
        columns, rows = np.meshgrid(np.arange(self.left, self.right), np.arange(self.top, self.bottom))
        return columns, rows

    def overlap(self, other: Roi) -> Roi | None:
        """Return the region that two share, None if they share no pixel."""
        left, top = max(self.left, other.left), max(self.top, other.top)
        right, bottom = min(self.right, other.right), min(self.bottom, other.bottom)
        return Roi.between(left, top, right, bottom) if left < right and top < bottom else None

    def fits(self, width: int, height: int) -> bool:
        """Whether it holds a pixel and lies in an image of this size."""
        return 0 <= self.left < self.right <= width and 0 <= self.top < self.bottom <= height


def checked_roi(roi: Roi | None, width: int, height: int, where: str) -> Roi:
    """Return the region, or all of an image of this size if there is none.

    Parameters
    ----------
    roi
        Region; all of the image if None.
    width, height
        Of the image [px].
    where
        Name of the file or argument, for the error.

    Raises
    ------
    InputError
        If the region is empty or does not lie in the image.
    """
    if roi is None:
        return Roi.whole(width, height)
    if not roi.fits(width, height):
        found = f"left {roi.left}, top {roi.top}, width {roi.width}, height {roi.height}"
        raise InputError(where, "region of interest", found, f"a region within {width} x {height} pixels")
    return roi
