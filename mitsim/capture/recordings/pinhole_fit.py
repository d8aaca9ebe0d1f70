"""Fit the camera of an organised cloud to the cloud alone.

The fit is that of :mod:`characterisation.pinhole_grid`. Its residual shows whether the cloud has the grid of a pinhole
at the origin with the expected axes, so the user need not state it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from characterisation.pinhole_grid import LEAST_POINTS, PINHOLE_RMS_PX, pinhole_of
from mitsim.sensor.camera import Camera

__all__ = ["LEAST_POINTS", "PINHOLE_RMS_PX", "fit_pinhole", "off_the_rays"]


def fit_pinhole(points: NDArray[np.floating]) -> tuple[Camera, float] | None:
    """Return the pinhole of points (H, W, 3), NaN where missing, and the rms of its residuals [px].

    None if :func:`characterisation.pinhole_grid.pinhole_of` finds none.
    """
    found = pinhole_of(points)
    if found is None:
        return None
    matrix = np.array([[found.fx, 0.0, found.cx], [0.0, found.fy, found.cy], [0.0, 0.0, 1.0]])
    height, width = points.shape[:2]
    return Camera(matrix, np.zeros(5), width, height), found.rms


def off_the_rays(points: NDArray[np.floating], camera: Camera) -> float:
    """Return the median distance [px] of points (H, W, 3) [mm], projected by a camera, from their own pixels."""
    rows, columns = np.nonzero(np.isfinite(points).all(axis=-1))
    if len(rows) == 0:
        return float("nan")
    step = max(1, len(rows) // 20_000)
    seen = camera.project(points[rows[::step], columns[::step]])
    off = np.linalg.norm(seen - np.stack([columns, rows], axis=-1)[::step], axis=-1)
    return float(np.median(np.where(np.isnan(off), np.inf, off)))
