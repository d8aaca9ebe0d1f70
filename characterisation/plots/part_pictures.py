"""Compute the viewer's frame, the edges between shapes, and the places for names in pictures of parts."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from characterisation.files.arrays import Floats

#: share of its colour that remains on the edge of a shape
EDGE_SHADE = 0.55


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
