"""Read clouds without a grid, and clouds in arrays and text files, to measure them or to compare with them.

Signal chain: .npy, .npz, .mat, text of columns, or points of a PLY or PCD -> x, y, z of every point, on a grid if the
array has rows and columns -> unit -> cloud.

The points are used as they are: mitsim assumes that their frame is that of the sensor or, for a reference, that of the
cloud. A cloud without a grid is one row of pixels, and each pixel's ray passes through its point. So it has no windows
and no picture.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from characterisation.files.checked_files import read_bounded
from characterisation.files.errors import InputError
from characterisation.point_cloud import PointCloud, Status, ViewGrid
from mitsim.capture.npy import numbers_of_npy
from mitsim.capture.recordings.array_file import arrays_of_npz, map_in, points_among
from mitsim.capture.recordings.cloud_numbers import leave_out_copies, leave_out_marks, scale_to_mm
from mitsim.capture.recordings.cloud_text import points_of_text
from mitsim.sensor.mat_structure import read_mat

#: most numbers of a MATLAB file: x, y, z and more of 100 million points
_MOST_NUMBERS = 1_000_000_000

#: rounding of coordinates [mm] that is worth a remark: clouds hold 24 bits
_COARSE_MM = 1e-3

#: suffixes of clouds in arrays
ARRAYS = (".npy", ".npz", ".mat")

#: suffixes of clouds in text
TEXTS = (".xyz", ".xyzn", ".xyzi", ".xyzrgb", ".txt", ".asc", ".pts", ".csv")


def is_array_or_text(path: Path) -> bool:
    """Return whether a file is a cloud in an array or a text, by its suffix."""
    return path.suffix.lower() in (*ARRAYS, *TEXTS) and path.is_file()


def read_plain_cloud(path: Path, unit: str | None = None) -> tuple[PointCloud, str]:
    """Return the cloud [mm] of an array or a text, and a sentence on unit and grid; InputError without points."""
    data = read_bounded(path, "a cloud")
    suffix = path.suffix.lower()
    if suffix in TEXTS:
        points, stated = points_of_text(data, path)
        return plain_cloud(points, path, unit, stated)
    return plain_cloud(_of_arrays(path, data, suffix), path, unit)


def plain_cloud(
    stored: NDArray[np.floating], path: Path, unit: str | None = None, stated: str | None = None
) -> tuple[PointCloud, str]:
    """Return the cloud [mm] of points (n, 3) or (H, W, 3) as a file has them, and a sentence about its unit and grid.

    ``stored``: the points. ``path``: the file, for messages. ``unit``, ``stated``: unit of length that the user gives,
    and the one that the file states; by default that of the median distance. Raises InputError if there is no point, or
    one is too far away.
    """
    points = np.array(stored, np.float64)
    notes = leave_out_marks(points), leave_out_copies(points)
    name, distance = scale_to_mm(points, path, unit or stated, "name the unit: --unit")
    organised = points.ndim == 3 and min(points.shape[:2]) > 1
    grid = points if organised else points.reshape(1, -1, 3)
    status = np.where(np.isfinite(grid[..., 0]), Status.VALID, Status.NO_SURFACE).astype(np.uint8)
    cloud = PointCloud(grid.astype(np.float32), status, _through(grid), "point-cloud", "device")
    shape = f"{grid.shape[1]} x {grid.shape[0]} points" if organised else f"{grid.shape[1]} points without a grid"
    why = "as given" if unit else "as the file states" if stated else ""
    why = why or f"which their median distance of {distance:.4g} suggests; if not, --unit"
    step = float(np.spacing(np.float32(np.nanmax(np.abs(grid)))))
    coarse = f"coordinates kept to {step:.2g} mm: subtract their offset" if step > _COARSE_MM else ""
    return cloud, "; ".join(remark for remark in (f"{path.name}: {shape}, in {name}, {why}", *notes, coarse) if remark)


def _through(points: NDArray[np.float64]) -> ViewGrid:
    """Return a grid whose rays pass through the points (H, W, 3); along the axis where there is none ahead."""
    height, width = points.shape[:2]
    ahead = points[..., 2] > 0
    depth = np.where(ahead, points[..., 2], 1.0)[..., None]
    rays = np.where(ahead[..., None], points[..., :2] / depth, np.nan)
    steps = np.linalg.norm(np.diff(rays, axis=1), axis=-1)
    steps = steps[steps > 0]
    focal = 1.0 / float(np.median(steps)) if steps.size else 1.0
    rays = np.nan_to_num(rays).astype(np.float32)
    return ViewGrid(focal, focal, (width - 1) / 2, (height - 1) / 2, width, height, normalised=rays)


def is_map_of_depths(path: Path) -> bool:
    """Return whether a file of NumPy has depths of rows and columns, and no points."""
    if path.suffix.lower() not in (".npy", ".npz"):
        return False
    try:
        return map_in(read_bounded(path, "a cloud"), path, 0).ndim == 2
    except InputError:
        return False


def _of_arrays(path: Path, data: bytes, suffix: str) -> NDArray[np.floating]:
    """Return the points (n, 3) or (H, W, 3) of a file of NumPy or MATLAB, in its unit."""
    if suffix == ".npy":
        arrays = {path.name: numbers_of_npy(data, path, tables=True)}
    elif suffix == ".npz":
        arrays = arrays_of_npz(data, path)
    else:
        arrays = dict(_arrays_in(read_mat(path, data, _MOST_NUMBERS, simplify_cells=True)))
    points = points_among(arrays, path)
    if points is None:
        shapes = ", ".join(f"{name} {' x '.join(map(str, array.shape))}" for name, array in arrays.items())[:200]
        allowed = "an array of n x 3, 3 x n or rows x columns x 3, or x, y and z alike"
        raise InputError(path, "", shapes or "no array", allowed)
    return points


def _arrays_in(values: dict[str, Any]) -> Iterator[tuple[str, NDArray[Any]]]:
    """Yield the arrays of MATLAB's variables and of the fields of its structures, by name."""
    for name, value in values.items():
        if isinstance(value, np.ndarray):
            yield name, value
        elif isinstance(value, dict):
            yield from _arrays_in(value)
