"""Recordings of DepthAI made here, by its own ``RecordMessage``, of frames that are known; no device is needed.

Run as a program, ``python depthai_recordings.py PLAN.npz ...``, in a process apart: a plan holds the frames and the
names of the files, and the package's threads end with the process. Beside NAME.mcap lies NAME.npz, which holds what
DepthAI says of each frame: the images of ``getFrame``, the matrices of ``getIntrinsicMatrix``.

``rewritten`` writes a recording once more, changed or packed in another way, with whole checksums.
"""

import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np
from mcap.reader import make_reader
from mcap.writer import Writer

#: exposure of the first frame [us], one more for each that follows; and its sensitivity
EXPOSURE_US, ISO = 8000, 400


@dataclass(frozen=True)
class Recording:
    """Stacks (n, H, W), uint8 or uint16, to record as NAME.mcap in a folder; frames are numbered from ``first`` on.

    ``padding`` bytes follow each row. Where ``cropped``, the frames were cut from larger ones, whose matrix is
    ``matrix``, and halved. Bytes are RAW8 or, where ``grey``, GRAY8.
    """

    folder: Path
    streams: dict[str, np.ndarray]
    matrix: np.ndarray | None = None
    first: int = 0
    padding: int = 0
    cropped: bool = False
    grey: bool = False

    def plan(self) -> Path:
        """Write what the program needs."""
        self.folder.mkdir(parents=True, exist_ok=True)
        extra = {} if self.matrix is None else {"matrix": self.matrix}
        stacks = {f"stream:{name}": stack for name, stack in self.streams.items()}
        options = [self.first, self.padding, self.cropped, self.grey]
        np.savez(self.folder / "plan.npz", **stacks, **extra, options=options)
        return self.folder / "plan.npz"


def record(*recordings: Recording) -> None:
    """Make recordings, all in one process, which takes half a second to import DepthAI."""
    plans = [one.plan() for one in recordings]
    quiet = os.environ | {"DEPTHAI_LEVEL": "off"}
    subprocess.run([sys.executable, __file__, *map(str, plans)], check=True, env=quiet, timeout=300)
    for one, plan in zip(recordings, plans, strict=True):
        plan.unlink()
        for name, stack in one.streams.items():
            with (one.folder / f"{name}.mcap").open("rb") as stream:
                assert make_reader(stream).get_summary().statistics.message_count == len(stack), "frames were lost"


def rewritten(
    content: bytes, change: Callable | None = None, schema: Callable | None = None, channels: int = 1, **options
) -> bytes:
    """The messages of a recording, written by ``mcap``'s own writer, to which the options go.

    ``change`` takes the messages' bytes, a list, and returns others; ``schema`` name and bytes of the schema.
    """
    read = list(make_reader(BytesIO(content)).iter_messages(log_time_order=False))
    name, description = read[0][0].name, read[0][0].data
    if schema is not None:
        name, description = schema(name, description)
    messages = [message.data for *_, message in read]
    out = BytesIO()
    writer = Writer(out, **options)
    writer.start("protobuf", "test")
    known = writer.register_schema(name, "protobuf", description)
    numbers = [writer.register_channel(f"img_frame{n}", "protobuf", known) for n in range(channels)]
    for place, data in enumerate(messages if change is None else change(messages)):
        writer.add_message(numbers[place % channels], place, data, place)
    writer.finish()
    return out.getvalue()


def _frame(image: np.ndarray, matrix: np.ndarray | None, padding: int, cropped: bool, grey: bool):
    import depthai as dai

    height, width = image.shape
    kinds = dai.ImgFrame.Type
    rows = np.ascontiguousarray(image).view(np.uint8).reshape(height, -1)
    rows = np.pad(rows, ((0, 0), (0, padding)), constant_values=170)
    frame = dai.ImgFrame()
    frame.setType(kinds.RAW16 if image.dtype == np.uint16 else kinds.GRAY8 if grey else kinds.RAW8)
    frame.setWidth(width)
    frame.setHeight(height)
    frame.setStride(rows.shape[1])
    frame.setData(rows.ravel())
    if matrix is not None:
        place = dai.ImgTransformation(width, height, matrix.tolist())
        if cropped:
            place = dai.ImgTransformation(2 * width + 32, 2 * height + 40, matrix.tolist())
            place.addCrop(8, 12, 2 * width, 2 * height)
            place.addScale(0.5, 0.5)
        frame.setTransformation(place)
    return frame


def _record(folder: Path, name: str, stack: np.ndarray, matrix: np.ndarray | None, first: int, *how: int) -> None:
    import depthai as dai

    images, matrices = [], []
    with dai.Pipeline(False) as pipeline:
        recorder = pipeline.create(dai.node.RecordMetadataOnly)
        recorder.setRecordFile(folder / f"{name}.mcap")
        pipeline.start()
        for number, image in enumerate(stack):
            frame = _frame(image, matrix, *how)
            frame.setSequenceNum(first + number)
            frame.cam.exposureTimeUs = EXPOSURE_US + number
            frame.cam.sensitivityIso = ISO
            images.append(frame.getFrame())
            matrices.append(frame.getTransformation().getIntrinsicMatrix())
            recorder.input.send(frame)  # waits while the queue is full
        while recorder.input.getSize() > 0:  # what is queued when it stops is lost; what was taken is written
            time.sleep(0.001)
        pipeline.stop()
        pipeline.wait()
    np.savez(folder / f"{name}.npz", images=images, matrices=matrices)


if __name__ == "__main__":
    for place in map(Path, sys.argv[1:]):
        with np.load(place) as table:
            for key in (key for key in table.files if key.startswith("stream:")):
                known = table["matrix"] if "matrix" in table.files else None
                _record(place.parent, key.removeprefix("stream:"), table[key], known, *map(int, table["options"]))
