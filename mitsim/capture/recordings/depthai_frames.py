"""Read frames of DepthAI's recordings: MCAP files of protobuf messages ``dai.proto.img_frame.ImgFrame``.

The file's own schema describes the message, so DepthAI is not needed. Files of several streams share the frames whose
sequence numbers all of them have. Unnumbered frames are matched by their order.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from google.protobuf.message import DecodeError
from mcap.exceptions import McapError
from mcap_protobuf.decoder import DecoderFactory
from numpy.typing import NDArray

from characterisation.files.checked_files import read_bounded
from characterisation.files.errors import InputError
from mitsim.capture.recordings.mcap_messages import mcap_messages
from mitsim.capture.recordings.recording_files import chosen_frame
from mitsim.sensor.png import LONGEST_SIDE_PX

_IMG_FRAME = "dai.proto.img_frame.ImgFrame"

#: frame types whose bytes are grey levels, disparities or depths
_PLAIN: dict[str, np.dtype[Any]] = {"RAW8": np.dtype("u1"), "GRAY8": np.dtype("u1"), "RAW16": np.dtype("<u2")}

_RECORDED = "a recording of DepthAI's RecordMessage"

#: upper limit of the entries of a camera matrix [px]
_LARGEST_ENTRY = 1e6

#: errors of protobuf for invalid descriptions and messages, and of reading messages of another structure
_ODD = (DecodeError, McapError, AttributeError, LookupError, OverflowError, RuntimeError, TypeError, ValueError)


@dataclass(frozen=True)
class RecordedFrame:
    """One frame of a stream: ``image`` (H, W) uint8 or uint16, and the device's data about it.

    ``matrix``: K (3, 3) of the frame's pixels [px], None if the device gave none. ``socket`` of its camera,
    0 if not stated. ``count``: number of frames.
    """

    image: NDArray[Any]
    matrix: NDArray[np.float64] | None
    exposure_s: float
    sensitivity_iso: int
    sequence: int
    socket: int
    count: int


def read_frames(files: dict[str, Path], frame: int | None) -> dict[str, RecordedFrame]:
    """Read the frame of one number from each stream, by the names of ``files``."""
    sequences = {name: _sequences(file) for name, file in files.items()}
    positions, count = _chosen(sequences, frame, next(iter(files.values())))
    return {name: _frame(file, positions[name], count) for name, file in files.items()}


def _messages(file: Path) -> Iterator[Any]:
    """Yield the messages of a recording of one stream, decoded by protobuf."""
    decoders, channels = DecoderFactory(), set()
    for schema, channel, message in mcap_messages(read_bounded(file), file):
        channels.add(channel.id)
        if schema.name != _IMG_FRAME:
            raise _other(file, schema.name.rpartition(".")[2])
        if len(channels) > 1:
            raise InputError(file, channel.topic, "a second stream", "one stream in a file")
        with _in_words(file):
            decode = decoders.decoder_for(channel.message_encoding, schema)
            if decode is None:
                raise ValueError(f"encoded as {channel.message_encoding}")
            decoded = decode(message.data)
        yield decoded


def _sequences(file: Path) -> list[int]:
    """Return the sequence numbers of a stream of uncompressed frames."""
    numbers: list[int] = []
    for message in _messages(file):
        with _in_words(file):
            _kind(message, file)
            numbers.append(int(message.sequenceNum))
    if not numbers:
        raise InputError(file, "", "a recording without a frame", _RECORDED)
    return numbers


def _chosen(sequences: dict[str, list[int]], frame: int | None, where: Path) -> tuple[dict[str, int], int]:
    """Return the position of the chosen frame in each stream, and the number of common frames."""
    streams = [{number: position for position, number in enumerate(numbers)} for numbers in sequences.values()]
    if all(len(set(numbers)) == len(numbers) for numbers in sequences.values()):
        common = [number for number in streams[0] if all(number in stream for stream in streams)]
        positions = [[stream[number] for stream in streams] for number in common]
    else:
        positions = [[position] * len(sequences) for position in range(min(map(len, sequences.values())))]
    if not positions:
        raise InputError(where, "", "streams without a frame in common", "streams that were recorded together")
    number = chosen_frame(frame, len(positions), where, "frames")
    return dict(zip(sequences, positions[number], strict=True)), len(positions)


def _frame(file: Path, position: int, count: int) -> RecordedFrame:
    message: Any = next(islice(_messages(file), position, None), None)  # None if the file has changed meanwhile
    with _in_words(file):
        matrix = _matrix(message.transformation)
        exposure_s, iso = float(message.cam.exposureTimeUs) * 1e-6, int(message.cam.sensitivityIso)
        sequence, socket = int(message.sequenceNum), int(getattr(message, "instanceNum", 0))
        return RecordedFrame(_image(message, file), matrix, exposure_s, iso, sequence, socket, count)


def _image(message: Any, file: Path) -> NDArray[Any]:
    """Return the pixels as ImgFrame's ``getFrame`` does: rows at the stride, without padding."""
    dtype = _PLAIN[_kind(message, file)]
    width, height = int(message.fb.width), int(message.fb.height)
    stride = int(message.fb.stride) or width * dtype.itemsize
    if not (1 <= width <= LONGEST_SIDE_PX and 1 <= height <= LONGEST_SIDE_PX):
        raise InputError(file, "size", f"{width} x {height} px", f"sides of 1 to {LONGEST_SIDE_PX} px")
    if stride < width * dtype.itemsize or stride % dtype.itemsize:
        row = f"at least a row of {width} px, in whole pixels of {dtype.itemsize} bytes"
        raise InputError(file, "stride", f"{stride} bytes", row)
    if len(message.data) < stride * (height - 1) + width * dtype.itemsize:
        size = f"{width} x {height} px of {dtype.itemsize} bytes, rows {stride} bytes apart"
        raise InputError(file, "", f"a frame of {len(message.data)} bytes", size)
    rows = np.ndarray((height, width), dtype, message.data, strides=(stride, dtype.itemsize))
    return rows.astype(dtype.newbyteorder("="))


def _matrix(transformation: Any) -> NDArray[np.float64] | None:
    """Return K of the frame's pixels, from the sensor's K and the frame's crop and scale; None if absent."""
    tables = (transformation.transformationMatrix.arrays, transformation.sourceIntrinsicMatrix.arrays)
    if any(len(rows) != 3 or any(len(row.values) != 3 for row in rows) for rows in tables):
        return None
    frame_from_sensor, sensor = (np.array([list(row.values) for row in rows], float) for rows in tables)
    if not all(np.abs(entries).max() < _LARGEST_ENTRY for entries in (frame_from_sensor, sensor)):  # NaN fails too
        return None
    matrix = frame_from_sensor @ sensor
    is_known = matrix[0, 0] > 1 and matrix[1, 1] > 1  # an unknown matrix is the identity
    return matrix if is_known and np.abs(matrix).max() < _LARGEST_ENTRY else None


def _kind(message: Any, file: Path) -> str:
    fields = message.fb.DESCRIPTOR.fields_by_name
    name = str(fields["type"].enum_type.values_by_number[message.fb.type].name)
    if name not in _PLAIN:
        raise _other(file, name)
    return name


def _other(file: Path, name: str) -> InputError:
    lossy = name in ("EncodedFrame", "BITSTREAM", "JPEG")
    found = f"frames of {name}" + (", which are compressed with loss" if lossy else "")
    return InputError(file, "", found, ", ".join(_PLAIN), "record the stream before the encoder")


@contextmanager
def _in_words(file: Path) -> Iterator[None]:
    try:
        yield
    except InputError:
        raise
    except _ODD as error:
        raise InputError(file, "", f"a message that is not an ImgFrame ({error})", _RECORDED) from None
