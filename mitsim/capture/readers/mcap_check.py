"""Whether an MCAP file is whole, before a maker's library reads it.

DepthAI's replay neither looks at checksums nor tells of damage: a flipped bit comes out as another depth. Here the
records are walked, and the CRC-32 of each chunk, of its uncompressed records, and of the summary are checked,
as the format says (mcap.dev/spec, version 0).
"""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

from characterisation.checked_files import LARGEST_FILE
from characterisation.errors import InputError
from mitsim.capture.readers.lz4 import decode_lz4_frame

MAGIC = b"\x89MCAP0\r\n"

_FOOTER, _CHUNK, _DATA_END = 0x02, 0x06, 0x0F

#: header of a chunk: times of its first and last message, uncompressed size, its CRC, length of the compression's name
_CHUNK_HEADER = struct.Struct("<QQQII")


def check_mcap(data: bytes, where: str | Path) -> None:
    """Refuse an MCAP file that is cut off or damaged.

    Raises
    ------
    InputError
        If it is, or its chunks are compressed by anything but lz4.
    """
    whole = "a whole MCAP file: copy or record it again"
    if not data.startswith(MAGIC):
        raise InputError(where, "", "a file that is no MCAP", "a recording of DepthAI's RecordMessage")
    if not data.endswith(MAGIC) or len(data) < 2 * len(MAGIC):
        raise InputError(where, "", "a file that is cut off", whole, "stop the pipeline before the device is closed")
    at, end, seen = len(MAGIC), len(data) - len(MAGIC), set()
    while at < end:
        if at + 9 > end:
            raise InputError(where, f"byte {at}", "a record that is cut off", whole)
        kind, length = data[at], int.from_bytes(data[at + 1 : at + 9], "little")
        body = data[at + 9 : at + 9 + length]
        if at + 9 + length > end:
            raise InputError(where, f"byte {at}", "a record beyond the end of the file", whole)
        try:
            if kind == _CHUNK:
                _check_chunk(body)
            elif kind == _DATA_END:
                _check_crc(data[:at], int.from_bytes(body[:4], "little"), "data section")
            elif kind == _FOOTER:
                start, _, crc = struct.unpack("<QQI", body)
                _check_crc(data[start : at + 9 + 16] if start else b"", crc if start else 0, "summary")
        except (ValueError, struct.error) as error:
            raise InputError(where, f"byte {at}", f"a damaged record ({error})", whole) from None
        seen.add(kind)
        at += 9 + length
    if _FOOTER not in seen:
        raise InputError(where, "", "a file without its footer", whole)


def _check_chunk(body: bytes) -> None:
    _, _, size, crc, length = _CHUNK_HEADER.unpack_from(body)
    at = _CHUNK_HEADER.size
    compression = body[at : at + length]
    (packed,) = struct.unpack_from("<Q", body, at + length)
    records = body[at + length + 8 : at + length + 8 + packed]
    if len(records) != packed or size > LARGEST_FILE:
        raise ValueError(f"{len(records)} of {packed} bytes, for {size}")
    if compression == b"lz4":
        records = decode_lz4_frame(records, size)
    elif compression != b"":
        raise ValueError(f"compressed by {compression[:10].decode('ascii', 'replace')}, not by lz4 as DepthAI does")
    _check_crc(records, crc, "chunk")


def _check_crc(data: bytes, crc: int, what: str) -> None:
    if crc != 0 and zlib.crc32(data) != crc:  # 0: not computed
        raise ValueError(f"checksum of the {what}")
