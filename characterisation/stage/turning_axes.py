"""Describe the axes of a stage as lines in space, and the motion of its load when they turn.

Signal chain: lines (direction, point) + angles -> a rotation about each line -> their product, the motion of the load
on the last axis.

The first axis is fixed to the ground, the last carries the load. All lines are given in the frame of the sensor, with
all angles at zero. The motion is the product of exponentials E_1(theta_1) ... E_k(theta_k), where E_i is a rotation by
theta_i about line i (Murray, Li, Sastry, *A Mathematical Introduction to Robotic Manipulation*, 1994, section 3.2.2).
With direction a and point p, R = exp(theta [a]) and t = (I - R) p.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from characterisation.features.vectors import tangents
from characterisation.files.arrays import Floats

#: parameters of a small change of one line
LINE_PARAMETERS = 4


@dataclass(frozen=True)
class TurningAxes:
    """Lines with unit ``directions`` (k, 3) through ``points`` (k, 3) [mm].

    Parameters of a small change, four for each line: tilts [rad] of the direction toward e1 and e2 of
    :func:`~characterisation.features.vectors.tangents`, shifts [mm] of the point along them.
    """

    directions: Floats
    points: Floats

    @property
    def count(self) -> int:
        """Return the number of axes."""
        return len(self.directions)

    def moved(self, parameters: Floats) -> TurningAxes:
        """Change the axes by the 4 k parameters."""
        directions, points = self.directions.copy(), self.points.copy()
        for i, (tilt1, tilt2, shift1, shift2) in enumerate(np.reshape(parameters, (self.count, LINE_PARAMETERS))):
            first, second = tangents(self.directions[i])
            tilted = directions[i] + tilt1 * first + tilt2 * second
            directions[i] = tilted / np.linalg.norm(tilted)
            points[i] += shift1 * first + shift2 * second
        return TurningAxes(directions, points)

    def at_feet_of(self, point: Floats) -> TurningAxes:
        """Describe the same lines by their points nearest to ``point`` (3,) [mm]."""
        along = ((point - self.points) * self.directions).sum(axis=1, keepdims=True)
        return TurningAxes(self.directions, self.points + along * self.directions)

    def turns(self, angles: ArrayLike) -> Floats:
        """Return the rotation about each line alone, (k, n, 4, 4), by angles (n, k) [rad]."""
        angles = np.atleast_2d(np.asarray(angles, float))
        out = np.zeros((self.count, len(angles), 4, 4))
        for i, (direction, point) in enumerate(zip(self.directions, self.points, strict=True)):
            out[i, :, :3, :3] = rotation_about(direction, angles[:, i])
            out[i, :, :3, 3] = point - out[i, :, :3, :3] @ point
            out[i, :, 3, 3] = 1.0
        return out

    def motion(self, angles: ArrayLike) -> Floats:
        """Return the motion (n, 4, 4) of the load from its place at zero, by angles (n, k) [rad]."""
        return np.asarray(reduce(np.matmul, self.turns(angles)))


def rotation_about(direction: Floats, angles: Floats) -> Floats:
    """Return rotations (n, 3, 3) about a unit direction (3,) by angles (n,) [rad]; the identity for NaN."""
    return np.asarray(Rotation.from_rotvec(np.nan_to_num(angles)[:, None] * direction).as_matrix())
