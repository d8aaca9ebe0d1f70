"""Read grey images from common image files, and check them.

Signal chain: bytes -> chunks of a PNG, checked; pages of a TIFF -> decoded image -> one channel of colour images, if
requested -> grey image (H, W) of 8 or 16 bits -> the bits of the camera, and the bit at which its levels begin.

A saturated pixel has the largest level of the camera. Cameras of 10 or 12 bits put their levels in files of 16 bits
either from bit 0, or in the upper bits; then the largest level is not the largest of the file, and all levels are
multiples of a power of two.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from characterisation.files.checked_files import LARGEST_FILE, read_bounded
from characterisation.files.errors import InputError
from mitsim.sensor.png import LONGEST_SIDE_PX, PNG_SIGNATURE, check_png, decode_png, is_grey_png

#: suffixes of the image files that are read
SUFFIXES = (".png", ".tif", ".tiff", ".bmp", ".jpg", ".jpeg", ".pgm")

#: first bytes of a TIFF, and the byte order of its numbers
_TIFF_MARKS = {b"II*\0": "<", b"MM\0*": ">", b"II+\0": "<", b"MM\0+": ">"}

#: most pages of a file; chosen
_MOST_PAGES = 10_000

#: tag of the kind of a page (TIFF 6.0, NewSubfileType)
_KIND = 254
#: bits of the kind: a reduced copy, and a mask
_REDUCED_OR_MASK = 0b101

#: the head of a PFM, whose last number is its scale
_PFM = re.compile(rb"P[fF]\s+\d+\s+\d+\s+(\S{1,40})\s")

Image = NDArray[np.unsignedinteger[Any]]

#: fewest lower bits that are empty in all levels of images whose levels are in the upper bits; chosen
_LEAST_EMPTY = 2

#: channels of a colour image, in the order of OpenCV
CHANNELS = {"blue": 0, "green": 1, "red": 2}


def channel_of(name: str | None) -> int:
    """Return the number of a channel by its name; None is green, which has half of the pixels of a Bayer pattern."""
    if name is not None and name not in CHANNELS:
        raise InputError("--channel", "", repr(name), " | ".join(CHANNELS))
    return CHANNELS[name or "green"]


def is_colour(path: Path) -> bool:
    """Return whether the first image of a file can be read and has channels that differ."""
    try:
        next(read_pages(path))
    except InputError as error:
        return error.field == "colour"
    return False


def read_grey(path: Path, *, channel: int | None = None) -> Image:
    """Read a grey image (H, W), uint8 or uint16.

    A colour image is read only if its colour channels are equal, or if ``channel`` selects one by its number
    (:data:`CHANNELS`). Raises InputError if the file cannot be read, is not an image, has several pages, or channels
    that differ.
    """
    return decode_grey(_bytes_of(path), path, channel=channel)


def read_pages(path: Path, *, channel: int | None = None) -> Iterator[Image]:
    """Yield the grey images (H, W) of a file as :func:`read_grey` does: all pages of a TIFF, in order."""
    data = _bytes_of(path)
    pages = _pages(data, path)
    for page, label in zip(pages, page_labels(path, len(pages)), strict=True):
        yield _checked(_decoded(data, label, channel, page), label)


def page_labels(path: str | Path, count: int) -> list[str]:
    """Return a name for each of the images in a file, for messages and records; the only one has that of the file."""
    return [str(path)] if count == 1 else [f"{path}, page {number} of {count}" for number in range(1, count + 1)]


def page_count(path: Path) -> int:
    """Return the number of images in a file."""
    begin = read_bounded(path, first=4)
    return len(_tiff_pages(_bytes_of(path), path)) if begin in _TIFF_MARKS else 1


def _pages(data: bytes, where: str | Path) -> list[int]:
    return _tiff_pages(data, where) if data[:4] in _TIFF_MARKS else [0]


def _tiff_pages(data: bytes, where: str | Path) -> list[int]:
    """Return the numbers of the pages with images in the content of a TIFF file, from 0; ``where`` names the file.

    A TIFF is a chain of directories, each of which describes one page and states the offset of the next (TIFF 6.0;
    BigTIFF with offsets of 8 bytes). Tag 254 states whether a page is a reduced copy of another one, or its mask.
    """
    order, big = _TIFF_MARKS[data[:4]], data[2:4] in (b"+\0", b"\0+")
    count, offset, entry = (order + "Q", order + "Q", 20) if big else (order + "H", order + "I", 12)
    images: list[int] = []
    seen: set[int] = set()
    try:
        at = int(struct.unpack_from(offset, data, 8 if big else 4)[0])
        while at:
            if at in seen or len(seen) >= _MOST_PAGES:
                raise InputError(where, "pages", "pages in a ring, or too many", f"up to {_MOST_PAGES} pages")
            seen.add(at)
            entries = int(struct.unpack_from(count, data, at)[0])
            at += struct.calcsize(count)
            end = at + entries * entry
            following = int(struct.unpack_from(offset, data, end)[0])
            kinds = [
                int(struct.unpack_from(order + "I", data, position + entry - struct.calcsize(offset))[0])
                for position in range(at, end, entry)
                if struct.unpack_from(order + "H", data, position)[0] == _KIND
            ]
            if not any(kind & _REDUCED_OR_MASK for kind in kinds):
                images.append(len(seen) - 1)
            at = following
    except (struct.error, OverflowError):
        found = f"a TIFF cut off in page {len(seen) + 1}"
        raise InputError(where, "", found, "a complete TIFF: copy it again") from None
    return images or list(range(len(seen)))


def read_depths(path: Path) -> NDArray[Any]:
    """Read a grey image (H, W) as :func:`read_grey` does, or one of signed whole numbers or of floating point."""
    data = _bytes_of(path)
    _check_scale(data, path)
    image = _decoded(data, path, None)
    of_depths = image.dtype.kind in "fi" and image.ndim == 2 and max(image.shape) <= LONGEST_SIDE_PX
    return image if of_depths else _checked(image, path)


def _check_scale(data: bytes, where: str | Path) -> None:
    """Check that a PFM has a scale of 1 or -1: OpenCV divides by another one, and most programs do not."""
    if (head := _PFM.match(data)) is None:
        return
    scale = 1.0
    with suppress(ValueError):  # OpenCV refuses it
        scale = float(head[1])
    if abs(scale) != 1:
        hint = "programs differ on whether it divides the numbers: save them with a scale of -1"
        raise InputError(where, "scale", head[1].decode("ascii", "replace"), "1 or -1 in a PFM", hint)


def _bytes_of(path: Path) -> bytes:
    data = read_bounded(path)
    if not data:
        raise InputError(path, "size", "0 bytes", f"1 to {LARGEST_FILE} bytes")
    return data


def decode_grey(data: bytes, where: str | Path, *, channel: int | None = None) -> Image:
    """Read a grey image from the bytes of a file, as :func:`read_grey` does."""
    return _checked(_decoded(data, where, channel), where)


def _decoded(data: bytes, where: str | Path, channel: int | None, page: int | None = None) -> NDArray[Any]:
    """Return the numbers (H, W) of a ``page``, by default the only one: its only channel, or the requested one."""
    if page is None:
        page, *others = _pages(data, where)
        if others:
            hint = "save the page that is meant as a file of its own"
            raise InputError(where, "pages", f"{1 + len(others)} pages", "one image", hint)
    if data.startswith(PNG_SIGNATURE):
        check_png(data, where)  # OpenCV would decode the undamaged part of a damaged PNG
        if is_grey_png(data):
            return decode_png(data, where)
    image = None
    with suppress(cv2.error, IndexError):  # reported below, as where OpenCV returns None
        numbers = np.frombuffer(data, np.uint8)
        if page:
            image = cv2.imdecodemulti(numbers, cv2.IMREAD_UNCHANGED, range=(page, page + 1))[1][0]
        elif data:
            image = cv2.imdecode(numbers, cv2.IMREAD_UNCHANGED)
    if image is None:
        raise InputError(where, "", "a file that is not an image, or is damaged", f"one of {', '.join(SUFFIXES)}")
    if image.ndim == 3:
        colours = image[..., :3] if image.shape[2] >= 3 else image[..., :1]
        if channel is not None and image.shape[2] >= 3:
            return np.ascontiguousarray(image[..., channel])
        if (colours != colours[..., :1]).any():
            hint = "convert it without changing its levels; for a colour camera, take one channel or the raw image"
            raise InputError(where, "colour", f"{image.shape[2]} channels that differ", "a grey image", hint)
        return np.ascontiguousarray(image[..., 0])
    return image


def _checked(image: NDArray[Any], where: str | Path) -> Image:
    if image.dtype not in (np.uint8, np.uint16):
        raise InputError(where, "depth", image.dtype, "8 or 16 bits, unsigned")
    if max(image.shape) > LONGEST_SIDE_PX:
        raise InputError(where, "size", f"{image.shape[1]} x {image.shape[0]} px", f"up to {LONGEST_SIDE_PX} px a side")
    return np.asarray(image)


def check_image_size(image: Image, size: tuple[int, int], where: str | Path, reason: str) -> None:
    """Check that an image has the ``size`` (width, height) [px]; the error at ``where`` says its ``reason``."""
    if image.shape != size[::-1]:
        found = f"{image.shape[1]} x {image.shape[0]} px"
        raise InputError(where, "size", found, f"{size[0]} x {size[1]} px, {reason}")


def bits_of(images: Iterable[Image]) -> int:
    """Return the bits of a camera from its images: 8 for 8-bit images, else the fewest that hold all levels."""
    arrays = list(images)
    if all(array.dtype == np.uint8 for array in arrays):
        return 8
    largest = max(int(array.max()) for array in arrays)
    return next(bits for bits in (10, 12, 14, 16) if largest < 2**bits)


def from_bit_0(images: dict[str, Image], bits: int | None = None) -> tuple[dict[str, Image], int]:
    """Return images by name whose levels begin at bit 0, and the number of bits below them that were removed.

    ``bits`` are those of the camera, if known: the upper ones are kept. By default all empty bits are removed; levels
    of 8 bits become uint8.
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
