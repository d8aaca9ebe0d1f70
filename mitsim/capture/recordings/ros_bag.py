"""Open bags of ROS: ROS 1 ``.bag``, ROS 2 ``.db3`` and ``.mcap``, or the folder of a ROS 2 bag.

Signal chain: file -> topics with the types and numbers of their messages -> the bytes of one message.

rosbags reads ROS 1 bags, through their index; sqlite3 reads ``.db3``; :mod:`mitsim.capture.recordings.mcap_messages`
reads MCAP. A bag may be damaged anywhere, so every error of a reader becomes an :class:`InputError`, and chunks and
messages are unpacked up to a limit.
"""

from __future__ import annotations

import bz2
import mmap
import re
import sqlite3
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import lz4.frame
import zstandard
from rosbags.rosbag1 import Reader
from rosbags.rosbag1.reader import decompressors

from characterisation.files.errors import InputError, in_one_line
from mitsim.capture.recordings.mcap_messages import Expected, mcap_messages
from mitsim.capture.recordings.recording_files import BAG_MAGIC, LARGEST_RECORDING, MCAP_MAGIC, MOST_FILES, SQLITE_MAGIC
from mitsim.sensor.projector_images import counted

#: first bytes of data packed by Zstandard
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"

#: suffixes of the files of a ROS 2 bag
ROS2_SUFFIXES = (".db3", ".mcap")

#: largest unpacked chunk, and largest message [bytes]: an organised cloud of 8 megapixels, 32 bytes for each point
LARGEST_CHUNK = 256 * 1024**2

_MCAP = Expected("a bag of ROS 2", "mcap recover writes a whole one", LARGEST_CHUNK, 2_000_000)

_WHOLE = "a whole bag: copy or record it again"


@dataclass(frozen=True)
class Topic:
    """A topic: its ``name``, the ``kind`` of its messages (``sensor_msgs/msg/Image``), and their ``count``.

    ``ros1``: whether they are serialised as in ROS 1. ``digest``: MD5 of their definition in ROS 1, else empty.
    """

    name: str
    kind: str
    count: int
    ros1: bool = False
    digest: str = ""


@dataclass(frozen=True)
class RosBag:
    """A bag: its ``path``, its ``topics`` by name, and ``message``, which returns the bytes of a message by number."""

    path: Path
    topics: dict[str, Topic]
    message: Callable[[str, int], bytes]


def open_bag(path: Path) -> RosBag:
    """Open a bag: a file, or the folder of a ROS 2 bag, whose files follow one another."""
    if not path.is_dir():
        return _opened(path)
    files = [file for file in islice(path.iterdir(), MOST_FILES) if file.is_file() and not file.is_symlink()]
    bag_files = sorted((file for file in files if file.suffix.lower() in ROS2_SUFFIXES), key=counted)
    if not bag_files:
        packed = next((file.name for file in files if file.name.lower().endswith(".zstd")), None)
        hint = "" if packed is None else f"unpack it: zstd -d {packed}"
        raise InputError(path, "", packed or "no .db3 and no .mcap", "the folder of a ROS 2 bag", hint)
    bags = [_opened(file) for file in bag_files]
    return bags[0] if len(bags) == 1 else _joined(path, bags)


def _opened(path: Path) -> RosBag:
    try:
        size = path.stat().st_size
        with path.open("rb") as stream:
            begin = stream.read(64)
    except (OSError, ValueError):
        raise InputError(path, "", "a file that cannot be read", "a bag of ROS: .bag, .db3 or .mcap") from None
    if begin.startswith(BAG_MAGIC) or path.suffix.lower() == ".bag":
        return _of_ros1(path)
    if begin.startswith(SQLITE_MAGIC) or path.suffix.lower() == ".db3":
        return _of_sqlite(path)
    if size > LARGEST_RECORDING:
        raise InputError(path, "size", f"{size} bytes", f"up to {LARGEST_RECORDING} bytes", "cut it: mcap filter")
    if begin.startswith(MCAP_MAGIC):
        return _of_mcap(path)
    raise InputError(path, "", "a file that is no bag", "a bag of ROS: .bag, .db3 or .mcap")


def _joined(path: Path, bags: list[RosBag]) -> RosBag:
    def message(name: str, number: int) -> bytes:
        for bag in bags:
            count = bag.topics[name].count if name in bag.topics else 0
            if number < count:
                return bag.message(name, number)
            number -= count
        raise LookupError(name)

    return RosBag(path, _by_name(topic for bag in bags for topic in bag.topics.values()), message)


def _by_name(topics: Iterable[Topic]) -> dict[str, Topic]:
    """Return topics by name; those of one name are one, with the messages of all."""
    out: dict[str, Topic] = {}
    for topic in topics:
        known = out.get(topic.name)
        out[topic.name] = topic if known is None else replace(known, count=known.count + topic.count)
    return out


def _of_ros1(path: Path) -> RosBag:
    with _in_words(path), Reader(path) as reader:
        found = (Topic(one.topic, one.msgtype, one.msgcount, True, one.digest or "") for one in reader.connections)
        topics = _by_name(found)

    def message(name: str, number: int) -> bytes:
        with _in_words(path), Reader(path) as reader:
            reader.chunks = {
                position: chunk._replace(decompressor=_bounded_by(chunk.decompressor))
                for position, chunk in reader.chunks.items()
            }
            chosen = [connection for connection in reader.connections if connection.topic == name]
            times = sorted(entry.time for connection in chosen for entry in reader.indexes[connection.id])
            start = times[number]
            messages = reader.messages(chosen, start=start, stop=start + 1)
            return next(islice(messages, number - times.index(start), None))[2]

    return RosBag(path, topics, message)


def _bounded_by(decompressor: Callable[[bytes], bytes]) -> Callable[[bytes], bytes]:
    """Return the decompressor of a chunk of ROS 1, which stops beyond :data:`LARGEST_CHUNK`."""
    name = next(name for name, candidate in decompressors.items() if candidate is decompressor)
    if name == "none":
        return decompressor

    def bounded(data: bytes) -> bytes:
        unpacker: Any = bz2.BZ2Decompressor() if name == "bz2" else lz4.frame.LZ4FrameDecompressor()
        out: bytes = unpacker.decompress(data, LARGEST_CHUNK + 1)
        if len(out) > LARGEST_CHUNK:
            raise ValueError(f"a chunk of over {LARGEST_CHUNK} bytes")
        return out

    return bounded


def _of_sqlite(path: Path) -> RosBag:
    with _in_words(path), _database(path) as database:
        query = "SELECT count(*) FROM sqlite_master WHERE type = 'table' AND name IN ('topics', 'messages')"
        if database.execute(query).fetchone()[0] != 2:
            raise InputError(path, "", "a database without the tables topics and messages", "a ROS 2 bag")
        rows = database.execute("SELECT id, name, type, serialization_format FROM topics").fetchall()
        counts = dict(database.execute("SELECT topic_id, count(*) FROM messages GROUP BY topic_id").fetchall())
        numbers = {str(name): int(key) for key, name, _, _ in rows}
        topics = {
            str(name): Topic(str(name), str(kind), int(counts.get(key, 0)))
            for key, name, kind, written in rows
            if written == "cdr"
        }

    def message(name: str, number: int) -> bytes:
        with _in_words(path), _database(path) as database:
            query = "SELECT data FROM messages WHERE topic_id = ? ORDER BY timestamp, id LIMIT 1 OFFSET ?"
            return _unpacked(database.execute(query, (numbers[name], number)).fetchone()[0])

    return RosBag(path, topics, message)


@contextmanager
def _database(path: Path) -> Iterator[sqlite3.Connection]:
    with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro&immutable=1", uri=True)) as database:
        database.execute("PRAGMA trusted_schema = OFF")
        yield database


def _unpacked(data: bytes) -> bytes:
    """Return a message of a ROS 2 bag, which rosbag2 may have packed alone."""
    if not data.startswith(_ZSTD_MAGIC):
        return data
    out = zstandard.ZstdDecompressor(max_window_size=LARGEST_CHUNK).stream_reader(data).read(LARGEST_CHUNK + 1)
    if len(out) > LARGEST_CHUNK:
        raise ValueError(f"a message of over {LARGEST_CHUNK} bytes")
    return out


def _of_mcap(path: Path) -> RosBag:
    topics: dict[str, Topic] = {}
    counts: Counter[str] = Counter()
    for name, kind, encoding, _ in _mcap(path):
        counts[name] += 1
        topics.setdefault(name, Topic(name, re.sub(r"^(\w+)/(\w+)$", r"\1/msg/\2", kind), 0, encoding == "ros1"))

    def message(name: str, number: int) -> bytes:
        messages = (data for topic, _, _, data in _mcap(path) if topic == name)
        with _in_words(path):
            return _unpacked(next(islice(messages, number, None)))

    return RosBag(path, {name: replace(topic, count=counts[name]) for name, topic in topics.items()}, message)


def _mcap(path: Path) -> Iterator[tuple[str, str, str, bytes]]:
    """Yield topic, type, encoding and bytes of every message in ROS's encodings."""
    for schema, channel, message in mcap_messages(_mapped(path), path, _MCAP):
        if channel.message_encoding in ("cdr", "ros1"):
            yield channel.topic, schema.name, channel.message_encoding, message.data


def _mapped(path: Path) -> mmap.mmap:
    """Return a file in memory as far as it is read; it is closed with its last reference."""
    with path.open("rb") as stream:
        return mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)


def is_ros_mcap(path: Path) -> bool:
    """Return whether the first message of an MCAP file, or else its profile, is of ROS."""
    with path.open("rb") as stream:
        begin = stream.read(64)
    if begin[21:25] in (b"ros1", b"ros2"):  # magic, kind and length of the header, length of the profile
        return True
    try:
        first = islice(mcap_messages(_mapped(path), path, _MCAP), 1)
        return any(channel.message_encoding in ("cdr", "ros1") for _, channel, _ in first)
    except (InputError, ValueError, OSError):
        return False


@contextmanager
def _in_words(path: Path) -> Iterator[None]:
    """Turn every error of a reader of bags into one that names the file."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:  # a damaged bag may raise anything
        text = in_one_line(error, 160)
        if "not indexed" in text:
            raise InputError(path, "", "a bag without its index", _WHOLE, f"rosbag reindex {path.name}") from None
        raise InputError(path, "", f"a bag that cannot be read ({text})", _WHOLE) from None
