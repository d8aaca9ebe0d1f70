"""LZ4, the compression of DepthAI's recordings, decoded as its block and frame formats say.

A block is a row of sequences: a token, whose upper four bits count literals and whose lower four a match, 15 meaning
that bytes to add follow; the literals; the distance of the match in two bytes, of whose length 4 is not counted. A
frame is a magic number, a header and blocks with their sizes (github.com/lz4/lz4, *doc/lz4_Frame_format.md*, version
1.6; *doc/lz4_Block_format.md*). Checksums inside of the frame are not checked: who calls has one of the whole.
"""

from __future__ import annotations

from mitsim.capture.readers.lzf import repeat

_MAGIC = b"\x04\x22\x4d\x18"


def decode_lz4_frame(data: bytes, size: int) -> bytes:
    """Decompress one frame to ``size`` bytes.

    Raises
    ------
    ValueError
        If the data do not make exactly that many bytes.
    """
    if not data.startswith(_MAGIC) or len(data) < 7:
        raise ValueError("no LZ4 frame")
    flags = data[4]
    if flags >> 6 != 1 or flags & 1:
        raise ValueError("an LZ4 frame of another version, or with a dictionary")
    at = 6 + (8 if flags & 8 else 0) + 1
    out = bytearray()
    while True:
        if at + 4 > len(data):
            raise ValueError("an LZ4 frame without its end")
        length = int.from_bytes(data[at : at + 4], "little")
        at += 4
        if length == 0:
            break
        plain, length = length >> 31, length & 0x7FFFFFFF
        block = data[at : at + length]
        if len(block) < length:
            raise ValueError("an LZ4 block that is cut off")
        if plain:
            out += block
        else:
            # a block by itself must not reach back into the one before
            _decode_block(block, out, len(out) if flags & 32 else 0, size)
        if len(out) > size:
            break
        at += length + (4 if flags & 16 else 0)
    if len(out) != size:
        raise ValueError(f"{len(out)} bytes, more or less than the {size} that were told")
    return bytes(out)


def _decode_block(block: bytes, out: bytearray, first: int, size: int) -> None:
    at, end = 0, len(block)
    while at < end:
        token = block[at]
        at += 1
        count, at = _length(block, at, token >> 4)
        if at + count > end:
            raise ValueError("literals beyond the end of a block")
        out += block[at : at + count]
        at += count
        if at == end:  # the last sequence has no match
            return
        if at + 2 > end:
            raise ValueError("a match that is cut off")
        distance = int.from_bytes(block[at : at + 2], "little")
        count, at = _length(block, at + 2, token & 15)
        if distance == 0 or len(out) - distance < first or len(out) + count > size:
            raise ValueError("a match beyond the data")
        repeat(out, len(out) - distance, count + 4)


def _length(block: bytes, at: int, count: int) -> tuple[int, int]:
    """A length that goes on in further bytes where its first four bits are all set, and the place after it."""
    if count == 15:
        while True:
            if at >= len(block):
                raise ValueError("a length that is cut off")
            count += block[at]
            at += 1
            if block[at - 1] != 255:
                break
    return count, at
