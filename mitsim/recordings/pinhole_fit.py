"""The camera that an organised cloud was seen by, from the cloud alone.

The fit is that of :mod:`characterisation.pinhole_grid`. Its residual says whether the cloud has a pinhole's grid, its
eye at the origin and its axes in order, and nothing need be asked.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from characterisation.pinhole_grid import LEAST_POINTS, PINHOLE_RMS_PX, pinhole_of
from mitsim.sensor.camera import Camera

__all__ = ["LEAST_POINTS", "PINHOLE_RMS_PX", "fit_pinhole", "off_the_rays"]


def fit_pinhole(points: NDArray[np.floating]) -> tuple[Camera, float] | None:
    """Pinhole of points (H, W, 3), NaN where missing, and the rms of its residuals [px].

    None where :func:`characterisation.pinhole_grid.pinhole_of` finds none.
    """
    found = pinhole_of(points)
    if found is None:
        return None
    matrix = np.array([[found.fx, 0.0, found.cx], [0.0, found.fy, found.cy], [0.0, 0.0, 1.0]])
    height, width = points.shape[:2]
    return Camera(matrix, np.zeros(5), width, height), found.rms


def off_the_rays(points: NDArray[np.floating], camera: Camera) -> float:
    """Median distance [px] of the points (H, W, 3) [mm], projected by a camera, from their own pixels."""
    rows, columns = np.nonzero(np.isfinite(points).all(axis=-1))
    if len(rows) == 0:
        return float("nan")
    step = max(1, len(rows) // 20_000)
    seen = camera.project(points[rows[::step], columns[::step]])
    off = np.linalg.norm(seen - np.stack([columns, rows], axis=-1)[::step], axis=-1)
    return float(np.median(np.where(np.isnan(off), np.inf, off)))
