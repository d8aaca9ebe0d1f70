"""Compute the covariance of a calibration: one bundle adjustment of all eyes and poses, linearised at the nominal rig.

Signal chain: rig, board and views -> Jacobian J of the observations, their covariance, and sensitivities to errors of
the board -> normal matrix -> covariance of the rig's parameters.

The observations are x = f(theta, poses) of the board's corners in every eye. The estimate minimises the unweighted sum
of squares, as OpenCV's does. With observation errors e of covariance Sigma, and common errors k of the board with
sensitivities G = df/dk,

    d theta = (J^T J)^-1 J^T (e + G k)        cov = (J^T J)^-1 (J^T Sigma J + J^T G K G^T J) (J^T J)^-1

The block of the rig's parameters is the marginal covariance over the poses. For equal independent noise it is
sigma^2 (J^T J)^-1, and its block that of the Schur complement (Triggs et al., Bundle adjustment - a modern synthesis,
2000, sections 6 and 9; Hartley and Zisserman, Multiple View Geometry, 2nd ed., appendix 6). The errors k are not
estimated ("consider" parameters: Bierman, Factorization Methods, 1977, chapter VIII). More poses do not average them
out, since every pose sees the same board.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from characterisation.files.arrays import Floats
from characterisation.files.errors import InputError
from mitsim.sensor.camera import Camera, Rig
from mitsim.sensor.rig_parameters import MATRIX_NAMES, POSE_NAMES, distortion_names, moved, parameter_names
from mitsim.sensor.transforms import Transform
from mitsim.study.calibration.board import Board

#: columns of OpenCV's Jacobian after rotation, translation and fx fy cx cy: the coefficients
_ORDER = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tx", "ty")

#: angle [deg] between a second eye's places at one pose and at the others, above which corners have another order.
#: Chosen: half of a quarter turn; 1 px of noise gives 4 deg
_TURNED_DEG = 45.0


@dataclass(frozen=True)
class BoardView:
    """One pose of the board: ``sensor_from_board``; ``corners`` (n,) that all eyes see; noise of an observation.

    ``camera_px``: one sigma of each coordinate of a corner in a camera. ``coordinate_px``: additional one sigma of the
    projector's coordinates.
    """

    sensor_from_board: Transform
    corners: NDArray[np.intp]
    camera_px: float
    coordinate_px: float = 0.0


class BoardSetup(NamedTuple):
    """Nominal ``rig``, its ``eyes`` that are calibrated, the reference camera first, and ``views`` of a ``board``."""

    rig: Rig
    eyes: Mapping[str, Camera]
    board: Board
    views: Sequence[BoardView]


@dataclass(frozen=True)
class Linearised:
    """A bundle adjustment linearised at the true parameters.

    - ``names`` (p,) of the rig's parameters; six of each pose follow (a rotation about the board's origin, then a
      translation, both in the sensor frame).
    - ``normal``: J^T J (q, q); ``noise``: J^T Sigma J (q, q); ``board``: J^T G (q, m); ``board_sigma`` (m,).
    """

    names: tuple[str, ...]
    normal: Floats
    noise: Floats
    board: Floats
    board_sigma: Floats

    def response(self) -> tuple[Floats, Floats]:
        """Return (J^T J)^-1 (q, q), and the effect of board errors on all parameters, (J^T J)^-1 J^T G (q, m)."""
        inverse = inverse_of(self.normal)
        return inverse, inverse @ self.board

    def covariance(self) -> Floats:
        """Return the covariance of the rig's parameters (p, p) from noise and board together."""
        count = len(self.names)
        inverse, shared = self.response()
        spread = shared[:count] * self.board_sigma
        return np.asarray(inverse[:count] @ self.noise @ inverse[:count].T + spread @ spread.T)


def inverse_of(normal: Floats) -> Floats:
    """Return the inverse of a normal matrix (q, q), whose parameters may differ by many orders of magnitude."""
    scale = 1 / np.sqrt(np.diag(normal))
    return np.asarray(np.linalg.inv(normal * np.outer(scale, scale)) * np.outer(scale, scale))


def eye_start(
    points: Sequence[Floats], pixels: Sequence[Floats], size: tuple[int, int], guess: Floats, **options: Any
) -> tuple[float, Floats, Floats, list[Transform]]:
    """Return misfit, matrix, distortion and poses ``camera_from_board`` of one eye alone, by ``cv2.calibrateCamera``.

    Parameters
    ----------
    points, pixels
        Points (n, 3) of the board and their pixels (n, 2), for each pose.
    size
        Width and height of the image [px].
    guess
        Initial matrix (3, 3).
    **options
        ``distCoeffs``, ``flags`` and others of OpenCV's function.
    """
    seen = [corners.astype(np.float32).reshape(-1, 1, 2) for corners in pixels]
    flat = [corners.astype(np.float32) for corners in points]
    misfit, matrix, distortion, turns, shifts = cv2.calibrateCamera(flat, seen, size, guess, **options)
    poses = [
        Transform(Rotation.from_rotvec(turn.ravel()).as_matrix(), np.asarray(shift, np.float64).ravel())
        for turn, shift in zip(turns, shifts, strict=True)
    ]
    return misfit, np.asarray(matrix, np.float64), np.asarray(distortion, np.float64).reshape(-1), poses


def second_eye(first: Sequence[Transform], second: Sequence[Transform]) -> Transform:
    """Return the pose of an eye in the frame of a first one: their mean over poses of the board in both frames."""
    apart = [transform @ other.inverse() for transform, other in zip(first, second, strict=True)]
    turn = Rotation.from_matrix([motion.rotation for motion in apart]).mean().as_matrix()
    return Transform(turn, np.median([motion.translation for motion in apart], axis=0))


def check_order(first: Sequence[Transform], second: Sequence[Transform], eye: str, names: Sequence[str]) -> None:
    """Check that the second eye stands alike to the first at all poses: corners in another order turn it.

    Parameters
    ----------
    first, second
        Poses ``eye_from_board`` of the board in both eyes.
    eye
        Name of the second eye, for messages.
    names
        Those of the poses; an empty one is replaced by the number of its pose.

    Raises
    ------
    InputError
        If one pose of the board turns it by about a quarter or half of a turn, as another order of its corners does.

    See Also
    --------
    second_eye : the place of the second eye
    """
    turns = np.array([(pose @ other.inverse()).rotation for pose, other in zip(second, first, strict=True)])
    cosine = (np.einsum("iab,jab->ij", turns, turns) - 1) / 2
    apart = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    from_most = apart[np.argmin(np.median(apart, axis=1))]
    odd = int(np.argmax(from_most))
    if from_most[odd] > _TURNED_DEG:
        found = f"corners that turn {eye} by {from_most[odd]:.0f} deg against the other poses"
        hint = "are they in the order of --board, COLUMNSxROWS, as at other poses? Reverse them, or leave out the pose"
        raise InputError("boards", f"{eye}, pose {names[odd] or odd}", found, "one order in both eyes", hint)


def stepped(rig: Rig, poses: Sequence[Transform], names: tuple[str, ...], step: Floats) -> tuple[Rig, list[Transform]]:
    """Return rig and poses of the board after a step of an adjustment.

    Parameters
    ----------
    rig
        Rig before the step.
    poses
        Poses ``sensor_from_board`` before the step.
    names
        The p parameters of the rig that are adjusted.
    step
        (p + 6 poses,) changes of the parameters, then of each pose: rotation vector [rad], translation [mm].

    See Also
    --------
    linearise : the normal matrix of the same parameters
    """
    turns = step[len(names) :].reshape(-1, 6)
    return moved(rig, names, step[: len(names)]), [
        Transform(Rotation.from_rotvec(turn[:3]).as_matrix() @ pose.rotation, pose.translation + turn[3:])
        for turn, pose in zip(turns, poses, strict=True)
    ]


def linearise(setup: BoardSetup) -> Linearised:
    """Linearise the bundle adjustment of a calibration at the nominal values of its rig."""
    rig, eyes, board, views = setup
    projector = "projector" in eyes
    names = tuple(name for name in parameter_names(rig, projector) if name.rpartition(".")[0] in eyes)
    modes, sigma = board.imperfections()
    size = len(names) + 6 * len(views)
    normal, noise = np.zeros((size, size)), np.zeros((size, size))
    shared = np.zeros((size, len(modes)))
    for number, view in enumerate(views):
        indices = [*range(len(names)), *range(first := len(names) + 6 * number, first + 6)]
        jacobian, by_point = view_jacobian(eyes, names, view.sensor_from_board, board.corners[view.corners])
        covariance = observation_covariance(eyes, by_point, view)
        to_board = board_derivatives(view.sensor_from_board, modes[:, view.corners], by_point)
        part = jacobian.reshape(len(view.corners), -1, len(indices))  # groups all coordinates of a corner
        normal[np.ix_(indices, indices)] += np.einsum("nop,noq->pq", part, part)
        weighted = np.einsum("nor,nrq->noq", covariance, part)
        noise[np.ix_(indices, indices)] += np.einsum("nop,noq->pq", part, weighted)
        shared[indices] += np.einsum("nop,nom->pm", part, to_board.reshape(len(view.corners), -1, len(modes)))
    return Linearised(names, normal, noise, shared, sigma)


def board_derivatives(pose: Transform, modes: Floats, by_point: Floats) -> Floats:
    """Return derivatives (n, eyes, 2, m) of pixels by imperfections (m, n, 3) of the board at a pose."""
    shifts = np.einsum("ij,mnj->mni", pose.rotation, modes)
    return np.asarray(np.einsum("neak,mnk->neam", by_point, shifts))


def eye_jacobian(eye: Camera, points: Floats) -> tuple[Floats, Floats]:
    """Return derivatives of pixels of points (n, 3) in the sensor frame: by the points (n, 2, 3), by the optics.

    The latter, (n, 2, 4 + c), are in the order of ``MATRIX_NAMES`` and :func:`distortion_names`.
    """
    local = np.ascontiguousarray(eye.sensor_from_camera.inverse().points(points)).reshape(-1, 1, 3)
    zero, count = np.zeros(3), len(points)
    if eye.model == "fisheye":
        _, raw = cv2.fisheye.projectPoints(local, zero, zero, eye.matrix, eye.distortion.reshape(-1, 1))
        by_local, optics = raw[:, 11:14], raw[:, :8]
    else:
        _, raw = cv2.projectPoints(local, zero, zero, eye.matrix, eye.distortion)
        chosen = [_ORDER.index(name) for name in distortion_names(eye)]
        by_local, optics = raw[:, 3:6], raw[:, [6, 7, 8, 9, *(10 + index for index in chosen)]]
    by_point = by_local.reshape(count, 2, 3) @ eye.sensor_from_camera.rotation.T
    return np.asarray(by_point), np.asarray(optics.reshape(count, 2, -1))


def homographies(first: Floats, second: Floats, pose: Transform) -> Floats:
    """Return the derivatives of a second eye's pixels by those of a first on the board's plane, (n, 2, 2).

    ``first`` and ``second`` (n, 2, 3) are the derivatives of the two eyes' pixels by the point.
    """
    plane = pose.rotation[:, :2]
    return np.asarray((second @ plane) @ np.linalg.inv(first @ plane))


def view_jacobian(
    eyes: Mapping[str, Camera], names: tuple[str, ...], pose: Transform, corners: Floats
) -> tuple[Floats, Floats]:
    """Return the derivatives of the pixels of a board's corners in every eye.

    They are by the rig's parameters and the six of the pose ``sensor_from_board``, (n, eyes, 2, p + 6), and by the
    point in the sensor frame, (n, eyes, 2, 3).

    Parameters
    ----------
    eyes
        Cameras and projector by name, the reference camera first.
    names
        The p parameters of the rig, in the order of the columns.
    pose
        Pose ``sensor_from_board``.
    corners
        (n, 3) corners in the board's frame [mm].

    See Also
    --------
    eye_jacobian : the derivatives of the pixels of a single eye
    """
    points = pose.points(corners)
    arms = points - pose.translation
    jacobian = np.zeros((len(points), len(eyes), 2, len(names) + 6))
    by_point = np.empty((len(points), len(eyes), 2, 3))
    for number, (name, eye) in enumerate(eyes.items()):
        moves, optics = eye_jacobian(eye, points)
        by_point[:, number] = moves
        columns = [names.index(f"{name}.{parameter}") for parameter in (*MATRIX_NAMES, *distortion_names(eye))]
        jacobian[:, number][:, :, columns] = optics
        if number:
            pose_columns = [names.index(f"{name}.{parameter}") for parameter in POSE_NAMES]
            # in the frame of R exp(w) a point x is rotated by exp(-w): dx = x cross w
            local = moves @ eye.sensor_from_camera.rotation
            seen = eye.sensor_from_camera.inverse().points(points)
            jacobian[:, number][:, :, pose_columns[:3]] = np.cross(local, seen[:, None])
            jacobian[:, number][:, :, pose_columns[3:]] = -moves
    jacobian[..., -6:-3] = np.cross(arms[:, None, None], by_point)
    jacobian[..., -3:] = by_point
    return jacobian, by_point


def observation_covariance(eyes: Mapping[str, Camera], by_point: Floats, view: BoardView) -> Floats:
    """Return the covariance of all coordinates of each corner, (n, 2 eyes, 2 eyes); ``by_point`` (n, eyes, 2, 3)."""
    count = len(by_point)
    out = np.zeros((count, 2 * len(eyes), 2 * len(eyes)))
    out[:, range(2 * len(eyes)), range(2 * len(eyes))] = view.camera_px**2
    if "projector" in eyes:
        turned = homographies(by_point[:, 0], by_point[:, 1], view.sensor_from_board)
        crossed = view.camera_px**2 * turned
        out[:, 2:4, 0:2], out[:, 0:2, 2:4] = crossed, np.swapaxes(crossed, 1, 2)
        out[:, 2:4, 2:4] = crossed @ np.swapaxes(turned, 1, 2) + view.coordinate_px**2 * np.eye(2)
    return out
