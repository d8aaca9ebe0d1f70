"""The camera that an organised cloud was seen by, from the cloud alone.

If point (x, y, z) of the pixel in column u and row v lies on the view ray of a pinhole at the origin, then

    u = fx x / z + cx,    v = fy y / z + cy

which are two straight lines through all points, fitted by least squares. Clouds that a device made of a depth image
satisfy them to rounding: their residual says whether the cloud has a pinhole's grid, its eye at the origin and its axes
in order, and nothing need be asked.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mitsim.sensor.camera import Camera

#: residual, rms, up to which a cloud is one of a pinhole [px]; assumed: rounding makes 1e-4, lens distortion 1 and more
PINHOLE_RMS_PX = 0.05

#: least number of points that a fit is believed from
LEAST_POINTS = 1000


def fit_pinhole(points: NDArray[np.floating]) -> tuple[Camera, float] | None:
    """Pinhole of points (H, W, 3), NaN where missing, and the rms of its residuals [px].

    None if there are too few points, they do not spread over the image, or no camera sees them so: mirrored, or behind.
    """
    rows, columns = np.nonzero(np.isfinite(points).all(axis=-1))
    x, y, z = points[rows, columns].astype(np.float64).T
    if len(z) < LEAST_POINTS or not (z > 0).all():
        return None
    lines = []
    for slope, place in ((x / z, columns), (y / z, rows)):
        if np.ptp(slope) < 1e-6 or np.ptp(place) < 8:
            return None
        design = np.stack([slope, np.ones(len(z))], axis=1)
        (focal, centre), *_ = np.linalg.lstsq(design, place.astype(float), rcond=None)
        lines.append((focal, centre, float(np.mean((design @ [focal, centre] - place) ** 2))))
    (fx, cx, error_x), (fy, cy, error_y) = lines
    if fx <= 0 or fy <= 0:
        return None
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    height, width = points.shape[:2]
    return Camera(matrix, np.zeros(5), width, height), float(np.sqrt(error_x + error_y))


def off_the_rays(points: NDArray[np.floating], camera: Camera) -> float:
    """Median distance [px] of the points (H, W, 3) [mm], projected by a camera, from their own pixels."""
    rows, columns = np.nonzero(np.isfinite(points).all(axis=-1))
    if len(rows) == 0:
        return float("nan")
    step = max(1, len(rows) // 20_000)
    seen = camera.project(points[rows[::step], columns[::step]])
    off = np.linalg.norm(seen - np.stack([columns, rows], axis=-1)[::step], axis=-1)
    return float(np.median(np.where(np.isnan(off), np.inf, off)))
