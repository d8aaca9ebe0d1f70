"""Locate the axes of a stage in the sensor frame, from captures of a board on the stage.

Signal chain: read-back angles + the pose of a board, ChArUco say, in each capture -> first estimate in closed form
(:mod:`characterisation.stage.axes_from_sweeps`) -> least squares over all parameters -> covariance.

The noise is estimated too: one variance of rotations and one of positions, by their shares of the redundancy (Helmert's
variance components: Koch, *Parameter Estimation and Hypothesis Testing in Linear Models*, 1999, section 3.6). So it
contains the errors of the read-back angles that vary from capture to capture.

The covariance does not contain errors common to all captures: a scale error of the angles, bearing play that is always
on the same side, or a wrong calibration of the sensor.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from characterisation.files.arrays import Floats
from characterisation.files.errors import InputError
from characterisation.stage.axes_from_sweeps import axes_from_rotations, undetermined
from characterisation.stage.turning_axes import LINE_PARAMETERS, TurningAxes

#: least noise that is distinguished from rounding: of rotations [rad], of positions [mm]
SMALLEST_DEVIATIONS = (1e-8, 1e-5)

#: largest number of steps, each with a new estimate of the noise; few are needed
MOST_STEPS = 50

#: the steps end when they change no parameter by more than this share of its standard deviation, and the noise by less
#: than :data:`NOISE_CONVERGED` of itself
CONVERGED = 1e-6
NOISE_CONVERGED = 1e-3

#: a parameter is undetermined where the smallest singular value is below this share of the largest
UNDETERMINED = 1e-7

#: steps of central differences: their error is a share of 1e-10 of the derivatives, and rounding is smaller
RADIAN_STEP = 1e-5
MM_STEP = 1e-2


@dataclass(frozen=True)
class BoardCalibration:
    """A stage calibrated with a board."""

    axes: TurningAxes  # in the sensor frame
    zero_pose: Floats  # (4, 4) ``sensor_from_board`` at zero [mm]
    #: of the parameters: four for each axis as in :class:`~characterisation.stage.turning_axes.TurningAxes`; rotation
    #: [rad] of the zero pose about the sensor's axes; its shift [mm]
    covariance: Floats
    residuals: Floats  # (n, 6), measured minus fitted: rotation vectors [rad] about the sensor's axes, positions [mm]

    def poses(self, angles: ArrayLike) -> Floats:
        """Return ``sensor_from_board`` (n, 4, 4) at angles (n, k) [rad]."""
        return np.asarray(self.axes.motion(angles) @ self.zero_pose)


def axis_deviations(calibration: BoardCalibration) -> tuple[Floats, Floats]:
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


def calibrate_with_board(angles: ArrayLike, poses: ArrayLike) -> BoardCalibration:
    """Estimate the axes from ``poses`` (n, 4, 4) of a board, ``sensor_from_board`` [mm], at read-back ``angles`` (n, k)
    [rad].

    Poses with NaN are ignored. Raises InputError if the captures do not determine the axes; the message names the axis.
    """
    angles, poses = _usable(np.asarray(angles, float), np.asarray(poses, float))
    axes, zero = axes_from_rotations(angles, poses[:, :3, :3], poses[:, :3, 3])
    axes = axes.at_feet_of(zero[:3, 3])
    residuals = _differences(poses, axes.motion(angles) @ zero)
    deviations = np.maximum([residuals[:, :3].std(), residuals[:, 3:].std()], SMALLEST_DEVIATIONS)
    for _ in range(MOST_STEPS):
        noise = np.tile(np.repeat(deviations, 3), len(angles))
        jacobian = _pose_derivatives(axes, zero, angles).reshape(len(noise), -1) / noise[:, None]
        step, covariance = _solved(jacobian, residuals.ravel() / noise)
        axes, zero = _moved(axes, zero, step)
        residuals = _differences(poses, axes.motion(angles) @ zero)
        redundancy = 1 - np.einsum("np,pq,nq->n", jacobian, covariance, jacobian).reshape(-1, 2, 3)
        before, squares = deviations, (residuals.reshape(-1, 2, 3) ** 2).sum(axis=(0, 2))
        deviations = np.maximum(np.sqrt(squares / redundancy.sum(axis=(0, 2))), SMALLEST_DEVIATIONS)
        small = np.abs(step) < CONVERGED * np.sqrt(np.diag(covariance))
        if small.all() and np.allclose(before, deviations, rtol=NOISE_CONVERGED, atol=0):
            break
    return BoardCalibration(axes, zero, covariance, residuals)


def _solved(jacobian: Floats, residuals: Floats) -> tuple[Floats, Floats]:
    """Return the least-squares step (p,) and (J^T J)^-1 (p, p); reject a parameter that is undetermined."""
    scale = np.linalg.norm(jacobian, axis=0)
    across, singular, along = np.linalg.svd(jacobian / np.where(scale > 0, scale, 1.0), full_matrices=False)
    if jacobian.shape[0] <= jacobian.shape[1] or not singular[-1] > UNDETERMINED * singular[0]:
        raise undetermined(
            "captures",
            f"{len(jacobian) // 6} captures that leave a parameter undetermined",
            "captures that turn every axis, alone and together",
        )
    step = along.T @ (across.T @ residuals / singular) / scale
    return step, np.asarray((along.T / singular**2) @ along / np.outer(scale, scale))


def _moved(axes: TurningAxes, zero: Floats, parameters: Floats) -> tuple[TurningAxes, Floats]:
    """Return axes and zero pose changed by the parameters of a :class:`BoardCalibration`."""
    moved = zero.copy()
    moved[:3, :3] = Rotation.from_rotvec(parameters[-6:-3]).as_matrix() @ zero[:3, :3]
    moved[:3, 3] += parameters[-3:]
    return axes.moved(parameters[:-6]), moved


def _pose_derivatives(axes: TurningAxes, zero: Floats, angles: Floats) -> Floats:
    """Return the derivatives (n, 6, p) of the poses at angles (n, k) by the parameters."""
    steps = np.array([*[RADIAN_STEP, RADIAN_STEP, MM_STEP, MM_STEP] * axes.count, *[RADIAN_STEP] * 3, *[MM_STEP] * 3])
    columns = []
    for step in np.diag(steps):
        high, low = (moved.motion(angles) @ at for moved, at in (_moved(axes, zero, step), _moved(axes, zero, -step)))
        columns.append(_differences(high, low) / (2 * step.max()))
    return np.stack(columns, axis=-1)


def _differences(poses: Floats, other_poses: Floats) -> Floats:
    """Return poses minus other poses (n, 6): rotation vectors [rad] about the sensor's axes, positions [mm]."""
    rotation = Rotation.from_matrix(poses[:, :3, :3] @ other_poses[:, :3, :3].swapaxes(1, 2)).as_rotvec()
    return np.concatenate([rotation, poses[:, :3, 3] - other_poses[:, :3, 3]], axis=1)


def _usable(angles: Floats, poses: Floats) -> tuple[Floats, Floats]:
    """Return angles and poses of the captures without NaN."""
    if angles.ndim != 2 or len(angles) != len(poses) or not 1 <= angles.shape[1] <= 3:
        allowed = f"({len(poses)}, 1 to 3), a row for each of the poses"
        raise InputError("stage calibration", "angles", f"shape {angles.shape}", allowed)
    kept = np.isfinite(angles).all(axis=1) & np.isfinite(poses).all(axis=(1, 2))
    if not kept.any():
        raise InputError("stage calibration", "poses", "none without NaN", "captures that show the board")
    return angles[kept], poses[kept]
