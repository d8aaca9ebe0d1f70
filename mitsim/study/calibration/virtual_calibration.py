"""Calibrate a sensor virtually: board, poses, corner noise and bundle adjustment give the covariance of its rig.

Signal chain: board and poses -> corner noise at their distances -> bundle adjustment, linearised -> covariance of the
rig -> accuracy of rigs drawn from it, with and without drift.

The decoder determines which eyes are calibrated:

- active stereo, and structured light matched between two cameras: the cameras;
- a camera and a code, or a stored image: camera and projector;
- time of flight: the camera, and offset and scale of the path, fitted to the distances of the same board.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from characterisation.files.arrays import Floats
from characterisation.files.errors import InputError
from mitsim.sensor.camera import Camera
from mitsim.sensor.drift import Drift
from mitsim.sensor.preset_covariance import with_drift
from mitsim.sensor.rig_covariance import RigCovariance
from mitsim.sensor.rig_parameters import PATH_NAMES
from mitsim.sensor.sensor import Sensor
from mitsim.study.calibration.accuracy import Accuracy, accuracy
from mitsim.study.calibration.board import Board, board_poses, default_board
from mitsim.study.calibration.bundle import BoardSetup, BoardView, Linearised, linearise
from mitsim.study.calibration.corner_noise import coordinate_noise, corner_noise

#: default number of poses; calibration handbooks recommend 15 to 25
POSES = 20
#: number of rigs drawn for the accuracy
_DRAWS = 400
#: a normal distribution has 95 % within this many sigma
_INSIDE = 1.959964


@dataclass(frozen=True)
class VirtualCalibration:
    """Inputs and results of a virtual calibration.

    ``covariance`` and ``accuracy`` are of the calibration alone, ``accuracy_drifted`` includes the drift since then.
    """

    sensor: Sensor
    setup: BoardSetup
    covariance: RigCovariance
    accuracy: Accuracy
    accuracy_drifted: Accuracy


def sensor_drift(sensor: Sensor) -> Drift:
    """Return the drift by a sensor's own file, and by the default change of its temperature."""
    return replace(sensor.unknowns.calibration.drift(), temperature_k=Drift.temperature_k)


def calibrate(
    sensor: Sensor, board: Board | None = None, poses: int = POSES, seed: int = 1, drift: Drift | None = None
) -> VirtualCalibration:
    """Calibrate a sensor virtually; equal seeds give equal results.

    Parameters
    ----------
    sensor
        Its eyes are calibrated.
    board
        By default :func:`default_board` at the middle of the working range.
    poses
        Number of poses of the board.
    seed
        Of the noise of corners, and of the rigs drawn for the accuracy.
    drift
        Drift since the calibration, by default :func:`sensor_drift`.

    Raises
    ------
    InputError
        If the number of poses is not 6 to 300, or all eyes together see too little of the board.
    """
    if not 6 <= poses <= 300:
        raise InputError("--poses", "", poses, "6 to 300")
    eyes = sensor.measuring_eyes
    middle = float(np.sqrt(np.prod(sensor.working_range_mm)))
    board = board or default_board(sensor.rig.reference, middle)
    views = board_views(sensor, eyes, board, poses, seed)
    setup = BoardSetup(sensor.measuring_rig, eyes, board, views)
    linear = linearise(setup)
    names, matrix = linear.names, linear.covariance()
    if sensor.technology == "time_of_flight":
        names, matrix = (*names, *PATH_NAMES), _with_path(linear, board, views)
    covariance = RigCovariance(names, matrix, _source(sensor, board, views), _details(board, views))
    drift = drift or sensor_drift(sensor)
    rng = np.random.default_rng(seed)
    alone = accuracy(sensor, eyes, covariance, _DRAWS, rng)
    drifted = accuracy(sensor, eyes, with_drift(covariance, sensor, drift), _DRAWS, rng)
    numbers = {f"calibration_{key}": value for key, value in alone.numbers().items()}
    numbers |= {f"with_drift_{key}": value for key, value in drifted.numbers().items() if key not in ("middle_mm",)}
    numbers |= {f"drift_{key}": value for key, value in drift.numbers().items()}
    covariance = replace(covariance, details=dict(covariance.details) | numbers)
    return VirtualCalibration(sensor, setup, covariance, alone, drifted)


def board_views(sensor: Sensor, eyes: Mapping[str, Camera], board: Board, poses: int, seed: int) -> list[BoardView]:
    """Return the board's poses, each with the noise of its corners, interpolated between five distances.

    Parameters
    ----------
    sensor
        Sensor to calibrate.
    eyes
        Cameras and projector by name, the reference camera first.
    board
        Calibration board.
    poses
        Number of poses to try.
    seed
        Selects the noise of the simulated corners.

    See Also
    --------
    mitsim.study.calibration.board.board_poses : the poses alone
    """
    placements = board_poses(board, eyes, sensor.working_range_mm, poses)
    focal = sensor.rig.reference.matrix[0, 0]
    distances = np.array([np.linalg.norm(pose.translation - sensor.rig.reference.centre) for pose, _ in placements])
    nodes = np.geomspace(distances.min(), distances.max(), 5)
    camera = [corner_noise(sensor, d, board.square_mm * focal / d, seed).sigma for d in nodes]
    coordinate = [
        coordinate_noise(sensor, d, board.square_mm * focal / d, seed) if "projector" in eyes else 0.0 for d in nodes
    ]
    return [
        BoardView(pose, corners, float(np.interp(d, nodes, camera)), float(np.interp(d, nodes, coordinate)))
        for (pose, corners), d in zip(placements, distances, strict=True)
    ]


def _with_path(linear: Linearised, board: Board, views: list[BoardView]) -> Floats:
    """Return the covariance of the rig's parameters and of offset and scale of the path, (p + 2, p + 2).

    The path is fitted to the board's distances from the camera's calibration: a straight line through the mean distance
    of each pose. Its noise averages out over the thousands of pixels of a board and is neglected. Deviations from a
    straight line (wiggling, the delay of a pixel) are errors of the sensor, not of the calibration, and are excluded.
    """
    count = len(linear.names)
    inverse, moved = linear.response()
    modes, _ = board.imperfections()
    by_pose, by_board, distances = [], [], []
    for number, view in enumerate(views):
        pose = view.sensor_from_board
        points = pose.points(board.corners[view.corners])
        rays = points / np.linalg.norm(points, axis=1, keepdims=True)
        row = np.zeros(len(inverse))
        first = count + 6 * number
        row[first : first + 3] = np.cross(points - pose.translation, rays).mean(axis=0)
        row[first + 3 : first + 6] = rays.mean(axis=0)
        by_pose.append(row)
        # the calibration uses the nominal board at its estimated pose; the true one is also bent and scaled
        by_board.append(-np.einsum("ni,ij,mnj->m", rays, pose.rotation, modes[:, view.corners]) / len(points))
        distances.append(np.linalg.norm(points, axis=1).mean())
    fit = np.linalg.pinv(np.stack([np.ones(len(views)), np.array(distances)], axis=1))
    # errors of the rig are true minus nominal, those of the path reported minus true: opposite signs
    rows = np.concatenate([np.eye(count, len(inverse)), -(fit @ np.array(by_pose))])
    noise = rows @ inverse
    shared = rows @ moved
    shared[count:] -= fit @ np.array(by_board)
    shared *= linear.board_sigma
    return np.asarray(noise @ linear.noise @ noise.T + shared @ shared.T)


def _source(sensor: Sensor, board: Board, views: list[BoardView]) -> str:
    return f"virtual calibration: {sensor.name}, board of {board}, {len(views)} poses"


def _details(board: Board, views: list[BoardView]) -> dict[str, str | float]:
    camera, coordinate = [view.camera_px for view in views], [view.coordinate_px for view in views]
    out: dict[str, str | float] = {
        "board": str(board),
        "board_scale_sigma": board.made.scale,
        "poses": float(len(views)),
        "corners": float(sum(len(view.corners) for view in views)),
        "corner_noise_least_px": min(camera),
        "corner_noise_most_px": max(camera),
    }
    if max(coordinate) > 0:
        out["coordinate_noise_px"] = max(coordinate)
    return out


def calibration_table(calibration: VirtualCalibration) -> str:
    """Return board, noise, standard deviations and accuracy, one per line."""
    _, eyes, board, views = calibration.setup
    camera = [view.camera_px for view in views]
    lines = [
        f"{calibration.sensor.name}: board of {board}; "
        f"{len(views)} poses, {sum(len(view.corners) for view in views)} corners",
        f"noise of a corner: {min(camera):.3f} to {max(camera):.3f} px in a camera",
    ]
    if "projector" in eyes:
        lines[-1] += f", {max(view.coordinate_px for view in views):.2g} px of the projector's own"
    lines += ["", f"{'parameter':<28} {'one sigma':>10}"]
    lines += [
        f"{name:<28} {sigma:>10.3g}"
        for name, sigma in zip(calibration.covariance.names, calibration.covariance.one_sigma, strict=True)
    ]
    alone, drifted = calibration.accuracy.numbers(), calibration.accuracy_drifted.numbers()
    rows = {
        "ball bar, SD, one sigma [mm]": "sphere_spacing_sigma_mm",
        "  relative to its length": "sphere_spacing_relative",
        "ball bar, worst of seven, 95 % [mm]": "sphere_spacing_95_mm",
        "flatness, worst of five, median [mm]": "flatness_median_mm",
        "flatness, worst of five, 95 % [mm]": "flatness_95_mm",
        "distance, one sigma [mm]": "depth_sigma_mm",
    }
    lines += [
        "",
        f"at {alone['middle_mm']:.0f} mm, over a diagonal of {alone['diagonal_mm']:.0f} mm: true points, no noise",
    ]
    lines += [f"{'':<40} {'calibration':>12} {'and drift':>12}"]
    lines += [f"{label:<40} {alone[key]:>12.3g} {drifted[key]:>12.3g}" for label, key in rows.items()]
    return "\n".join(lines) + "\n"


def coverage_table(names: tuple[str, ...], scores: NDArray[np.float64]) -> str:
    """Return the share of simulated calibrations within the stated 95 %, by parameter and overall.

    ``scores`` (count, n): errors over one sigma.
    """
    inside = np.abs(scores) <= _INSIDE
    lines = [f"{'parameter':<28} {'inside 95 %':>12} {'rms / sigma':>12}"]
    lines += [
        f"{name:<28} {share:>12.3f} {spread:>12.3f}"
        for name, share, spread in zip(names, inside.mean(axis=0), np.sqrt((scores**2).mean(axis=0)), strict=True)
    ]
    lines += [f"{'all of ' + str(len(scores)) + ' calibrations':<28} {inside.mean():>12.3f}"]
    return "\n".join(lines) + "\n"
