"""Find the pinhole camera of an organised cloud from its points alone.

If point (x, y, z) of the pixel in column u and row v lies on the view ray of a pinhole at the origin, then

    u = fx x / z + cx,    v = fy y / z + cy

These are two straight lines, fitted by least squares. Clouds that a device computes from a depth image satisfy them to
rounding.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

#: largest rms residual [px] of a pinhole's cloud; assumed: rounding gives 1e-4 px, lens distortion 1 px or more
PINHOLE_RMS_PX = 0.05

#: fewest points for a credible fit
LEAST_POINTS = 1000


@dataclass(frozen=True)
class Pinhole:
    """Pinhole with focal lengths ``fx, fy``, principal point ``cx, cy`` and ``rms`` residual, all in [px]."""

    fx: float
    fy: float
    cx: float
    cy: float
    rms: float


def pinhole_of(points: NDArray[np.floating]) -> Pinhole | None:
    """Fit a pinhole at the origin to points (H, W, 3) [mm], NaN where missing.

    Return None if the points are too few or do not spread over the image, or if they are mirrored or behind the camera.
    """
    rows, columns = np.nonzero(np.isfinite(points).all(axis=-1))
    x, y, z = points[rows, columns].astype(np.float64).T
    if len(z) < LEAST_POINTS or not (z > 0).all():
        return None
    lines = []
    for slope, pixels in ((x / z, columns), (y / z, rows)):
        if np.ptp(slope) < 1e-6 or np.ptp(pixels) < 8:
            return None
        design = np.stack([slope, np.ones(len(z))], axis=1)
        (focal, centre), *_ = np.linalg.lstsq(design, pixels.astype(float), rcond=None)
        lines.append((focal, centre, float(np.mean((design @ [focal, centre] - pixels) ** 2))))
    (fx, cx, error_x), (fy, cy, error_y) = lines
    if fx <= 0 or fy <= 0:
        return None
    return Pinhole(float(fx), float(fy), float(cx), float(cy), float(np.sqrt(error_x + error_y)))
