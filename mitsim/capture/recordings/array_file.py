"""Read arrays of numbers that other programs saved as NumPy's ``.npy`` and ``.npz``, and find the points among arrays.

The axis of x, y and z is the last: (n, 3), (rows, columns, 3); or the first, as in MATLAB and PyTorch: (3, n),
(3, rows, columns). Or x, y and z are three arrays, or three fields of one, of these names.
"""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import numpy as np
from numpy.typing import NDArray

from characterisation.files.errors import InputError, in_one_line
from mitsim.capture.npy import NPY_MAGIC, numbers_of_npy
from mitsim.capture.recordings.cloud_numbers import check_points_first
from mitsim.capture.recordings.recording_files import chosen_frame
from mitsim.sensor.calibration_qualifiers import UNITS_MM

#: most values of a point: x, y, z, normal and colour
_MOST_VALUES = 9

#: names of arrays of points, and of others that have three values of a pixel as well
_POINTS = re.compile(r"point|xyz|vert|cloud|location|pos", re.IGNORECASE)
_NO_POINTS = re.compile(r"normal|colou?r|rgb|bgr|image|img|texture", re.IGNORECASE)

#: names of disparities, and of inverse depths
_DISPARITY = re.compile(r"disparit|(?<![a-z])disp(?![a-z])|(?:inv(?:erse)?[-_ ]?|(?<![a-z])i)depth", re.IGNORECASE)

#: least number of values of a map or a cloud beside others: a calibration, a pose or a covariance has fewer; chosen
_LEAST_VALUES = 100

#: largest unpacked archive [bytes]
_LARGEST_ARCHIVE = 4 * 1024**3


def arrays_of_npz(data: bytes, where: str | Path) -> dict[str, NDArray[Any]]:
    """Return the arrays of numbers in the bytes of an ``.npz`` archive, by name; arrays of objects are left out.

    Raises InputError if the bytes are not a complete archive, or too large.
    """
    try:
        with ZipFile(io.BytesIO(data)) as packed:
            unpacked = sum(entry.file_size for entry in packed.infolist())
            if unpacked > _LARGEST_ARCHIVE:
                raise InputError(where, "size", f"{unpacked:,} bytes unpacked", f"up to {_LARGEST_ARCHIVE:,}")
            members = {entry.filename: packed.read(entry) for entry in packed.infolist()}
    except InputError:
        raise
    except Exception as error:  # a damaged archive raises many types of errors
        reason = in_one_line(error, 120)
        raise InputError(where, "", f"an unreadable file ({reason})", "an .npz file of NumPy") from None
    return {
        name.removesuffix(".npy"): numbers_of_npy(member, f"{where}: {name}", tables=True)
        for name, member in members.items()
        if member.startswith(NPY_MAGIC) and b"'|O'" not in member[:200]
    }


def arrays_in(data: bytes, where: Path) -> dict[str, NDArray[Any]]:
    """Return the arrays of an ``.npy`` or ``.npz`` file by name; that of the first has none."""
    return {"": numbers_of_npy(data, where, tables=True)} if data.startswith(NPY_MAGIC) else arrays_of_npz(data, where)


def map_in(data: bytes, where: Path, frame: int | None = None) -> NDArray[Any]:
    """Return the map in an ``.npy`` or ``.npz`` file (:func:`map_among`)."""
    return map_among(arrays_in(data, where), where, frame)


def map_among(arrays: dict[str, NDArray[Any]], where: Path, frame: int | None = None) -> NDArray[Any]:
    """Return the points (rows, columns, 3), or else the depths (rows, columns), among arrays.

    ``frame`` is the number, from 0, of one of several images of depths, (frames, rows, columns).
    """
    arrays = _large(arrays)
    points = points_among(arrays, where)
    if points is not None and points.ndim == 3 and min(points.shape[:2]) > 1:
        return points
    flat = {name: array[..., 0] if array.ndim == 3 and array.shape[2] == 1 else array for name, array in arrays.items()}
    depths = {name: array for name, array in flat.items() if array.ndim in (2, 3) and array.dtype.kind in "fiu"}
    if depths and all(map(is_disparity, depths)):
        raise disparities(where)
    depths = {name: array for name, array in depths.items() if not is_disparity(name)}
    called = {name: array for name, array in depths.items() if "depth" in name.lower()}
    named = called or depths
    if len(named) != 1 or (points is not None and not called):
        shapes = ", ".join(f"{name} {' x '.join(map(str, array.shape))}".strip() for name, array in arrays.items())
        allowed = "points of rows x columns x 3, or depths of rows x columns"
        raise InputError(where, "shape", shapes[:300] or "no arrays", allowed)
    depth = next(iter(named.values()))
    images = depth if depth.ndim == 3 else depth[None]
    return np.asarray(images[chosen_frame(frame, len(images), where, "images of depths")])


def is_disparity(name: str) -> bool:
    """Return whether a file or an array is named after disparities or inverse depths."""
    return _DISPARITY.search(name) is not None


def unit_of_depths(arrays: dict[str, NDArray[Any]]) -> float | None:
    """Return the unit [mm] that the only array of depths has in its name, as ``depth_cm``; None without one."""
    named = [name for name in _large(arrays) if "depth" in name.lower() and not is_disparity(name)]
    match = re.search(r"[_.]([uµμcm]?m)$", named[0].lower()) if len(named) == 1 else None
    return None if match is None else UNITS_MM[match[1]]


def disparities(where: str | Path) -> InputError:
    """Return the error of a file that is named after disparities."""
    hint = "depth = f B / disparity, with the focal length f [px] and the baseline B [mm]; save it under another name"
    return InputError(where, "", "disparities, by the name", "depths", hint)


def points_among(arrays: dict[str, NDArray[Any]], where: str | Path) -> NDArray[Any] | None:
    """Return the array of points (n, 3) or (rows, columns, 3) among arrays; None without one.

    Of several, one that is named so comes first, then the largest; colours and normals are none. Raises InputError if
    numbers of rows or colours precede x, y and z in the array; the error names the file ``where``.
    """
    arrays = _large(arrays)
    tables = [array for array in arrays.values() if array.dtype.names]
    fields = {name: table[name] for table in tables for name in table.dtype.names or () if name in "xyzXYZ"}
    real = {name: array for name, array in (arrays | fields).items() if array.dtype.kind in "fiu"}
    named = [next((array for name, array in real.items() if name.lower() == axis), None) for axis in "xyz"]
    first = named[0]
    if first is not None and all(array is not None and array.shape == first.shape for array in named):
        joined = np.stack([np.asarray(array, np.float64) for array in named], axis=-1)
        return joined.reshape(-1, 3) if joined.ndim == 2 or 1 in joined.shape[:-1] else joined
    turned = [
        (_POINTS.search(name) is not None, points.size, points)
        for name, array in real.items()
        if (_POINTS.search(name) or not _NO_POINTS.search(name)) and (points := _with_points_last(array)) is not None
    ]
    points = max(turned, key=lambda candidate: candidate[:2], default=(False, 0, None))[2]
    if points is None:
        return None
    check_points_first(points.reshape(-1, points.shape[-1]), where, "save x, y and z alone")
    return points[..., :3]


def _large(arrays: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Return the arrays that may be maps or clouds: all of them if all are small."""
    return {name: array for name, array in arrays.items() if array.size >= _LEAST_VALUES} or arrays


def _with_points_last(array: NDArray[Any]) -> NDArray[Any] | None:
    """Return an array whose last axis begins with x, y, z, of one whose last or first axis has them; else None."""
    if array.ndim not in (2, 3) or not array.size or array.dtype == np.uint8:  # of a colour image
        return None
    if 3 <= array.shape[-1] <= _MOST_VALUES:
        return array
    if array.shape[0] != 3 or min(array.shape[1:]) <= _MOST_VALUES or not (array[:2] < 0).any():
        return None  # without x or y on both sides of the axis they are three images of depths
    return np.moveaxis(array, 0, -1)
