"""Estimate the axes of a stage in closed form, from captures that differ in one axis at a time.

Signal chain: rotations of a board, or normals of a coupon, at known angles -> direction of the first axis, from pairs
between which all others are at rest -> rotation of this axis removed -> direction of the second, and so on -> points of
all axes, by linear least squares.

Consider two poses that differ by a rotation about axis i alone. With the rotations of the axes before it removed, the
relative rotation R_a R_b^T is a rotation about axis i. The vector part of its quaternion is sin(delta / 2) times the
direction. For two normals, the difference is perpendicular to the axis. The direction is the one perpendicular to many
such differences (the smallest singular vector); its sense is that in which the normals turn.

With known directions, positions and distances are linear in the points: t = sum_i Q_i (I - R_i) p_i + R t_0, and d =
d_0 + sum_i ((I - R_i^T) Q_i^T N) p_i, Q_i = R_1 ... R_(i-1). A point is determined only perpendicular to its axis; the
one nearest to the origin is used.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lstsq
from scipy.spatial.transform import Rotation

from characterisation.files.errors import InputError
from characterisation.stage.turning_axes import TurningAxes, rotation_about

Floats = NDArray[np.float64]

#: largest change of the angle of an axis at rest [rad]
SAME = float(np.radians(0.5))

#: least rotation between two captures that is used to locate an axis [rad]
LEAST_TURN = float(np.radians(2.0))

#: normals turn about an axis if their differences spread in two directions by this many times their noise
LEAST_SPREAD = 3.0

#: rounding counts as noise of this size [rad]
SMALLEST_TILT = 1e-7


def axes_from_rotations(angles: Floats, rotations: Floats, translations: Floats) -> tuple[TurningAxes, Floats]:
    """Return the axes, and the pose (4, 4) at zero, from poses at angles (n, k) [rad].

    Raises
    ------
    InputError
        If no two captures differ in one axis alone.
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
            raise _undetermined(i, "rotations that contradict each other", "a board that turns with the axis")
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


def axes_from_normals(
    angles: Floats, normals: Floats, distances: Floats, tilt_std: float
) -> tuple[TurningAxes, Floats, float]:
    """Return the axes, and the normal (3,) and distance [mm] at zero, from planes N x = d at angles (n, k) [rad].

    Parameters
    ----------
    angles
        (n, k) [rad].
    normals, distances
        Planes N x = d, (n, 3) and (n,) [mm].
    tilt_std
        Standard deviation of the normals [rad], which their rotation must exceed.

    Raises
    ------
    InputError
        If no three captures differ in one axis alone, or the normals do not turn about it.

    See Also
    --------
    axes_from_rotations : from poses
    """
    directions: list[Floats] = []
    left = normals
    for i in range(angles.shape[1]):
        first, second, turn = _pairs(angles, i)
        spread = np.linalg.svd(left[first] - left[second], full_matrices=False)
        noise = np.sqrt(2 * len(first)) * max(tilt_std, SMALLEST_TILT)  # noise of differences
        if len(first) < 2 or spread[1][1] < LEAST_SPREAD * noise:
            raise _undetermined(
                i,
                "normals that lie on a line or do not move",
                "three or more angles of it; an axis along the coupon's normal has no visible effect",
            )
        direction = spread[2][2]
        turned = [_turned(sense * direction, turn, left[second]) - left[first] for sense in (1.0, -1.0)]
        directions.append(direction if (turned[0] ** 2).sum() < (turned[1] ** 2).sum() else -direction)
        left = _turned(directions[i], -angles[:, i], left)
    normal = left.mean(axis=0)
    normal /= np.linalg.norm(normal)
    chains = _chains(directions, angles)
    shown = chains[-1][0] @ normal
    columns = [np.einsum("nji,nj->ni", chain @ (np.eye(3) - turn), shown) for chain, turn in chains[:-1]]
    matrix = np.concatenate([*columns, np.ones((len(angles), 1))], axis=1)
    solution = np.asarray(lstsq(matrix, distances, cond=1e-9)[0])
    return TurningAxes(np.array(directions), solution[:-1].reshape(-1, 3)), normal, float(solution[-1])


def _pairs(angles: Floats, index: int) -> tuple[NDArray[np.intp], NDArray[np.intp], Floats]:
    """Return pairs of captures between which, of this axis and those after it, only this one turns; and its angle."""
    apart = np.abs(angles[:, None, index + 1 :] - angles[None, :, index + 1 :])
    still = (apart < SAME).all(axis=2)
    turn = angles[:, None, index] - angles[None, :, index]
    first, second = np.nonzero(np.triu(still & (np.abs(turn) > LEAST_TURN), 1))
    if len(first) == 0:
        raise _undetermined(index, "no two captures in which it alone turns", "a sweep of each axis alone")
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


def _turned(direction: Floats, angles: Floats, vectors: Floats) -> Floats:
    return np.asarray(np.einsum("nij,nj->ni", rotation_about(direction, angles), vectors))


def _undetermined(index: int, found: str, allowed: str) -> InputError:
    return InputError("stage calibration", f"axis {index + 1}", found, allowed, "calibration_angles gives a plan")
