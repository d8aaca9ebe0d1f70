"""Find the pages of a TIFF file, without the reduced copies and the masks that it may have beside them.

A TIFF is a chain of directories, each of which describes one page and states the offset of the next (TIFF 6.0; BigTIFF
with offsets of 8 bytes). Tag 254 states whether a page is a reduced copy of another one, or its mask.
"""

from __future__ import annotations

import struct
from pathlib import Path

from characterisation.files.errors import InputError

#: first bytes of a TIFF, and the byte order of its numbers
TIFF_MARKS = {b"II*\0": "<", b"MM\0*": ">", b"II+\0": "<", b"MM\0+": ">"}

#: most pages of a file
_MOST_PAGES = 10_000

#: tag of the kind of a page
_KIND = 254
#: bits of the kind: a reduced copy, and a mask
_REDUCED_OR_MASK = 0b101


def tiff_pages(data: bytes, where: str | Path) -> list[int]:
    """Return the numbers of the pages with images in the content of a TIFF file, from 0; ``where`` names the file.

    Raises
    ------
    InputError
        If the file is cut off, or its pages form a ring or are too many.
    """
    order, big = TIFF_MARKS[data[:4]], data[2:4] in (b"+\0", b"\0+")
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
        raise InputError(
            where, "", f"a TIFF cut off in page {len(seen) + 1}", "a complete TIFF: copy it again"
        ) from None
    return images or list(range(len(seen)))
