"""Find the bits of a camera from the levels of its images, and the bit at which the levels begin.

A saturated pixel has the largest level of the camera. Cameras of 10 or 12 bits put their levels in files of 16 bits
either from bit 0, or in the upper bits; then the largest level is not the largest of the file, and all levels are
multiples of a power of two.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.unsignedinteger[Any]]

#: fewest lower bits that are empty in all levels of images whose levels are in the upper bits
_LEAST_EMPTY = 2


def bits_of(images: Iterable[Image]) -> int:
    """Return the bits of a camera from its images: 8 for 8-bit images, else the fewest that hold all levels."""
    arrays = list(images)
    if all(array.dtype == np.uint8 for array in arrays):
        return 8
    largest = max(int(array.max()) for array in arrays)
    return next(bits for bits in (10, 12, 14, 16) if largest < 2**bits)


def from_bit_0(images: dict[str, Image], bits: int | None = None) -> tuple[dict[str, Image], int]:
    """Return images by name whose levels begin at bit 0, and the number of bits below them that were removed.

    Parameters
    ----------
    images
        Images of the cameras.
    bits
        Those of the camera, if known: the upper ones are kept. By default all empty bits are removed; levels of 8 bits
        become uint8.
    """
    used = 0
    for image in images.values():
        used |= int(np.bitwise_or.reduce(image, axis=None))
    empty = (used & -used).bit_length() - 1 if used else 0
    removed = empty if bits is None else 16 - bits
    if not _LEAST_EMPTY <= removed <= empty or any(image.dtype == np.uint8 for image in images.values()):
        return images, 0
    levels = np.uint8 if bits is None and used >> removed < 256 else np.uint16
    return {name: (image >> removed).astype(levels) for name, image in images.items()}, removed
