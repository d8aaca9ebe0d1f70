"""Insert the decoded points of a region into an organised cloud of the whole grid.

A decoded region has the same points as the same region of the whole decoded image. Each decoder states how far from the
edges of a region its points may differ.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from characterisation.point_cloud import PointCloud, Status, ViewGrid
from characterisation.region_of_interest import Roi


class GridGeometry(Protocol):
    """Geometry that a decoder prepares once from a rig, with at least ``grid`` and ``baseline``."""

    @property
    def grid(self) -> ViewGrid:
        """Pixels of the cloud."""

    @property
    def baseline(self) -> NDArray[np.float64]:
        """(3,) unit vector from the first camera to the second camera or the projector, in the sensor frame."""


def cloud_on_grid(
    points: NDArray[np.floating],
    status: NDArray[np.uint8],
    sigma: NDArray[np.floating] | None,
    roi: Roi,
    geometry: GridGeometry,
    sensor: str,
    source: str,
) -> PointCloud:
    """Return a cloud of the whole grid with the results of a region; pixels outside are ``NO_SURFACE``.

    - ``points``: (h, w, 3) in the sensor frame [mm].
    - ``status``: (h, w) of :class:`~characterisation.point_cloud.Status`.
    - ``sigma``: (h, w) standard deviation along the view ray [mm], or None.
    - ``roi``: the region; it is ignored if ``status`` has the size of the grid.
    - ``geometry``: grid and baseline of the cloud.
    - ``sensor``, ``source``: copied into the cloud.
    """
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
    region, shape = roi.slices, (grid.height, grid.width)
    all_points = np.full((*shape, 3), np.nan, np.float32)
    all_status = np.full(shape, Status.NO_SURFACE, np.uint8)
    all_points[region], all_status[region] = points, status
    all_sigma = None
    if sigma is not None:
        all_sigma = np.full(shape, np.nan, np.float32)
        all_sigma[region] = sigma
    return PointCloud(all_points, all_status, grid, sensor, source, baseline, sigma=all_sigma)


def empty_cloud(geometry: GridGeometry, sensor: str, source: str) -> PointCloud:
    """Return a cloud without points."""
    no_pixels = np.empty((0, 0), np.uint8)
    return cloud_on_grid(np.empty((0, 0, 3)), no_pixels, None, Roi(0, 0, 0, 0), geometry, sensor, source)
