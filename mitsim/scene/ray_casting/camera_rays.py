"""A camera prepared for tracing: from a place in the image and in the lens to a ray.

Signal chain: pixel -> direction in the camera frame (OpenCV's model, exact at pixel corners) -> point on the plane of
sharp focus -> ray from a place in the aperture toward it.

The camera is any smooth map from pixels to rays: the kernel sees directions at pixel corners and interpolates inside
the pixel (error under 3e-4 px for the strongest distortion of our presets, in the corners of the image). A thin lens
in focus at depth z_f images a point at depth z as a disc of diameter D f |1/z - 1/z_f| px.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline, make_interp_spline
from scipy.sparse import csr_array

from mitsim.errors import InputError
from mitsim.scene.backend import dr, mi
from mitsim.scene.ray_casting.distortion import Distortion
from mitsim.sensor.camera import Camera
from mitsim.sensor.roi import Roi

#: spacing of the raster on which the rays of two calibrations are compared [px]
_RASTER_PX = 8


class CameraRays:
    """A camera whose ray table lies on the device, and is laid there once.

    ``aperture_mm`` diameter of the entrance pupil, 0 for a pinhole; ``focus_mm`` depth of the plane of sharp focus.
    """

    def __init__(self, camera: Camera, aperture_mm: float = 0.0, focus_mm: float = np.inf) -> None:
        if aperture_mm < 0 or not focus_mm > 0:
            raise InputError("camera", "aperture_mm, focus_mm", (aperture_mm, focus_mm), "0 or more; over 0")
        columns, rows = np.meshgrid(np.arange(camera.width + 1) - 0.5, np.arange(camera.height + 1) - 0.5)
        rays = camera.rays(np.stack([columns, rows], axis=-1))
        self.camera = camera
        self.bend = Distortion(camera)
        self.aperture_mm, self.focus_mm = float(aperture_mm), float(focus_mm)
        self.x = mi.Float(np.ravel(rays[..., 0] / rays[..., 2]).astype(np.float32))
        self.y = mi.Float(np.ravel(rays[..., 1] / rays[..., 2]).astype(np.float32))

    def moved(self, camera: Camera) -> CameraRays:
        """The rays of a camera of the same size whose calibration differs a little from this one's.

        The difference of the two is smooth, so it is worked out on a raster of corners and interpolated: the table of
        a camera of two megapixels is laid out in 20 ms rather than in a second.
        """
        other = copy.copy(self)
        other.camera = camera
        if np.array_equal(camera.matrix, self.camera.matrix) and np.array_equal(
            camera.distortion, self.camera.distortion
        ):
            return other
        other.bend = Distortion(camera)
        down, across = (_spline(size + 1, _RASTER_PX) for size in (camera.height, camera.width))
        columns, rows = np.meshgrid(across.knots - 0.5, down.knots - 0.5)
        places = np.stack([columns, rows], axis=-1)
        before, after = (rays[..., :2] / rays[..., 2:] for rays in (self.camera.rays(places), camera.rays(places)))
        bends = [down.coefficients @ one @ across.coefficients.T for one in np.moveaxis(after - before, -1, 0)]
        dx, dy = (down.basis @ (across.basis @ bend.T).T for bend in bends)
        other.x = self.x + mi.Float(np.ravel(dx).astype(np.float32))
        other.y = self.y + mi.Float(np.ravel(dy).astype(np.float32))
        dr.eval(other.x, other.y)
        return other

    @property
    def whole(self) -> Roi:
        """The whole image."""
        return Roi.whole(self.camera.width, self.camera.height)

    def corners(self, column: Any, row: Any) -> tuple[list[Any], list[Any]]:
        """Ideal image points x/z and y/z at the four corners of pixels."""
        corner = row * (self.camera.width + 1) + column
        below = corner + self.camera.width + 1
        places = [corner, corner + 1, below, below + 1]
        return [dr.gather(mi.Float, self.x, p) for p in places], [dr.gather(mi.Float, self.y, p) for p in places]


def between(corners: list[Any], a: Any, b: Any) -> Any:
    """Bilinear between a pixel's four corners, (a, b) in the unit square from the upper left."""
    return dr.lerp(dr.lerp(corners[0], corners[1], a), dr.lerp(corners[2], corners[3], a), b)


def pixel_area(x: list[Any], y: list[Any]) -> Any:
    """Area of a pixel on the plane z = 1, from its four corners: half the cross product of its diagonals."""
    return 0.5 * dr.abs((x[3] - x[0]) * (y[2] - y[1]) - (x[2] - x[1]) * (y[3] - y[0]))


@dataclass(frozen=True)
class _Spline:
    """A cubic spline from ``knots`` (k,) to whole numbers: ``coefficients`` (k, k) of its basis, ``basis`` (n, k)."""

    knots: NDArray[np.float64]
    coefficients: NDArray[np.float64]
    basis: csr_array


@cache
def _spline(count: int, spacing: int) -> _Spline:
    """The spline through knots among 0 to count - 1, about ``spacing`` apart; four of its basis reach a place."""
    knots = np.linspace(0, count - 1, max(4, -(-(count - 1) // spacing) + 1))
    through = make_interp_spline(knots, np.eye(len(knots)), k=3)
    basis = BSpline.design_matrix(np.arange(count, dtype=float), through.t, 3)
    return _Spline(knots, np.asarray(through.c), csr_array(basis))
