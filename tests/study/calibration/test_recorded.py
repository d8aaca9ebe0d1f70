"""A calibration from recorded boards finds the rig of simulated ones, and its intervals hold it."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from characterisation.files.errors import InputError
from mitsim.sensor.camera import Camera, Rig
from mitsim.sensor.rig_parameters import eyes, parameter_differences
from mitsim.sensor.transforms import Transform
from mitsim.study.calibration.board import Board
from mitsim.study.calibration.bundle import BoardSetup, BoardView
from mitsim.study.calibration.halves import calibrate_checked
from mitsim.study.calibration.recorded import RecordedBoard, RecordedCorners, calibrate_recorded
from mitsim.study.calibration.simulated import simulate_corners

BOARD = Board(9, 7, 10.0, "glass")
SIZES = {"camera": (1280, 720), "projector": (1920, 1080)}


def rig() -> Rig:
    camera = Camera(np.array([[2000, 0, 650], [0, 2002, 350], [0, 0, 1.0]]), np.array([-0.1, 0.05, 0, 0, 0]), 1280, 720)
    turned = Transform(Rotation.from_rotvec([0.0, 0.28, 0.1]).as_matrix(), np.array([-170.0, -20.0, 20.0]))
    lamp = Camera(
        np.array([[2300, 0, 950], [0, 2301, 700], [0, 0, 1.0]]), np.array([0.05, 0, 0, 0, 0]), 1920, 1080, turned
    )
    return Rig({"camera": camera}, lamp)


def recorded(seed: int, poses: int = 6) -> list[RecordedBoard]:
    turns = [(0.5, 0.1, 0.2), (-0.5, 0.3, 0.1), (0.1, 0.6, -0.2), (0.2, -0.5, 0.3), (0.0, 0.0, 0.1), (-0.3, -0.3, 0.0)]
    views = [
        BoardView(
            Transform(Rotation.from_rotvec(turn).as_matrix(), np.array([8.0 * k - 20, 6.0 * k - 15, 400 + 25.0 * k])),
            np.arange(len(BOARD.corners)),
            0.1,
            0.05,
        )
        for k, turn in enumerate(turns[:poses])
    ]
    seen = simulate_corners(BoardSetup(rig(), eyes(rig()), BOARD, views), np.random.default_rng(seed))
    return [
        RecordedBoard(view.corners, {eye: seen.pixels[eye][number] for eye in SIZES})
        for number, view in enumerate(views)
    ]


def test_intervals_hold_the_rig():
    """Of 20 parameters in 12 calibrations, errors of one being correlated, 95 % lie within 95 % intervals."""
    errors = []
    for seed in range(12):
        found = calibrate_recorded(RecordedCorners(BOARD, recorded(seed), SIZES), "simulated")
        names = found.covariance.names
        told = [i for i, name in enumerate(names) if not name.endswith((".k2", ".k3"))]  # those the prior tells
        off = parameter_differences(found.rig, rig(), names)
        errors.append((off / found.covariance.one_sigma)[told])
        assert found.camera_px == pytest.approx(np.full(6, 0.1), rel=0.35)
        assert found.coordinate_px == pytest.approx(np.full(6, 0.05), rel=0.35)
    held, square = float(np.mean(np.abs(errors) < 1.96)), float(np.mean(np.square(errors)))
    print(f"{held:.3f} in the 95 % interval, mean squared error {square:.2f} of its variance")
    assert 0.91 < held < 0.99
    assert 0.7 < square < 1.4


@pytest.mark.parametrize("k3", [-0.09, 0.05])
def test_the_third_coefficient_of_an_ordinary_lens_is_found(rng, k3):
    """Before, a prior of 0.001 kept k3 near 0, and k1 and k2, 15 and 30 u off, took its place."""
    distortion = np.array([-0.43676, 0.24510, 0.00015, 0.00019, k3])
    lens = Camera(np.array([[1105.0, 0, 652], [0, 1105, 488], [0, 0, 1]]), distortion, 1280, 960)
    board, views = Board(11, 8, 20.0, "glass"), []
    for turn in np.arange(12) * np.pi / 6:  # boards in the middle, and out to the corners
        axis, out = np.array([-np.sin(turn), np.cos(turn), 0.0]), np.array([np.cos(turn), np.sin(turn), 0.0])
        place = Transform(Rotation.from_rotvec(0.5 * axis).as_matrix(), 120 * (len(views) % 3) * out + [0, 0, 500])
        seen = lens.project(place.points(board.corners))
        inside = np.flatnonzero(((seen > 3) & (seen < (1277, 957))).all(axis=1))
        views.append(BoardView(place, inside, 0.08, 0.0))
    corners = simulate_corners(BoardSetup(Rig({"camera": lens}), {"camera": lens}, board, views), rng).pixels["camera"]
    boards = [RecordedBoard(view.corners, {"camera": seen}) for view, seen in zip(views, corners, strict=True)]
    found = calibrate_recorded(RecordedCorners(board, boards, {"camera": (1280, 960)}), "simulated")
    names, sigma = found.covariance.names, found.covariance.one_sigma
    off = parameter_differences(found.rig, Rig({"camera": lens}), names)
    assert sigma[names.index("camera.k3")] < 0.02
    assert np.abs(off / sigma).max() < 4  # nine parameters; 4 u has a chance of 6e-4
    assert off @ np.linalg.solve(found.covariance.covariance, off) < 33.7  # 0.9999 of chi square with 9


def test_two_poses_are_too_few():
    with pytest.raises(InputError, match="3 or more"):
        calibrate_recorded(RecordedCorners(BOARD, recorded(1, 2), SIZES), "simulated")


def test_a_lens_beyond_the_model_is_refused():
    """Corners of an equidistant lens, up to 80 deg off the axis: no five coefficients fit them."""
    wide, boards = Board(9, 7, 20.0, "glass"), []
    for turn, away in [*((k, 0.0) for k in range(4)), *((k, 70.0) for k in range(6))]:
        out = np.array([np.cos(turn), np.sin(turn)])
        turned = Rotation.from_rotvec([0.5 * out[1], -0.5 * out[0], 0.0]).as_matrix()
        place = Transform(turned, np.array([*(away * out), 60.0]))
        points = place.points(wide.corners)
        radius = np.hypot(points[:, 0], points[:, 1])
        shown = 2000 * (np.arctan2(radius, points[:, 2]) / radius)[:, None] * points[:, :2]
        boards.append(RecordedBoard(np.arange(len(points)), {"camera": shown + np.array([2999.5, 1999.5])}))
    with pytest.raises(InputError, match=r"residuals of .* px") as caught:
        calibrate_recorded(RecordedCorners(wide, boards, {"camera": (6000, 4000)}), "simulated")
    assert "nan" not in str(caught.value)


@pytest.mark.parametrize("poses", [5, 8])
def test_corners_of_a_transposed_board_are_refused(poses):
    """--board 8x11 for 11x8: the fitted lens saw no corner. f was 1.7 px, its covariance NaN; 8 poses, a traceback."""
    rng, lens = np.random.default_rng(6), np.array([-0.1, 0.05, 0.0005, -0.0003, 0.0])
    matrix = np.array([[900.0, 0, 640], [0, 900, 400], [0, 0, 1]])
    board, told, boards = Board(11, 8, 30.0, "glass"), Board(8, 11, 30.0, "glass"), []
    for _ in range(poses):
        place = np.array([*rng.uniform(-100, 100, 2) * (1, 0.6), rng.uniform(600, 1000)])
        seen, _ = cv2.projectPoints(board.corners - (135, 90, 0), rng.uniform(-0.5, 0.5, 3), place, matrix, lens)
        boards.append(RecordedBoard(np.arange(70), {"camera": seen[:, 0] + rng.normal(0, 0.05, (70, 2))}))
    with pytest.raises(InputError, match=r"order of --board") as caught:
        calibrate_checked(RecordedCorners(told, boards, {"camera": (1280, 800)}), "simulated")
    assert "nan" not in str(caught.value)
