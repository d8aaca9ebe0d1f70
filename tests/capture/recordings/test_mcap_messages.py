"""Messages of MCAP files, written by the ``mcap`` package: what is whole is read, and damage is refused in words."""

from __future__ import annotations

import tracemalloc
import zlib
from io import BytesIO

import lz4.frame
import numpy as np
import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st
from mcap.data_stream import RecordBuilder
from mcap.records import Channel, Chunk, DataEnd, Footer, Message, Schema
from mcap.writer import CompressionType, Writer

from characterisation.files.errors import InputError
from mitsim.capture.recordings.mcap_messages import LARGEST_CHUNK, LARGEST_SCHEMA, MOST_RECORDS, mcap_messages
from mitsim.capture.recordings.recording_files import MCAP_MAGIC as MAGIC

#: what is repeated, so that compression has something to do, and what is not
PAYLOADS = [b"abc" * 40, b"", np.random.default_rng(1).bytes(60)]


def written(payloads=PAYLOADS, **options) -> bytes:
    out = BytesIO()
    writer = Writer(out, **options)
    writer.start("protobuf", "test")
    channel = writer.register_channel("topic", "protobuf", writer.register_schema("Name", "protobuf", b"schema"))
    for number, payload in enumerate(payloads):
        writer.add_message(channel, number, payload, number)
    writer.finish()
    return out.getvalue()


def read(content: bytes) -> list[tuple[str, bytes, str, bytes]]:
    return [
        (schema.name, schema.data, channel.message_encoding, message.data)
        for schema, channel, message in mcap_messages(content, "x.mcap")
    ]


EXPECTED = [("Name", b"schema", "protobuf", payload) for payload in PAYLOADS]


@pytest.mark.parametrize("compression", list(CompressionType))
@pytest.mark.parametrize("options", [{}, {"use_chunking": False}, {"chunk_size": 1}, {"enable_data_crcs": True}])
def test_messages_come_back_in_order(compression, options):
    assert read(written(compression=compression, **options)) == EXPECTED


@pytest.mark.parametrize("compression", list(CompressionType))
@pytest.mark.parametrize("summed", [False, True])
def test_every_bit_that_is_flipped_is_noticed_or_changes_no_message(compression, summed):
    """DepthAI writes checksums of chunks and summary, and none of the data between the chunks; then with that too."""
    content = written(compression=compression, enable_data_crcs=summed)
    unnoticed = 0
    for place in range(8 * len(content)):
        flipped = bytearray(content)
        flipped[place // 8] ^= 1 << place % 8
        try:
            assert read(bytes(flipped)) == EXPECTED
            unnoticed += 1
        except InputError as error:
            assert error.where == "x.mcap"
    # without a checksum: texts of the header, times of the chunk, the message index
    assert unnoticed == 0 if summed else 0 < unnoticed < 8 * 200


def test_every_length_that_is_cut_off_is_refused():
    content = written()
    for length in range(len(content)):
        with pytest.raises(InputError, match=r"not MCAP|truncated|damaged record|without its footer"):
            read(content[:length])


@given(st.binary(max_size=200))
def test_bytes_that_are_no_mcap_are_refused(data):
    for content in (data, MAGIC + data, MAGIC + data + MAGIC):
        with pytest.raises(InputError):
            read(content)


def test_a_chunk_that_is_no_longer_known_as_one_is_missed():
    content = bytearray(written())
    at = len(MAGIC) + 9 + int.from_bytes(content[9:17], "little")
    assert content[at] == 0x06
    content[at] = 0x86  # a private record, to be stepped over
    with pytest.raises(InputError, match="found 0 messages of the 3 that its summary counts"):
        read(bytes(content))


def assembled(*records) -> bytes:
    """A file of records, without a summary."""
    out = RecordBuilder()
    for record in (*records, DataEnd(0), Footer(0, 0, 0)):
        record.write(out)
    return MAGIC + out.end() + MAGIC


def chunk(data: bytes, compression: str = "", size: int | None = None, crc: int = 0) -> Chunk:
    return Chunk(compression, data, 0, 0, crc, len(data) if size is None else size)


def test_a_file_without_a_summary_is_read():
    inside = RecordBuilder()
    for record in (Schema(1, b"schema", "protobuf", "Name"), Channel(1, "topic", "protobuf", {}, 1)):
        record.write(inside)
    head = inside.end()
    Message(1, 0, b"payload", 0, 0).write(inside)
    message = inside.end()
    checked = chunk(message, crc=zlib.crc32(message))
    assert read(assembled(chunk(head), checked)) == [("Name", b"schema", "protobuf", b"payload")]
    with pytest.raises(InputError, match="KeyError 1"):
        read(assembled(checked))
    with pytest.raises(InputError, match="checksum of the chunk"):
        read(assembled(chunk(head), chunk(message, crc=1)))


PLAIN = bytes(4 * LARGEST_CHUNK)
LZ4, ZSTD = lz4.frame.compress(PLAIN), zstandard.compress(PLAIN)
#: without its size in the header of the frame
ZSTD_UNTOLD = zstandard.ZstdCompressor(write_content_size=False).compress(PLAIN)
#: a frame of one empty block, whose header tells 2^62 bytes
ZSTD_LIE = b"\x28\xb5\x2f\xfd\xe0" + (2**62).to_bytes(8, "little") + b"\x01\x00\x00"


@pytest.mark.parametrize(
    ("bomb", "told"),
    [
        (chunk(LZ4, "lz4", len(PLAIN)), f"{len(PLAIN)} bytes in a chunk, over {LARGEST_CHUNK}"),
        (chunk(ZSTD, "zstd", 2**64 - 1), f"{2**64 - 1} bytes in a chunk"),
        (chunk(LZ4, "lz4", 1000), "does not have its stated 1000 bytes"),
        (chunk(ZSTD, "zstd", 1000), "does not have its stated 1000 bytes"),
        (chunk(ZSTD_UNTOLD, "zstd", 1000), "does not have its stated 1000 bytes"),
        (chunk(ZSTD_LIE, "zstd", 1000), "damaged record"),
        (chunk(LZ4[: len(LZ4) // 2], "lz4", LARGEST_CHUNK - 1), "does not have its stated"),
        (chunk(LZ4[:-9], "lz4", 0), "does not have its stated 0 bytes"),
        (chunk(b"no frame", "lz4", 10), "damaged record .RuntimeError"),
        (chunk(b"no frame", "zstd", 10), "damaged record .ZstdError"),
        (chunk(b"", "bz2", 10), "compressed by 'bz2', not by lz4 or zstd"),
        (chunk(bytes(2**20), "", 10), "does not have its stated 10 bytes"),
        (Schema(1, bytes(LARGEST_SCHEMA), "protobuf", "Name"), "bytes in a schema, over 1048576"),
        (Message(1, 0, bytes(LARGEST_CHUNK), 0, 0), "bytes in a message, over 33554432"),
    ],
)
def test_what_would_unpack_to_more_than_it_tells_or_is_believed_is_refused_at_once(bomb, told):
    content = assembled(bomb)
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match=rf"x\.mcap: byte 8: found a damaged record .*{told}|{told}"):
            read(content)
        # the compressed bytes, copied, and what the largest chunk unpacks to, no more
        assert tracemalloc.get_traced_memory()[1] < 2 * LARGEST_CHUNK + 3 * len(content)
    finally:
        tracemalloc.stop()


def test_a_chunk_of_countless_empty_records_is_refused():
    """Nine bytes each, of a kind that nobody knows: without a bound a file of 256 MiB would be read for hours."""
    records = (b"\x80" + bytes(8)) * (MOST_RECORDS + 1)
    bomb = chunk(lz4.frame.compress(records), "lz4", len(records))
    with pytest.raises(InputError, match=f"{MOST_RECORDS + 1} records, over {MOST_RECORDS}"):
        read(assembled(bomb))


def test_chunks_that_unpack_to_too_much_together_are_refused(monkeypatch):
    """Each within its limit; the limit of all is lowered here, for 4 GiB take seconds."""
    monkeypatch.setattr("mitsim.capture.recordings.mcap_messages.LARGEST_RECORDING", 10_000)
    unknown = b"\x80" + (3000).to_bytes(8, "little") + bytes(3000)
    one = chunk(lz4.frame.compress(unknown), "lz4", len(unknown))
    assert read(assembled(one, one, one)) == []
    with pytest.raises(InputError, match="12000 bytes in all chunks, over 10000"):
        read(assembled(one, one, one, one))
