"""Decoded points of a region, put into an organised cloud of the whole grid.

Decoding a region gives the same points as decoding the whole image and cutting the region out, but for a margin at its
edges that each decoder states.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from characterisation.point_cloud import PointCloud, Status, ViewGrid
from mitsim.sensor.roi import Roi


class OnGrid(Protocol):
    """What a decoder prepares once from a rig: it has at least the ``grid`` and ``baseline`` (3,) of its clouds."""

    @property
    def grid(self) -> ViewGrid:
        """Pixels of the cloud."""

    @property
    def baseline(self) -> NDArray[np.float64]:
        """Unit vector from the first camera to the second camera or the projector, in the sensor frame."""


def placed_cloud(
    points: NDArray[np.floating],
    status: NDArray[np.uint8],
    sigma: NDArray[np.floating] | None,
    roi: Roi,
    geometry: OnGrid,
    sensor: str,
    source: str,
) -> PointCloud:
    """Return a cloud of the whole grid with the points (h, w, 3), status and sigma of a region; else ``NO_SURFACE``."""
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
    where, shape = roi.slices, (grid.height, grid.width)
    every_point = np.full((*shape, 3), np.nan, np.float32)
    every_status = np.full(shape, Status.NO_SURFACE, np.uint8)
    every_point[where], every_status[where] = points, status
    every_sigma = None
    if sigma is not None:
        every_sigma = np.full(shape, np.nan, np.float32)
        every_sigma[where] = sigma
    return PointCloud(every_point, every_status, grid, sensor, source, baseline, sigma=every_sigma)


def unseen_cloud(geometry: OnGrid, sensor: str, source: str) -> PointCloud:
    """Return a cloud without points."""
    nothing = np.empty((0, 0), np.uint8)
    return placed_cloud(np.empty((0, 0, 3)), nothing, None, Roi(0, 0, 0, 0), geometry, sensor, source)
