"""Describe a region of interest: a rectangle of pixels of an image.

One class serves the renderer, the decoders and the measurements, for camera images and for the grids of clouds.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from characterisation.files.errors import InputError


@dataclass(frozen=True)
class Roi:
    """A region of ``width`` x ``height`` pixels from column ``left`` and row ``top`` on.

    Settings of captures and options of commands give these four numbers in the order of the fields.
    """

    left: int
    top: int
    width: int
    height: int

    @classmethod
    def whole(cls, width: int, height: int) -> Roi:
        """Return the region of all pixels of an image."""
        return cls(0, 0, width, height)

    @classmethod
    def between(cls, left: float, top: float, right: float, bottom: float) -> Roi:
        """Return the region between edges.

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
    def around(cls, mask: NDArray[np.bool_], margin: int = 0) -> Roi | None:
        """Return the smallest region that holds all pixels of a mask (H, W), None if the mask has none.

        It is larger by a ``margin`` [px] on each side, but for what lies outside the mask's image.
        """
        rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
        if not len(rows):
            return None
        box = cls.between(columns[0] - margin, rows[0] - margin, columns[-1] + 1 + margin, rows[-1] + 1 + margin)
        return box.overlap(cls.whole(mask.shape[1], mask.shape[0]))

    @property
    def right(self) -> int:
        """Return the first column after the region."""
        return self.left + self.width

    @property
    def bottom(self) -> int:
        """Return the first row after the region."""
        return self.top + self.height

    @property
    def slices(self) -> tuple[slice, slice]:
        """Return slices of rows and columns, to index an image (H, W)."""
        return slice(self.top, self.bottom), slice(self.left, self.right)

    def pixels(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return columns and rows (height, width) of all pixels."""
        columns, rows = np.meshgrid(np.arange(self.left, self.right), np.arange(self.top, self.bottom))
        return columns, rows

    def overlap(self, other: Roi) -> Roi | None:
        """Return the common region of two; None if they share no pixel."""
        left, top = max(self.left, other.left), max(self.top, other.top)
        right, bottom = min(self.right, other.right), min(self.bottom, other.bottom)
        return Roi.between(left, top, right, bottom) if left < right and top < bottom else None

    def joined(self, other: Roi) -> Roi:
        """Return the smallest region that contains both."""
        left, top = min(self.left, other.left), min(self.top, other.top)
        return Roi.between(left, top, max(self.right, other.right), max(self.bottom, other.bottom))

    def fits(self, width: int, height: int) -> bool:
        """Return whether the region holds a pixel and lies in an image of this size [px]."""
        return 0 <= self.left < self.right <= width and 0 <= self.top < self.bottom <= height


def checked_roi(roi: Roi | None, width: int, height: int, where: str) -> Roi:
    """Return the region, or all of an image of this size if there is none.

    Raises InputError if the region is empty or does not lie in the image.

    Parameters
    ----------
    roi
        Region; all of the image if None.
    width, height
        Of the image [px].
    where
        Name of the file or argument, for the error.
    """
    if roi is None:
        return Roi.whole(width, height)
    if not roi.fits(width, height):
        found = f"left {roi.left}, top {roi.top}, width {roi.width}, height {roi.height}"
        raise InputError(where, "region of interest", found, f"a region within {width} x {height} pixels")
    return roi
