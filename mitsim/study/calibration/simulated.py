"""Simulate calibrations: draw corner errors, and estimate the rig from the corners with OpenCV.

Signal chain: board and views -> corners with random errors -> OpenCV's estimate of each eye -> joint adjustment ->
errors over their stated sigma.

They verify the stated covariance: the errors of many estimates must lie inside its intervals at the stated rate.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from characterisation.files.arrays import Floats
from characterisation.files.errors import InputError
from mitsim.sensor.camera import Camera, Rig
from mitsim.sensor.rig_parameters import distortion_names, parameter_differences, parameter_names
from mitsim.sensor.rig_parameters import eyes as all_eyes
from mitsim.sensor.transforms import Transform
from mitsim.study.calibration import bundle

#: termination of OpenCV's estimate of one eye, which is only a start; that of its tutorials
_COARSE = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 30, 1e-6)
#: largest number of steps of the joint adjustment; chosen
_MOST_STEPS = 30
#: its final step: norm over all observations [px]; chosen
_SMALL_STEP_PX = 1e-5
#: factor on the focal lengths of OpenCV's initial guess: a data sheet's accuracy
_START_OFF = 1.01


@dataclass(frozen=True)
class SimulatedCorners:
    """Observations of a calibration: for each pose, nominal board points and their pixels by eye, (n, 2) each."""

    points: list[Floats]
    pixels: dict[str, list[Floats]]


def simulate_corners(setup: bundle.BoardSetup, rng: np.random.Generator) -> SimulatedCorners:
    """Draw a board and the errors of all its corners.

    The model of the errors is that of :func:`mitsim.study.calibration.bundle.linearise`.
    """
    _, eyes, board, views = setup
    modes, sigma = board.imperfections()
    true = board.corners + np.einsum("m,mni->ni", sigma * rng.standard_normal(len(sigma)), modes)
    pixels: dict[str, list[Floats]] = {name: [] for name in eyes}
    for view in views:
        points = view.sensor_from_board.points(true[view.corners])
        errors: list[Floats] = []
        for name, eye in eyes.items():
            error = view.camera_px * rng.standard_normal((len(points), 2))
            if name == "projector":  # read at the position of the corner found by the camera
                first = bundle.eye_jacobian(next(iter(eyes.values())), points)[0]
                turned = bundle.homographies(first, bundle.eye_jacobian(eye, points)[0], view.sensor_from_board)
                error = np.einsum("nij,nj->ni", turned, errors[0])
                error += view.coordinate_px * rng.standard_normal(error.shape)
            errors.append(error)
            pixels[name].append(eye.project(points) + error)
    return SimulatedCorners([board.corners[view.corners] for view in views], pixels)


def estimate(rig: Rig, eyes: Mapping[str, Camera], corners: SimulatedCorners) -> tuple[Rig, list[Transform]]:
    """Estimate the rig and the board's poses from corners: each eye by OpenCV, then all together.

    ``cv2.calibrateCamera`` of each eye gives the start. The damped steps of ``cv2.stereoCalibrate`` stop 1 to 3 sigma
    short of the minimum after 200 of them, because the parameters are strongly correlated. The joint adjustment is
    therefore Gauss-Newton, with the derivatives of ``cv2.projectPoints``.

    Raises
    ------
    InputError
        For fisheye lenses, for which OpenCV finds no such start; or if the adjustment does not converge.
    """
    if any(eye.model == "fisheye" for eye in eyes.values()):
        raise InputError("--check", "", "a fisheye lens", "perspective lenses", "leave --check out")
    started, poses, reference = dict[str, Camera](), dict[str, list[Transform]](), next(iter(eyes))
    for name, eye in eyes.items():
        guess = eye.matrix.copy()
        guess[[0, 1], [0, 1]] *= _START_OFF
        _, matrix, distortion, poses[name] = bundle.eye_start(
            corners.points,
            corners.pixels[name],
            (eye.width, eye.height),
            guess,
            distCoeffs=np.zeros(14 if len(eye.distortion) > 5 else 5),
            flags=_flags(eyes),
            criteria=_COARSE,
        )
        sensor_from_eye = eye.sensor_from_camera
        if name != reference:
            sensor_from_eye = eyes[reference].sensor_from_camera @ bundle.second_eye(poses[reference], poses[name])
        started[name] = replace(eye, matrix=matrix, distortion=distortion, sensor_from_camera=sensor_from_eye)
    board_poses = [eyes[reference].sensor_from_camera @ pose for pose in poses[reference]]
    cameras = {name: started.get(name, camera) for name, camera in rig.cameras.items()}
    return _adjusted(
        replace(rig, cameras=cameras, projector=started.get("projector", rig.projector)), board_poses, corners
    )


def _adjusted(rig: Rig, poses: list[Transform], corners: SimulatedCorners) -> tuple[Rig, list[Transform]]:
    """Minimise the sum of squares of all residuals over the rig and the board's poses by Gauss-Newton."""
    names = tuple(
        n for n in parameter_names(rig, "projector" in corners.pixels) if n.rpartition(".")[0] in corners.pixels
    )
    count = len(names)
    for _ in range(_MOST_STEPS):
        optics = {name: eye for name, eye in all_eyes(rig).items() if name in corners.pixels}
        size = count + 6 * len(poses)
        normal, gradient = np.zeros((size, size)), np.zeros(size)
        for number, (pose, board) in enumerate(zip(poses, corners.points, strict=True)):
            jacobian, _ = bundle.view_jacobian(optics, names, pose, board)
            at = pose.points(board)
            left = np.stack([corners.pixels[name][number] - eye.project(at) for name, eye in optics.items()], axis=1)
            indices = [*range(count), *range(count + 6 * number, count + 6 * number + 6)]
            flat = jacobian.reshape(-1, count + 6)
            normal[np.ix_(indices, indices)] += flat.T @ flat
            gradient[indices] += flat.T @ left.reshape(-1)
        scale = 1 / np.sqrt(np.diag(normal))
        step = scale * np.linalg.solve(normal * np.outer(scale, scale), scale * gradient)
        rig, poses = bundle.stepped(rig, poses, names, step)
        # change of all observations in the step: root of the sum of squares [px]
        if float(step @ normal @ step) < _SMALL_STEP_PX**2:
            return rig, poses
    raise InputError(
        "--check", "", f"an adjustment that does not converge in {_MOST_STEPS} steps", "poses that determine it"
    )


def _flags(eyes: Mapping[str, Camera]) -> int:
    """Return the flags for OpenCV to estimate exactly the coefficients of the nominal models."""
    flags = cv2.CALIB_USE_INTRINSIC_GUESS
    used = {name for eye in eyes.values() for name in distortion_names(eye)}
    for member, flag in (
        ("k4", cv2.CALIB_RATIONAL_MODEL),
        ("s1", cv2.CALIB_THIN_PRISM_MODEL),
        ("tx", cv2.CALIB_TILTED_MODEL),
    ):
        flags |= flag if member in used else 0
    return int(flags)


def coverage(setup: bundle.BoardSetup, stated: Mapping[str, float], streams: Sequence[np.random.Generator]) -> Floats:
    """Return errors over sigma of simulated calibrations, (count, n), one from each of the streams.

    ``stated`` has sigma of the n parameters, by their names.
    """
    names, sigma, rows = list(stated), np.array(list(stated.values())), []
    for stream in streams:
        estimated_rig, _ = estimate(setup.rig, setup.eyes, simulate_corners(setup, stream))
        rows.append(parameter_differences(setup.rig, estimated_rig, names) / sigma)
    return np.array(rows)
