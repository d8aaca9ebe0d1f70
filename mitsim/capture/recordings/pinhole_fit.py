"""Fit the camera of an organised cloud, and the grid of a cloud that does not state it, to the cloud alone.

The pinhole is that of :mod:`characterisation.pinhole_grid`. Its residual shows whether the cloud has the grid of a
pinhole at the origin with the expected axes, so the user need not state it. Where it does not, the distortion of a lens
(Brown's radial k1, k2, k3 and small tangential p1, p2, as OpenCV has them) is fitted too:

    u = fx (x' (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x' y' + p2 (r^2 + 2 x'^2)) + cx,    x' = x / z,  y' = y / z

Devices that do not rectify their images, such as Zivid's and PhoXi's, have such clouds. The tangential part is bounded,
since a larger one could stand for a turn of the frame.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from characterisation.pinhole_grid import LEAST_POINTS, PINHOLE_RMS_PX, pinhole_of
from mitsim.sensor.camera import Camera
from mitsim.sensor.png import LONGEST_SIDE_PX

#: largest tangential coefficient that is fitted; those of lenses are under 1e-3, and a turn by 0.17 deg has as much
_TANGENTIAL = 1e-3

#: largest radial coefficients that are fitted
_RADIAL = 10.0

#: largest rms residual of a pinhole, over the longer side, that a lens may explain; that of a fisheye lens is 0.1
_BENT_SHARE = 0.2

#: most steps of a fit
_MOST_STEPS = 200

#: points of which a lens or a grid is fitted
_POINTS_USED = 4000

#: steepest view ray of a grid that is looked for, as x / z
_STEEPEST = 10.0

#: narrowest side of a grid that is looked for [px]
_NARROWEST = 16


def fit_pinhole(points: NDArray[np.floating]) -> tuple[Camera, float] | None:
    """Return the camera of points (H, W, 3), NaN where missing, and the rms of its residuals [px].

    It has a distortion only if it would not fit without one, and fits with it. None if
    :func:`characterisation.pinhole_grid.pinhole_of` finds none.
    """
    pinhole = pinhole_of(points)
    if pinhole is None:
        return None
    height, width = points.shape[:2]
    if PINHOLE_RMS_PX < pinhole.rms < _BENT_SHARE * max(height, width):
        bent = _with_lens(points, (pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy))
        if bent is not None and bent[1] <= PINHOLE_RMS_PX:
            return bent
    matrix = np.array([[pinhole.fx, 0.0, pinhole.cx], [0.0, pinhole.fy, pinhole.cy], [0.0, 0.0, 1.0]])
    return Camera(matrix, np.zeros(5), width, height), pinhole.rms


def _with_lens(points: NDArray[np.floating], start: tuple[float, float, float, float]) -> tuple[Camera, float] | None:
    """Return the camera with a distortion, fitted to half of the points, and the rms at the others [px]."""
    height, width = points.shape[:2]
    rows, columns = np.nonzero(np.isfinite(points).all(axis=-1))
    used = np.linspace(0, len(rows) - 1, min(2 * _POINTS_USED, len(rows))).astype(int)
    rows, columns = rows[used], columns[used]
    x, y, z = points[rows, columns].astype(np.float64).T
    a, b = x / z, y / z

    def residuals(values: NDArray[np.float64], part: slice) -> NDArray[np.float64]:
        fx, fy, cx, cy, k1, k2, p1, p2, k3 = values
        x, y = a[part], b[part]
        r2 = x**2 + y**2
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        u = fx * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)) + cx
        v = fy * (y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y) + cy
        return np.concatenate([u - columns[part], v - rows[part]])

    side = float(max(height, width))
    limits = np.array([np.inf] * 4 + [_RADIAL, _RADIAL, _TANGENTIAL, _TANGENTIAL, _RADIAL])
    first = np.array([*start, 0, 0, 0, 0, 0], float)
    scale = np.array([side, side, side, side, 0.1, 0.1, 1e-3, 1e-3, 0.1])
    even = (slice(0, None, 2),)
    try:
        with np.errstate(all="ignore"):
            bounds = (-limits, limits)
            fit = least_squares(residuals, first, args=even, bounds=bounds, x_scale=scale, max_nfev=_MOST_STEPS)
    except ValueError:  # numbers that are not finite
        return None
    fx, fy, cx, cy, *lens = fit.x.tolist()
    if fx <= 0 or fy <= 0:
        return None
    rms = math.sqrt(2 * float(np.mean(residuals(fit.x, slice(1, None, 2)) ** 2)))
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return Camera(matrix, np.array(lens), width, height), rms


def grid_of(points: NDArray[np.floating]) -> tuple[int, int] | None:
    """Return (width, height) [px] of a cloud (n, 3) whose points are in row order, missing ones as NaN or with z = 0.

    Every width that divides n is tried; the grid is the one whose points lie on the view rays of a camera at the
    origin, with either direction of the axes. None if there is none, as of a cloud that omits missing points.
    """
    count = len(points)
    seen = np.isfinite(points).all(axis=-1) & (points[:, 2] != 0)
    indices = np.flatnonzero(seen)
    if len(indices) < LEAST_POINTS:
        return None
    used = indices[np.linspace(0, len(indices) - 1, min(_POINTS_USED, len(indices))).astype(int)]
    x, y, z = points[used].astype(np.float64).T
    if not ((z > 0).all() or (z < 0).all()):
        return None
    y, z = (y, z) if z[0] > 0 else (-y, -z)
    slopes = np.stack([x / z, y / z, np.ones(len(used))], axis=1)
    if np.abs(slopes).max() > _STEEPEST:
        return None
    bend = (slopes[:, :2] ** 2).sum(axis=1)[:, None]
    across, down = (np.concatenate([slopes, slopes[:, [k]] * bend, slopes[:, [k]] * bend**2], axis=1) for k in (0, 1))
    best: tuple[float, tuple[int, int]] | None = None
    for width in range(_NARROWEST, min(count // _NARROWEST, LONGEST_SIDE_PX) + 1):
        if count % width or count // width > LONGEST_SIDE_PX:
            continue
        off = max(_residual(across, used % width), _residual(down, used // width))
        if best is None or off < best[0]:
            best = off, (width, count // width)
    return best[1] if best is not None and best[0] <= _LOOSE_PX else None


#: largest rms residual [px] of the simple lens by which a grid is recognised; a wrong width has tens of pixels or more
_LOOSE_PX = 1.0


def _residual(design: NDArray[np.float64], coordinates: NDArray[np.intp]) -> float:
    """Return the rms [px] of coordinates as a combination of the columns of a design."""
    weights, *_ = np.linalg.lstsq(design, coordinates.astype(float), rcond=None)
    return float(np.sqrt(np.mean((design @ weights - coordinates) ** 2)))


def off_the_rays(points: NDArray[np.floating], camera: Camera) -> float:
    """Return the median distance [px] of points (H, W, 3) [mm], projected by a camera, from their own pixels."""
    rows, columns = np.nonzero(np.isfinite(points).all(axis=-1))
    if len(rows) == 0:
        return float("nan")
    step = max(1, len(rows) // 20_000)
    seen = camera.project(points[rows[::step], columns[::step]])
    off = np.linalg.norm(seen - np.stack([columns, rows], axis=-1)[::step], axis=-1)
    return float(np.median(np.where(np.isnan(off), np.inf, off)))
