"""Choose the frame in which ``mitsim measure`` states positions and directions: ``--points-in``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from characterisation.features.robust_fit import FitError
from characterisation.files.errors import InputError
from mitsim.decoding.input_clouds import InputCloud

_ALLOWED = "sensor, workspace, board=COLUMNS,ROWS,PITCH of a chequerboard's inner corners [mm], or a pose file"


@dataclass(frozen=True)
class MeasuringFrame:
    """The frame of the sensor, of a workspace, of a ``board``, or of a pose ``file``; see :func:`read_frame`."""

    text: str
    board: tuple[int, int, float] | None = None
    file: Path | None = None

    def of(self, input_cloud: InputCloud, view: int | None = None) -> tuple[NDArray[np.float64], str]:
        """Return the transform (4, 4) [mm] from the sensor frame of a cloud, and a sentence about it, or none.

        Raises InputError if the cloud has no workspace, its images do not show the board, or the pose file cannot be
        read.
        """
        if self.board is not None:
            return self._of_board(input_cloud, *self.board)
        if self.file is not None:
            from mitsim.study.task_measurement import read_pose

            return read_pose(self.file, view).matrix(), f"places in the frame of {self.file}"
        if self.text == "sensor":
            return np.eye(4), ""
        from mitsim.capture.workspace import written_frame

        if input_cloud.capture is None:
            found, hint = "a cloud, whose workspace is not known", "give the capture folder instead of its cloud"
            raise InputError(input_cloud.path, "--points-in", found, "a capture", hint)
        frame = written_frame(input_cloud.capture, self.text, input_cloud.path)
        assert frame is not None  # the text is workspace
        return frame.from_sensor, f"places in the frame {frame.name}"

    def _of_board(
        self, input_cloud: InputCloud, columns: int, rows: int, pitch: float
    ) -> tuple[NDArray[np.float64], str]:
        from mitsim.decoding.board_frame import BoardCorners, board_frame
        from mitsim.decoding.plate import image_on_grid

        if input_cloud.capture is None or not input_cloud.capture.images:
            allowed, hint = "images that show the board", "give the capture folder, which the command decodes"
            raise InputError(input_cloud.path, "--points-in", "a cloud without images", allowed, hint)
        image = image_on_grid(input_cloud.capture, input_cloud.cloud.grid)
        try:
            frame, scale, rms = board_frame(BoardCorners(columns, rows, pitch), input_cloud.cloud, image)
        except FitError as error:
            allowed = "a capture that shows the whole board"
            raise InputError(input_cloud.path, "--points-in", str(error), allowed) from None
        return frame, f"places in the frame of the board: scale {scale:.5f}, corners {rms:.3g} mm from the print (rms)"


def read_frame(text: str) -> MeasuringFrame:
    """Read the text of ``--points-in``."""
    if text in ("sensor", "workspace"):
        return MeasuringFrame(text)
    if text.startswith("board="):
        try:
            first, second, last = text.removeprefix("board=").split(",")
            columns, rows, pitch = int(first), int(second), float(last)
        except ValueError:
            columns, rows, pitch = 0, 0, 0.0
        if not (3 <= columns <= 100 and 3 <= rows <= 100 and 0 < pitch < 1e4):
            allowed = "board=COLUMNS,ROWS,PITCH: 3 to 100 inner corners, and their pitch over 0 mm"
            raise InputError("--points-in", "", repr(text), allowed)
        return MeasuringFrame(text, (columns, rows, pitch))
    if Path(text).is_file():
        return MeasuringFrame(text, file=Path(text))
    raise InputError("--points-in", "", repr(text), _ALLOWED)
