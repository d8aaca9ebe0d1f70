"""Find plane, outline and bend of a coupon, from the capture's pose, or from its decoded cloud.

Signal chain without a pose: cloud -> plane through most of its points, by RANSAC, then by least squares -> frame with z
along the normal, toward the sensor -> cells of a grid in the plane that contain points -> holes filled -> largest
connected region. RANSAC: Fischler & Bolles, Commun. ACM 24, 1981.

Signal chain of the pose over a coupon: cloud and the window of its pixels that shows the coupon -> plane through most
of the points there -> a frame in that plane: origin where the middle of the window meets it, x along the window's rows,
z along the normal, toward the sensor. The offset of the points from the true surface is not seen.

The bend of a sheet is a low-order surface over its plane: median heights of square cells -> Legendre polynomials of
total degree d by least squares, for several d -> the degree with the smallest leave-one-out error. The leave-one-out
residuals are r_i / (1 - h_ii), with h_ii the leverages (Allen, Technometrics 16 (1974) 125). Allen's PRESS is the sum
of their squares; the median of the squares is used here, so that a few wrong cells do not choose the degree. A higher
degree is chosen only if it predicts cells that were not used in its fit, so a flat plate stays flat within its noise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial.legendre import legvander2d
from numpy.typing import NDArray
from scipy import ndimage

from characterisation.files.arrays import Floats
from characterisation.files.errors import InputError
from characterisation.point_cloud import PointCloud, Status
from characterisation.region_of_interest import Roi
from mitsim.sensor.transforms import Transform

#: what to do about a specimen that is too small
LARGER = "use a larger --window, or a nearer view"

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
#: total degrees of the bends that are tried
DEGREES = (1, 2, 3, 4, 5, 6)
#: number of cells along the longer side for the fit of a bend; chosen
_BEND_CELLS = 28
#: least number of points in such a cell, for their median height; chosen
_BEND_POINTS = 20

#: least number of cells for each coefficient of a degree
_CELLS_PER_TERM = 5

#: least cosine of the incidence: a plane seen at 85 deg, beyond the limit of a campaign's orientations
_LEAST_COSINE = 0.087


@dataclass(frozen=True)
class Bend:
    """Heights over the plane z = 0 of a specimen."""

    #: ``middle``, ``half`` (2,) [mm]: centre and half the size of the extent in x and y
    middle: Floats
    half: Floats
    degree: int
    coefficients: Floats  # (k,) [mm] of the Legendre polynomials up to the total degree ``degree``
    rms: float  # [mm] of the heights at the fitted cells

    def heights(self, xy: Floats) -> Floats:
        """Return heights (...) [mm] at points (..., 2) [mm] of the plane; outside the extent, those of its edge."""
        return np.asarray(_terms((xy - self.middle) / self.half, self.degree) @ self.coefficients)


@dataclass(frozen=True)
class Specimen:
    """A flat coupon in the plane z = 0 of its own frame, with the normal +z toward the sensor."""

    world_from_sensor: Transform  # transform from the sensor frame to the frame of the coupon [mm]
    low: Floats  # (x, y) [mm]: corner of the first cell
    cell: Floats  # (x, y) [mm]: size of a cell
    occupied: NDArray[np.bool_]  # (R, C) cells of the plane that belong to the coupon
    off_plane: float = float("nan")  # [mm]: scatter of the cloud's points about the plane, NaN if the pose was known
    bend: Bend | None = None  # heights of the coupon over the plane, None for a flat one

    @property
    def distance(self) -> float:
        """Distance of the sensor from the origin [mm]."""
        return float(np.linalg.norm(self.world_from_sensor.translation))

    @property
    def extent(self) -> Floats:
        """Size (2,) [mm] of the rectangle of all cells, along x and y."""
        return np.asarray(self.cell * self.occupied.shape[::-1])

    @property
    def size(self) -> tuple[float, float]:
        """Width and height [mm] of a rectangle, centred at the origin, that contains the coupon."""
        width, height = 2 * np.maximum(np.abs(self.low), np.abs(self.low + self.extent))
        return float(width), float(height)

    def corners(self) -> Floats:
        """Return the corners (4, 3) [mm] of the rectangle of all cells, in the sensor frame."""
        return self.in_sensor(*np.stack([self.low, self.low + self.extent], axis=1)).reshape(-1, 3)

    def in_sensor(self, x: Floats, y: Floats) -> Floats:
        """Return the raster (rows, columns, 3) [mm] of coordinates of the plane, in the sensor frame."""
        xs, ys = np.meshgrid(x, y)
        return self.world_from_sensor.inverse().points(np.stack([xs, ys, np.zeros_like(xs)], axis=-1))

    def contains(self, points: NDArray[np.floating], margin: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Return which points (N, 2) [mm] lie ``margin`` (N,) [mm] inside the coupon, tested along x and y."""
        occupied = np.pad(self.occupied, 1)  # all other points lie in its rim
        columns, rows = occupied.shape[1], occupied.shape[0]

        def cells(axis: int, count: int, shift: NDArray[np.floating] | float) -> NDArray[np.intp]:
            index = np.floor((points[:, axis] + shift - self.low[axis]) / self.cell[axis])
            return np.asarray(np.fmax(np.fmin(index, count - 2), -1), np.intp) + 1  # NaN lies outside

        column, row = cells(0, columns, 0.0), cells(1, rows, 0.0) * columns
        inside = np.ones(len(points), bool)
        for shift in (margin, -margin):
            inside &= occupied.take(row + cells(0, columns, shift))
            inside &= occupied.take(cells(1, rows, shift) * columns + column)
        return inside


def known_specimen(world_from_sensor: Transform, width: float, height: float) -> Specimen:
    """Return a centred coupon of this size [mm] in the plane z = 0, for a capture with a pose."""
    size = np.array([width, height])
    return Specimen(world_from_sensor, -size / 2, size, np.ones((1, 1), bool))


def specimen_in_cloud(cloud: PointCloud, where: str) -> Specimen:
    """Find the plane through most points of a cloud, and the outline of the points in it.

    ``off_plane`` of the result is their rms distance from the plane. Messages name ``where``. Raises InputError if too
    few points lie in one plane.
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
    return Specimen(pose, low, cell, occupied, float(np.sqrt(np.mean(off**2))))


def pose_over_coupon(cloud: PointCloud, window: Roi, where: str) -> Transform:
    """Return ``world_from_sensor``, with the frame of a coupon as the world.

    The pixels of ``window`` show only the coupon; ``where`` names the capture in messages. Raises InputError if the
    window is not in the cloud, too few of its points lie in one plane, or the plane is seen edge-on.
    """
    grid = cloud.grid
    asked = f"{window.left} {window.top} {window.width} {window.height}"
    if not window.fits(grid.width, grid.height):
        raise InputError("--coupon", "", asked, f"COLUMN ROW WIDTH HEIGHT within {grid.width} x {grid.height} pixels")
    outside = np.ones(cloud.status.shape, bool)
    outside[window.slices] = False
    points, status = cloud.points.copy(), cloud.status.copy()
    points[outside], status[outside] = np.nan, Status.NO_SURFACE
    plane = specimen_in_cloud(replace(cloud, points=points, status=status), where).world_from_sensor
    normal = plane.rotation[2]  # in the sensor frame
    middle = window.top + window.height // 2
    columns = np.array([window.left, window.left + window.width // 2, window.right - 1])
    rays = grid.rays_at(columns, np.full(3, middle))
    cosines = -rays @ normal
    if cosines.min() < _LEAST_COSINE:
        raise InputError("--coupon", "", f"{asked}, a plane seen edge-on", "a coupon tilted by less than 85 deg")
    left, origin, right = (
        grid.origin + rays * (((grid.origin - plane.inverse().translation) @ normal) / cosines)[:, None]
    )
    across = (right - left) / np.linalg.norm(right - left)
    return Transform(np.stack([across, np.cross(normal, across), normal], axis=1), origin).inverse()


def plane_points(points: Floats) -> NDArray[np.bool_]:
    """Return which points (N, 3) [mm], sensor frame, lie near the plane of most, within a limit by distance."""
    best = np.zeros(len(points), bool)
    if len(points) < _FEWEST:
        return best
    rng = np.random.default_rng(0)
    near = _FLAT * np.linalg.norm(points, axis=1)
    sample = rng.integers(0, len(points), min(len(points), 4000))
    votes = -1
    for _ in range(_TRIALS):
        a, b, c = points[rng.integers(0, len(points), 3)]
        normal = np.cross(b - a, c - a)
        length = float(np.linalg.norm(normal))
        if length < 1e-9:
            continue
        count = int((np.abs((points[sample] - a) @ (normal / length)) < near[sample]).sum())
        if count > votes:
            votes, best = count, np.abs((points - a) @ (normal / length)) < near
    return best


def _frame(points: Floats) -> Transform:
    """Return the frame of a coupon from the sensor's: the mean of its points (N, 3) [mm], z toward the sensor."""
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
    pieces, piece_count = ndimage.label(ndimage.binary_opening(dense, iterations=2)[3:-3, 3:-3])
    return np.asarray(
        pieces == int(np.argmax(np.bincount(pieces.ravel())[1:])) + 1 if piece_count else np.zeros_like(dense)
    )


def _no_plane(where: str, count: int) -> InputError:
    return InputError(
        where,
        "pose",
        f"null, and {count} points of its cloud in a plane",
        f"a world_from_sensor, or {_FEWEST} points side by side in a plane",
        "decode the capture to see which points are missing: mitsim decode",
    )


def fit_bend(points: Floats, step: float = 0.0) -> Bend | None:
    """Fit the bend of points (n, 3) [mm] in the frame of their plane, with z along its normal; None for too few.

    ``step`` [mm] is that of rounded depths. A median of these would be rounded too, so the height of a cell is then the
    mean of its points within two steps of the median.
    """
    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    cell = float((high - low).max()) / _BEND_CELLS
    if not cell > 0:
        return None
    centres, heights = _cell_heights(points, low, cell, step)
    if len(heights) < _CELLS_PER_TERM * 3:
        return None
    middle, half = (low + high) / 2, np.maximum((high - low) / 2, cell)
    best: tuple[float, int, Floats] | None = None
    for degree in DEGREES:
        terms = _terms((centres - middle) / half, degree)
        if len(heights) < _CELLS_PER_TERM * terms.shape[1]:
            break
        q, r = np.linalg.qr(terms)
        coefficients = np.linalg.solve(r, q.T @ heights)
        left_out = (heights - terms @ coefficients) / (1 - np.minimum((q**2).sum(axis=1), 0.99))
        # the median square, not the sum: a false match in a cell must not choose the degree
        error = float(np.median(left_out**2))
        if best is None or error < best[0]:
            best = error, degree, coefficients
    assert best is not None
    _, degree, coefficients = best
    rms = float(np.sqrt(np.mean((_terms((centres - middle) / half, degree) @ coefficients) ** 2)))
    return Bend(middle, half, degree, coefficients, rms)


def _cell_heights(points: Floats, low: Floats, cell: float, step: float) -> tuple[Floats, Floats]:
    """Return the centres (m, 2) of the cells with enough points, and their median heights (m,), all in mm.

    Of depths rounded to a ``step`` [mm] they are the means near the median.
    """
    columns, rows = np.floor((points[:, :2] - low) / cell).astype(int).T
    number = rows * (columns.max() + 1) + columns
    order = np.lexsort((points[:, 2], number))
    labels, first, counts = np.unique(number[order], return_index=True, return_counts=True)
    ordered = points[order, 2]
    heights = ordered[first + counts // 2]
    if step:
        near = np.abs(ordered - np.repeat(heights, counts)) <= 2 * step
        heights = np.add.reduceat(ordered * near, first) / np.add.reduceat(near, first, dtype=float)
    kept = counts >= _BEND_POINTS
    row, column = np.divmod(labels[kept], columns.max() + 1)
    return low + (np.stack([column, row], axis=1) + 0.5) * cell, heights[kept]


def _terms(points: Floats, degree: int) -> Floats:
    """Return Legendre polynomials (..., k) up to the total degree ``degree`` at points (..., 2) in -1..1."""
    inside = np.clip(points, -1.0, 1.0)
    every = legvander2d(inside[..., 0], inside[..., 1], [degree, degree])
    power = np.add.outer(np.arange(degree + 1), np.arange(degree + 1)).reshape(-1)
    return np.asarray(every[..., power <= degree])
