"""Unpack zlib and gzip streams to a bounded size, and reject those that are cut off."""

from __future__ import annotations

import zlib

#: ``wbits`` of :func:`zlib.decompressobj` for zlib streams: the largest window, 2^15 bytes
ZLIB = 15

#: ``wbits`` for gzip streams: the same window, plus 16
GZIP = 31


def inflated(data: bytes | memoryview, most: int, wbits: int) -> bytes:
    """Return the bytes of a stream; of one with more than ``most`` bytes, the first ``most + 1``.

    ``wbits``: :data:`ZLIB` or :data:`GZIP`.

    Raises
    ------
    zlib.error
        If the stream is damaged or cut off.
    """
    stream = zlib.decompressobj(wbits)
    out = stream.decompress(data, most + 1)
    if len(out) <= most and not stream.eof:
        raise zlib.error("the stream is cut off")
    return out
