"""Apply the distortion of a camera on the device, by both models of OpenCV.

Signal chain: ideal image point (x/z, y/z) -> lens distortion -> pixel (column, row).

Projected light, and light paths that are traced from the projector to a camera, need this direction, from space to
pixel. :mod:`mitsim.scene.ray_casting.camera_rays` tabulates the inverse, from pixel to ray.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mitsim.scene.backend import dr
from mitsim.scene.device import opaque
from mitsim.sensor.camera import Camera
from mitsim.sensor.distortion_fold import inverse_fold_radii

#: largest radius that is projected, over the ideal radius of the farthest corner. Beyond it, a distortion polynomial
#: may fold back into the image
_BEYOND = 1.02


class Distortion:
    """OpenCV's forward camera model on the device: from ideal image point to pixel.

    The perspective model has the coefficients k1..k6 (rational radial), p1 p2 (tangential), s1..s4 (thin prism) and tx
    ty (tilt): OpenCV, module calib3d. The fisheye model has k1..k4 (Kannala and Brandt, IEEE TPAMI 28, 2006).
    """

    def __init__(self, optics: Camera) -> None:
        k = optics.matrix
        self.border = ideal_border(optics)
        fold = inverse_fold_radii(optics.distortion, optics.model).max()
        self.reach = min(float(np.linalg.norm(self.border, axis=1).max()) * _BEYOND, 1 / fold if fold else np.inf)
        coefficients = np.concatenate([optics.distortion, np.zeros(14)])[:14]
        homography = _tilt(*coefficients[12:])
        self._fisheye, self._distorted = optics.model == "fisheye", bool(coefficients.any())
        self._focal, self._principal = [opaque(k[i, i]) for i in (0, 1)], [opaque(c) for c in k[:2, 2]]
        self._coefficients = [opaque(c) for c in coefficients[:12]]
        self._tilt = None if homography is None else [[opaque(h) for h in row] for row in homography]
        self._tilt_area = opaque(1.0 if homography is None else float(np.linalg.det(homography)))
        self._last = [opaque(n - 0.5) for n in (optics.width, optics.height)]
        self._reach_squared = opaque(self.reach**2)

    def pixel(self, x: Any, y: Any) -> tuple[Any, Any]:
        """Return the pixel (column, row) of the ideal image point (x, y)."""
        if self._fisheye:
            x, y = self._equidistant(x, y)
        elif self._distorted:
            x, y = self._perspective(x, y)
        return self._focal[0] * x + self._principal[0], self._focal[1] * y + self._principal[1]

    def image(self, x: Any, y: Any, active: Any) -> tuple[Any, Any, Any]:
        """Return the pixel (column, row) of the ideal image point (x, y), and whether it lies in the image."""
        near = active & (dr.square(x) + dr.square(y) < self._reach_squared)
        u, v = self.pixel(x, y)
        return u, v, near & (u > -0.5) & (u < self._last[0]) & (v > -0.5) & (v < self._last[1])

    def stretch(self, x: Any, y: Any) -> Any:
        """Return the area of the image of a small area at the ideal image point (x, y), 1 without distortion [1].

        It is the determinant of the derivative of the distorted by the ideal point.
        """
        if self._fisheye:
            k1, k2, k3, k4 = self._coefficients[:4]
            radius = dr.maximum(dr.sqrt(x * x + y * y), 1e-6)
            theta = dr.atan(radius)
            t2 = theta * theta
            bent = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
            slope = 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))
            return dr.abs(bent / radius * slope / (1 + radius * radius))
        k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = self._coefficients
        r2 = x * x + y * y
        above, below = 1 + r2 * (k1 + r2 * (k2 + r2 * k3)), 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
        radial = above / below
        by_r2 = (k1 + r2 * (2 * k2 + r2 * 3 * k3) - radial * (k4 + r2 * (2 * k5 + r2 * 3 * k6))) / below
        prism_x, prism_y = 2 * (s1 + 2 * r2 * s2), 2 * (s3 + 2 * r2 * s4)
        shared = 2 * (x * y * by_r2 + p1 * x + p2 * y)
        xx = radial + 2 * x * x * by_r2 + 2 * p1 * y + 6 * p2 * x + x * prism_x
        yy = radial + 2 * y * y * by_r2 + 6 * p1 * y + 2 * p2 * x + y * prism_y
        area = xx * yy - (shared + y * prism_x) * (shared + x * prism_y)
        if self._tilt is not None:
            t, (x, y) = self._tilt, self._perspective(x, y, tilted=False)
            w = t[2][0] * x + t[2][1] * y + t[2][2]
            area = area * self._tilt_area / (w * w * w)
        return dr.abs(area)

    def _equidistant(self, x: Any, y: Any) -> tuple[Any, Any]:
        k1, k2, k3, k4 = self._coefficients[:4]
        radius = dr.sqrt(x * x + y * y)
        theta = dr.atan(radius)
        t2 = theta * theta
        scale = dr.select(
            radius > 1e-6, theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))) / dr.maximum(radius, 1e-6), 1.0
        )
        return x * scale, y * scale

    def _perspective(self, x: Any, y: Any, tilted: bool = True) -> tuple[Any, Any]:
        k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = self._coefficients
        r2 = x * x + y * y
        radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        x, y = (
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + r2 * (s1 + r2 * s2),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y + r2 * (s3 + r2 * s4),
        )
        if tilted and self._tilt is not None:
            t = self._tilt
            w = t[2][0] * x + t[2][1] * y + t[2][2]
            x, y = (t[0][0] * x + t[0][1] * y + t[0][2]) / w, (t[1][0] * x + t[1][1] * y + t[1][2]) / w
        return x, y


def _tilt(tx: float, ty: float) -> list[list[float]] | None:
    """Return the homography of an imager tilted by ``tx``, ``ty`` [rad] about x and y, OpenCV's tauX and tauY."""
    if tx == 0 and ty == 0:
        return None
    about_x = np.array([[1, 0, 0], [0, np.cos(tx), np.sin(tx)], [0, -np.sin(tx), np.cos(tx)]])
    about_y = np.array([[np.cos(ty), 0, -np.sin(ty)], [0, 1, 0], [np.sin(ty), 0, np.cos(ty)]])
    R = about_y @ about_x
    project = np.array([[R[2, 2], 0, -R[0, 2]], [0, R[2, 2], -R[1, 2]], [0, 0, 1]])
    return [[float(value) for value in row] for row in project @ R]


def ideal_border(optics: Camera) -> NDArray[np.float64]:
    """Return ideal image points (260, 2) along the border of an image, or of the fold before it, 65 on each side."""
    columns, rows = np.linspace(-0.5, optics.width - 0.5, 65), np.linspace(-0.5, optics.height - 0.5, 65)
    border = np.concatenate(
        [
            np.stack([columns, np.full(65, -0.5)], 1),
            np.stack([columns, np.full(65, optics.height - 0.5)], 1),
            np.stack([np.full(65, -0.5), rows], 1),
            np.stack([np.full(65, optics.width - 0.5), rows], 1),
        ]
    )
    rays = optics.rays_to_fold(border)
    return np.asarray(rays[:, :2] / rays[:, 2:])
