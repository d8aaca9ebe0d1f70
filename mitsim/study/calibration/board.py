"""Describe the calibration board: its size, its quality, and the poses at which a sensor sees it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from characterisation.files.arrays import Floats
from characterisation.files.errors import InputError, nearest
from mitsim.sensor.camera import Camera
from mitsim.sensor.transforms import Transform


@dataclass(frozen=True)
class BoardGrade:
    """Manufacturing quality of a kind of board; one standard deviation each.

    - ``scale``: relative error of all lengths.
    - ``flatness``: amplitude of each bending mode (cylinder about either side, saddle), relative to the longer side.
    - ``print_mm``: position error of a single corner, along each axis.
    - ``largest_mm``: longest side available.
    """

    scale: float
    flatness: float
    print_mm: float
    largest_mm: float


#: Scale errors are *assumed*: 20 um over 300 mm printed on glass, 50 um on aluminium composite. Positions of single
#: corners: a supplier's "1 micron (glass) to 5 microns (aluminium composite)" (calibvision.com, 2025), doubled here.
#: Flatness is *assumed*: for composite a third of "one-thousandth of the smallest dimension" as a limit (imatest.com,
#: supported targets). Available lengths are *assumed*. ``paper`` is a sheet from an office printer, glued to a flat
#: base; all of its figures are *assumed*.
GRADES: Mapping[str, BoardGrade] = {
    "glass": BoardGrade(scale=20e-3 / 300, flatness=5e-5, print_mm=0.002, largest_mm=400.0),
    "composite": BoardGrade(scale=50e-3 / 300, flatness=3e-4, print_mm=0.010, largest_mm=800.0),
    "paper": BoardGrade(scale=3e-3, flatness=1e-3, print_mm=0.02, largest_mm=280.0),
}

#: longer side of the default board, relative to the reference camera's field width at the middle of the range
_FIELD_SHARE = 0.5
#: available sides of a square, times a power of ten [mm]
_SQUARES = (1.0, 1.2, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0)

#: tilts of the board relative to the view ray of its centre, in the order of the poses [deg]
TILTS_DEG = (0.0, 15.0, 25.0, 35.0)
#: least share of the corners that all eyes must see
_LEAST_SEEN = 0.5
#: corners closer to the edge of an image than this are not detected [px]
_EDGE_PX = 8.0


@dataclass(frozen=True)
class Board:
    """A chequerboard of ``columns`` x ``rows`` squares of ``square_mm``, with the name of its grade."""

    columns: int
    rows: int
    square_mm: float
    grade: str

    @property
    def made(self) -> BoardGrade:
        """Return its manufacturing quality."""
        return GRADES[self.grade]

    @cached_property
    def corners(self) -> Floats:
        """The inner corners in the board's frame, with its centre as origin, (n, 3) [mm]."""
        x, y = np.meshgrid(np.arange(1, self.columns), np.arange(1, self.rows))
        positions = np.stack([x - self.columns / 2, y - self.rows / 2, np.zeros_like(x, float)], axis=-1)
        return np.asarray(positions.reshape(-1, 3) * self.square_mm)

    @property
    def bends(self) -> Floats:
        """Return the heights of the corners for each bending mode, amplitude 1, (3, n): about y, about x, saddle."""
        x, y = (self.corners[:, :2] / (np.array([self.columns, self.rows]) * self.square_mm / 2)).T
        return np.stack([2 * x**2 - 1, 2 * y**2 - 1, 2 * x * y])

    def imperfections(self) -> tuple[Floats, Floats]:
        """Return the corners' position errors common to all poses: modes (m, n, 3) and their one sigma (m,).

        The modes are scale [1], three bends [mm], then each corner along x and y [mm]; errors are mode times value.
        """
        corners, count = self.corners, len(self.corners)
        bent = np.zeros((3, count, 3))
        bent[..., 2] = self.bends
        printed = np.zeros((2 * count, count, 3))
        printed[np.arange(2 * count), np.repeat(np.arange(count), 2), np.tile([0, 1], count)] = 1
        longer = max(self.columns, self.rows) * self.square_mm
        sigma = [self.made.scale, *[self.made.flatness * longer] * 3, *[self.made.print_mm] * (2 * count)]
        return np.concatenate([corners[None], bent, printed]), np.array(sigma)

    def __str__(self) -> str:
        return f"{self.columns} x {self.rows} squares of {self.square_mm:g} mm, {self.grade}"


def default_board(reference: Camera, middle_mm: float) -> Board:
    """Return a board of 11 x 8 squares over half of the width that a camera sees at a distance, in glass if available.

    Larger boards are of composite, up to 800 mm.
    """
    wanted = _FIELD_SHARE * middle_mm * reference.width / reference.matrix[0, 0]
    grade = next((name for name, made in GRADES.items() if wanted <= made.largest_mm), "composite")
    square = min(wanted, GRADES[grade].largest_mm) / 11
    offered = np.array(_SQUARES) * 10.0 ** np.floor(np.log10(square))
    return Board(11, 8, float(offered[offered <= square].max()), grade)


def parse_board(text: str) -> Board:
    """Parse a board given as ``COLUMNSxROWSxSQUARE_MM:GRADE``, for example ``11x8x30:glass``.

    Raises
    ------
    InputError
        If the text has another form, or the board cannot be used for calibration.
    """
    allowed = f"COLUMNSxROWSxSQUARE_MM:GRADE, such as 11x8x30:glass; grades are {', '.join(GRADES)}"
    size, _, grade = text.partition(":")
    try:
        columns, rows, square = (float(part) for part in size.split("x"))
    except ValueError:
        raise InputError("--board", "", repr(text), allowed) from None
    if grade not in GRADES:
        raise InputError("--board", "grade", repr(grade), ", ".join(GRADES), nearest(grade, list(GRADES)))
    if not (columns % 1 == 0 and rows % 1 == 0 and 4 <= columns <= 30 and 4 <= rows <= 30 and 0.5 <= square <= 500):
        hint = "squares are one more than inner corners, along either side"
        raise InputError("--board", "", repr(text), "4 to 30 squares a side, of 0.5 to 500 mm", hint)
    return Board(int(columns), int(rows), square, grade)


def board_poses(
    board: Board, eyes: Mapping[str, Camera], working_range_mm: tuple[float, float], count: int
) -> list[tuple[Transform, NDArray[np.intp]]]:
    """Return poses ``sensor_from_board`` over range and field, each with the corners that all eyes see.

    - Distances cover the range in equal steps of their inverse, in a different order from positions and tilts.
    - Positions follow a low-discrepancy sequence over the reference camera's image. They shift toward the centre of the
      common view until half of the corners are visible.
    - Tilts go up to 35 deg about axes in all directions.
    - The board is rotated in its plane by quarter turns.

    The poses are deterministic: the same board and eyes give the same poses.

    Parameters
    ----------
    board
        Calibration board.
    eyes
        Cameras and projector by name, the reference camera first.
    working_range_mm
        Least and greatest distance of the board [mm].
    count
        Number of poses to try. A pose that shows all eyes less than half of the board is left out.

    Raises
    ------
    InputError
        If fewer than 6 poses show all eyes half of the board.

    See Also
    --------
    seen_by_all : whether points lie in the images of all eyes
    """
    near, far = working_range_mm
    reference = next(iter(eyes.values()))
    out = []
    stride = next(step for step in range(7, 7 + count) if math.gcd(step, count) == 1)
    for index in range(count):
        # R2 sequence (Roberts 2018) for the position, a coprime stride for the distance
        position = (0.5 + index * np.array([0.7548776662466927, 0.5698402909980532])) % 1
        share = (index * stride % count + 0.5) / count
        distance = 1 / (share / near + (1 - share) / far)
        tilt, azimuth = np.radians(TILTS_DEG[index % len(TILTS_DEG)]), index * 2.399963
        pixel = (0.1 + 0.8 * position) * [reference.width - 1, reference.height - 1]
        ray = reference.sensor_from_camera.directions(reference.rays(pixel))
        turn = Rotation.from_euler("z", 90.0 * (index // 2), degrees=True)
        facing = Rotation.align_vectors([ray], [[0.0, 0.0, 1.0]])[0]
        tilted = Rotation.from_rotvec(tilt * np.array([np.cos(azimuth), np.sin(azimuth), 0.0]))
        rotation = (facing * tilted * turn).as_matrix()
        outward, inward = reference.centre + distance * ray, _middle(eyes, distance)
        for step in np.linspace(0, 1, 11):
            pose = Transform(rotation, outward + step * (inward - outward))
            seen = seen_by_all(pose.points(board.corners), eyes)
            if seen.mean() >= _LEAST_SEEN:
                out.append((pose, np.flatnonzero(seen)))
                break
    if len(out) < 6:
        poses = f"{len(out)} of {count} poses at which all eyes see half of the board"
        raise InputError("--board", str(board), poses, "6 poses or more", "use a smaller board or more poses")
    return out


def seen_by_all(points: Floats, eyes: Mapping[str, Camera]) -> NDArray[np.bool_]:
    """Return whether points (n, 3) in the sensor frame lie in the images of all eyes, (n,)."""
    seen = np.ones(len(points), bool)
    for eye in eyes.values():
        pixels = eye.project(points)
        with np.errstate(invalid="ignore"):
            inside = (pixels >= _EDGE_PX) & (pixels <= np.array([eye.width, eye.height]) - 1 - _EDGE_PX)
        seen &= inside.all(axis=1) & _unfolded(eye, points)
    return seen


def _unfolded(eye: Camera, points: Floats) -> NDArray[np.bool_]:
    """Return whether points lie in the field of the image's corners; beyond, the distortion polynomial may fold."""
    local = eye.sensor_from_camera.inverse().points(points)
    corner = eye.rays_to_fold(np.array([[0.0, 0.0], [eye.width - 1.0, eye.height - 1.0]]))
    widest = np.max(np.linalg.norm(corner[:, :2], axis=1) / corner[:, 2])
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = np.linalg.norm(local[:, :2], axis=1) / local[:, 2]
    return np.asarray((local[:, 2] > 0) & (slope <= 1.05 * widest))


def _middle(eyes: Mapping[str, Camera], distance: float) -> Floats:
    """Return the mean of the points at a distance on the central rays of all eyes, (3,)."""
    points = []
    for eye in eyes.values():
        ray = eye.rays(np.array([(eye.width - 1) / 2, (eye.height - 1) / 2]))
        points.append(eye.centre + distance * eye.sensor_from_camera.directions(ray))
    return np.asarray(np.mean(points, axis=0))
