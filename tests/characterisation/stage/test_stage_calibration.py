"""Axes of a stage from captures whose truth is known: closed forms, statistics, and simulated captures of a board."""

import time

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from characterisation.files.errors import InputError
from characterisation.stage.calibration import axis_deviations, calibrate_with_board, calibration_angles
from characterisation.stage.turning_axes import TurningAxes
from tests.capture.devices.emulated_port import emulated
from tests.characterisation.stage.known_stage import axes_error, unit

LIMITS = np.radians([[-50, 50], [-40, 30]])


def rigid(rotation_deg, position):
    out = np.eye(4)
    out[:3, :3] = Rotation.from_euler("xyz", rotation_deg, degrees=True).as_matrix()
    out[:3, 3] = position
    return out


#: a pan-tilt table 600 mm before the sensor, its axes not square and not meeting
PAN_TILT = TurningAxes(
    np.array([unit([0.02, 1.0, -0.04]), unit([1.0, 0.03, 0.05])]), np.array([[3.0, 0.0, 640.0], [0.0, -8.0, 625.0]])
)
BOARD = rigid([178.0, 4.0, 3.0], [-40.0, -25.0, 600.0])
THREE = TurningAxes(
    np.array([unit([0.1, 0.05, 1.0]), unit([0.02, 1.0, -0.04]), unit([1.0, 0.03, 0.05])]),
    np.array([[5.0, 2.0, 0.0], [3.0, 0.0, 640.0], [0.0, -8.0, 625.0]]),
)


def board_error(axes, zero, fit):
    turn = Rotation.from_matrix(zero[:3, :3] @ fit.zero_pose[:3, :3].T).as_rotvec()
    return np.array([*axes_error(axes, fit.axes), *turn, *zero[:3, 3] - fit.zero_pose[:3, 3]])


def noisy(poses, covariance, rng):
    """Poses with errors of rotation about the sensor's axes [rad] and of position [mm]."""
    errors = rng.multivariate_normal(np.zeros(6), covariance, len(poses))
    out = poses.copy()
    out[:, :3, :3] = Rotation.from_rotvec(errors[:, :3]).as_matrix() @ poses[:, :3, :3]
    out[:, :3, 3] += errors[:, 3:]
    return out


def test_a_turn_leaves_its_line_and_moves_all_else_by_rodrigues_formula():
    motion = PAN_TILT.turns(np.array([[0.4, -0.3]]))
    for turn, direction, point, angle in zip(
        motion[:, 0], PAN_TILT.directions, PAN_TILT.points, [0.4, -0.3], strict=True
    ):
        assert np.allclose(turn[:3, :3] @ (point + 70 * direction) + turn[:3, 3], point + 70 * direction, atol=1e-10)
        assert np.allclose(turn[:3, :3], Rotation.from_rotvec(angle * direction).as_matrix(), atol=1e-12)
    assert np.allclose(PAN_TILT.motion([0.4, -0.3])[0], motion[0, 0] @ motion[1, 0])


direction = st.tuples(*[st.floats(-1, 1) for _ in range(3)]).filter(lambda v: np.linalg.norm(v) > 0.2).map(unit)
place = st.tuples(st.floats(-200, 200), st.floats(-200, 200), st.floats(300, 900))


@settings(max_examples=40)
@given(st.lists(st.tuples(direction, place), min_size=1, max_size=3), direction, place)
def test_exact_poses_give_the_exact_axes_wherever_they_are(lines, turn, position):
    directions = np.array([line[0] for line in lines])
    if len(lines) > 1 and np.linalg.norm(np.cross(directions[:-1], directions[1:]), axis=1).min() < 0.2:
        return  # axes nearly in line do the same
    axes = TurningAxes(directions, np.array([line[1] for line in lines]))
    zero = rigid(np.degrees(turn), position)
    angles = calibration_angles(np.radians([[-40, 55]] * len(lines)), 4)
    fit = calibrate_with_board(angles, axes.motion(angles) @ zero)
    error = board_error(axes, zero, fit)
    assert np.abs(error.reshape(-1, 2)).max() < 1e-5  # rad and mm; positions of 1 m are told to 1e-13
    assert np.allclose(fit.poses(angles), axes.motion(angles) @ zero, atol=1e-6)


#: of rotations and positions of a board at 600 mm
NOISE = np.diag([4e-4] * 3 + [0.08] * 3) ** 2

REPEATS = 50


def check_coverage(errors, covariances, freedom):
    """Errors (r, p) of repeats against the covariances stated for them.

    e^T C^-1 e / p is of the F distribution with p and ``freedom`` degrees of freedom. The mean over r repeats has the
    standard error sd / sqrt(r); four of them are allowed. Of all standardised errors, 95.4 % are within two standard
    deviations of Student's t; the errors of a fit are correlated, so that a repeat counts as one: 4 standard errors.
    """
    errors, covariances = np.array(errors), np.array(covariances)
    p, nu, repeats = errors.shape[1], freedom, len(errors)
    ratio = np.einsum("ri,rij,rj->r", errors, np.linalg.inv(covariances), errors) / p
    mean = nu / (nu - 2)
    deviation = np.sqrt(2 * nu**2 * (p + nu - 2) / (p * (nu - 2) ** 2 * (nu - 4)))
    assert abs(ratio.mean() - mean) < 4 * deviation / np.sqrt(repeats)
    standardised = np.abs(errors) / np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    inside = (standardised < 2.0).mean(axis=0)
    assert np.abs(inside - 0.954).max() < 4 * np.sqrt(0.954 * 0.046 / repeats) + 2 / nu  # t with nu, not the normal
    # and no parameter has a bias: its mean is within 4.5 standard errors, for up to 14 of them
    assert np.abs((errors / np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))).mean(axis=0)).max() < 4.5 / np.sqrt(
        repeats
    )


def test_errors_are_as_large_as_stated():
    rng = np.random.default_rng(12)
    angles = calibration_angles(LIMITS, 7)
    true = PAN_TILT.motion(angles) @ BOARD
    errors, covariances, spreads = [], [], []
    for _ in range(REPEATS):
        fit = calibrate_with_board(angles, noisy(true, NOISE, rng))
        errors.append(board_error(PAN_TILT, BOARD, fit))
        covariances.append(fit.covariance)
        spreads.append(fit.residuals.reshape(-1, 2, 3).std(axis=(0, 2)))
    # two variances are estimated: each has about half of the degrees of freedom
    check_coverage(errors, covariances, (6 * len(angles) - 14) / 2)
    assert np.allclose(np.mean(spreads, axis=0), [4e-4, 0.08], rtol=0.1)


def test_errors_of_the_read_back_angles_are_within_those_stated():
    """A PTU-D46 reads in steps of 0.0514 deg: its angles are off by 0.26 mrad, more than a board's rotation here."""
    rng = np.random.default_rng(13)
    step = np.radians(185.1428 / 3600)
    noise = np.diag([1e-4] * 3 + [0.03] * 3) ** 2
    standardised = []
    for _ in range(REPEATS):
        stands = calibration_angles(LIMITS, 7) + rng.uniform(-0.5, 0.5, (18, 2)) * 0.01
        fit = calibrate_with_board(np.round(stands / step) * step, noisy(PAN_TILT.motion(stands) @ BOARD, noise, rng))
        standardised.append(board_error(PAN_TILT, BOARD, fit) / np.sqrt(np.diag(fit.covariance)))
    # errors of angles turn the board about two directions of three: their variance is up to 1.5 times the mean of three
    assert (np.mean(np.square(standardised), axis=0) < 1.5 * 47 / 45 + 4 * 1.5 * np.sqrt(2 / REPEATS)).all()


def test_deviations_of_the_axes_are_those_of_their_parameters():
    angles = calibration_angles(LIMITS, 7)
    rng = np.random.default_rng(16)
    fit = calibrate_with_board(angles, noisy(PAN_TILT.motion(angles) @ BOARD, NOISE, rng))
    tilts, shifts = axis_deviations(fit)
    variances = np.diag(fit.covariance)
    assert tilts[1] == pytest.approx(np.sqrt(variances[4] + variances[5]))
    assert shifts[0] == pytest.approx(np.sqrt(variances[2] + variances[3]))


@pytest.mark.parametrize(
    ("angles", "said"),
    [
        (
            np.radians([[0, 0], [10, 5], [20, 15], [-10, -5], [-20, -15]]),
            "axis 1: found no two captures in which it alone",
        ),
        (np.radians([[0, 0], [10, 0], [20, 0], [-10, 0]]), "axis 2: found no two captures"),
        (np.full((4, 2), np.nan), "poses: found none without NaN"),
        (np.zeros((3, 2)), r"angles: found shape \(3, 2\); allowed: \(4"),
    ],
)
def test_captures_that_do_not_determine_the_axes_say_so(angles, said):
    poses = np.concatenate([PAN_TILT.motion(np.nan_to_num(angles)) @ BOARD] * 2)
    with pytest.raises(InputError, match=said):
        calibrate_with_board(angles, poses[: max(4, len(angles))])


def test_captures_in_which_the_board_was_not_found_are_left_out():
    angles = calibration_angles(LIMITS, 7)
    poses = PAN_TILT.motion(angles) @ BOARD
    poses[[3, 8]] = np.nan
    fit = calibrate_with_board(angles, poses)
    assert np.abs(board_error(PAN_TILT, BOARD, fit)).max() < 1e-6
    assert len(fit.residuals) == len(angles) - 2


def test_an_emulated_stage_is_found_from_the_angles_that_it_reads_back(n10):
    """Axes from images: the stage moves, a board is projected into a camera with noise, and cv2 finds its pose."""
    rng = np.random.default_rng(18)
    stage, _ = emulated("ptu")
    stage.home()
    camera = n10.rig.reference
    grid = np.stack(np.meshgrid(np.arange(10), np.arange(7), indexing="ij"), axis=-1).reshape(-1, 2) * 15.0
    board = np.column_stack([grid, np.zeros(len(grid))])
    noise = 0.05  # px, what the virtual calibration has
    read, poses = [], []
    for asked in np.degrees(calibration_angles(LIMITS, 7)):
        back = np.radians(stage.move(asked))
        pose = (PAN_TILT.motion(back) @ BOARD)[0]
        pixels = camera.project(board @ pose[:3, :3].T + pose[:3, 3]) + rng.normal(0, noise, (len(board), 2))
        _, turn, place = cv2.solvePnP(board, pixels, camera.matrix, camera.distortion, flags=cv2.SOLVEPNP_ITERATIVE)
        found = np.eye(4)
        found[:3, :3], found[:3, 3] = cv2.Rodrigues(turn)[0], place.ravel()
        read.append(back), poses.append(found)
    began = time.perf_counter()
    fit = calibrate_with_board(np.array(read), np.array(poses))
    took = time.perf_counter() - began
    error = board_error(PAN_TILT, BOARD, fit)
    assert error @ np.linalg.solve(fit.covariance, error) < chi2.ppf(0.9999, len(error)) * 1.5
    tilts, shifts = axis_deviations(fit)
    print(f"directions {np.degrees(tilts).round(4)} deg, points {shifts.round(3)} mm, {took:.3f} s")
