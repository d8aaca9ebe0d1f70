"""Estimate the axes of a stage in closed form, from captures that differ in one axis at a time.

Signal chain: rotations of a board at known angles -> direction of the first axis, from pairs between which all others
are at rest -> rotation of this axis removed -> direction of the second, and so on -> points of all axes, by linear
least squares.

Consider two poses that differ by a rotation about axis i alone. With the rotations of the axes before it removed, the
relative rotation R_a R_b^T is a rotation about axis i. The vector part of its quaternion is sin(delta / 2) times the
direction.

With known directions, positions are linear in the points: t = sum_i Q_i (I - R_i) p_i + R t_0, Q_i = R_1 ... R_(i-1). A
point is determined only perpendicular to its axis; the one nearest to the origin is used.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lstsq
from scipy.spatial.transform import Rotation

from characterisation.files.arrays import Floats
from characterisation.files.errors import InputError
from characterisation.stage.turning_axes import TurningAxes, rotation_about

#: largest change of the angle of an axis at rest [rad]
SAME = float(np.radians(0.5))

#: least rotation between two captures that is used to locate an axis [rad]
LEAST_TURN = float(np.radians(2.0))


def axes_from_rotations(angles: Floats, rotations: Floats, translations: Floats) -> tuple[TurningAxes, Floats]:
    """Return the axes, and the pose (4, 4) at zero, from poses at angles (n, k) [rad].

    Raises InputError if no two captures differ in one axis alone.
    """
    directions: list[Floats] = []
    left = rotations
    for i in range(angles.shape[1]):
        first, second, turn = _pairs(angles, i)
        quaternions = Rotation.from_matrix(left[first] @ left[second].swapaxes(1, 2)).as_quat()
        # a quaternion and its negative are one rotation: use the one nearer to the stage's own rotation
        sense = np.sign(quaternions[:, 3] * np.cos(turn / 2)) * (np.abs(quaternions[:, 3]) > 0.1)
        summed = ((sense * np.sin(turn / 2))[:, None] * quaternions[:, :3]).sum(axis=0)
        if np.linalg.norm(summed) < np.sin(LEAST_TURN / 2) ** 2:
            raise undetermined(
                f"axis {i + 1}", "rotations that contradict each other", "a board that turns with the axis"
            )
        directions.append(summed / np.linalg.norm(summed))
        left = rotation_about(directions[i], angles[:, i]).swapaxes(1, 2) @ left
    chains = _chains(directions, angles)
    zero = np.eye(4)
    zero[:3, :3] = Rotation.from_matrix(left).mean().as_matrix()
    columns = [chain @ (np.eye(3) - turn) for chain, turn in chains[:-1]]
    matrix = np.concatenate([*columns, chains[-1][0]], axis=2).reshape(3 * len(angles), -1)
    solution = np.asarray(lstsq(matrix, translations.ravel(), cond=1e-9)[0]).reshape(-1, 3)
    zero[:3, 3] = solution[-1]
    return TurningAxes(np.array(directions), solution[:-1]), zero


def _pairs(angles: Floats, index: int) -> tuple[NDArray[np.intp], NDArray[np.intp], Floats]:
    """Return pairs of captures between which, of this axis and those after it, only this one turns; and its angle."""
    apart = np.abs(angles[:, None, index + 1 :] - angles[None, :, index + 1 :])
    still = (apart < SAME).all(axis=2)
    turn = angles[:, None, index] - angles[None, :, index]
    first, second = np.nonzero(np.triu(still & (np.abs(turn) > LEAST_TURN), 1))
    if len(first) == 0:
        raise undetermined(f"axis {index + 1}", "no two captures in which it alone turns", "a sweep of each axis alone")
    return first, second, turn[first, second]


def _chains(directions: list[Floats], angles: Floats) -> list[tuple[Floats, Floats]]:
    """Return for each axis the rotations (n, 3, 3) of all before it, and its own; at the end those of all."""
    chain = np.broadcast_to(np.eye(3), (len(angles), 3, 3))
    out = []
    for i, direction in enumerate(directions):
        turn = rotation_about(direction, angles[:, i])
        out.append((chain, turn))
        chain = chain @ turn
    return [*out, (chain, chain)]


def undetermined(where: str, found: str, allowed: str) -> InputError:
    """Return the error of captures that do not determine an axis, ``where`` of them."""
    return InputError("stage calibration", where, found, allowed, "calibration_angles gives a plan")
