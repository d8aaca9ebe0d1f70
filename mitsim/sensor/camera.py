"""Project points to pixels and pixels to rays with OpenCV's camera models, exactly in both directions.

Signal chain: direction in the camera frame -> ideal image point (x/z, y/z) -> lens distortion -> pixel. A projector
is a camera whose pixels emit light instead of receiving it; it uses the same class.

Distortion coefficients are in OpenCV's order (k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4 tx ty), 0 to 14 of them, or the four
of its fisheye model. Pixel centres lie at integers.

Far outside the calibrated image a distortion may fold over (:mod:`mitsim.sensor.distortion_fold`). Directions beyond
the fold have no pixel, and pixels without a direction before it have no ray: both are NaN.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from characterisation.files.errors import InputError
from characterisation.files.threads import in_threads
from mitsim.sensor.distortion_fold import before_fold, inverse_fold_radii
from mitsim.sensor.transforms import Transform

# OpenCV's default stops after 5 steps, up to 0.013 px from the solution on real lenses
_EXACT = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 200, 1e-12)

#: largest error of OpenCV's centre of a rectified image that is accepted, as a share of the image width
LOST_SHARE = 0.1

#: largest distance [px] of a pixel from the projection of its ray
_ROUND_TRIP_PX = 1e-6

#: steps from the axis to a pixel in which the ray is found where OpenCV's iteration fails; chosen
_STEPS = 12

#: Newton steps at each of them, and four times as many at the last, which must be exact; chosen
_NEWTON_STEPS = 5

#: points projected at once, to stay in the processor's cache: OpenCV also computes derivatives, 400 bytes per point
_TOGETHER = 1 << 14


@dataclass(frozen=True, eq=False)
class Camera:
    """Intrinsics and pose of one camera or projector.

    ``matrix`` is K (3, 3) [px]; ``distortion`` (n,) [1]; ``width`` x ``height`` [px]; ``sensor_from_camera`` takes
    camera coordinates to the sensor frame [mm]; ``model`` is ``perspective`` or ``fisheye``. Cameras with equal values
    are equal, so tables of pixels can be kept by camera.
    """

    matrix: NDArray[np.float64]
    distortion: NDArray[np.float64]
    width: int
    height: int
    sensor_from_camera: Transform = field(default_factory=Transform.identity)
    model: str = "perspective"

    def __post_init__(self) -> None:
        if self.model not in ("perspective", "fisheye"):
            raise ValueError(f"camera model {self.model!r}: allowed are perspective, fisheye")

    def _values(self) -> tuple[object, ...]:
        pose = self.sensor_from_camera
        arrays = (self.matrix, self.distortion, pose.rotation, pose.translation)
        return (self.model, self.width, self.height, *(np.asarray(array, float).tobytes() for array in arrays))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Camera) and self._values() == other._values()

    def __hash__(self) -> int:
        return hash(self._values())

    @property
    def centre(self) -> NDArray[np.float64]:
        """Return the optical centre in the sensor frame, (3,) [mm]."""
        return self.sensor_from_camera.translation

    def rays(self, pixels: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return unit view directions in the camera frame, (..., 3), of pixels (..., 2) given as (column, row).

        NaN where the pixel has no unique direction, since the distortion folds over before it.
        """
        flat = np.ascontiguousarray(pixels, np.float64).reshape(-1, 1, 2)
        rays = np.empty((len(flat), 3))

        def find(part: slice) -> None:
            if self.model == "fisheye":
                distortion = self.distortion.reshape(-1, 1)
                ideal = cv2.fisheye.undistortPoints(flat[part], self.matrix, distortion, criteria=_EXACT)
            else:
                ideal = cv2.undistortPointsIter(flat[part], self.matrix, self.distortion, np.eye(3), np.eye(3), _EXACT)
            ideal = self._unique(np.asarray(ideal.reshape(-1, 2), np.float64), flat[part, 0])
            x, y = ideal.T
            length = np.sqrt(x * x + y * y + 1)
            rays[part, 0], rays[part, 1], rays[part, 2] = x / length, y / length, 1 / length

        in_threads(find, [slice(start, start + _TOGETHER) for start in range(0, len(flat), _TOGETHER)])
        return rays.reshape(*pixels.shape[:-1], 3)

    def rays_to_fold(self, pixels: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return :meth:`rays` of pixels (..., 2), with the direction at the fold in place of NaN.

        For outlines of the field of view, and for simulated images, which have no missing pixels.
        """
        rays = self.rays(pixels)
        lost = np.isnan(rays[..., 0])
        if not lost.any():
            return rays
        inverse = inverse_fold_radii(self.distortion, self.model)
        column, row = np.moveaxis(pixels[lost] - self._at(np.zeros((1, 2))), -1, 0)
        angle = np.arctan2(row / self.matrix[1, 1], column / self.matrix[0, 0])
        around = 2 * np.pi * np.arange(len(inverse)) / len(inverse)
        radius = 0.999 / np.maximum(np.interp(angle, around, inverse, period=2 * np.pi), 1e-3)
        local = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.ones_like(angle)], axis=-1)
        rays[lost] = local / np.linalg.norm(local, axis=-1, keepdims=True)
        return rays

    def project(self, points: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return pixel positions (..., 2), as (column, row), of points (..., 3) in the *sensor* frame [mm].

        Points behind the camera are NaN, and points beyond the fold of the distortion.
        """
        local = self.sensor_from_camera.inverse().points(points)
        flat = np.ascontiguousarray(local, np.float64).reshape(-1, 1, 3)
        if flat.size == 0:
            return np.empty((*points.shape[:-1], 2))
        out = self._pixels(flat)
        out[flat[:, 0, 2] <= 0] = np.nan
        radii = inverse_fold_radii(self.distortion, self.model)
        if radii.any():
            with np.errstate(all="ignore"):  # points behind the camera
                x, y = (flat[:, 0, :2] / flat[:, 0, 2:]).T
                out[~before_fold(x, y, radii)] = np.nan
        return out.reshape(*points.shape[:-1], 2)

    def _pixels(self, local: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return pixel positions (n, 2) of points (n, 1, 3) in the camera frame, also behind it or beyond a fold."""
        out = np.empty((len(local), 2))
        tilted = self.distortion[12:].any()
        project = self._by_opencv if self.model == "fisheye" or tilted else self._without_derivatives
        for start in range(0, len(local), _TOGETHER):
            out[start : start + _TOGETHER] = project(local[start : start + _TOGETHER])
        return out

    def _at(self, ideal: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return pixel positions (n, 2) of ideal image points (n, 2)."""
        return self._pixels(np.concatenate([ideal, np.ones((len(ideal), 1))], axis=1)[:, None])

    def _unique(self, ideal: NDArray[np.float64], pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the ideal image points (n, 2) of pixels (n, 2), NaN where there is none before the fold.

        ``ideal`` (n, 2) are OpenCV's results. Its iteration can diverge, or stop on a direction beyond the fold. Such
        pixels are traced from the axis outward, where the solution is unique, by Newton's method in steps.
        """
        if not self.distortion.any():
            return ideal
        radii = inverse_fold_radii(self.distortion, self.model)
        with np.errstate(all="ignore"):
            exact = np.abs(self._at(ideal) - pixels).max(axis=1) < _ROUND_TRIP_PX
            failed = np.flatnonzero(~(exact & before_fold(ideal[:, 0], ideal[:, 1], radii)))
        if not failed.size:
            return ideal
        ideal = ideal.copy()
        ideal[failed] = np.nan
        failed = failed[self._within_fold(pixels[failed], radii)]
        if failed.size:
            ideal[failed] = self._traced(pixels[failed], radii)
        return ideal

    def _within_fold(self, pixels: NDArray[np.float64], radii: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return whether pixels (n, 2) lie inside the image of the fold, or in a margin of 1 % around it."""
        if not (radii > 0).all():
            return np.ones(len(pixels), bool)
        axis = self._at(np.zeros((1, 2)))
        angle = 2 * np.pi * np.arange(len(radii)) / len(radii)
        fold = self._at(np.stack([np.cos(angle), np.sin(angle)], axis=1) / radii[:, None]) - axis
        at, reach = np.arctan2(fold[:, 1], fold[:, 0]), np.linalg.norm(fold, axis=1)
        off = pixels - axis
        limit = np.interp(np.arctan2(off[:, 1], off[:, 0]), at, reach, period=2 * np.pi)
        return np.asarray(np.linalg.norm(off, axis=1) < 1.01 * limit)

    @np.errstate(all="ignore")
    def _traced(self, pixels: NDArray[np.float64], radii: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return ideal image points (n, 2) of pixels (n, 2), followed from the axis outward; NaN at the fold."""
        axis = self._at(np.zeros((1, 2)))
        ideal = np.zeros_like(pixels)
        for step in range(1, _STEPS + 1):
            wanted = axis + (pixels - axis) * (step / _STEPS)
            for _ in range(_NEWTON_STEPS * (1 if step < _STEPS else 4)):
                width = 1e-6 * (1e-3 + np.abs(ideal).max(axis=1, keepdims=True))
                by_x, by_y = (
                    (self._at(ideal + width * unit) - self._at(ideal - width * unit)) / (2 * width)
                    for unit in np.eye(2)
                )
                (u, v), (u_x, v_x), (u_y, v_y) = (wanted - self._at(ideal)).T, by_x.T, by_y.T
                determinant = u_x * v_y - v_x * u_y
                ideal = ideal + np.stack([u * v_y - v * u_y, v * u_x - u * v_x], axis=1) / determinant[:, None]
        exact = np.abs(self._at(ideal) - pixels).max(axis=1) < _ROUND_TRIP_PX
        return np.where((exact & before_fold(ideal[:, 0], ideal[:, 1], radii))[:, None], ideal, np.nan)

    def _by_opencv(self, local: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return pixel positions (n, 2) of points (n, 1, 3) in the camera frame."""
        zero = np.zeros(3)
        if self.model == "fisheye":
            pixels, _ = cv2.fisheye.projectPoints(local, zero, zero, self.matrix, self.distortion.reshape(-1, 1))
        else:
            pixels, _ = cv2.projectPoints(local, zero, zero, self.matrix, self.distortion)
        return np.asarray(pixels.reshape(-1, 2))

    def _without_derivatives(self, local: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return what :meth:`_by_opencv` does for an imager without tilt, by OpenCV's operations in its order.

        OpenCV also computes the derivatives by all parameters, which takes ten times as long.
        """
        k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = np.concatenate([self.distortion.ravel(), np.zeros(12)])[:12]
        with np.errstate(all="ignore"):  # points behind the camera
            x, y, z = local[:, 0].T
            scale = 1.0 / z
            x, y = x * scale, y * scale
            r2 = x * x + y * y
            r4 = r2 * r2
            r6 = r4 * r2
            radial, inverse = 1 + k1 * r2 + k2 * r4 + k3 * r6, 1.0 / (1 + k4 * r2 + k5 * r4 + k6 * r6)
            xy, xx, yy = 2 * x * y, r2 + 2 * x * x, r2 + 2 * y * y
            u = x * radial * inverse + p1 * xy + p2 * xx + s1 * r2 + s2 * r4
            v = y * radial * inverse + p1 * yy + p2 * xy + s3 * r2 + s4 * r4
            (fx, _, cx), (_, fy, cy), _ = self.matrix
            pixels = np.empty((len(local), 2))
            pixels[:, 0], pixels[:, 1] = u * fx + cx, v * fy + cy
            return pixels

    def binned(self, step: int) -> Camera:
        """Return the camera with pixels binned ``step`` x ``step``; incomplete bins at the edges are cut off."""
        matrix = self.matrix.copy()
        matrix[:2] /= step
        matrix[:2, 2] += 0.5 / step - 0.5  # pixel centres lie at integers
        return replace(self, matrix=matrix, width=self.width // step, height=self.height // step)

    def pixel_grid(self) -> NDArray[np.float64]:
        """Return the pixel centres, (height, width, 2), as (column, row)."""
        columns, rows = np.meshgrid(np.arange(self.width, dtype=float), np.arange(self.height, dtype=float))
        return np.stack([columns, rows], axis=-1)

    def pixel_directions(self) -> NDArray[np.float64]:
        """Return the unit view direction of each pixel in the *sensor* frame, (height, width, 3), read-only."""
        return _pixel_directions(self)


@lru_cache(maxsize=2)  # to undistort all pixels of a camera takes up to 0.6 s
def _pixel_directions(camera: Camera) -> NDArray[np.float64]:
    directions = camera.sensor_from_camera.directions(camera.rays(camera.pixel_grid()))
    directions.flags.writeable = False
    return directions


@dataclass(frozen=True)
class Rectification:
    """Row-aligned virtual pair of a stereo rig: ``K`` without distortion, and rotations from each real camera.

    ``matrix_left`` and ``matrix_right`` (3, 3) share focal length and row, not necessarily column, of the principal
    point; ``rotation_left`` and ``rotation_right`` (3, 3) take camera coordinates to rectified coordinates.
    With disparity d = x_left - x_right, depth is Z = f B / (d + cx_right - cx_left).
    """

    matrix_left: NDArray[np.float64]
    matrix_right: NDArray[np.float64]
    rotation_left: NDArray[np.float64]
    rotation_right: NDArray[np.float64]
    baseline: float
    width: int
    height: int

    def depth(self, disparity: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return the depth Z in the rectified left frame [mm] of a disparity [px]; NaN at infinity and beyond."""
        shifted = np.asarray(disparity, float) + self.matrix_right[0, 2] - self.matrix_left[0, 2]
        in_front = shifted > 0
        depth = self.matrix_left[0, 0] * self.baseline / np.where(in_front, shifted, 1.0)
        return np.where(in_front, depth, np.nan)

    def disparity(self, depth: NDArray[np.floating] | float) -> NDArray[np.float64]:
        """Return the disparity [px] of a depth Z in the rectified left frame [mm]; inverse of :meth:`depth`."""
        shift = self.matrix_right[0, 2] - self.matrix_left[0, 2]
        return np.asarray(self.matrix_left[0, 0] * self.baseline / np.asarray(depth, float) - shift)


@dataclass(frozen=True)
class Rig:
    """The cameras of one sensor and its projector, all in the sensor frame (the frame of the first camera).

    ``rectification`` is the manufacturer's own if a recording includes it; otherwise it is computed from the cameras.
    """

    cameras: dict[str, Camera]
    projector: Camera | None = None
    rectification: Rectification | None = None

    @property
    def reference(self) -> Camera:
        """Return the first camera; the cloud is organised on its pixels."""
        return next(iter(self.cameras.values()))

    @property
    def baseline_direction(self) -> NDArray[np.float64]:
        """Return the unit vector in the sensor frame from the reference camera to the second camera or projector."""
        eyes = [*list(self.cameras.values())[1:], *([self.projector] if self.projector else [])]
        if not eyes:
            return np.array([1.0, 0.0, 0.0])
        direction = eyes[0].centre - self.reference.centre
        length = np.linalg.norm(direction)
        return direction / length if length > 0 else np.array([1.0, 0.0, 0.0])


def stereo_rectification(left: Camera, right: Camera) -> Rectification:
    """Rectify a pair as OpenCV does (Bouguet's method): equal rotation of both cameras, focal length kept in scale.

    Where OpenCV has the second camera above, below or to the left, both are rolled until it is to the right (+x).
    OpenCV finds the centre of the rectified image by undistorting its corners, an iteration that can diverge for strong
    distortion. Rotations and focal length do not depend on it; a diverged centre is replaced. Raises InputError if both
    cameras stand in the same place.
    """
    right_from_left = right.sensor_from_camera.inverse() @ left.sensor_from_camera
    if not right_from_left.translation.any():
        found = "both cameras of the pair in the same place"
        raise InputError("rig", "cameras", found, "a distance between them", "give the pose of the second camera")
    eyes = (left.matrix, left.distortion, right.matrix, right.distortion, (left.width, left.height))
    rotation, shift = right_from_left.rotation, right_from_left.translation.reshape(3, 1)
    r1, r2, p1, p2, *_ = cv2.stereoRectify(*eyes, rotation, shift, flags=0, alpha=-1)
    k1, k2, turn1, turn2 = (np.array(matrix, np.float64)[:, :3] for matrix in (p1, p2, r1, r2))
    baseline = float(np.linalg.norm(shift))
    x, y, _ = np.round(-turn2 @ right_from_left.translation / baseline)  # one is 1 or -1
    roll = np.array([[x, y, 0.0], [-y, x, 0.0], [0.0, 0.0, 1.0]])
    turn1, turn2 = (turn1, turn2) if x == 1 else (roll @ turn1, roll @ turn2)
    upright = abs(turn1[0, 0]) > abs(turn1[0, 1])
    width, height = (left.width, left.height) if upright else (left.height, left.width)
    f, middle, centres = k1[0, 0], np.array([(width - 1) / 2, (height - 1) / 2]), []
    for camera, rotation in ((left, turn1), (right, turn2)):
        ray = rotation @ camera.rays(np.array([(camera.width - 1) / 2, (camera.height - 1) / 2]))
        centres.append(middle - f * ray[:2] / ray[2])
    if x != 1 or not upright or np.abs(np.subtract([k1[:2, 2], k2[:2, 2]], centres)).max() >= LOST_SHARE * left.width:
        row = float(np.mean([centre[1] for centre in centres]))
        k1, k2 = (np.array([[f, 0, column], [0, f, row], [0, 0, 1]]) for column, _ in centres)
    return Rectification(k1, k2, turn1, turn2, baseline, width, height)
