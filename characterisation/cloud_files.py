"""Point clouds on disk: binary PLY that keeps the grid.

PLY has no units, frames or grids, so comment lines hold them; other readers ignore these. Missing points are not
written; each other point has its ``row`` and ``col``. A second element, ``pixel``, has the status of every pixel, so
that reading restores the whole cloud. For a camera with lens distortion it also has ``ray_x`` and ``ray_y`` (x/z and
y/z) of each pixel.

For other programs the points may be written in another frame, such as a robot's (:class:`WrittenFrame`). The file then
holds the transform, and reading returns the points to the sensor frame.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from characterisation.files.atomic_io import atomic_write
from characterisation.files.checked_files import read_bounded
from characterisation.files.errors import InputError, in_one_line
from characterisation.point_cloud import PointCloud, Status, ViewGrid

_VERTEX = np.dtype(
    [*((name, "<f4") for name in ("x", "y", "z", "sigma")), ("row", "<u2"), ("col", "<u2"), ("feature", "<i2")]
)
_PIXEL = np.dtype([("status", "u1")])
_BENT_PIXEL = np.dtype([("status", "u1"), ("ray_x", "<f4"), ("ray_y", "<f4")])
_NAMES = {"<f4": "float", "<u2": "ushort", "<i2": "short", "|u1": "uchar"}
_KEY = "mitsim"

#: rows or columns that ``row`` and ``col``, of 16 bits, can tell apart
_MOST_LINES = 1 << 16

#: largest file that is read [bytes]: 35 million points
_LARGEST_CLOUD = 1 << 30

#: largest distance of a point from the sensor [mm]
_FARTHEST_MM = 1e6


@dataclass(frozen=True)
class WrittenFrame:
    """Frame of the points in a file: its ``name`` (one line) and the rigid transform ``from_sensor`` (4, 4) [mm]."""

    name: str
    from_sensor: NDArray[np.float64]


def write_cloud(cloud: PointCloud, path: str | Path, frame: WrittenFrame | None = None) -> None:
    """Write an organised cloud as binary PLY.

    The file holds the pixel grid, the status of every pixel, and each point with its row, column, feature and sigma.
    Writing is atomic: an existing file is replaced only when the new one is complete.

    Parameters
    ----------
    cloud
        Points (H, W, 3) [mm] in the sensor frame.
    path
        Path of the file. Its folder must exist.
    frame
        Frame in which the points are written; by default, the sensor frame.

    Raises
    ------
    InputError
        If the grid has over 65536 rows or columns, or a status does not fit its point.
    OSError
        If the file cannot be written.

    Examples
    --------
    >>> import characterisation
    >>> cloud = characterisation.read_cloud("cloud.ply")
    >>> characterisation.write_cloud(cloud, "copy.ply")
    """
    if max(cloud.status.shape) > _MOST_LINES:
        found = f"{cloud.grid.width} x {cloud.grid.height} px"
        raise InputError(path, "grid", found, f"up to {_MOST_LINES} px each way, as cameras have")
    _check_status(path, cloud)
    rows, columns = np.nonzero(cloud.valid)
    vertices = np.zeros(len(rows), _VERTEX)
    points = cloud.points[rows, columns].astype(np.float64)
    if frame is not None:
        points = points @ frame.from_sensor[:3, :3].T + frame.from_sensor[:3, 3]
    for axis, name in enumerate("xyz"):
        vertices[name] = points[:, axis]
    vertices["row"], vertices["col"] = rows, columns
    vertices["feature"] = -1 if cloud.feature is None else cloud.feature[rows, columns]
    vertices["sigma"] = np.nan if cloud.sigma is None else cloud.sigma[rows, columns]
    grid = cloud.grid
    about = {
        "sensor": cloud.sensor,
        "source": cloud.source,
        "feature_names": list(cloud.feature_names),
        "baseline": cloud.baseline.tolist(),
        "labelled": cloud.feature is not None,
        "grid": {
            **{name: getattr(grid, name) for name in ("fx", "fy", "cx", "cy", "width", "height")},
            "rotation": grid.rotation.tolist(),
            "origin": grid.origin.tolist(),
            "bent": grid.normalised is not None,
        },
    }
    if frame is not None:
        about["frame_from_sensor"] = frame.from_sensor.tolist()
    pixels = np.zeros(cloud.status.shape, _PIXEL if grid.normalised is None else _BENT_PIXEL)
    pixels["status"] = cloud.status
    if grid.normalised is not None:
        pixels["ray_x"], pixels["ray_y"] = np.moveaxis(grid.normalised, -1, 0)
    header = [
        "ply",
        "format binary_little_endian 1.0",
        "comment units mm",
        "comment frame sensor, OpenCV: x right, y down, z forward" if frame is None else f"comment frame {frame.name}",
        f"comment {_KEY} {json.dumps(about)}",
    ]
    for name, table in (("vertex", vertices), ("pixel", pixels)):
        header.append(f"element {name} {table.size}")
        header += [f"property {_NAMES[table.dtype[field].str]} {field}" for field in table.dtype.names or ()]
    header.append("end_header\n")
    with atomic_write(path) as file:
        file.write_bytes("\n".join(header).encode() + vertices.tobytes() + pixels.tobytes())


def read_cloud(path: str | Path) -> PointCloud:
    """Read an organised cloud from a PLY file written by :func:`write_cloud` or ``mitsim decode``.

    Parameters
    ----------
    path
        The file.

    Returns
    -------
    PointCloud
        Points (H, W, 3) [mm] in the sensor frame, NaN where missing.

    Raises
    ------
    InputError
        If the file is missing or truncated, or is a PLY without a pixel grid. ``mitsim import`` reads the clouds of
        other programs.

    Examples
    --------
    >>> import characterisation
    >>> cloud = characterisation.read_cloud("cloud.ply")
    >>> cloud.points.shape
    (240, 320, 3)
    """
    path = Path(path)
    data = read_bounded(path, "a PLY file", largest=_LARGEST_CLOUD)
    head, mark, body = data.partition(b"end_header\n")
    if not data.startswith(b"ply\n") or not mark:
        raise InputError(path, "", "a file without a PLY header", "a PLY file")
    lines = head.decode("ascii", "replace").splitlines()
    comment = next((line for line in lines if line.startswith(f"comment {_KEY} ")), None)
    if comment is None:
        raise InputError(path, "comment", "no grid", "an organised cloud, written by mitsim")
    try:
        about = json.loads(comment.split(" ", 2)[2])
        g = about["grid"]
        fx, fy, cx, cy = (float(g[key]) for key in ("fx", "fy", "cx", "cy"))
        width, height, bent = int(g["width"]), int(g["height"]), bool(g.get("bent", False))
        rotation, origin = np.array(g["rotation"], float).reshape(3, 3), np.array(g["origin"], float).reshape(3)
        count = int(next(line for line in lines if line.startswith("element vertex ")).split()[2])
        names, labelled = tuple(map(str, about["feature_names"])), bool(about["labelled"])
        moved = np.array(about.get("frame_from_sensor", np.eye(4)), float).reshape(4, 4)
        sensor, source, baseline = str(about["sensor"]), str(about["source"]), np.array(about["baseline"], float)
        numbers = np.concatenate([[fx, fy, cx, cy], rotation.ravel(), origin, moved.ravel(), baseline.ravel()])
        if baseline.shape != (3,) or not (np.abs(numbers) < 1e9).all() or not (fx > 0 and fy > 0):
            raise ValueError("optics or a pose that are infinite, huge or not numbers")
    except (ValueError, KeyError, TypeError, StopIteration, IndexError, OverflowError, RecursionError) as error:
        cause = in_one_line(repr(error))
        raise InputError(path, "comment", f"an inconsistent header ({cause})", "as written") from None
    pixel = _BENT_PIXEL if bent else _PIXEL
    if min(count, width - 1, height - 1) < 0 or len(body) != count * _VERTEX.itemsize + width * height * pixel.itemsize:
        raise InputError(
            path, "", f"{len(body)} bytes of data", "as many as the header says; the file may be truncated"
        )
    vertices = np.frombuffer(body, _VERTEX, count)
    pixels = np.frombuffer(body, pixel, width * height, count * _VERTEX.itemsize).reshape(height, width)
    status = pixels["status"].copy()
    normalised = np.stack([pixels["ray_x"], pixels["ray_y"]], axis=-1) if bent else None
    grid = ViewGrid(fx, fy, cx, cy, width, height, rotation, origin, normalised)
    points = np.full((grid.height, grid.width, 3), np.nan, np.float32)
    feature = np.full((grid.height, grid.width), -1, np.int16)
    sigma = np.full((grid.height, grid.width), np.nan, np.float32)
    rows, columns = vertices["row"], vertices["col"]
    if count and (rows.max() >= grid.height or columns.max() >= grid.width or status.max() > max(Status)):
        raise InputError(path, "row, col", "a pixel outside the grid", f"{grid.height} x {grid.width}")
    read = np.stack([vertices["x"], vertices["y"], vertices["z"]], axis=-1)
    if count and not -1 <= vertices["feature"].min() <= vertices["feature"].max() < max(len(names), 1):
        raise InputError(path, "feature", "an unknown feature number", f"-1 to {len(names) - 1}")
    if not (np.abs(read) < _FARTHEST_MM).all():
        raise InputError(path, "vertex", "coordinates that are infinite, huge or not numbers", "points within 1000 m")
    if "frame_from_sensor" in about:
        read = ((read - moved[:3, 3]) @ moved[:3, :3]).astype(np.float32)
    points[rows, columns] = read
    feature[rows, columns], sigma[rows, columns] = vertices["feature"], vertices["sigma"]
    known_sigma = sigma if np.isfinite(sigma).any() else None
    labels = feature if labelled else None
    cloud = PointCloud(points, status, grid, sensor, source, baseline, labels, names, known_sigma)
    _check_status(path, cloud)
    return cloud


def _check_status(path: str | Path, cloud: PointCloud) -> None:
    """Check that pixels are valid exactly where they have a point."""
    wrong = (cloud.status == Status.VALID) != cloud.valid
    if wrong.any():
        row, column = np.argwhere(wrong)[0]
        status, word = Status(cloud.status[row, column]).name, "a" if cloud.valid[row, column] else "no"
        where = f"status {status} and {word} point at row {row}, column {column}, {wrong.sum()} pixels in all"
        raise InputError(path, "status", where, "VALID exactly where a pixel has a point")
