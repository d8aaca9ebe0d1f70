"""Where a coupon lies before a sensor: by the capture's pose, or by a plane through its decoded cloud.

Signal chain, pose known: the coupon's own frame. Signal chain, pose unknown: cloud -> plane through most of its points
(RANSAC, Fischler & Bolles, Commun. ACM 24, 1981; then least squares) -> frame with z along the normal, toward the
sensor -> a raster of cells in the plane that hold points, holes filled, the largest piece.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from characterisation.point_cloud import PointCloud
from mitsim.errors import InputError
from mitsim.fit.bend import Bend
from mitsim.sensor.transforms import Transform

#: cells of a raster along the longer side of what was seen
_CELLS = 120
#: a point is of the plane if it is this share of its distance from it: a sheet may be bent
_FLAT = 0.01
_TRIALS = 200
_ROUNDS = 3
#: a cell of the sheet holds this share of the points of the fullest: stray points of a matcher lie thinner
_DENSE = 0.3
#: fewer points of a plane are none
_FEWEST = 500


@dataclass(frozen=True)
class Place:
    """A flat coupon in the plane z = 0 of its frame, its normal +z toward the sensor.

    ``world_from_sensor`` takes the sensor frame to that of the coupon. ``occupied`` (R, C) says which cells of the
    plane belong to it, the first at ``low`` (x, y) [mm], each ``cell`` (x, y) [mm] large. ``off_plane`` [mm] rms of
    the cloud, NaN where the pose was known. ``bend`` of the sheet over that plane, None for flat.
    """

    world_from_sensor: Transform
    low: NDArray[np.float64]
    cell: NDArray[np.float64]
    occupied: NDArray[np.bool_]
    off_plane: float = float("nan")
    bend: Bend | None = None

    @property
    def size(self) -> tuple[float, float]:
        """Width and height of a rectangle about the origin that holds it [mm]."""
        high = self.low + self.cell * self.occupied.shape[::-1]
        width, height = 2 * np.maximum(np.abs(self.low), np.abs(high))
        return float(width), float(height)

    def corners(self) -> NDArray[np.float64]:
        """Corners of all cells together, (4, 3) [mm], in the sensor frame."""
        high = self.low + self.cell * self.occupied.shape[::-1]
        xs, ys = np.meshgrid([self.low[0], high[0]], [self.low[1], high[1]])
        return self.world_from_sensor.inverse().points(np.stack([xs, ys, np.zeros_like(xs)], axis=-1).reshape(-1, 3))

    def holds(self, points: NDArray[np.floating], margin: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Which points (N, 2) [mm] of the plane belong to the coupon, and all those ``margin`` (N,) beside them."""
        inside = np.ones(len(points), bool)
        for along, across in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            beside = points + margin[:, None] * np.array([along, across])
            column, row = np.floor((beside - self.low) / self.cell).astype(int).T
            rows, columns = self.occupied.shape
            known = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
            inside &= known
            inside[known] &= self.occupied[row[known], column[known]]
        return inside


def known_place(world_from_sensor: Transform, width: float, height: float) -> Place:
    """A coupon of that size [mm] in the plane z = 0, centred, whose pose the capture says."""
    size = np.array([width, height])
    return Place(world_from_sensor, -size / 2, size, np.ones((1, 1), bool))


def found_place(cloud: PointCloud, where: str) -> Place:
    """The plane through most points of a cloud.

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
    for _ in range(_ROUNDS):  # stray points pull at the plane until the raster has thrown them out
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
    """Return which of the points (N, 3) [mm], seen from the origin, lie near the plane that most of them share."""
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
    """Coupon from sensor: origin in the middle of points (N, 3), z along the normal toward the sensor, x rightward."""
    centre = points.mean(axis=0)
    axes = np.linalg.svd(points - centre, full_matrices=False)[2]
    normal = -axes[2] * np.sign(axes[2] @ centre)
    across = axes[0] if abs(axes[0, 0]) > abs(axes[1, 0]) else axes[1]
    across = across * np.sign(across[0])
    return Transform(np.stack([across, np.cross(normal, across), normal], axis=1), centre).inverse()


def _largest_piece(row: NDArray[np.int64], column: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Cells of a raster (R, C) that are dense with points, holes filled, crumbs and all pieces but the largest gone."""
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
        "decode it alone to see what is missing: mitsim decode",
    )
