"""Locate the axes of a stage in the sensor frame, from captures of the load of the stage.

Signal chain: read-back angles + the pose of a board, or the plane of a coupon, in each capture -> first estimate in
closed form (:mod:`characterisation.stage.axes_from_sweeps`) -> least squares over all parameters -> covariance.

A board (ChArUco, say) gives a whole pose. A coupon gives only its plane, by normal and distance, so only the plane at
zero is estimated. The noise is given as covariances of the captures. For poses it can instead be estimated: one
variance of rotations and one of positions, by their shares of the redundancy (Helmert's variance components: Koch,
*Parameter Estimation and Hypothesis Testing in Linear Models*, 1999, section 3.6). ``angle_std`` is the standard
deviation of the read-back angles, independent in each capture; for steps of size q it is q / sqrt(12).

The resulting covariance is (J^T W J)^-1 times chi^2 / (degrees of freedom), so residuals larger than their stated noise
increase it. It does not contain errors common to all captures: a scale error of the angles, bearing play that is always
on the same side, or a wrong calibration of the sensor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from characterisation.features.fitted import PlaneFit
from characterisation.features.surfaces import Plane, tangents
from characterisation.files.errors import InputError
from characterisation.stage.adjustment import adjusted, whitened
from characterisation.stage.axes_from_sweeps import axes_from_normals, axes_from_rotations
from characterisation.stage.turning_axes import LINE_PARAMETERS, TurningAxes, axial_vector, cross_matrix

Floats = NDArray[np.float64]

#: least noise that is distinguished from rounding: of rotations [rad], of positions [mm]
SMALLEST_DEVIATIONS = (1e-8, 1e-5)

#: largest number of rounds that estimate the noise; few are needed
MOST_ROUNDS = 20

_WHERE = "stage calibration"


@dataclass(frozen=True)
class BoardCalibration:
    """A stage calibrated with a board.

    - ``axes`` in the sensor frame.
    - ``zero_pose`` (4, 4): ``sensor_from_board`` at zero [mm].
    - ``covariance`` of the parameters: four for each axis as in
      :class:`~characterisation.stage.turning_axes.TurningAxes`; rotation [rad] of the zero pose about the sensor's
      axes; its shift [mm].
    - ``residuals`` (n, 6), measured minus fitted: rotation vectors [rad] about the sensor's axes, positions [mm].
    - ``scale`` [1]: size of the residuals relative to the stated noise (1 where the noise was estimated).
    - ``freedom``: degrees of freedom.
    """

    axes: TurningAxes
    zero_pose: Floats
    covariance: Floats
    residuals: Floats
    scale: float
    freedom: int

    def poses(self, angles: ArrayLike) -> Floats:
        """Return ``sensor_from_board`` (n, 4, 4) at angles (n, k) [rad]."""
        return np.asarray(self.axes.motion(angles) @ self.zero_pose)

    def pose_covariance(self, angles: ArrayLike) -> Floats:
        """Return the covariance (n, 6, 6) of the poses: rotation about the sensor's axes [rad], position [mm]."""
        jacobian = _pose_derivatives(_Board(self.axes, self.zero_pose), np.atleast_2d(np.asarray(angles, float)))
        return np.asarray(jacobian @ self.covariance @ jacobian.swapaxes(1, 2))


@dataclass(frozen=True)
class CouponCalibration:
    """A stage calibrated with the plane of a coupon.

    The fields are those of :class:`BoardCalibration`, with two differences. ``zero_plane`` is the coupon's plane at
    zero, with the parameters of :class:`~characterisation.features.surfaces.Plane`. ``residuals`` (n, 3) are the shift
    [mm] and the two tilts [rad] of the measured planes from the fitted ones. The position of the coupon's edges on its
    plane is unknown.
    """

    axes: TurningAxes
    zero_plane: Plane
    covariance: Floats
    residuals: Floats
    scale: float
    freedom: int

    def planes(self, angles: ArrayLike) -> list[Plane]:
        """Return the coupon's plane at angles (n, k) [rad]."""
        motion = self.axes.motion(angles)
        points = motion[:, :3, :3] @ self.zero_plane.point + motion[:, :3, 3]
        return [Plane(p, n) for p, n in zip(points, motion[:, :3, :3] @ self.zero_plane.normal, strict=True)]


def axis_deviations(calibration: BoardCalibration | CouponCalibration) -> tuple[Floats, Floats]:
    """Return standard deviations of each axis: of its direction (k,) [rad], and of its point (k,) [mm].

    Both are perpendicular to the axis.
    """
    count = calibration.axes.count
    variances = np.diag(calibration.covariance)[: LINE_PARAMETERS * count].reshape(count, 2, 2)
    tilts, shifts = np.sqrt(variances.sum(axis=2)).T
    return tilts, shifts


def calibration_angles(limits: ArrayLike, count: int) -> Floats:
    """Return angles (n, k) [rad] that determine a stage, for limits (k, 2) [rad] that include zero.

    Each axis alone takes ``count`` angles from limit to limit while the others are at zero. Then follow all corners at
    0.7 of the limits, which separate the errors of the axes.
    """
    limits = np.asarray(limits, float)
    rows = np.eye(len(limits))
    sweeps = [np.outer(np.linspace(low, high, count), row) for (low, high), row in zip(limits, rows, strict=True)]
    corners = 0.7 * np.array(np.meshgrid(*limits, indexing="ij")).reshape(len(limits), -1).T
    return np.concatenate([*sweeps, corners])


def calibrate_with_board(
    angles: ArrayLike, poses: ArrayLike, covariance: ArrayLike | None = None, angle_std: ArrayLike = 0.0
) -> BoardCalibration:
    """Estimate the axes from poses of a board.

    Parameters
    ----------
    angles
        (n, k) read-back angles [rad].
    poses
        (n, 4, 4) ``sensor_from_board`` [mm]; those with NaN are ignored.
    covariance
        (n, 6, 6) of each pose: rotation about the sensor's axes [rad], position of the board's origin [mm]. By default,
        one variance of rotations and one of positions are estimated.
    angle_std
        Standard deviation of each angle, one or (k,) [rad].

    Raises
    ------
    InputError
        If the captures do not determine the axes; the message names the axis.
    """
    poses = np.asarray(poses, float)
    angles, kept = _usable(angles, poses.reshape(len(poses), -1), "poses")
    poses = poses[kept]
    start = _board_start(angles, poses)
    if covariance is None:
        fitted, spread, chi2, freedom = _with_components(start, angles, poses, angle_std)
    else:
        variances = np.asarray(covariance, float)[kept]
        fitted, spread, chi2, freedom = adjusted(
            start, lambda model: _board_linearised(model, angles, poses), _Board.moved, variances, angle_std
        )
    residuals = _board_linearised(fitted, angles, poses)[0]
    factor = chi2 / freedom
    return BoardCalibration(fitted.axes, fitted.zero_pose, factor * spread, residuals, float(np.sqrt(factor)), freedom)


def calibrate_with_coupon(
    angles: ArrayLike, planes: Sequence[PlaneFit], angle_std: ArrayLike = 0.0
) -> CouponCalibration:
    """Estimate the axes from planes fitted to the clouds of a coupon, with their covariances.

    Parameters
    ----------
    angles
        (n, k) read-back angles [rad].
    planes
        n planes in the sensor frame, with normals facing the sensor.
    angle_std
        Standard deviation of each angle, one or (k,) [rad].

    Raises
    ------
    InputError
        If the captures do not determine the axes; the message names the axis. The rotation about an axis along the
        coupon's normal has no visible effect.
    """
    values = np.array([[*plane.point, *plane.normal] for plane in planes])
    angles, kept = _usable(angles, values, "planes")
    points, normals = values[kept, :3], values[kept, 3:]
    variances = np.array([plane.covariance for plane in planes])[kept]
    start = _coupon_start(angles, points, normals, float(np.sqrt(np.median(variances[:, [1, 2], [1, 2]]))))
    fitted, spread, chi2, freedom = adjusted(
        start, lambda model: _coupon_linearised(model, angles, points, normals), _Coupon.moved, variances, angle_std
    )
    residuals = _coupon_linearised(fitted, angles, points, normals)[0]
    factor = chi2 / freedom
    return CouponCalibration(
        fitted.axes, fitted.zero_plane, factor * spread, residuals, float(np.sqrt(factor)), freedom
    )


@dataclass(frozen=True)
class _Board:
    axes: TurningAxes
    zero_pose: Floats

    def moved(self, parameters: Floats) -> _Board:
        axes = self.axes.moved(parameters[:-6])
        zero = self.zero_pose.copy()
        zero[:3, :3] = Rotation.from_rotvec(parameters[-6:-3]).as_matrix() @ zero[:3, :3]
        zero[:3, 3] += parameters[-3:]
        return _Board(axes, zero)


@dataclass(frozen=True)
class _Coupon:
    axes: TurningAxes
    zero_plane: Plane

    def moved(self, parameters: Floats) -> _Coupon:
        return _Coupon(self.axes.moved(parameters[:-3]), self.zero_plane.moved(parameters[-3:]))


def _board_start(angles: Floats, poses: Floats) -> _Board:
    axes, zero = axes_from_rotations(angles, poses[:, :3, :3], poses[:, :3, 3])
    return _Board(axes.at_feet_of(zero[:3, 3]), zero)


def _coupon_start(angles: Floats, points: Floats, normals: Floats, tilt_std: float) -> _Coupon:
    axes, normal, distance = axes_from_normals(angles, normals, (normals * points).sum(axis=1), tilt_std)
    back = np.linalg.inv(axes.motion(angles))
    middle = (np.einsum("nij,nj->ni", back[:, :3, :3], points) + back[:, :3, 3]).mean(axis=0)
    point = middle + (distance - normal @ middle) * normal
    return _Coupon(axes.at_feet_of(point), Plane(point, normal))


def _pose_derivatives(model: _Board, angles: Floats) -> Floats:
    """Return derivatives (n, 6, p) of the poses: rotation about the sensor's axes, position."""
    motion = model.axes.motion(angles)
    pose = motion @ model.zero_pose
    by_axes = model.axes.by_parameters(angles) @ model.zero_pose
    turned = np.einsum("npij,nkj->npik", by_axes[..., :3, :3], pose[:, :3, :3])
    out = np.zeros((len(pose), 6, by_axes.shape[1] + 6))
    out[:, :3, :-6] = axial_vector(turned).swapaxes(1, 2)
    out[:, 3:, :-6] = by_axes[..., :3, 3].swapaxes(1, 2)
    out[:, :3, -6:-3] = out[:, 3:, -3:] = motion[:, :3, :3]
    return out


def _board_linearised(model: _Board, angles: Floats, poses: Floats) -> tuple[Floats, Floats, Floats]:
    """Return residuals (n, 6), measured minus fitted, and their derivatives (n, 6, .) by parameters and by angles."""
    fitted = model.axes.motion(angles) @ model.zero_pose
    rotation = Rotation.from_matrix(poses[:, :3, :3] @ fitted[:, :3, :3].swapaxes(1, 2)).as_rotvec()
    residuals = np.concatenate([rotation, poses[:, :3, 3] - fitted[:, :3, 3]], axis=1)
    by_angles = model.axes.by_angles(angles) @ model.zero_pose
    turned = axial_vector(np.einsum("nkij,nlj->nkil", by_angles[..., :3, :3], fitted[:, :3, :3]))
    by_angles = np.concatenate([turned, by_angles[..., :3, 3]], axis=2).swapaxes(1, 2)
    # exp(r) exp(-d) = exp(r - J d), with J the inverse of the right Jacobian: 1 + [r]/2 + [r]^2/12 + ...
    cross = np.array([cross_matrix(vector) for vector in rotation])
    carried = np.broadcast_to(np.eye(6), (len(angles), 6, 6)).copy()
    carried[:, :3, :3] += cross / 2 + cross @ cross / 12
    return residuals, -carried @ _pose_derivatives(model, angles), -carried @ by_angles


def _coupon_linearised(
    model: _Coupon, angles: Floats, points: Floats, normals: Floats
) -> tuple[Floats, Floats, Floats]:
    """Return residuals (n, 3), measured minus fitted, and their derivatives by the parameters and by the angles.

    The residuals are the shift along the measured normal at the measured point, and two tilts.
    """
    bases = np.array([tangents(normal) for normal in normals])
    plane = model.zero_plane
    motion = model.axes.motion(angles)
    normal, point = motion[:, :3, :3] @ plane.normal, motion[:, :3, :3] @ plane.point + motion[:, :3, 3]
    facing = (normals * normal).sum(axis=1)
    shift = ((point - points) * normal).sum(axis=1) / facing
    tilt = np.einsum("nij,nj->ni", bases, normal) / facing[:, None]
    residuals = -np.column_stack([shift, tilt])

    def derivatives(normals_by: Floats, points_by: Floats) -> Floats:
        """Return those of the residuals (n, 3, p), from those of normal and point (n, p, 3)."""
        turned = np.einsum("npj,nj->np", normals_by, normals)
        shifted = np.einsum("npj,nj->np", points_by, normal) + np.einsum("npj,nj->np", normals_by, point - points)
        tilted = np.einsum("nij,npj->nip", bases, normals_by)
        top = (shifted - shift[:, None] * turned)[:, None]
        return np.asarray(-np.concatenate([top, tilted - tilt[:, :, None] * turned[:, None]], axis=1))

    def of_motion(by: Floats) -> Floats:
        return derivatives(by[..., :3, :3] @ plane.normal, by[..., :3, :3] @ plane.point + by[..., :3, 3])

    still = np.zeros((len(angles), 1, 3))
    first, second = (motion[:, :3, :3] @ edge for edge in tangents(plane.normal))
    by_plane = derivatives(
        np.concatenate([still, first[:, None], second[:, None]], axis=1),
        np.concatenate([normal[:, None], still, still], axis=1),
    )
    by_parameters = np.concatenate([of_motion(model.axes.by_parameters(angles)), by_plane], axis=2)
    return residuals, by_parameters, of_motion(model.axes.by_angles(angles))


def _with_components(
    start: _Board, angles: Floats, poses: Floats, angle_std: ArrayLike
) -> tuple[_Board, Floats, float, int]:
    """Fit with one variance of rotations and one of positions, both estimated from the residuals."""
    residuals = _board_linearised(start, angles, poses)[0]
    deviations = np.maximum([residuals[:, :3].std(), residuals[:, 3:].std()], SMALLEST_DEVIATIONS)
    model = start
    for _ in range(MOST_ROUNDS):
        variances = np.broadcast_to(np.diag(np.repeat(deviations**2, 3)), (len(angles), 6, 6))
        model, covariance, chi2, freedom = adjusted(
            model, lambda model: _board_linearised(model, angles, poses), _Board.moved, variances, angle_std
        )
        residuals, jacobian, by_angles = _board_linearised(model, angles, poses)
        white, jacobian = whitened(residuals, jacobian, by_angles, variances, angle_std)
        leverage = np.einsum("nip,pq,niq->ni", jacobian, covariance, jacobian)
        parts = [(white[:, part] ** 2).sum() / (1 - leverage[:, part]).sum() for part in (slice(0, 3), slice(3, 6))]
        before, deviations = deviations, np.maximum(deviations * np.sqrt(parts), SMALLEST_DEVIATIONS)
        if np.allclose(before, deviations, rtol=1e-3, atol=0):
            break
    return model, covariance, chi2, freedom


def _usable(angles: ArrayLike, values: Floats, what: str) -> tuple[Floats, NDArray[np.bool_]]:
    """Return the angles (n, k) of the captures without NaN, and the mask of these captures."""
    angles = np.asarray(angles, float)
    if angles.ndim != 2 or len(angles) != len(values) or not 1 <= angles.shape[1] <= 3:
        raise InputError(
            _WHERE, "angles", f"shape {angles.shape}", f"({len(values)}, 1 to 3), a row for each of the {what}"
        )
    kept = np.isfinite(angles).all(axis=1) & np.isfinite(values).all(axis=1)
    if not kept.any():
        raise InputError(_WHERE, what, "none without NaN", "captures that show the board or coupon")
    return angles[kept], kept
