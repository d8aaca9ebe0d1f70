"""Read and write grey PNG images of 8 or 16 bits, and check all that is read.

Signal chain: bytes -> chunks, their lengths and checksums compared -> size and type of the image -> its pixels
expanded, and their number compared -> image; with filters that mitsim does not write, decoded by OpenCV.

OpenCV decodes the undamaged part of a damaged PNG, and reports the damage only on stderr. The half-black image would
then be measured. So the file is checked before OpenCV decodes it.
"""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from characterisation.files.errors import InputError

Image = NDArray[np.unsignedinteger[Any]]

#: first bytes of every PNG
PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"

#: largest allowed side of an image [px]
LONGEST_SIDE_PX = 16384

#: largest allowed number of pixels of an image
MOST_PIXELS = 64_000_000


def encode_png(image: Image) -> bytes:
    """Return an image (H, W), uint8 or uint16, as the bytes of a lossless PNG.

    Raises
    ------
    ValueError
        If OpenCV cannot write the image.
    """
    done, data = cv2.imencode(".png", image)
    if not done:
        raise ValueError(f"OpenCV cannot write an image of {image.shape}, {image.dtype} as PNG")
    return data.tobytes()


def decode_png(data: bytes, where: str | Path, size: tuple[int, int] | None = None) -> Image:
    """Return the image (H, W), uint8 or uint16, in the bytes of a PNG file; messages name ``where``.

    ``size`` is the expected (H, W); None allows any size.

    Raises
    ------
    InputError
        If the bytes are not a complete grey PNG of 8 or 16 bits, or the image has another size than expected.
    """
    chunks = png_chunks(data, where)
    width, height, depth, colour, _, _, interlace = struct.unpack(">IIBBBBB", chunks[0][1])
    if size is not None and (height, width) != size:
        raise InputError(where, "size", f"{width} x {height} px", f"{size[1]} x {size[0]} px, as the calibration says")
    if colour != 0 or depth not in (8, 16) or interlace:
        raise InputError(
            where,
            "colour",
            f"type {colour}, {depth} bits, interlace {interlace}",
            "grey (type 0) of 8 or 16 bits, not interlaced",
            "colour images are not read",
        )
    compressed = b"".join(body for kind, body in chunks if kind == b"IDAT")
    pixels = _inflated(compressed, height * (1 + width * depth // 8), where)
    rows = np.frombuffer(pixels, np.uint8).reshape(height, -1)
    if (rows[:, 0] == 1).all():
        return _unfiltered(rows[:, 1:], depth // 8)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise InputError(where, "", f"a PNG that OpenCV cannot read ({error})", "a complete PNG") from None
    if image is None or image.shape != (height, width) or image.dtype.itemsize != depth // 8:
        raise InputError(where, "", "a PNG that OpenCV cannot read", "a grey PNG of 8 or 16 bits")
    return np.asarray(image)


def png_chunks(data: bytes, where: str | Path) -> list[tuple[bytes, bytes]]:
    """Return type and content of every chunk of a PNG, grey or colour, from header to end, after checks.

    Raises
    ------
    InputError
        If the file is not a PNG, is cut off or damaged, or exceeds :data:`LONGEST_SIDE_PX` or :data:`MOST_PIXELS`.
    """
    if not data.startswith(PNG_SIGNATURE):
        raise InputError(where, "", "a file that is not a PNG", "a grey PNG of 8 or 16 bits")
    chunks, at = [], len(PNG_SIGNATURE)
    while at < len(data):
        if at + 12 > len(data):
            raise InputError(where, "", f"a PNG cut off after {len(data)} bytes", "a complete PNG: copy the file again")
        (length,) = struct.unpack(">I", data[at : at + 4])
        kind, body, end = data[at + 4 : at + 8], data[at + 8 : at + 8 + length], at + 12 + length
        if end > len(data):
            raise InputError(where, "", f"a PNG cut off after {len(data)} bytes", "a complete PNG: copy the file again")
        if struct.pack(">I", zlib.crc32(kind + body)) != data[end - 4 : end]:
            raise InputError(where, "", f"a damaged PNG (chunk at byte {at})", "a complete PNG: copy the file again")
        chunks.append((kind, body))
        at = end
    if len(chunks) < 3 or chunks[0][0] != b"IHDR" or len(chunks[0][1]) != 13 or chunks[-1][0] != b"IEND":
        raise InputError(where, "", "a PNG without its header or end", "a complete PNG: copy the file again")
    width, height = struct.unpack(">II", chunks[0][1][:8])
    if not (0 < width <= LONGEST_SIDE_PX and 0 < height <= LONGEST_SIDE_PX):
        raise InputError(where, "size", f"{width} x {height} px", f"1 to {LONGEST_SIDE_PX} px a side")
    if width * height > MOST_PIXELS:
        raise InputError(where, "size", f"{width} x {height} px", f"up to {MOST_PIXELS:,} pixels")
    return chunks


def _inflated(compressed: bytes, expected: int, where: str | Path) -> bytes:
    """Return the ``expected`` bytes of compressed pixels. At most one byte more is expanded."""
    inflate = zlib.decompressobj()
    try:
        found = inflate.decompress(compressed, expected + 1)
    except zlib.error as error:
        raise InputError(where, "", f"a damaged PNG ({error})", "a complete PNG: copy the file again") from None
    if len(found) != expected:
        allowed = f"{expected} bytes, as stated in its header"
        raise InputError(where, "", f"a PNG with {len(found)} bytes of pixels", allowed)
    return found


def _unfiltered(rows: NDArray[np.uint8], size: int) -> Image:
    """Return the image (H, W) whose rows (H, W * size) are filtered by differences, as OpenCV writes them.

    Filter type 1 of the PNG specification: each byte less the same byte of the pixel to its left, modulo 256. ``size``
    is the bytes of a pixel; two are big-endian.
    """
    levels = np.cumsum(rows.reshape(len(rows), -1, size), axis=1, dtype=np.uint8)
    if size == 1:
        return levels[..., 0]
    return levels.view(">u2")[..., 0].astype(np.uint16)
