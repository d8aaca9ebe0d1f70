"""Know what qualifies the numbers of a calibration, for the readers of all formats.

The numbers of a camera matrix mean nothing without these:

- **the part of the imager** that the images show, and its binning. ROS (``sensor_msgs/CameraInfo``) states K of the
  full imager beside ``roi`` and ``binning_x``, ``binning_y``;
- **the size of the images**, by which normalised values and values in mm are recognised;
- **the lens model** of the distortion coefficients (:mod:`mitsim.sensor.lens_models`);
- **the unit of length** of a translation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from characterisation.files.errors import InputError
from mitsim.sensor.calibration_numbers import vector
from mitsim.sensor.camera import Camera

#: focal length over the longer side: fields of view from 169 deg to 0.06 deg
_FOCAL_SHARE = (0.05, 1000.0)

#: farthest principal point from the image's corner, over the longer side
_CENTRE_SHARE = 20.0

#: units of length by the words of files [mm]
UNITS_MM = {
    word: size
    for size, words in {
        1e-3: "um µm μm micron microns micrometer micrometers micrometre micrometres",
        1.0: "mm millimeter millimeters millimetre millimetres",
        10.0: "cm centimeter centimeters centimetre centimetres",
        1000.0: "m meter meters metre metres",
        25.4: "in inch inches",
        304.8: "ft foot feet",
    }.items()
    for word in words.split()
}

#: units of length that an option may name [mm]
LENGTHS_MM = {word: UNITS_MM[word] for word in ("um", "mm", "cm", "m", "inch", "foot")}

#: names under which files state their unit of length
UNIT_NAMES = ("unit", "units", "length_unit", "world_units", "WorldUnits", "translation_unit", "baseline_unit")

#: name of the unit that a format implies, which the file itself does not state
OF_FORMAT = "unit of the format"

#: units of other quantities that may have the same name
_NOT_LENGTHS = ("px", "pixel", "pixels", "deg", "degree", "degrees", "rad", "radian", "radians", "none")


@dataclass(frozen=True)
class ReadOut:
    """The part of the imager that the images show, and its ``binning`` (x, y).

    ``corner`` (x, y) and ``size`` (width, height) are in pixels of the full imager; without a size the part extends to
    the imager's end.
    """

    corner: tuple[float, float]
    size: tuple[float, float] | None
    binning: tuple[int, int]


def check_intrinsics(focal: tuple[float, float], principal: tuple[float, float], width: int, height: int) -> None:
    """Check that a focal length and a principal point belong to images of a size.

    ``focal``, ``principal``, ``width``, ``height``: all [px]. Raises ValueError if they cannot; the message names the
    key of a sensor file, the limits, and the likely cause.
    """
    side = max(width, height)
    low, high = (share * side for share in _FOCAL_SHARE)
    images = f"for images of {width} x {height} px"
    if not all(low <= focal_px <= high for focal_px in focal):
        raise ValueError(f"focal_px from {low:g} to {high:g} {images}{_cause(focal, principal)}")
    if not all(abs(coordinate) <= _CENTRE_SHARE * side for coordinate in principal):
        raise ValueError(f"principal_px within {_CENTRE_SHARE * side:g} px of the image's corner {images}")


def _cause(focal: tuple[float, float], principal: tuple[float, float]) -> str:
    """Return the likely cause of a focal length that no image has, as the end of a sentence."""
    if not all(math.isfinite(length) and length > 0 for length in focal):
        return ""
    if max(focal) < 15 and all(-1 <= coordinate <= 2 for coordinate in principal):
        return (
            "; these are normalised values, shares of the image's sides: multiply fx and cx by the width in px, fy and "
            "cy by the height"
        )
    if max(focal) < 0.5:
        return "; a focal length in metres is to be divided by the size of a pixel in metres"
    return "; a focal length in mm is to be divided by the size of a pixel in mm" if max(focal) < 100 else ""


def check_camera(camera: Camera, where: str | Path, field: str = "") -> None:
    """Check that the matrix of a camera belongs to its images.

    Raises InputError if it cannot; the error names the file, the field and the likely cause.
    """
    (fx, _, cx), (_, fy, cy), _ = camera.matrix.tolist()
    try:
        check_intrinsics((fx, fy), (cx, cy), camera.width, camera.height)
    except ValueError as error:
        found = f"focal_px {fx:g}, {fy:g} and principal_px {cx:g}, {cy:g}"
        raise InputError(where, field, found, str(error)) from None


def read_out_of(table: dict[str, Any], where: str | Path) -> ReadOut | None:
    """Return the part of the imager that a table states; None for the full imager.

    In ROS a ``roi`` of zeros means the full imager, and a binning of 0 means 1. Raises InputError if a stated value is
    not a whole number of pixels.
    """
    stated = table.get("roi")
    roi: dict[str, Any] = stated if isinstance(stated, dict) else {}
    values = []
    for holder, name, field in (
        *((roi, name, f"roi.{name}") for name in ("x_offset", "y_offset", "width", "height")),
        *((table, name, name) for name in ("binning_x", "binning_y")),
    ):
        number = vector(holder.get(name, 0), 1)
        if number is None or not 0 <= number[0] < 1e5 or number[0] % 1:
            raise InputError(where, field, holder.get(name), "a whole number of pixels, 0 to 100000")
        values.append(int(number[0]))
    x, y, width, height, bin_x, bin_y = values
    if not any(values[:4]) and max(bin_x, bin_y) <= 1:
        return None
    size = (float(width), float(height)) if width and height else None
    return ReadOut((float(x), float(y)), size, (max(bin_x, 1), max(bin_y, 1)))


def of_images(
    matrix: NDArray[np.float64],
    stated: tuple[int, int] | None,
    read_out: ReadOut,
    images: tuple[int, int] | None = None,
) -> tuple[NDArray[np.float64], tuple[int, int] | None, str]:
    """Return the camera matrix and size of the images of a read-out, and a sentence that says what was done.

    A principal point cx of the full imager is (cx - x + 1/2) / b - 1/2 in images that begin at column x and are binned
    by b, since pixel centres lie at integers. (ROS's ``image_geometry`` leaves out the halves.)

    Images of the size of the full imager are not cut. If the part does not lie inside the stated size, the file states
    the size of the part; the matrix is then that of the full imager, or already that of the part: the reading whose
    principal point is nearer to the middle of the images is used.

    ``matrix``: K (3, 3) [px] of the full imager. ``stated``: (width, height) [px] of the full imager as the file states
    it. ``read_out``: part of the imager that is read out, and its binning. ``images``: (width, height) [px] of the
    images, if known.
    """
    corner, binning = np.array(read_out.corner), np.array(read_out.binning)
    full = None if stated is None else np.array(stated, float)
    part = read_out.size
    if part is None:
        if full is None:
            return matrix, None, ""
        part = (float(full[0] - corner[0]), float(full[1] - corner[1]))
    size = (int(part[0] // binning[0]), int(part[1] // binning[1]))
    whole = None if full is None else tuple(int(side) for side in full // binning)
    binned = np.diag([*(1 / binning), 1.0]) @ matrix
    binned[:2, 2] += 0.5 / binning - 0.5
    by = "" if max(binning) == 1 else f", binned {binning[0]} x {binning[1]}"
    if images is not None and images != size and images == stated and max(binning) > 1:
        return matrix, stated, "binning is not applied: the images have the size of the full imager"
    if images is not None and images == whole and images != size:
        return binned, images, f"roi is not applied: the images show the full imager{by}"
    cut = binned.copy()
    cut[:2, 2] -= corner / binning
    inside = full is None or bool(((corner + part) <= full).all())
    middle = (np.array(size) - 1) / 2
    if not inside and np.linalg.norm(cut[:2, 2] - middle) > np.linalg.norm(binned[:2, 2] - middle):
        return binned, size, "roi is not applied: the principal point is already that of the part"
    if not corner.any() and max(binning) == 1:
        return cut, size, ""
    (x, y), (cx, cy) = corner.astype(int), cut[:2, 2]
    return (
        cut,
        size,
        (
            f"the images show {part[0]:g} x {part[1]:g} px of the imager from column {x} and row {y}{by}: principal "
            f"point {matrix[0, 2]:g}, {matrix[1, 2]:g} of the full imager, {cx:g}, {cy:g} of the images"
        ),
    )


def unit_mm(table: dict[str, Any], where: str | Path) -> float | None:
    """Return the unit of length [mm] that a table states, else that of its format; None without both.

    Raises InputError if the unit is unknown.
    """
    for name in (*UNIT_NAMES, OF_FORMAT):
        text = table.get(name)
        if isinstance(text, str) and text:
            unit = UNITS_MM.get(text.lower())
            if unit is None and text.lower() in _NOT_LENGTHS:
                continue
            if unit is None:
                hint = "say the unit in a sensor file: [calibration] with to_mm"
                raise InputError(where, name, repr(text), ", ".join(UNITS_MM), hint)
            return unit
    return None


def rectified_pair(
    first: dict[str, Any], second: dict[str, Any]
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Return R and T of ``stereoCalibrate`` [m] from the rectifications of a pair of ROS; None if they have none.

    ROS states the rotation R_i from camera i to the rectified frame, and P_i, whose last column is f t_i with the
    position -t_i of camera i in the rectified frame of the pair (sensor_msgs/CameraInfo). A point X of the first camera
    is R_2^T (R_1 X + t_2 - t_1) of the second.
    """
    turns, shifts = [], []
    for table in (first, second):
        R, P = vector(table.get("rectification_matrix"), 9), vector(table.get("projection_matrix"), 12)
        if R is None or P is None or not P[0] > 0 or not P[5] > 0:
            return None
        turns.append(R.reshape(3, 3))
        shifts.append(np.array([P[3] / P[0], P[7] / P[5], 0.0]))
    if np.array_equal(shifts[0], shifts[1]):
        return None
    return turns[1].T @ turns[0], turns[1].T @ (shifts[1] - shifts[0])
