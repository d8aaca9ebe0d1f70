"""Find plane and outline of a coupon, from the capture's pose, or from a plane through its decoded cloud.

Signal chain with a known pose: the coupon's own frame.

Signal chain without a pose: cloud -> plane through most of its points, by RANSAC, then by least squares -> frame with z
along the normal, toward the sensor -> cells of a grid in the plane that contain points -> holes filled -> largest
connected region. RANSAC: Fischler & Bolles, Commun. ACM 24, 1981.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from characterisation.files.errors import InputError
from characterisation.point_cloud import PointCloud
from mitsim.sensor.transforms import Transform
from mitsim.twin.finish.bend import Bend

#: number of cells along the longer side of the recovered points
_CELLS = 120
#: largest distance of a point from the plane, as a share of its distance from the sensor; a sheet may be bent
_FLAT = 0.01
_TRIALS = 200
_ROUNDS = 3
#: least number of points in a cell, as a share of the 95th percentile of all cells; false matches are sparser
_DENSE = 0.3
#: least number of points of a plane
_FEWEST = 500


@dataclass(frozen=True)
class Place:
    """A flat coupon in the plane z = 0 of its own frame, with the normal +z toward the sensor.

    - ``world_from_sensor``: transform from the sensor frame to the frame of the coupon [mm].
    - ``occupied`` (R, C): cells of the plane that belong to the coupon.
    - ``low`` (x, y) [mm]: corner of the first cell; ``cell`` (x, y) [mm]: size of a cell.
    - ``off_plane`` [mm]: scatter of the cloud's points about the plane, NaN if the pose was known.
    - ``bend``: heights of the coupon over the plane, None for a flat one.
    """

    world_from_sensor: Transform
    low: NDArray[np.float64]
    cell: NDArray[np.float64]
    occupied: NDArray[np.bool_]
    off_plane: float = float("nan")
    bend: Bend | None = None

    @property
    def size(self) -> tuple[float, float]:
        """Width and height [mm] of a rectangle, centred at the origin, that contains the coupon."""
        high = self.low + self.cell * self.occupied.shape[::-1]
        width, height = 2 * np.maximum(np.abs(self.low), np.abs(high))
        return float(width), float(height)

    def corners(self) -> NDArray[np.float64]:
        """Return the corners (4, 3) [mm] of the rectangle of all cells, in the sensor frame."""
        high = self.low + self.cell * self.occupied.shape[::-1]
        xs, ys = np.meshgrid([self.low[0], high[0]], [self.low[1], high[1]])
        return self.world_from_sensor.inverse().points(np.stack([xs, ys, np.zeros_like(xs)], axis=-1).reshape(-1, 3))

    def contains(self, points: NDArray[np.floating], margin: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Return which points (N, 2) [mm] of the plane lie on the coupon, ``margin`` (N,) [mm] or more inside its edge.

        The margin is tested at four positions, in both directions of x and y.
        """
        occupied = np.pad(self.occupied, 1)  # all other points lie in its rim
        columns, rows = occupied.shape[1], occupied.shape[0]

        def cells(axis: int, count: int, shift: NDArray[np.floating] | float) -> NDArray[np.intp]:
            place = np.floor((points[:, axis] + shift - self.low[axis]) / self.cell[axis])
            return np.asarray(np.fmax(np.fmin(place, count - 2), -1), np.intp) + 1  # NaN lies outside

        column, row = cells(0, columns, 0.0), cells(1, rows, 0.0) * columns
        inside = np.ones(len(points), bool)
        for shift in (margin, -margin):
            inside &= occupied.take(row + cells(0, columns, shift))
            inside &= occupied.take(cells(1, rows, shift) * columns + column)
        return inside


def known_place(world_from_sensor: Transform, width: float, height: float) -> Place:
    """Return a centred coupon of this size [mm] in the plane z = 0, for a capture with a pose."""
    size = np.array([width, height])
    return Place(world_from_sensor, -size / 2, size, np.ones((1, 1), bool))


def found_place(cloud: PointCloud, where: str) -> Place:
    """Find the plane through most points of a cloud, and the outline of the points in it.

    ``off_plane`` of the result is their rms distance from the plane. Messages name ``where``.

    Raises
    ------
    InputError
        If too few points lie in one plane.
    """
    points = cloud.points[cloud.valid].astype(float)
    flat = plane_points(points)
    if flat.sum() < _FEWEST:
        raise _no_plane(where, int(flat.sum()))
    points = points[flat]
    for _ in range(_ROUNDS):  # outliers tilt the plane until the grid of cells has excluded them
        pose = _frame(points)
        local = pose.points(points)
        low, high = local[:, :2].min(axis=0), local[:, :2].max(axis=0)
        cell = np.full(2, (high - low).max() / _CELLS)
        column, row = np.floor((local[:, :2] - low) / cell).astype(int).T
        occupied = _largest_piece(row, column)
        if not occupied.any():
            raise _no_plane(where, 0)
        points = points[occupied[row, column]]
    off = pose.points(points)[:, 2]
    return Place(pose, low, cell, occupied, float(np.sqrt(np.mean(off**2))))


def plane_points(points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which points (N, 3) [mm] lie near the plane through most of them, by RANSAC (see the module).

    The points are in the frame of the sensor: the limit grows with their distance from the origin.
    """
    best = np.zeros(len(points), bool)
    if len(points) < _FEWEST:
        return best
    rng = np.random.default_rng(0)
    near = _FLAT * np.linalg.norm(points, axis=1)
    some = rng.integers(0, len(points), min(len(points), 4000))
    votes = -1
    for _ in range(_TRIALS):
        a, b, c = points[rng.integers(0, len(points), 3)]
        normal = np.cross(b - a, c - a)
        length = float(np.linalg.norm(normal))
        if length < 1e-9:
            continue
        count = int((np.abs((points[some] - a) @ (normal / length)) < near[some]).sum())
        if count > votes:
            votes, best = count, np.abs((points - a) @ (normal / length)) < near
    return best


def _frame(points: NDArray[np.float64]) -> Transform:
    """Return the transform from the sensor frame to that of a coupon, from its points (N, 3) [mm].

    Its origin is the mean of the points. z is along the normal, toward the sensor; x points to the right.
    """
    centre = points.mean(axis=0)
    axes = np.linalg.svd(points - centre, full_matrices=False)[2]
    normal = -axes[2] * np.sign(axes[2] @ centre)
    across = axes[0] if abs(axes[0, 0]) > abs(axes[1, 0]) else axes[1]
    across = across * np.sign(across[0])
    return Transform(np.stack([across, np.cross(normal, across), normal], axis=1), centre).inverse()


def _largest_piece(row: NDArray[np.int64], column: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return the largest connected region of the cells (R, C) that are dense with points, with its holes filled."""
    count = np.zeros((row.max() + 1, column.max() + 1))
    np.add.at(count, (row, column), 1)
    dense = np.pad(count > _DENSE * np.percentile(count[count > 0], 95), 3)
    dense = ndimage.binary_fill_holes(ndimage.binary_closing(dense, iterations=2))
    pieces, found = ndimage.label(ndimage.binary_opening(dense, iterations=2)[3:-3, 3:-3])
    return np.asarray(pieces == int(np.argmax(np.bincount(pieces.ravel())[1:])) + 1 if found else np.zeros_like(dense))


def _no_plane(where: str, count: int) -> InputError:
    return InputError(
        where,
        "pose",
        f"null, and {count} points of its cloud in a plane",
        f"a world_from_sensor, or {_FEWEST} points side by side in a plane",
        "decode the capture to see which points are missing: mitsim decode",
    )
