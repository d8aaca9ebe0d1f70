"""Recordings of DepthAI made here, by its own ``RecordMessage``, of frames that are known; no device is needed.

Run as a program, ``python depthai_recordings.py PLAN.npz``, in a process apart: the plan holds the frames and the names
of the files, and the package's threads end with the process.
"""

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np


def record(folder: Path, streams: dict[str, np.ndarray], matrix: np.ndarray | None = None, first: int = 0) -> Path:
    """Record stacks (n, H, W), uint8 or uint16, as NAME.mcap; frames are numbered from ``first`` on."""
    folder.mkdir(parents=True, exist_ok=True)
    plan = folder / "plan.npz"
    extra = {} if matrix is None else {"matrix": matrix}
    np.savez(plan, __first=first, **{f"stream:{name}": stack for name, stack in streams.items()}, **extra)
    quiet = os.environ | {"DEPTHAI_LEVEL": "off"}
    subprocess.run([sys.executable, __file__, str(plan)], check=True, env=quiet, timeout=100)
    plan.unlink()
    return folder


def _record(folder: Path, name: str, stack: np.ndarray, matrix: np.ndarray | None, first: int) -> None:
    import depthai as dai

    kind = dai.ImgFrame.Type.RAW16 if stack.dtype == np.uint16 else dai.ImgFrame.Type.RAW8

    class Frames(dai.node.ThreadedHostNode):
        def __init__(self):
            super().__init__()
            self.out = self.createOutput()

        def run(self):
            for number, image in enumerate(stack):
                frame = dai.ImgFrame()
                frame.setType(kind)
                frame.setWidth(image.shape[1])
                frame.setHeight(image.shape[0])
                frame.setData(np.frombuffer(image.tobytes(), np.uint8))
                frame.setSequenceNum(first + number)
                if matrix is not None:
                    frame.setTransformation(dai.ImgTransformation(image.shape[1], image.shape[0], matrix.tolist()))
                self.out.send(frame)

    with dai.Pipeline(False) as pipeline:
        frames, recorder = pipeline.create(Frames), pipeline.create(dai.node.RecordMetadataOnly)
        recorder.setRecordFile(folder / f"{name}.mcap")
        frames.out.link(recorder.input)
        pipeline.start()
        time.sleep(0.5)  # what is queued when it stops is lost
        pipeline.stop()


if __name__ == "__main__":
    place = Path(sys.argv[1])
    with np.load(place) as table:
        for key in (key for key in table.files if key.startswith("stream:")):
            known = table["matrix"] if "matrix" in table.files else None
            _record(place.parent, key.removeprefix("stream:"), table[key], known, int(table["__first"]))
