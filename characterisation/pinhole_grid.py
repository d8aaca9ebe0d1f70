"""The pinhole whose pixels an organised cloud was measured in, from the cloud alone.

If point (x, y, z) of the pixel in column u and row v lies on the view ray of a pinhole at the origin, then

    u = fx x / z + cx,    v = fy y / z + cy

which are two straight lines through all points, fitted by least squares. Clouds that a device made of a depth image
satisfy them to rounding.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

#: residual, rms, up to which a cloud is one of a pinhole [px]; assumed: rounding makes 1e-4, lens distortion 1 and more
PINHOLE_RMS_PX = 0.05

#: least number of points that a fit is believed from
LEAST_POINTS = 1000


@dataclass(frozen=True)
class Pinhole:
    """Focal lengths ``fx, fy`` and principal point ``cx, cy`` [px], and the ``rms`` of the residuals [px]."""

    fx: float
    fy: float
    cx: float
    cy: float
    rms: float


def pinhole_of(points: NDArray[np.floating]) -> Pinhole | None:
    """Fit a pinhole at the origin to points (H, W, 3) [mm], NaN where missing.

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
    return Pinhole(float(fx), float(fy), float(cx), float(cy), float(np.sqrt(error_x + error_y)))
