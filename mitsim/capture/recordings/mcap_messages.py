"""Read the messages of an MCAP file, checking all limits and checksums (mcap.dev/spec, version 0).

Signal chain: records in order -> chunks unpacked up to their stated size, with checksum -> schemas, channels, messages
-> checksums at the ends of the data and of the summary -> comparison of the number of messages with the summary.

The ``mcap`` package parses the records. Its own readers are not used: they unpack an lz4 chunk to any size, ignore the
summary's checksum and skip a chunk whose type is damaged.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from io import BytesIO
from mmap import mmap
from pathlib import Path

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, DataEnd, Footer, Message, Schema, Statistics

from characterisation.files.errors import InputError
from mitsim.capture.recordings.recording_files import LARGEST_RECORDING, MCAP_MAGIC

#: largest unpacked chunk, and largest message [bytes]: one 16-bit frame of 16 megapixels
LARGEST_CHUNK = 32 * 1024**2

#: largest schema [bytes]; DepthAI's have a few thousand
LARGEST_SCHEMA = 1024**2

#: largest number of records of a file, including those in chunks
MOST_RECORDS = 250_000

#: allowed value in messages about damage
WHOLE = "a whole MCAP file: copy or record it again"

#: errors of the package, the decompressors and the checks below for damaged records
_DAMAGED = (McapError, zstandard.ZstdError, struct.error, LookupError, OverflowError, RuntimeError, ValueError)

#: type and length of a record
_RECORD = struct.Struct("<BQ")

#: type, length and offsets of the footer, which precede its checksum
_FOOTER_SIZE = _RECORD.size + 16


@dataclass(frozen=True)
class Expected:
    """What a file should be in words (``made_by``), how to avoid a truncated one, and its limits.

    ``chunk``: largest chunk and message [bytes]; ``records``: largest number of records.
    """

    made_by: str = "a recording of DepthAI's RecordMessage"
    truncated: str = "stop the pipeline before the device is closed"
    chunk: int = LARGEST_CHUNK
    records: int = MOST_RECORDS


def mcap_messages(
    data: bytes | mmap, where: str | Path, expected: Expected = Expected()
) -> Iterator[tuple[Schema, Channel, Message]]:
    """Yield the messages in the order of the file, with the schema and the channel of each.

    Raises InputError if the file is truncated or damaged, or exceeds a limit of ``expected`` when unpacked. The overall
    checksums and the number of messages are checked after the last message.
    """
    if data[: len(MCAP_MAGIC)] != MCAP_MAGIC:
        raise InputError(where, "", "a file that is not MCAP", expected.made_by)
    if data[-len(MCAP_MAGIC) :] != MCAP_MAGIC or len(data) < 2 * len(MCAP_MAGIC):
        raise InputError(where, "", "a truncated file", WHOLE, expected.truncated)
    yield from _messages(memoryview(data)[: -len(MCAP_MAGIC)], where, expected)


def _messages(view: memoryview, where: str | Path, expected: Expected) -> Iterator[tuple[Schema, Channel, Message]]:
    """Yield the messages of a file without its last magic bytes."""
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    kind, at, ended = 0, len(MCAP_MAGIC), 0  # end of the data; 0 until found
    seen, unpacked, count, stated = 0, 0, 0, None
    try:
        for kind, at, body in _records(view, len(MCAP_MAGIC)):
            seen = _bounded(seen + 1, expected.records, "records")
            if kind == Opcode.DATA_END:
                _check_crc(view[:at], DataEnd.read(_stream(body)).data_section_crc, "data section")
                ended = at + _RECORD.size + len(body)
            elif kind == Opcode.FOOTER:
                footer = Footer.read(_stream(body))
                if footer.summary_start not in (0, ended):
                    raise ValueError(f"data that end at {ended}, not where the summary begins")
                _check_crc(view[footer.summary_start or at : at + _FOOTER_SIZE], footer.summary_crc, "summary")
            elif kind == Opcode.STATISTICS:
                stated = Statistics.read(_stream(body)).message_count
            if ended:  # later records repeat earlier ones
                continue
            for inner, _, record in _data(kind, body, expected.chunk):
                seen = _bounded(seen + 1, expected.records, "records")
                unpacked = _bounded(unpacked + len(record), LARGEST_RECORDING, "bytes in all chunks")
                if inner == Opcode.SCHEMA:
                    _bounded(len(record), LARGEST_SCHEMA, "bytes in a schema")
                    schema = Schema.read(_stream(record))
                    schemas[schema.id] = schema
                elif inner == Opcode.CHANNEL:
                    channel = Channel.read(_stream(record))
                    channels[channel.id] = channel
                elif inner == Opcode.MESSAGE:
                    _bounded(len(record), expected.chunk, "bytes in a message")
                    message = Message.read(_stream(record), len(record))
                    channel = channels[message.channel_id]
                    count += 1
                    yield schemas[channel.schema_id], channel, message
    except _DAMAGED as error:
        words = str(error) if type(error) is ValueError else f"{type(error).__name__} {error}".strip()
        raise InputError(where, f"byte {at}", f"a damaged record ({words})", WHOLE) from None
    if kind != Opcode.FOOTER or not ended:
        raise InputError(where, "", "a file without its footer or the end of its data", WHOLE)
    if stated is not None and stated != count:
        raise InputError(where, "", f"{count} messages of the {stated} that its summary counts", WHOLE)


def _records(view: memoryview, at: int = 0) -> Iterator[tuple[int, int, memoryview]]:
    """Yield type, position and body of each record from ``at`` on."""
    while at < len(view):
        kind, length = _RECORD.unpack_from(view, at)
        body = view[at + _RECORD.size : at + _RECORD.size + length]
        if len(body) != length:
            raise ValueError(f"{length} bytes, beyond the end")
        yield kind, at, body
        at += _RECORD.size + length


def _data(kind: int, body: memoryview, largest: int) -> Iterable[tuple[int, int, memoryview]]:
    """Return a record of the data section, or the records in a chunk, as :func:`_records` does."""
    if kind != Opcode.CHUNK:
        return [(kind, 0, body)]
    return _records(memoryview(_unpacked(Chunk.read(_stream(body)), largest)))


def _unpacked(chunk: Chunk, largest: int) -> bytes:
    """Unpack the records of a chunk, never beyond its stated size."""
    size = _bounded(chunk.uncompressed_size, largest, "bytes in a chunk")
    if chunk.compression == "lz4":
        records: bytes = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1)
    elif chunk.compression == "zstd":
        unpacker = zstandard.ZstdDecompressor(max_window_size=largest)
        records = unpacker.stream_reader(chunk.data).read(size + 1)
    elif chunk.compression == "":
        records = chunk.data
    else:
        raise ValueError(f"compressed by {chunk.compression[:10]!r}, not by lz4 or zstd")
    if len(records) != size:
        raise ValueError(f"a chunk that does not have its stated {size} bytes")
    _check_crc(memoryview(records), chunk.uncompressed_crc, "chunk")
    return records


def _stream(body: memoryview) -> ReadDataStream:
    return ReadDataStream(BytesIO(body))


def _bounded(number: int, most: int, quantity: str) -> int:
    if number > most:
        raise ValueError(f"{number} {quantity}, over {most}")
    return number


def _check_crc(data: memoryview, crc: int, part: str) -> None:
    if crc != 0 and zlib.crc32(data) != crc:  # 0 means not computed
        raise ValueError(f"checksum of the {part}")
