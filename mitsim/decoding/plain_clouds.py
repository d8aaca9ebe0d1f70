"""Read clouds without a grid, and clouds in arrays and text files, to measure them or to compare with them.

Signal chain: .npy, .mat, text of three columns, or points of a PLY or PCD -> x, y, z of every point, on a grid if the
array has rows and columns -> unit -> cloud.

The points are used as they are: mitsim assumes that their frame is that of the sensor or, for a reference, that of the
cloud. A cloud without a grid is one row of pixels, and each pixel's ray passes through its point. So it has no windows
and no picture.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from characterisation.files.checked_files import read_bounded
from characterisation.files.errors import InputError
from characterisation.point_cloud import PointCloud, Status, ViewGrid
from mitsim.capture.npy import numbers_of_npy
from mitsim.capture.recordings.number_text import number_words
from mitsim.capture.recordings.organised_cloud import scale_to_mm
from mitsim.sensor.mat_structure import read_mat

#: most numbers of a MATLAB file: x, y, z and more of 100 million points
_MOST_NUMBERS = 1_000_000_000

#: suffixes of clouds in arrays and text
ARRAYS, TEXTS = (".npy", ".mat"), (".xyz", ".txt", ".asc", ".pts", ".csv")

#: largest text [bytes]; reading takes ten times as much memory
_LARGEST_TEXT = 256 * 1024**2


def is_array_or_text(path: Path) -> bool:
    """Return whether a file is a cloud in an array or a text, by its suffix."""
    return path.suffix.lower() in (*ARRAYS, *TEXTS) and path.is_file()


def read_plain_cloud(path: Path) -> tuple[PointCloud, str]:
    """Return the cloud [mm] of an array or a text, and a sentence about its unit and its grid.

    Raises
    ------
    InputError
        If the file holds no points with x, y and z.
    """
    data = read_bounded(path, "a cloud")
    suffix = path.suffix.lower()
    return plain_cloud(_of_text(path, data) if suffix in TEXTS else _of_arrays(path, data, suffix), path)


def plain_cloud(stored: NDArray[np.floating], path: Path) -> tuple[PointCloud, str]:
    """Return the cloud [mm] of points (n, 3) or (H, W, 3) as a file has them, and a sentence about its unit and grid.

    Raises
    ------
    InputError
        If there is no point, or one is too far away.
    """
    points = np.array(stored, np.float64)
    name, distance = scale_to_mm(points, path)
    organised = points.ndim == 3 and min(points.shape[:2]) > 1
    grid = points if organised else points.reshape(1, -1, 3)
    status = np.where(np.isfinite(grid[..., 0]), Status.VALID, Status.NO_SURFACE).astype(np.uint8)
    cloud = PointCloud(grid.astype(np.float32), status, _through(grid), "point-cloud", "device")
    shape = f"{grid.shape[1]} x {grid.shape[0]} points" if organised else f"{grid.shape[1]} points without a grid"
    unit = f"in {name}, which their median distance of {distance:.4g} suggests"
    return cloud, f"{path.name}: {shape}, {unit}"


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


def _of_arrays(path: Path, data: bytes, suffix: str) -> NDArray[np.floating]:
    """Return the points (n, 3) or (H, W, 3) of a file of NumPy or MATLAB, in its unit."""
    if suffix == ".npy":
        arrays = {path.name: numbers_of_npy(data, path)}
    else:
        read = read_mat(path, data, _MOST_NUMBERS)
        arrays = {name: value for name, value in read.items() if isinstance(value, np.ndarray)}
    found = _with_three(arrays)
    if found is None:
        shapes = ", ".join(f"{name} {' x '.join(map(str, one.shape))}" for name, one in arrays.items())[:200]
        raise InputError(path, "", shapes or "no array", "an array of n x 3 or rows x columns x 3, or x, y and z alike")
    return found


def _with_three(arrays: dict[str, NDArray[np.generic]]) -> NDArray[np.floating] | None:
    """Return the largest array of points among arrays, or x, y and z joined; None without either."""
    real = {name: one for name, one in arrays.items() if one.dtype.kind in "fiu"}
    points = [one for one in real.values() if one.ndim in (2, 3) and one.shape[-1] >= 3 and one.size]
    named = [next((one for name, one in real.items() if name.lower() == axis), None) for axis in "xyz"]
    if all(one is not None and one.shape == (named[0].shape if named[0] is not None else ()) for one in named):
        joined = np.stack([np.asarray(one, np.float64) for one in named], axis=-1)
        return joined.reshape(-1, 3) if 1 in joined.shape[:-1] else joined
    best = max((one for one in points if one.shape[-1] <= 9), key=lambda one: one.size, default=None)
    return None if best is None else np.asarray(best[..., :3], np.float64)


def _of_text(path: Path, data: bytes) -> NDArray[np.float64]:
    """Return the first three columns of a text; lines that begin with a letter, # or / are comments."""
    if len(data) > _LARGEST_TEXT:
        raise InputError(path, "", f"{len(data):,} bytes of text", f"at most {_LARGEST_TEXT:,}", "save it as PLY")
    lines = [line.strip() for line in data.removeprefix(b"\xef\xbb\xbf").splitlines()]
    rows = [line for line in lines if line and not _comment(line)]
    try:
        columns = len(number_words(rows[0].translate(_SPACES))) if rows else 0
        if columns == 1:  # the number of points
            rows, columns = rows[1:], len(number_words(rows[1].translate(_SPACES))) if len(rows) > 1 else 0
        words = number_words(b"\n".join(rows).translate(_SPACES))
        if columns < 3 or len(words) != columns * len(rows):
            raise ValueError(f"{len(words)} numbers in {len(rows)} lines")
        return np.array(words, np.float64).reshape(len(rows), columns)[:, :3]
    except ValueError as error:
        reason = " ".join(str(error).split())[:120]
        raise InputError(
            path, "", f"text that is no cloud ({reason})", "lines of x, y and z, and equal columns"
        ) from None


_SPACES = bytes.maketrans(b",;\t", b"   ")


def _comment(line: bytes) -> bool:
    """Return whether a line is a comment or the names of the columns; NaN is a number."""
    return line.startswith((b"#", b"/")) or (line[:1].isalpha() and not line[:3].lower().startswith((b"nan", b"inf")))
