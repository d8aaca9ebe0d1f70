"""Compute the viewer's frame, what is seen, the edges between shapes, and places for names in pictures of parts."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from characterisation.files.arrays import Floats

#: share of its colour that remains on the edge of a shape
EDGE_SHADE = 0.55

#: largest distance outside an edge, over the triangle's height, of a pixel that counts as inside: rounding
_ON_EDGE = 1e-9

#: number of pixels that are tested at once; chosen
_AT_ONCE = 1 << 20


def viewer_frame(azimuth: float, elevation: float) -> Floats:
    """Return rows (3, 3): right, up and toward a viewer at an azimuth about z and an elevation below 90 deg [rad]."""
    flat = math.cos(elevation)
    toward = np.array([flat * math.cos(azimuth), flat * math.sin(azimuth), math.sin(elevation)])
    right = np.cross([0.0, 0.0, 1.0], toward)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(toward, right), toward])


def shape_edges(shape: NDArray[np.integer]) -> NDArray[np.bool_]:
    """Return the pixels (rows, columns) whose left or upper neighbour shows another shape."""
    edge = np.zeros(shape.shape, bool)
    edge[:, 1:] |= shape[:, 1:] != shape[:, :-1]
    edge[1:] |= shape[1:] != shape[:-1]
    return edge


def innermost_pixel(mask: NDArray[np.bool_]) -> tuple[int, int]:
    """Return row and column of the pixel of a mask that is farthest from its edges, and from those of the picture."""
    inside = distance_transform_edt(np.pad(mask, 1))[1:-1, 1:-1]
    row, column = np.unravel_index(int(inside.argmax()), inside.shape)
    return int(row), int(column)


def depth_buffer(vertices: Floats, depth: Floats, size: tuple[int, ...]) -> tuple[NDArray[np.int64], Floats]:
    """Return the nearest triangle of every pixel, -1 for none, and its depth, both (rows, columns).

    ``vertices`` (n, 3, 2) [px] of the triangles, ``depth`` (n, 3), larger is nearer; ``size`` is (columns, rows).
    """
    columns, rows = size
    index, nearest = np.full(rows * columns, -1, np.int64), np.full(rows * columns, -np.inf)
    low = np.maximum(np.ceil(vertices.min(axis=1)), 0).astype(int)
    high = np.minimum(np.floor(vertices.max(axis=1)), [columns - 1, rows - 1]).astype(int)
    (ax, ay), (bx, by), (cx, cy) = vertices.transpose(1, 2, 0)
    area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
    height = np.where((high >= low).all(axis=1) & (np.abs(area) >= 1e-12), high[:, 1] - low[:, 1] + 1, 0)
    triangle, row = _counted(height)  # most triangles of a fine mesh lie between pixels
    row += low[triangle, 1]
    left, right = low[triangle, 0].astype(float), high[triangle, 0].astype(float)
    # a long triangle has few pixels of its box: in each row those between its edges, and a few more
    for (px, py), (qx, qy) in (((bx, by), (cx, cy)), ((cx, cy), (ax, ay)), ((ax, ay), (bx, by))):
        rise = (py - qy)[triangle]
        with np.errstate(divide="ignore", invalid="ignore"):
            end = (py[triangle] - row) * qx[triangle] - (qy[triangle] - row) * px[triangle]
            end = (end - 2 * _ON_EDGE * area[triangle]) / rise
        left = np.where(rise * area[triangle] > 0, np.maximum(left, np.floor(end) - 1), left)
        right = np.where(rise * area[triangle] < 0, np.minimum(right, np.ceil(end) + 1), right)
    width = np.maximum(right - left + 1, 0).astype(int)
    ends = np.cumsum(width)
    for part in np.split(np.arange(len(width)), np.flatnonzero(np.diff(ends // _AT_ONCE)) + 1):
        span, offset = _counted(width[part])
        t, x, y = triangle[part][span], left[part][span].astype(int) + offset, row[part][span]
        first = ((bx[t] - x) * (cy[t] - y) - (cx[t] - x) * (by[t] - y)) / area[t]
        second = ((cx[t] - x) * (ay[t] - y) - (ax[t] - x) * (cy[t] - y)) / area[t]
        third = 1 - first - second
        inside = np.minimum(np.minimum(first, second), third) >= -_ON_EDGE
        here = first * depth[t, 0] + second * depth[t, 1] + third * depth[t, 2]
        here, t, pixel = here[inside], t[inside], (y * columns + x)[inside]
        order = np.lexsort((-t, here, pixel))
        last = order[np.diff(pixel[order], append=-1) != 0]  # the nearest of each pixel
        won = last[here[last] > nearest[pixel[last]]]
        nearest[pixel[won]], index[pixel[won]] = here[won], t[won]
    return index.reshape(rows, columns), nearest.reshape(rows, columns)


def _counted(counts: NDArray[np.integer]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the index of every item of groups with some ``counts``, and its place in its group."""
    index = np.repeat(np.arange(len(counts)), counts)
    return index, np.arange(len(index)) - np.repeat(np.cumsum(counts) - counts, counts)
