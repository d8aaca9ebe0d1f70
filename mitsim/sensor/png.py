"""Read and write grey PNG images of 8 or 16 bits, and check all that is read.

OpenCV decodes the undamaged part of a damaged PNG, and reports the damage only on stderr. The half-black image would
then be measured. So Pillow compares the checksums of all chunks first, and then decodes.
"""

from __future__ import annotations

import struct
from io import BytesIO
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import PIL.Image
from numpy.typing import NDArray

from characterisation.files.errors import InputError

Image = NDArray[np.unsignedinteger[Any]]

#: first bytes of every PNG
PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"

#: last chunk of every PNG
_END = b"\0\0\0\0IEND\xaeB`\x82"

#: largest allowed side of an image [px]
LONGEST_SIDE_PX = 16384

#: largest allowed number of pixels of an image
MOST_PIXELS = 64_000_000


def encode_png(image: Image) -> bytes:
    """Return an image (H, W), uint8 or uint16, as the bytes of a lossless PNG.

    Raises ValueError if OpenCV cannot write the image.
    """
    done, data = cv2.imencode(".png", image)
    if not done:
        raise ValueError(f"OpenCV cannot write an image of {image.shape}, {image.dtype} as PNG")
    return data.tobytes()


def decode_png(data: bytes, where: str | Path, size: tuple[int, int] | None = None) -> Image:
    """Return the image (H, W), uint8 or uint16, in the bytes of a PNG file; messages name ``where``.

    ``size`` is the expected (H, W); None allows any size. Raises InputError if the bytes are not a complete grey PNG of
    8 or 16 bits, or the image has another size than expected.
    """
    width, height = check_png(data, where)
    depth, colour, _, _, interlace = data[24:29]
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
    try:
        with PIL.Image.open(BytesIO(data), formats=("PNG",)) as image:
            return np.array(image, np.uint8 if depth == 8 else np.uint16)
    except Exception as error:  # Pillow raises many types of errors
        raise _damaged(where, str(error)) from None


def check_png(data: bytes, where: str | Path) -> tuple[int, int]:
    """Return the width and height [px] of a PNG, grey or colour, after a check of its checksums and its size.

    Raises InputError if the file is not a PNG, is cut off or damaged, or exceeds :data:`LONGEST_SIDE_PX` or
    :data:`MOST_PIXELS`.
    """
    if not data.startswith(PNG_SIGNATURE):
        raise InputError(where, "", "a file that is not a PNG", "a grey PNG of 8 or 16 bits")
    if not data.endswith(_END) or len(data) < 33:
        raise InputError(where, "", f"a PNG cut off after {len(data)} bytes", "a complete PNG: copy the file again")
    width, height = struct.unpack(">II", data[16:24])
    if not (0 < width <= LONGEST_SIDE_PX and 0 < height <= LONGEST_SIDE_PX):
        raise InputError(where, "size", f"{width} x {height} px", f"1 to {LONGEST_SIDE_PX} px a side")
    if width * height > MOST_PIXELS:
        raise InputError(where, "size", f"{width} x {height} px", f"up to {MOST_PIXELS:,} pixels")
    try:
        with PIL.Image.open(BytesIO(data), formats=("PNG",)) as image:
            image.verify()
    except Exception as error:  # Pillow raises many types of errors
        raise _damaged(where, str(error)) from None
    return width, height


def is_grey_png(data: bytes) -> bool:
    """Return whether the header of a PNG, checked by :func:`check_png`, says grey without transparency."""
    return data[25] == 0


def _damaged(where: str | Path, damage: str) -> InputError:
    return InputError(where, "", f"a damaged PNG ({damage})", "a complete PNG: copy the file again")
