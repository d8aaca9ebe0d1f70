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

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from characterisation.features.fitted import PlaneFit
from characterisation.features.surfaces import Plane, tangents
from characterisation.files.errors import InputError
from characterisation.stage.adjustment import adjusted, whitened
from characterisation.stage.axes_from_sweeps import axes_from_normals, axes_from_rotations
from characterisation.stage.turning_axes import LINE_PARAMETERS, TurningAxes

Floats = NDArray[np.float64]

#: least noise that is distinguished from rounding: of rotations [rad], of positions [mm]
SMALLEST_DEVIATIONS = (1e-8, 1e-5)

#: largest number of rounds that estimate the noise; few are needed
MOST_ROUNDS = 20

#: steps of central differences: their error is a share of 1e-10 of the derivatives, and rounding is smaller
RADIAN_STEP = 1e-5
MM_STEP = 1e-2

_LINE_STEPS = [RADIAN_STEP, RADIAN_STEP, MM_STEP, MM_STEP]

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
        angles = np.atleast_2d(np.asarray(angles, float))
        _, jacobian, _ = _linearised(_board_residuals(self.poses(angles)), angles)(_Board(self.axes, self.zero_pose))
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

    See Also
    --------
    calibrate_with_coupon : from clouds of a coupon
    """
    poses = np.asarray(poses, float)
    angles, kept = _usable(angles, poses.reshape(len(poses), -1), "poses")
    poses = poses[kept]
    axes, zero = axes_from_rotations(angles, poses[:, :3, :3], poses[:, :3, 3])
    start = _Board(axes.at_feet_of(zero[:3, 3]), zero)
    residuals_of = _board_residuals(poses)
    linearised = _linearised(residuals_of, angles)
    if covariance is None:
        fitted, spread, chi2, freedom = _with_components(start, linearised, angle_std)
    else:
        variances = np.asarray(covariance, float)[kept]
        fitted, spread, chi2, freedom = adjusted(start, linearised, _Board.moved, variances, angle_std)
    residuals, factor = residuals_of(fitted, angles), chi2 / freedom
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
    residuals_of = _coupon_residuals(points, normals)
    fitted, spread, chi2, freedom = adjusted(
        start, _linearised(residuals_of, angles), _Coupon.moved, variances, angle_std
    )
    residuals, factor = residuals_of(fitted, angles), chi2 / freedom
    return CouponCalibration(
        fitted.axes, fitted.zero_plane, factor * spread, residuals, float(np.sqrt(factor)), freedom
    )


@dataclass(frozen=True)
class _Board:
    axes: TurningAxes
    zero_pose: Floats

    @property
    def steps(self) -> Floats:
        """Return the steps (p,) of finite differences by the parameters."""
        return np.array([*_LINE_STEPS * self.axes.count, *[RADIAN_STEP] * 3, *[MM_STEP] * 3])

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

    @property
    def steps(self) -> Floats:
        """Return the steps (p,) of finite differences by the parameters."""
        return np.array([*_LINE_STEPS * self.axes.count, MM_STEP, *[RADIAN_STEP] * 2])

    def moved(self, parameters: Floats) -> _Coupon:
        return _Coupon(self.axes.moved(parameters[:-3]), self.zero_plane.moved(parameters[-3:]))


Model = TypeVar("Model", _Board, _Coupon)

#: residuals (n, m), measured minus fitted, of a model at angles (n, k)
Residuals = Callable[[Model, Floats], Floats]


def _coupon_start(angles: Floats, points: Floats, normals: Floats, tilt_std: float) -> _Coupon:
    axes, normal, distance = axes_from_normals(angles, normals, (normals * points).sum(axis=1), tilt_std)
    back = np.linalg.inv(axes.motion(angles))
    middle = (np.einsum("nij,nj->ni", back[:, :3, :3], points) + back[:, :3, 3]).mean(axis=0)
    point = middle + (distance - normal @ middle) * normal
    return _Coupon(axes.at_feet_of(point), Plane(point, normal))


def _linearised(residuals_of: Residuals[Model], angles: Floats) -> Callable[[Model], tuple[Floats, Floats, Floats]]:
    """Return the function of a model that gives residuals (n, m), and derivatives by parameters and by angles."""

    def derivatives(function: Callable[[Floats], Floats], steps: Floats) -> Floats:
        ends = [(function(step), function(-step)) for step in np.diag(steps)]
        return np.stack([(high - low) / (2 * size) for (high, low), size in zip(ends, steps, strict=True)], axis=-1)

    def linearised(model: Model) -> tuple[Floats, Floats, Floats]:
        by_parameters = derivatives(lambda change: residuals_of(model.moved(change), angles), model.steps)
        turn = np.full(angles.shape[1], RADIAN_STEP)
        by_angles = derivatives(lambda change: residuals_of(model, angles + change), turn)
        return residuals_of(model, angles), by_parameters, by_angles

    return linearised


def _board_residuals(poses: Floats) -> Residuals[_Board]:
    """Return residuals (n, 6): rotation vectors [rad] about the sensor's axes, positions [mm]."""

    def residuals(model: _Board, angles: Floats) -> Floats:
        fitted = model.axes.motion(angles) @ model.zero_pose
        rotation = Rotation.from_matrix(poses[:, :3, :3] @ fitted[:, :3, :3].swapaxes(1, 2)).as_rotvec()
        return np.concatenate([rotation, poses[:, :3, 3] - fitted[:, :3, 3]], axis=1)

    return residuals


def _coupon_residuals(points: Floats, normals: Floats) -> Residuals[_Coupon]:
    """Return residuals (n, 3): shift along the measured normal at the measured point [mm], and two tilts [rad]."""
    bases = np.array([tangents(normal) for normal in normals])

    def residuals(model: _Coupon, angles: Floats) -> Floats:
        motion = model.axes.motion(angles)
        normal = motion[:, :3, :3] @ model.zero_plane.normal
        point = motion[:, :3, :3] @ model.zero_plane.point + motion[:, :3, 3]
        facing = (normals * normal).sum(axis=1)
        shift = ((point - points) * normal).sum(axis=1) / facing
        return -np.column_stack([shift, np.einsum("nij,nj->ni", bases, normal) / facing[:, None]])

    return residuals


def _with_components(
    start: _Board, linearised: Callable[[_Board], tuple[Floats, Floats, Floats]], angle_std: ArrayLike
) -> tuple[_Board, Floats, float, int]:
    """Fit with one variance of rotations and one of positions, both estimated from the residuals."""
    residuals, _, _ = linearised(start)
    deviations = np.maximum([residuals[:, :3].std(), residuals[:, 3:].std()], SMALLEST_DEVIATIONS)
    model = start
    for _ in range(MOST_ROUNDS):
        variances = np.broadcast_to(np.diag(np.repeat(deviations**2, 3)), (len(residuals), 6, 6))
        model, covariance, chi2, freedom = adjusted(model, linearised, _Board.moved, variances, angle_std)
        white, jacobian = whitened(*linearised(model), variances, angle_std)
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
