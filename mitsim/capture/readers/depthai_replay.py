"""Replay recordings of DepthAI's ``RecordMessage`` through its ``ReplayMessage``, with no device, in a process apart.

``python -m mitsim.capture.readers.depthai_replay OUT NUMBER FILE...`` writes ``frames.json`` and one ``.npy`` for each
file into the folder OUT. The maker's library is compiled code, which could end the process that runs it, or never end;
so it gets one of its own.

Of the files together, the frames are those whose sequence numbers all have; where they are not numbered, the frames in
their order.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from datetime import timedelta
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from characterisation.errors import InputError
from mitsim.capture.npy import decode_npy, encode_npy
from mitsim.errors import MissingEnvironmentError

#: a replay that takes longer is stopped [s]
PATIENCE_S = 300.0

_NEXT_MESSAGE = timedelta(seconds=10)

#: kinds of frames whose bytes are grey levels, disparities or depths
_PLAIN = {"RAW8": np.uint8, "GRAY8": np.uint8, "RAW16": np.uint16}


@dataclass(frozen=True)
class ReplayedFrame:
    """One frame of a stream: ``image`` (H, W) uint8 or uint16, and what the device said of it.

    ``matrix`` K (3, 3) of the frame's pixels [px], None where the device did not say; ``count`` frames to choose from.
    """

    image: NDArray[Any]
    matrix: NDArray[np.float64] | None
    exposure_s: float
    sensitivity_iso: int
    sequence: int
    count: int


def replay(files: dict[str, Path], frame: int | None) -> dict[str, ReplayedFrame]:
    """Frame of a number of each stream, by the names of ``files``.

    Raises
    ------
    InputError
        If a file cannot be replayed, or has no such frame; or several, and none was chosen.
    MissingEnvironmentError
        If depthai is not installed.
    """
    if find_spec("depthai") is None:
        what = "recordings of DepthAI are replayed by depthai, which is not installed"
        raise MissingEnvironmentError(f"{what}: pip install 'mitsim[depthai]'")
    first = next(iter(files.values()))
    with tempfile.TemporaryDirectory() as place:
        command = [
            sys.executable,
            "-m",
            __name__,
            place,
            str(-1 if frame is None else frame),
            *map(str, files.values()),
        ]
        quiet = os.environ | {"DEPTHAI_LEVEL": "off", "DEPTHAI_INSTALL_SIGNAL_HANDLER": "0"}
        try:
            done = subprocess.run(command, env=quiet, capture_output=True, timeout=PATIENCE_S, check=False)
        except subprocess.TimeoutExpired:
            raise InputError(
                first, "", f"a recording that replays for over {PATIENCE_S:g} s", "a shorter one"
            ) from None
        report = Path(place) / "frames.json"
        if done.returncode != 0 or not report.is_file():
            told = done.stderr.decode("utf-8", "replace").strip().splitlines()
            found = f"a recording that DepthAI cannot replay ({told[-1] if told else f'exit {done.returncode}'})"
            raise InputError(first, "", found, "what RecordMessage wrote")
        table = json.loads(report.read_text(encoding="utf-8"))
        if "fault" in table:
            raise InputError(files[list(files)[table["stream"]]], *table["fault"])
        out = {}
        for number, name in enumerate(files):
            told = table["frames"][number]
            image = decode_npy((Path(place) / f"{number}.npy").read_bytes(), files[name])
            matrix = None if told["matrix"] is None else np.array(told["matrix"])
            out[name] = ReplayedFrame(
                image, matrix, told["exposure_s"], told["sensitivity_iso"], told["sequence"], table["count"]
            )
        return out


def _messages(file: Path) -> Any:
    """Messages of a recording, one after the other."""
    from mitsim.hardware.depthai_camera import depthai

    dai = depthai()
    with dai.Pipeline(False) as pipeline:
        node = pipeline.create(dai.node.ReplayMetadataOnly)
        node.setReplayFile(file)
        node.setLoop(False)
        node.setFps(1000)
        queue = node.out.createOutputQueue(maxSize=16, blocking=True)
        pipeline.start()
        while True:
            try:
                message = queue.get(_NEXT_MESSAGE)
            except dai.MessageQueue.QueueException:  # closed at the end of the recording
                return
            if message is None:
                return
            yield message


def _told(message: Any) -> dict[str, Any]:
    try:
        matrix = np.array(message.getTransformation().getIntrinsicMatrix(), float)
        sensible = matrix.shape == (3, 3) and np.isfinite(matrix).all() and matrix[0, 0] > 1 and matrix[1, 1] > 1
    except (RuntimeError, ValueError, TypeError, AttributeError):
        sensible = False
    return {
        "matrix": matrix.tolist() if sensible else None,
        "exposure_s": message.getExposureTime().total_seconds(),
        "sensitivity_iso": int(message.getSensitivity()),
        "sequence": int(message.getSequenceNum()),
    }


def _chosen(sequences: list[list[int]], number: int) -> tuple[list[int], int] | tuple[str, str, str]:
    """Place of the chosen frame in each stream, and how many there are; or what is wrong: field, found, allowed."""
    numbered = all(len(set(each)) == len(each) for each in sequences)
    if numbered:
        common = [one for one in sequences[0] if all(one in each for each in sequences)]
        places = [[each.index(one) for each in sequences] for one in common]
    else:
        places = [[index] * len(sequences) for index in range(min(map(len, sequences)))]
    if not places:
        return "", "streams without a frame in common", "streams that were recorded together"
    if number < 0 and len(places) > 1:
        return "--frame", f"{len(places)} frames", f"one in a capture: choose 0 to {len(places) - 1}"
    if number >= len(places):
        return "--frame", str(number), f"0 to {len(places) - 1}"
    return places[max(number, 0)], len(places)


def _write(folder: Path, number: int, files: list[Path]) -> dict[str, Any]:
    """Write the images of the chosen frames; what to say of them, or of the first fault."""
    sequences = []
    for stream, file in enumerate(files):
        numbers = []
        for message in _messages(file):
            kind = type(message).__name__
            name = message.getType().name if kind == "ImgFrame" else kind
            if name not in _PLAIN:
                lossy = name in ("EncodedFrame", "BITSTREAM", "JPEG")
                found = f"frames of {name}" + (", which are compressed with loss" if lossy else "")
                return {
                    "stream": stream,
                    "fault": ["", found, ", ".join(_PLAIN), "record the stream before the encoder"],
                }
            numbers.append(int(message.getSequenceNum()))
        if not numbers:
            return {"stream": stream, "fault": ["", "a recording without a frame", "what RecordMessage wrote"]}
        sequences.append(numbers)
    chosen = _chosen(sequences, number)
    if isinstance(chosen[0], str):
        return {"stream": 0, "fault": list(chosen)}
    places, count = chosen
    frames = []
    for stream, (file, place) in enumerate(zip(files, places, strict=True)):
        for index, message in enumerate(_messages(file)):
            if index == place:
                width, height = message.getWidth(), message.getHeight()
                dtype = np.dtype(_PLAIN[message.getType().name])
                data = np.asarray(message.getData(), np.uint8).tobytes()
                if len(data) != width * height * dtype.itemsize:
                    fault = ["", f"a frame of {len(data)} bytes", f"{width} x {height} px of {dtype.itemsize} bytes"]
                    return {"stream": stream, "fault": fault}
                (folder / f"{stream}.npy").write_bytes(encode_npy(np.frombuffer(data, dtype).reshape(height, width)))
                frames.append(_told(message))
    return {"count": count, "frames": frames}


if __name__ == "__main__":
    target = Path(sys.argv[1])
    answer = _write(target, int(sys.argv[2]), [Path(file) for file in sys.argv[3:]])
    (target / "frames.json").write_text(json.dumps(answer), encoding="utf-8")
