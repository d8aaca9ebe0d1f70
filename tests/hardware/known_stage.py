"""Stages whose axes are known: how far a calibration is from them, and how sure the poses of a board are."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from characterisation.features.surfaces import tangents


def unit(vector):
    return np.asarray(vector, float) / np.linalg.norm(vector)


def axes_error(true, fitted):
    """The true axes in the parameters of the fitted ones."""
    out = []
    for direction, point, a, p in zip(true.directions, true.points, fitted.directions, fitted.points, strict=True):
        basis = tangents(a)
        # where the true line meets the plane across the fitted one
        foot = point + ((p - point) @ a) / (direction @ a) * direction
        out += [*basis @ direction / (direction @ a), *basis @ (foot - p)]
    return np.array(out)


def pose_covariance(camera, board, pose, noise):
    """Of rotation about the sensor's axes and position, from independent errors of the pixels."""
    columns = []
    for i, h in enumerate([1e-6] * 3 + [1e-4] * 3):
        moved = []
        for sign in (1, -1):
            turn = Rotation.from_rotvec(sign * h * np.eye(6)[i, :3]).as_matrix() @ pose[:3, :3]
            moved.append(camera.project(board @ turn.T + pose[:3, 3] + sign * h * np.eye(6)[i, 3:]).ravel())
        columns.append((moved[0] - moved[1]) / (2 * h))
    jacobian = np.stack(columns, axis=1)
    return noise**2 * np.linalg.inv(jacobian.T @ jacobian)
