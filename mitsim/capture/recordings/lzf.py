"""Decode LZF, the compression of ``binary_compressed`` PCD files (Marc Lehmann's LibLZF).

A control byte c under 32 precedes c + 1 literal bytes. Otherwise its upper three bits are a length; 7 means that a byte
follows to be added to it. Its lower five bits are the upper bits of a distance, whose lower eight follow. Then
length + 2 bytes are repeated from distance + 1 bytes before.
"""

from __future__ import annotations


def decode_lzf(data: bytes, size: int) -> bytes:
    """Decompress to ``size`` bytes.

    Raises
    ------
    ValueError
        If the data do not decode to exactly that many bytes.
    """
    out = bytearray()
    at, end = 0, len(data)
    while at < end:
        control = data[at]
        at += 1
        if control < 32:
            literal = data[at : at + control + 1]
            if len(literal) <= control:
                raise ValueError("compressed data end in the middle of a run")
            out += literal
            at += control + 1
        else:
            length = control >> 5
            if at + (length == 7) >= end:
                raise ValueError("compressed data end in the middle of a repetition")
            if length == 7:
                length += data[at]
                at += 1
            begin = len(out) - ((control & 31) << 8) - data[at] - 1
            at += 1
            _repeat(out, begin, length + 2)
        if len(out) > size:
            break
    if len(out) != size:
        raise ValueError(f"{len(out)} bytes instead of {size}")
    return bytes(out)


def _repeat(out: bytearray, begin: int, count: int) -> None:
    """Append ``count`` bytes from ``begin`` on, which may overlap the appended ones.

    Raises
    ------
    ValueError
        If ``begin`` lies before the first byte.
    """
    if not 0 <= begin < len(out):
        raise ValueError("a repetition that starts before the first byte")
    piece = bytes(out[begin : begin + count])
    while len(piece) < count:  # an overlapping run repeats itself
        piece = (piece + piece)[:count]
    out += piece
