"""Refuse a real calibration of poses that are too much alike: recordings ``procam_points``.

python tests/benchmarks/procam_halves.py FOLDER_OF_RECORDINGS

Twelve poses of 147 circles in 21 staggered columns, in a camera and a projector. Their unknown pitch is taken as 10 mm:
it scales lengths, not angles. Prints the difference of every parameter between the halves of the poses, in standard
uncertainties, and the decision.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from characterisation.files.errors import InputError
from mitsim.sensor.rig_parameters import parameter_differences
from mitsim.study.calibration.board import Board
from mitsim.study.calibration.halves import calibrate_checked, in_words
from mitsim.study.calibration.recorded import RecordedBoard, RecordedCorners, calibrate_recorded

POSES, ROWS, COLUMNS, PITCH_MM = 12, 7, 21, 10.0
SIZES = {"camera": (1920, 1200), "projector": (1280, 800)}


class Circles(Board):
    """Staggered columns of circles."""

    @property
    def corners(self) -> NDArray[np.float64]:  # type: ignore[override]
        """The centres (n, 3) [mm], in the order of the recording."""
        column, row = np.divmod(np.arange(ROWS * COLUMNS), ROWS)
        down = -PITCH_MM * (row + 0.5 * (column % 2))
        places = np.stack([PITCH_MM / 2 * column, down, np.zeros(len(row))], axis=-1)
        return np.asarray(places - places.mean(axis=0))


def main(data: Path) -> None:
    """Print the table and the decision."""
    folder = data / "procam_points" / "CalibrationDataDistortion"
    names = {"camera": "cameraCirclePointsRight.txt", "projector": "projectorCirclePoints.txt"}
    pixels = {eye: np.loadtxt(folder / name).reshape(POSES, -1, 2) for eye, name in names.items()}
    board = Circles(COLUMNS, 2 * ROWS, PITCH_MM / 2, "glass")
    every = np.arange(ROWS * COLUMNS)
    boards = [RecordedBoard(every, {eye: one[pose] for eye, one in pixels.items()}) for pose in range(POSES)]
    halves = [calibrate_recorded(RecordedCorners(board, boards[first::2], SIZES), "procam_points") for first in (0, 1)]
    parameters = halves[0].covariance.names
    apart = parameter_differences(halves[0].rig, halves[1].rig, parameters)
    sigma = np.hypot(*[half.covariance.one_sigma for half in halves])
    print("| parameter | difference of halves | over its standard uncertainty |\n|---|---|---|")
    for name, difference, one in zip(parameters, apart, sigma, strict=True):
        print(f"| {name} | {difference:.4g} | {difference / one:.1f} |")
    try:
        print(in_words(calibrate_checked(RecordedCorners(board, boards, SIZES), "procam_points", "procam_points")))
    except InputError as error:
        print(error)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
