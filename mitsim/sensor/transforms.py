"""Represent frames and rigid transforms.

Every frame is right-handed and in mm. *Sensor* and *camera* frames follow OpenCV: x right, y down, z forward, pixel
centres at integers. The author of the scene chooses the *world* (part) frame.

A transform named ``world_from_sensor`` takes coordinates in the sensor frame to coordinates in the world frame, so
names chain: ``world_from_camera = world_from_sensor @ sensor_from_camera``.

Mitsuba's own cameras look along +z with x to the image's *left* and y *up*, and its film coordinates have pixel centres
at half-integers. Only this module contains that convention.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation


@dataclass(frozen=True)
class Transform:
    """Rigid motion ``x -> rotation @ x + translation``; ``rotation`` is (3, 3), ``translation`` is (3,) in mm."""

    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]

    @staticmethod
    def identity() -> Transform:
        """Return the transform that moves no point."""
        return Transform(np.eye(3), np.zeros(3))

    @staticmethod
    def from_degrees(rotation_deg: ArrayLike, position_mm: ArrayLike) -> Transform:
        """Return the rotation about fixed x, then y, then z [deg], followed by a translation [mm]."""
        rotation = Rotation.from_euler("xyz", np.asarray(rotation_deg, float), degrees=True).as_matrix()
        return Transform(rotation, np.asarray(position_mm, float))

    @staticmethod
    def from_matrix(matrix: ArrayLike) -> Transform:
        """Return the transform of a (4, 4) homogeneous matrix."""
        matrix = np.asarray(matrix, float)
        return Transform(matrix[:3, :3].copy(), matrix[:3, 3].copy())

    def matrix(self) -> NDArray[np.float64]:
        """Return the homogeneous (4, 4) matrix."""
        out = np.eye(4)
        out[:3, :3], out[:3, 3] = self.rotation, self.translation
        return out

    def inverse(self) -> Transform:
        """Return the inverse transform."""
        return Transform(self.rotation.T, -self.rotation.T @ self.translation)

    def __matmul__(self, other: Transform) -> Transform:
        """Compose two transforms; ``other`` applies first."""
        return Transform(self.rotation @ other.rotation, self.rotation @ other.translation + self.translation)

    def points(self, points: NDArray[np.floating]) -> NDArray[np.float64]:
        """Transform points of shape (..., 3) [mm]."""
        return points @ self.rotation.T + self.translation

    def directions(self, directions: NDArray[np.floating]) -> NDArray[np.float64]:
        """Rotate directions of shape (..., 3); the translation does not apply."""
        return directions @ self.rotation.T


def is_rotation(matrix: NDArray[np.floating], tolerance: float) -> bool:
    """Return whether a matrix (3, 3) is a right-handed rotation: no element of R R^T - I exceeds ``tolerance``."""
    off = np.abs(matrix @ matrix.T - np.eye(3)).max()
    return bool(off <= tolerance and np.linalg.det(matrix) > 0)  # False for NaN


def look_at(position: ArrayLike, target: ArrayLike, up: ArrayLike, roll_deg: float = 0.0) -> Transform:
    """Return ``world_from_sensor`` of a sensor at a position that looks at a target.

    Parameters
    ----------
    position, target
        The two points (3,) [mm].
    up
        Direction to which the image's up direction (minus y) is as close as possible.
    roll_deg
        Rotation about the view axis after that, clockwise as the sensor sees it (x toward y).
    """
    position, target = np.asarray(position, float), np.asarray(target, float)
    z = target - position
    z /= np.linalg.norm(z)
    upward = np.asarray(up, float)
    if np.linalg.norm(np.cross(upward, z)) < 1e-6 * np.linalg.norm(upward):  # parallel: use another axis
        upward = np.eye(3)[np.argmin(np.abs(z))]
    x = np.cross(z, upward)
    x /= np.linalg.norm(x)
    upright = np.stack([x, np.cross(z, x), z], axis=1)
    roll = Rotation.from_euler("z", roll_deg, degrees=True).as_matrix()
    return Transform(upright @ roll, position)
