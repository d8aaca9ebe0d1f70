"""Calibrate a real rig: from the corners of a board seen at several poses to the rig and its covariance.

Signal chain: corners in every eye (for a projector, the decoded coordinates at the camera's corners) -> each eye alone,
by OpenCV, as a start -> all eyes and poses in one weighted adjustment, with general properties of lenses as a prior ->
noise of camera and projector from the residuals, iterated -> covariance: noise and prior, and errors of the board.

The adjustment minimises r^T Sigma^-1 r + (theta - theta_0)^T P (theta - theta_0). With the normal matrix
N = J^T Sigma^-1 J + P, board errors k of covariance K and G = df/dk,

    cov = N^-1 + N^-1 J^T Sigma^-1 G K G^T Sigma^-1 J N^-1

(Triggs et al., Bundle adjustment - a modern synthesis, 2000; "consider" covariance of Bierman 1977, as
:mod:`mitsim.study.calibration.bundle`). A few poses do not determine all parameters of a lens: without a prior the
weakest coefficients diverge. A projector's coordinates are read at the camera's corners, so their errors are correlated
with the camera's.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from characterisation.files.arrays import Floats
from characterisation.files.errors import InputError
from mitsim.sensor.camera import Camera, Rig
from mitsim.sensor.fitted_to import FittedCapture
from mitsim.sensor.rig_covariance import RigCovariance
from mitsim.sensor.rig_parameters import eyes as all_eyes
from mitsim.sensor.rig_parameters import parameter_names, parameter_values
from mitsim.sensor.transforms import Transform
from mitsim.study.calibration import bundle
from mitsim.study.calibration.board import Board

#: One sigma of the prior of a camera's principal point relative to the size, along columns and rows; *assumed*, as all
#: numbers of the prior of a lens
_CAMERA_MIDDLE = (0.05, 0.05)
#: the same of a projector, which shifts its image along rows
_PROJECTOR_MIDDLE = (0.05, 0.5)
#: ratio of the focal lengths fx / fy
_ASPECT = 0.005
#: coefficients of distortion; k3 of eleven lenses calibrated by others is -0.28 to 0.16, 0.15 root mean square
_DISTORTION: Mapping[str, float] = {"k1": 0.2, "k2": 0.2, "p1": 0.002, "p2": 0.002, "k3": 0.2}
_ROUNDS = 4
#: largest number of steps of the adjustment
_MOST_STEPS = 300
#: last step, in squared standard uncertainties; chosen
_SMALL_STEP = 1e-4
#: relative gain of the last step; chosen
_SMALL_GAIN = 1e-9
#: damping with which the adjustment cannot go on
_STUCK = 1e9
#: residuals of corners [px], median of the poses, above which the model of the lens is wrong; *assumed*: corners of
#: real boards scatter by 0.05 to 1 px
MOST_NOISE_PX = 3.0
#: the usual cause of corners that no rig sees
_ORDER = "are the corners of all cameras in the order of --board, COLUMNSxROWS, and of the same pose?"
#: least angle [deg] between board normals for which a missing tilt is not named as the cause of a failure; *assumed*
_TILTED_DEG = 15.0
#: least number of poses: two views of a plane leave the focal length to the prior
LEAST_POSES = 3


@dataclass(frozen=True)
class RecordedBoard:
    """A board at one pose: ``corners`` (n,) of :attr:`Board.corners`, and their pixels (n, 2) by eye.

    ``images`` of the pose, if it was read from images; its ``name``, for messages.
    """

    corners: NDArray[np.intp]
    pixels: Mapping[str, Floats]
    images: FittedCapture | None = None
    name: str = ""


@dataclass(frozen=True)
class RecordedCorners:
    """Corners of a ``board`` at poses, the ``boards``, and ``sizes`` (width, height) [px] of the eyes.

    Every eye has the same corners of a pose. The reference camera is the first eye; a projector is named ``projector``.
    ``left_out`` describes poses that were not used.
    """

    board: Board
    boards: Sequence[RecordedBoard]
    sizes: Mapping[str, tuple[int, int]]
    left_out: Sequence[str] = ()


@dataclass(frozen=True)
class RecordedCalibration:
    """Result of a calibration: ``rig``, ``poses`` sensor_from_board, ``covariance``, observation noise.

    ``board_effect`` (p, m): what one standard deviation of each imperfection of the board changes; the covariance
    contains it.

    ``camera_px`` (poses,) of a corner in a camera, ``coordinate_px`` (poses,) the projector's additional part, 0
    without one; one sigma each. They differ between poses: a tilted board is out of focus, and its stripes are wider.
    """

    rig: Rig
    poses: list[Transform]
    covariance: RigCovariance
    camera_px: Floats
    coordinate_px: Floats
    board_effect: Floats


def calibrate_recorded(corners: RecordedCorners, source: str, *, own_units: bool = False) -> RecordedCalibration:
    """Calibrate a rig of perspective eyes (cameras and a projector); ``source`` is the text of the covariance's file.

    With ``own_units``, lengths are in the board's own squares, so the covariance excludes the error of its scale.

    Raises
    ------
    InputError
        If there are too few poses, the adjustment does not converge, or the model of the lens does not fit.
    """
    board, boards, sizes = corners.board, corners.boards, corners.sizes
    if len(boards) < LEAST_POSES:
        raise InputError("boards", "", f"{len(boards)} poses", f"{LEAST_POSES} or more, tilted against one another")
    observed, (rig, poses) = _Observations(boards, board), _start(boards, board, sizes)
    noise = np.tile([0.1, 0.1 if "projector" in sizes else 0.0], (len(boards), 1))
    for _ in range(_ROUNDS):
        rig, poses, normal = observed.adjusted(rig, poses, noise, rig_prior(rig, sizes))
        noise = observed.noise(rig, poses, normal)
    typical = float(np.median(noise[:, 0]))
    if not typical <= MOST_NOISE_PX:  # NaN of a lens that folds
        hint = (
            f"{_ORDER} A lens of more than about 90 deg needs another model; leave out corners far from the middle of "
            "the image"
        )
        residuals = (
            "corners that the fitted lens cannot see" if math.isnan(typical) else f"residuals of {typical:.1f} px"
        )
        raise InputError(
            "boards", "", residuals, f"{MOST_NOISE_PX:g} px or less, of a lens with k1, k2, p1, p2, k3", hint
        )
    matrix, effect = observed.covariance(rig, poses, noise, normal, own_units)
    details: dict[str, str | float] = {
        "board": str(board),
        "poses": float(len(poses)),
        "corners": float(sum(len(recorded.corners) for recorded in boards)),
        "corner_noise_px": float(noise[:, 0].max()),
        "coordinate_noise_px": float(noise[:, 1].max()),
    }
    shown = tuple(recorded.images for recorded in boards if recorded.images is not None)
    covariance = RigCovariance(parameter_names(rig), matrix, source, details, shown)
    camera_px, coordinate_px = noise.T
    return RecordedCalibration(rig, poses, covariance, camera_px, coordinate_px, effect)


@dataclass(frozen=True)
class LensPrior:
    """Prior of the rig's parameters ``names``: ``rows`` (m, p) times them is ``values`` (m,) +- ``sigma``."""

    names: tuple[str, ...]
    rows: Floats
    values: Floats
    sigma: Floats


def rig_prior(rig: Rig, sizes: Mapping[str, tuple[int, int]]) -> LensPrior:
    """Return the prior of any camera and projector: central principal point, square pixels, little distortion."""
    names = parameter_names(rig)
    rows, values, sigma = [], [], []

    def add(parts: Mapping[str, float], value: float, spread: float) -> None:
        row = np.zeros(len(names))
        for name, weight in parts.items():
            row[names.index(name)] = weight
        rows.append(row)
        values.append(value)
        sigma.append(spread)

    optics = all_eyes(rig)
    for eye, (width, height) in sizes.items():
        middle = _PROJECTOR_MIDDLE if eye == "projector" else _CAMERA_MIDDLE
        add({f"{eye}.principal_x_px": 1.0}, (width - 1) / 2, middle[0] * width)
        add({f"{eye}.principal_y_px": 1.0}, (height - 1) / 2, middle[1] * height)
        focal = float(optics[eye].matrix[0, 0])
        add({f"{eye}.focal_x_px": 1.0, f"{eye}.focal_y_px": -1.0}, 0.0, _ASPECT * focal)
        for name, spread in _DISTORTION.items():
            add({f"{eye}.{name}": 1.0}, 0.0, spread)
    return LensPrior(names, np.array(rows), np.array(values), np.array(sigma))


def _start(
    boards: Sequence[RecordedBoard], board: Board, sizes: Mapping[str, tuple[int, int]]
) -> tuple[Rig, list[Transform]]:
    """Return rig and poses by OpenCV, eye by eye: one focal length, central principal point, no distortion."""
    flags = cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_USE_INTRINSIC_GUESS
    flags |= cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3
    cameras, poses, reference = dict[str, Camera](), dict[str, list[Transform]](), next(iter(sizes))
    for eye, (width, height) in sizes.items():
        free = 0 if eye == "projector" else cv2.CALIB_FIX_PRINCIPAL_POINT
        points = [board.corners[view.corners] for view in boards]
        tries = []
        for share in (0.6, 1.0, 1.6, 2.5):
            guess = np.array([[share * width, 0, (width - 1) / 2], [0, share * width, (height - 1) / 2], [0, 0, 1.0]])
            pixels, options = [view.pixels[eye] for view in boards], {"distCoeffs": np.zeros(5), "flags": flags | free}
            tries.append(bundle.eye_start(points, pixels, (width, height), guess, **options))
        _, matrix, _, poses[eye] = min(tries, key=lambda fit: fit[0])
        bundle.check_order(poses[reference], poses[eye], eye, [view.name for view in boards])
        pose = Transform.identity() if eye == reference else bundle.second_eye(poses[reference], poses[eye])
        cameras[eye] = Camera(matrix, np.zeros(5), width, height, pose)
    projector = cameras.pop("projector", None)
    return Rig(cameras, projector), poses[reference]


@dataclass(frozen=True)
class _Observations:
    """A ``board`` and its corners as recorded at several poses."""

    boards: Sequence[RecordedBoard]
    board: Board

    def residuals(self, rig: Rig, pose: Transform, recorded: RecordedBoard) -> tuple[Floats, Floats, Floats]:
        """Return derivatives of one pose's pixels, (n, eyes, 2, p + 6), (n, eyes, 2, 3), and residuals (n, 2 eyes)."""
        optics, corners = all_eyes(rig), self.board.corners[recorded.corners]
        jacobian, by_point = bundle.view_jacobian(optics, parameter_names(rig), pose, corners)
        at = pose.points(corners)
        left = np.concatenate([recorded.pixels[name] - eye.project(at) for name, eye in optics.items()], axis=1)
        return jacobian, by_point, left

    def whitened(self, rig: Rig, poses: Sequence[Transform], noise: Floats) -> Iterator[_Whitened]:
        """Yield what each pose contributes to an adjustment, at a noise (poses, 2) [px]."""
        count = len(parameter_names(rig))
        for number, (pose, recorded, pose_noise) in enumerate(zip(poses, self.boards, noise, strict=True)):
            jacobian, by_point, left = self.residuals(rig, pose, recorded)
            view = bundle.BoardView(pose, recorded.corners, *map(float, pose_noise))
            covariance = bundle.observation_covariance(all_eyes(rig), by_point, view)
            whiten = np.linalg.inv(np.linalg.cholesky(covariance))
            flat = np.einsum("nij,njk->nik", whiten, jacobian.reshape(len(left), -1, count + 6))
            indices = [*range(count), *range(count + 6 * number, count + 6 * number + 6)]
            yield _Whitened(view, indices, flat, whiten, by_point, left)

    def adjusted(
        self, rig: Rig, poses: list[Transform], noise: Floats, prior: LensPrior
    ) -> tuple[Rig, list[Transform], Floats]:
        """Minimise weighted squares over rig and poses by Levenberg-Marquardt; also return the normal matrix (q, q)."""
        damping = 1e-3
        cost, normal, gradient = self._normal(rig, poses, noise, prior)
        for _ in range(_MOST_STEPS):
            scale = 1 / np.sqrt(np.diag(normal))
            scaled = normal * np.outer(scale, scale)
            step = scale * np.linalg.solve(scaled + damping * np.eye(len(scale)), scale * gradient)
            tried_rig, tried = bundle.stepped(rig, poses, prior.names, step)
            new = self._normal(tried_rig, tried, noise, prior)
            if not new[0] <= cost * (1 + 1e-12):  # a lens that folds projects to NaN
                damping *= 4
                if damping > _STUCK:
                    return rig, poses, normal
                continue
            gained = cost - new[0]
            rig, poses, damping = tried_rig, tried, max(damping / 3, 1e-12)
            cost, normal, gradient = new
            if gained < _SMALL_GAIN * cost and float(step @ normal @ step) < _SMALL_STEP:
                return rig, poses, normal
        failure = f"an adjustment that does not converge in {_MOST_STEPS} steps"
        hint = tilt_hint(poses) or _ORDER
        raise InputError("boards", "", failure, "poses that determine it", hint)

    def _normal(
        self, rig: Rig, poses: list[Transform], noise: Floats, prior: LensPrior
    ) -> tuple[float, Floats, Floats]:
        """Return weighted sum of squares, normal matrix (q, q) and gradient (q,) for the rig, then six of each pose."""
        count = len(prior.names)
        size = count + 6 * len(poses)
        normal, gradient = np.zeros((size, size)), np.zeros(size)
        weighted = prior.rows / prior.sigma[:, None]
        off = (prior.values - prior.rows @ parameter_values(rig, prior.names)) / prior.sigma
        normal[:count, :count], gradient[:count] = weighted.T @ weighted, weighted.T @ off
        cost = float(off @ off)
        for block in self.whitened(rig, poses, noise):
            flat = block.jacobian.reshape(-1, count + 6)
            white = np.einsum("nij,nj->ni", block.whiten, block.left).ravel()
            normal[np.ix_(block.indices, block.indices)] += flat.T @ flat
            gradient[block.indices] += flat.T @ white
            cost += float(white @ white)
        return cost, normal, gradient

    def noise(self, rig: Rig, poses: list[Transform], normal: Floats) -> Floats:
        """Return the noise of a camera's corner and the projector's part, (poses, 2), from residuals and freedom."""
        out, optics = [], list(all_eyes(rig))
        count = sum(2 * len(optics) * len(recorded.corners) for recorded in self.boards)
        lost = count / max(count - len(normal), 1)
        for pose, recorded in zip(poses, self.boards, strict=True):
            _, by_point, left = self.residuals(rig, pose, recorded)
            camera, projector = [], [np.zeros(1)]
            for index, eye in enumerate(optics):
                part = left[:, 2 * index : 2 * index + 2]
                if eye == "projector":
                    turned = bundle.homographies(by_point[:, 0], by_point[:, index], pose)
                    projector = [part - np.einsum("nij,nj->ni", turned, left[:, :2])]
                else:
                    camera.append(part)
            out.append([np.mean(np.concatenate(camera) ** 2), np.mean(np.concatenate(projector) ** 2)])
        return np.sqrt(np.array(out) * lost)

    def covariance(
        self, rig: Rig, poses: list[Transform], noise: Floats, normal: Floats, own_units: bool
    ) -> tuple[Floats, Floats]:
        """Return the covariance of the rig's parameters (p, p), and what the board's errors change of them (p, m)."""
        count, (modes, sigma) = len(parameter_names(rig)), self.board.imperfections()
        if own_units:
            sigma = np.concatenate([[0.0], sigma[1:]])  # the first is the scale
        shared = np.zeros((len(normal), len(modes)))
        for block in self.whitened(rig, poses, noise):
            moves = bundle.board_derivatives(block.view.sensor_from_board, modes[:, block.view.corners], block.by_point)
            moved = np.einsum("nij,njm->nim", block.whiten, moves.reshape(len(block.left), -1, len(modes)))
            shared[block.indices] += np.einsum("nip,nim->pm", block.jacobian, moved)
        inverse = bundle.inverse_of(normal)
        spread = (inverse @ shared)[:count] * sigma
        return np.asarray(inverse[:count, :count] + spread @ spread.T), np.asarray(spread)


def largest_tilt(poses: Sequence[Transform]) -> float:
    """Return the largest angle [deg] between normals of the board in two poses."""
    normals = np.array([pose.rotation[:, 2] for pose in poses])
    return float(np.degrees(np.arccos(np.clip((normals @ normals.T).min(), -1.0, 1.0))))


def tilt_hint(poses: Sequence[Transform]) -> str:
    """Return a hint if the poses of the board are too much alike to separate focal length and distance, or ""."""
    tilt = largest_tilt(poses)
    if tilt >= _TILTED_DEG:
        return ""
    advice = "record poses tilted by 20 to 40 deg in several directions"
    return f"tilts of the board differ by {tilt:.1f} deg at most; {advice}"


class _Whitened(NamedTuple):
    """One pose of the board: its parameters' ``indices``, whitened ``jacobian``, ``whiten`` (n, 2 eyes, 2 eyes)."""

    view: bundle.BoardView
    indices: list[int]
    jacobian: Floats
    whiten: Floats
    by_point: Floats
    left: Floats
