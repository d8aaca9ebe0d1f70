"""Unpack zlib and gzip streams to a bounded size, and reject those that are cut off."""

from __future__ import annotations

import zlib

#: ``wbits`` of :func:`zlib.decompressobj` for zlib streams: the largest window, 2^15 bytes
ZLIB = 15

#: ``wbits`` for gzip streams: the same window, plus 16
GZIP = 31


def inflated(data: bytes | memoryview, most: int, wbits: int) -> bytes:
    """Return at most ``most + 1`` bytes of a stream (:data:`ZLIB`, :data:`GZIP`); zlib.error if damaged or cut."""
    stream = zlib.decompressobj(wbits)
    out = stream.decompress(data, most + 1)
    if len(out) <= most and not stream.eof:
        raise zlib.error("the stream is cut off")
    return out
