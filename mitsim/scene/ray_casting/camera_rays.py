"""Make the rays of a camera: from a position in the image and in the lens to a ray.

Signal chain: pixel -> direction in the camera frame (OpenCV's model, exact at pixel corners) -> point on the plane of
sharp focus -> ray toward it from a position in the aperture.

The camera may be any smooth function from pixels to rays. The kernel has the directions at pixel corners and
interpolates inside the pixel. The error is below 3e-4 px for the strongest distortion of the presets, in the corners of
the image.

A thin lens in focus at depth z_f images a point at depth z as a disc of diameter D f |1/z - 1/z_f| px. Here D is the
diameter of the lens [mm] and f the focal length [px].
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline, make_interp_spline
from scipy.sparse import csr_array

from characterisation.files.errors import InputError
from characterisation.region_of_interest import Roi
from mitsim.scene.backend import dr, mi
from mitsim.scene.device import opaque_index, to_device
from mitsim.scene.ray_casting.distortion import Distortion
from mitsim.sensor.camera import Camera

#: spacing of the grid on which the rays of two calibrations are compared [px]
_GRID_PX = 8


class CameraRays:
    """The rays of a camera, in a table on the device.

    - ``distortion``: its forward model, from direction to pixel.
    - ``aperture_mm``: diameter of the entrance pupil, 0 for a pinhole; ``focus_mm``: depth of the plane of sharp focus.
    - ``x``, ``y``: ideal image coordinates x/z and y/z at the pixel corners, row by row, (H + 1)(W + 1) each.

    Raises
    ------
    InputError
        If the aperture is negative or the focus is not positive.
    """

    def __init__(self, camera: Camera, aperture_mm: float = 0.0, focus_mm: float = np.inf) -> None:
        if aperture_mm < 0 or not focus_mm > 0:
            raise InputError("camera", "aperture_mm, focus_mm", (aperture_mm, focus_mm), "0 or more; over 0")
        self.camera = camera
        self.distortion = Distortion(camera)
        self.aperture_mm, self.focus_mm = float(aperture_mm), float(focus_mm)
        self.x, self.y = _ideal_corners(camera)
        self._corners_in_row = opaque_index(camera.width + 1)

    def recalibrated(self, camera: Camera) -> CameraRays:
        """Return the rays of a camera of the same size whose calibration differs a little from this one's.

        The difference is smooth, so it is computed on a coarse grid of corners and interpolated by cubic splines. For a
        camera of two megapixels this takes 20 ms, where a new table takes a second.
        """
        other = copy.copy(self)
        other.camera = camera
        if np.array_equal(camera.matrix, self.camera.matrix) and np.array_equal(
            camera.distortion, self.camera.distortion
        ):
            return other
        other.distortion = Distortion(camera)
        down, across = (_spline(size + 1, _GRID_PX) for size in (camera.height, camera.width))
        before, after = _at_knots(self.camera), _ideal_at_knots(camera)
        differences = [
            down.coefficients @ component @ across.coefficients.T for component in np.moveaxis(after - before, -1, 0)
        ]
        dx, dy = (down.basis @ (across.basis @ difference.T).T for difference in differences)
        other.x = self.x + to_device(np.ravel(dx))
        other.y = self.y + to_device(np.ravel(dy))
        dr.eval(other.x, other.y)
        return other

    @property
    def whole(self) -> Roi:
        """The region of the whole image."""
        return Roi.whole(self.camera.width, self.camera.height)

    def corners(self, column: Any, row: Any) -> tuple[list[Any], list[Any]]:
        """Return x/z and y/z at the four corners of pixels: upper left, upper right, lower left, lower right."""
        corner = row * self._corners_in_row + column
        below = corner + self._corners_in_row
        indices = [corner, corner + 1, below, below + 1]
        return [dr.gather(mi.Float, self.x, i) for i in indices], [dr.gather(mi.Float, self.y, i) for i in indices]


@lru_cache(maxsize=16)  # up to 0.6 s for all pixels of a camera, and 26 MB; a choice of sensors asks for many
def _ideal_corners(camera: Camera) -> tuple[Any, Any]:
    """Return the ideal image coordinates x/z and y/z at the pixel corners, row by row."""
    columns, rows = np.meshgrid(np.arange(camera.width + 1) - 0.5, np.arange(camera.height + 1) - 0.5)
    rays = camera.rays_to_fold(np.stack([columns, rows], axis=-1))
    return tuple(to_device(np.ravel(rays[..., i] / rays[..., 2])) for i in (0, 1))


def bilinear(corners: list[Any], a: Any, b: Any) -> Any:
    """Interpolate between the four corners of a pixel; (a, b) is in the unit square, from the upper left corner."""
    return dr.lerp(dr.lerp(corners[0], corners[1], a), dr.lerp(corners[2], corners[3], a), b)


def pixel_area(x: list[Any], y: list[Any]) -> Any:
    """Return the area of a pixel on z = 1, half the cross product of its diagonals; positive also on a fold."""
    return dr.maximum(0.5 * dr.abs((x[3] - x[0]) * (y[2] - y[1]) - (x[2] - x[1]) * (y[3] - y[0])), 1e-20)


@dataclass(frozen=True)
class _Spline:
    """A cubic spline from ``knots`` (k,) to integers: B-spline ``coefficients`` (k, k) and ``basis`` (n, k)."""

    knots: NDArray[np.float64]
    coefficients: NDArray[np.float64]
    basis: csr_array


def _ideal_at_knots(camera: Camera) -> NDArray[np.float64]:
    """Return the ideal image coordinates (k, m, 2) at the knots of the grid on which calibrations are compared."""
    down, across = (_spline(size + 1, _GRID_PX) for size in (camera.height, camera.width))
    columns, rows = np.meshgrid(across.knots - 0.5, down.knots - 0.5)
    rays = camera.rays_to_fold(np.stack([columns, rows], axis=-1))
    return np.asarray(rays[..., :2] / rays[..., 2:])


_at_knots = lru_cache(maxsize=16)(_ideal_at_knots)  # of the calibration that others are compared with


@cache
def _spline(count: int, spacing: int) -> _Spline:
    """Return the spline through about equidistant knots from 0 to ``count`` - 1, at the integers between."""
    knots = np.linspace(0, count - 1, max(4, -(-(count - 1) // spacing) + 1))
    interpolant = make_interp_spline(knots, np.eye(len(knots)), k=3)
    basis = BSpline.design_matrix(np.arange(count, dtype=float), interpolant.t, 3)
    return _Spline(knots, np.asarray(interpolant.c), csr_array(basis))
