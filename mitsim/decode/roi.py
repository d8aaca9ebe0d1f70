"""A part of an image: what a decoder is asked for, or what a camera has read out.

A window is (column, row, right, bottom) [px], the last two not included. Decoding a window gives the same points as
decoding the whole image and cutting the window out, away from its edges by what each decoder says.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from characterisation.errors import InputError
from characterisation.point_cloud import PointCloud, Status, ViewGrid

Window = tuple[int, int, int, int]


def checked_window(window: Window | None, width: int, height: int, where: str) -> Window:
    """The window, or the whole image if there is none.

    Raises
    ------
    InputError
        If it is empty, or does not lie in the image.
    """
    if window is None:
        return 0, 0, width, height
    column0, row0, column1, row1 = (int(edge) for edge in window)
    if not (0 <= column0 < column1 <= width and 0 <= row0 < row1 <= height):
        allowed = f"(column0, row0, column1, row1) within 0, 0, {width}, {height}"
        raise InputError(where, "window", window, allowed)
    return column0, row0, column1, row1


def overlap(one: Window, other: Window) -> Window | None:
    """The part that two windows share, if any."""
    column0, row0 = max(one[0], other[0]), max(one[1], other[1])
    column1, row1 = min(one[2], other[2]), min(one[3], other[3])
    return (column0, row0, column1, row1) if column0 < column1 and row0 < row1 else None


def inside(window: Window) -> tuple[slice, slice]:
    """Rows and columns of a window."""
    return slice(window[1], window[3]), slice(window[0], window[2])


def reach(positions: NDArray[np.float32], width: int, height: int) -> Window:
    """Window of an image that interpolation at ``positions`` (2, ...), column and row, asks for.

    It ends where the image does, so that what lies beyond is as it is for the whole image.
    """
    edges = []
    for each, size in zip(positions, (width, height), strict=True):
        low, high = (float(np.clip(end, 0, size)) for end in (each.min(), each.max()))  # a fisheye's may be infinite
        first = min(max(int(low) - 1, 0), size - 1)
        edges.append((first, max(min(int(np.ceil(high)) + 2, size), first + 1)))
    (column, right), (row, bottom) = edges
    return column, row, right, bottom


def has_been_read(positions: NDArray[np.float32], part: Window, width: int, height: int) -> NDArray[np.bool_]:
    """Whether interpolation at ``positions`` (2, ...), column and row, needs nothing but the part that was read out.

    Where the part ends with the image, half a pixel more counts, as it does for whole images.
    """
    (column, row), (column0, row0, column1, row1) = positions, part
    within = column >= (column0 if column0 > 0 else -0.5)
    within &= column <= (column1 - 1 if column1 < width else width - 0.5)
    within &= row >= (row0 if row0 > 0 else -0.5)
    within &= row <= (row1 - 1 if row1 < height else height - 0.5)
    return np.asarray(within)


class OnGrid(Protocol):
    """What is prepared once from a rig: among other things, the ``grid`` and ``baseline`` (3,) of its clouds."""

    @property
    def grid(self) -> ViewGrid:
        """Pixels of the cloud."""

    @property
    def baseline(self) -> NDArray[np.float64]:
        """Unit vector from the first camera to what it is measured against, in the sensor frame."""


def placed_cloud(
    points: NDArray[np.floating],
    status: NDArray[np.uint8],
    sigma: NDArray[np.floating] | None,
    window: Window,
    geometry: OnGrid,
    sensor: str,
    source: str,
) -> PointCloud:
    """A cloud of the whole grid with the points (h, w, 3), status and sigma of a window; ``NO_SURFACE`` elsewhere."""
    grid, baseline = geometry.grid, geometry.baseline
    if status.shape == (grid.height, grid.width):
        return PointCloud(
            np.asarray(points, np.float32),
            status,
            grid,
            sensor,
            source,
            baseline,
            sigma=None if sigma is None else np.asarray(sigma, np.float32),
        )
    where, shape = inside(window), (grid.height, grid.width)
    every_point = np.full((*shape, 3), np.nan, np.float32)
    every_status = np.full(shape, Status.NO_SURFACE, np.uint8)
    every_point[where], every_status[where] = points, status
    every_sigma = None
    if sigma is not None:
        every_sigma = np.full(shape, np.nan, np.float32)
        every_sigma[where] = sigma
    return PointCloud(every_point, every_status, grid, sensor, source, baseline, sigma=every_sigma)


def unseen_cloud(geometry: OnGrid, sensor: str, source: str) -> PointCloud:
    """A cloud without a point."""
    nothing = np.empty((0, 0), np.uint8)
    return placed_cloud(np.empty((0, 0, 3)), nothing, None, (0, 0, 0, 0), geometry, sensor, source)
