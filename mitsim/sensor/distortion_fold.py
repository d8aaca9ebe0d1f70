"""Find where a lens distortion folds over: beyond, a pixel shows several directions, so it has no unique ray.

The polynomials of OpenCV's camera models fit the lens inside the calibrated image only. Farther out they may turn back:
a direction farther off the axis then has a pixel nearer to the axis. The model is one-to-one on the directions that a
walk from the axis outward reaches before the Jacobian determinant of the map (x/z, y/z) -> distorted position vanishes
(inverse function theorem). The radius at which it vanishes is the *fold*.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from characterisation.files.arrays import Floats

#: radii [1] at which the determinant is evaluated, and number of directions around the axis
_RADII = np.geomspace(1e-3, 1e2, 600)
_DIRECTIONS = 32


def inverse_fold_radii(distortion: NDArray[np.floating], model: str) -> Floats:
    """Return 1 / radius (32,) of the fold in equal steps of direction around the axis, 0 where there is no fold.

    ``distortion`` in OpenCV's order for the ``model`` ``perspective`` or ``fisheye``. The radius is that of ideal image
    points (x/z, y/z). A tilted imager has no effect: its map is one-to-one.
    """
    return _inverse_fold_radii(np.asarray(distortion, float).ravel().tobytes(), model)


def before_fold(x: Floats, y: Floats, inverse_radii: Floats) -> NDArray[np.bool_]:
    """Return whether ideal image points ``x``, ``y`` (n,) lie before the fold; False for NaN."""
    squared = x * x + y * y
    largest = inverse_radii.max()
    with np.errstate(invalid="ignore", over="ignore"):
        inside = np.asarray(squared * largest**2 < 1)
    uncertain = np.flatnonzero(~inside & np.isfinite(squared))
    if uncertain.size and inverse_radii.min() < largest:
        angle = np.arctan2(y[uncertain], x[uncertain]) * (len(inverse_radii) / (2 * np.pi))
        steps = np.arange(len(inverse_radii) + 1)
        there = np.interp(angle % len(inverse_radii), steps, np.append(inverse_radii, inverse_radii[0]))
        inside[uncertain] = squared[uncertain] * there**2 < 1
    return inside


@lru_cache(maxsize=256)
def _inverse_fold_radii(distortion: bytes, model: str) -> Floats:
    coefficients = np.frombuffer(distortion)
    out = np.zeros(_DIRECTIONS)
    if coefficients.any():
        if model == "fisheye":
            out[:] = _of_fisheye(coefficients)
        else:
            angle = 2 * np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
            x, y = _RADII * np.cos(angle)[:, None], _RADII * np.sin(angle)[:, None]
            out[:] = [_first_zero(_RADII, row) for row in _determinant(coefficients, x, y)]
    out.flags.writeable = False
    return out


def _of_fisheye(coefficients: Floats) -> float:
    """Return 1 / tan(theta) where theta (1 + k1 theta^2 + ... + k4 theta^8) stops to rise; 0 up to 90 deg."""
    theta = np.linspace(0.0, np.pi / 2, 2000)[1:-1]
    rise = 1 + sum((2 * n + 3) * k * theta ** (2 * n + 2) for n, k in enumerate(coefficients))
    return _first_zero(np.tan(theta), rise)


def _first_zero(radii: Floats, values: Floats) -> float:
    """Return 1 / radius of the first sign change of values (n,), between radii linearly; 0 without a change."""
    beyond = np.flatnonzero(~(values > 0))
    if not beyond.size:
        return 0.0
    after = int(beyond[0])
    if after == 0:
        return float(1 / radii[0])
    high, low = values[after - 1], values[after]
    share = high / (high - low) if np.isfinite(low) else 0.0
    return float(1 / (radii[after - 1] + share * (radii[after] - radii[after - 1])))


def _determinant(coefficients: Floats, x: Floats, y: Floats) -> Floats:
    """Return the Jacobian determinant of OpenCV's perspective model; NaN where its denominator is not positive."""
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = np.concatenate([coefficients, np.zeros(12)])[:12]
    r2 = x * x + y * y
    upper, lower = 1 + r2 * (k1 + r2 * (k2 + r2 * k3)), 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
    upper_slope, lower_slope = k1 + r2 * (2 * k2 + r2 * 3 * k3), k4 + r2 * (2 * k5 + r2 * 3 * k6)
    lower = np.where(lower > 0, lower, np.nan)
    radial, slope = upper / lower, (upper_slope * lower - upper * lower_slope) / lower**2
    thin_u, thin_v = s1 + 2 * s2 * r2, s3 + 2 * s4 * r2
    cross = 2 * (x * y * slope + p1 * x + p2 * y)
    u_x = radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x + 2 * x * thin_u
    v_y = radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x + 2 * y * thin_v
    return np.asarray(u_x * v_y - (cross + 2 * y * thin_u) * (cross + 2 * x * thin_v))
