"""The stated covariance of a calibration is that of OpenCV, of closed forms, and of whole simulated calibrations."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

from characterisation.files.errors import InputError
from mitsim.sensor.preset import load_sensor, presets
from mitsim.sensor.rig_parameters import moved, parameter_differences, parameter_names
from mitsim.study.calibration.board import TILTS_DEG, Board, board_poses, default_board, parse_board, seen_by_all
from mitsim.study.calibration.bundle import BoardSetup, BoardView, Linearised, linearise, view_jacobian
from mitsim.study.calibration.simulated import coverage, estimate, simulate_corners
from mitsim.study.calibration.virtual_calibration import _with_path

BOARD = Board(8, 6, 40.0, "glass")


def setting(name, poses=10, board=BOARD, camera_px=0.05, coordinate_px=0.02):
    sensor = load_sensor(name)
    eyes = sensor.measuring_eyes
    views = [
        BoardView(place, corners, camera_px, coordinate_px)
        for place, corners in board_poses(board, eyes, sensor.working_range_mm, poses)
    ]
    return sensor.measuring_rig, eyes, board, views


@pytest.mark.parametrize("poses", [7, 14, 20, 35])
def test_every_pose_has_a_distance_of_its_own(poses):
    sensor = load_sensor("ensenso-n10")
    eyes = sensor.measuring_eyes
    board = default_board(sensor.rig.reference, np.sqrt(np.prod(sensor.working_range_mm)))
    shown = board_poses(board, eyes, sensor.working_range_mm, poses)
    assert len({round(float(np.linalg.norm(place.translation))) for place, _ in shown}) > 0.8 * len(shown)


def only_noise(found):
    return Linearised(found.names, found.normal, found.noise, found.board, 0 * found.board_sigma)


@pytest.mark.parametrize("name", presets())
def test_every_sensor_sees_its_board_over_range_and_field(name):
    sensor = load_sensor(name)
    eyes, (near, far) = sensor.measuring_eyes, sensor.working_range_mm
    board = default_board(sensor.rig.reference, np.sqrt(near * far))
    poses = board_poses(board, eyes, (near, far), 20)
    assert len(poses) >= 18
    distances, pixels = [], []
    for place, corners in poses:
        points = place.points(board.corners[corners])
        assert seen_by_all(points, eyes).all() and 2 * len(corners) >= len(board.corners)
        distances.append(np.linalg.norm(place.translation - sensor.rig.reference.centre))
        pixels.append(sensor.rig.reference.project(points))
        ray = place.translation - sensor.rig.reference.centre
        lean = np.degrees(np.arccos(min(1.0, place.rotation[:, 2] @ ray / np.linalg.norm(ray))))
        assert lean < max(TILTS_DEG) + 20  # where the board gives way toward the middle its view ray turns
    assert min(distances) < near + 0.15 * (far - near) and max(distances) > near + 0.6 * (far - near)
    size = np.array([sensor.rig.reference.width, sensor.rig.reference.height])
    covered = np.ptp(np.concatenate(pixels), axis=0) / size
    # a projector beside the camera, or a second camera, does not see all of the first one's image
    assert (covered > 0.6).all(), covered


def test_boards_are_read_from_a_command_line():
    assert parse_board("11x8x30:glass") == Board(11, 8, 30.0, "glass")
    for bad, message in (
        ("11x8:glass", "COLUMNSxROWS"),
        ("11x8x30:glas", "did you mean 'glass'"),
        ("2x8x30:glass", "4 to 30.*one more than inner corners"),
        ("11x8xa:glass", "COLUMNS"),
    ):
        with pytest.raises(InputError, match=message):
            parse_board(bad)


def test_a_board_that_is_too_large_is_refused():
    sensor = load_sensor("photoneo-phoxi-s")
    with pytest.raises(InputError, match=r"of 12 poses.*smaller board"):
        board_poses(Board(11, 8, 200.0, "glass"), sensor.measuring_eyes, sensor.working_range_mm, 12)


@pytest.mark.parametrize("name", ["ensenso-n10", "ensenso-n35", "david-sls-3"])
def test_derivatives_agree_with_finite_differences(name):
    rig, eyes, board, views = setting(name)
    names = linearise(BoardSetup(rig, eyes, board, views)).names
    view = views[3]
    corners, place = board.corners[view.corners], view.sensor_from_board
    jacobian, _ = view_jacobian(eyes, names, place, corners)

    def pixels(other, place):
        every = other.cameras | {"projector": other.projector}
        return np.stack([every[eye].project(place.points(corners)) for eye in eyes], axis=1)

    for index, parameter in enumerate(names):
        h = 1e-6 if "rad" in parameter or "px" not in parameter else 1e-4
        ends = [pixels(moved(rig, [parameter], [sign * h]), place) for sign in (1, -1)]
        expected = (ends[0] - ends[1]) / (2 * h)
        assert np.abs(jacobian[..., index] - expected).max() < 1e-5 * np.abs(expected).max(), parameter
    for axis in range(6):
        ends = []
        for sign in (1, -1):
            step = sign * 1e-5 * np.eye(6)[axis]
            turn = Rotation.from_rotvec(step[:3]).as_matrix() @ place.rotation
            ends.append(pixels(rig, type(place)(turn, place.translation + step[3:])))
        expected = (ends[0] - ends[1]) / 2e-5
        assert np.abs(jacobian[..., len(names) + axis] - expected).max() < 1e-5 * np.abs(expected).max()


def test_one_camera_has_the_deviations_that_opencv_states(rng):
    """OpenCV's own standard deviations of intrinsics, from one draw: an independent (J^T J)^-1 and its own sigma."""
    rig, eyes, board, views = setting("kinect-v2", 15, Board(11, 8, 60.0, "glass"))
    found = only_noise(linearise(BoardSetup(rig, eyes, board, views)))
    ours = np.sqrt(np.diag(found.covariance()))
    camera = rig.reference
    points = [board.corners[view.corners].astype(np.float32) for view in views]
    pixels = [
        np.float32(
            camera.project(view.sensor_from_board.points(board.corners[view.corners]))
            + view.camera_px * rng.standard_normal((len(view.corners), 2))
        )
        for view in views
    ]
    *_, deviations, _, _ = cv2.calibrateCameraExtended(
        points,
        pixels,
        (camera.width, camera.height),
        camera.matrix.copy(),
        camera.distortion.copy(),
        flags=cv2.CALIB_USE_INTRINSIC_GUESS,
    )
    # their sigma comes from 1 800 residuals: 2 %; and they linearise where their estimate lies
    assert np.allclose(deviations.ravel()[:9], ours, rtol=0.06)


def test_the_scale_of_the_board_moves_places_and_nothing_else():
    rig, eyes, board, views = setting("ensenso-n10")
    found = linearise(BoardSetup(rig, eyes, board, views))
    sigma = np.zeros_like(found.board_sigma)
    sigma[0] = 1e-4
    scaled = Linearised(found.names, found.normal, 0 * found.noise, found.board, sigma)
    spread = np.sqrt(np.diag(scaled.covariance()))
    wanted = np.zeros(len(found.names))
    for axis, place in zip("xyz", rig.cameras["right"].centre, strict=True):
        wanted[found.names.index(f"right.position_{axis}_mm")] = 1e-4 * abs(place)
    unit = np.sqrt(np.diag(only_noise(found).covariance()))
    assert np.abs((spread - wanted) / unit).max() < 1e-4


def test_more_poses_average_noise_out_and_leave_the_scale():
    few, many = (linearise(BoardSetup(*setting("ensenso-n10", poses))) for poses in (10, 80))
    index = few.names.index("right.position_x_mm")
    noise = [np.sqrt(only_noise(each).covariance()[index, index]) for each in (few, many)]
    assert noise[1] < 0.5 * noise[0]  # sqrt(8) and what better places add
    rig = setting("ensenso-n10")[0]
    least = BOARD.made.scale * rig.cameras["right"].centre[0]
    assert np.sqrt(many.covariance()[index, index]) > least


@pytest.mark.parametrize(("name", "board"), [("zivid-2-m70", BOARD), ("ensenso-n35", Board(8, 6, 25.0, "composite"))])
def test_simulated_calibrations_lie_within_the_stated_interval(name, board, rng):
    rig, eyes, board, views = setting(name, board=board)
    found = linearise(BoardSetup(rig, eyes, board, views))
    count = 60
    stated = dict(zip(found.names, np.sqrt(np.diag(found.covariance())), strict=True))
    scores = coverage(BoardSetup(rig, eyes, board, views), stated, rng.spawn(count))
    inside = np.abs(scores) <= stats.norm.ppf(0.975)
    # every parameter by itself, all of them together at one in a thousand
    least, most = stats.binom.ppf([0.0005 / len(found.names), 1 - 0.0005 / len(found.names)], count, 0.95)
    assert (inside.sum(axis=0) >= least).all() and (inside.sum(axis=0) <= most).all()
    # as one: the squared distance of all parameters is chi-squared
    correlation = found.covariance() / np.outer(*[np.sqrt(np.diag(found.covariance()))] * 2)
    distance = np.einsum("ni,ij,nj->n", scores, np.linalg.inv(correlation), scores)
    assert stats.kstest(distance, stats.chi2(len(found.names)).cdf).pvalue > 1e-3


def test_offset_and_scale_of_a_path_go_with_the_focal_length(rng):
    """The path is fitted to the distances that the camera's own calibration gives: both err together."""
    rig, eyes, board, views = setting("kinect-v2", 12, Board(11, 8, 60.0, "composite"))
    found = linearise(BoardSetup(rig, eyes, board, views))
    stated = _with_path(found, board, views)
    rows = []
    for stream in rng.spawn(60):
        # the same board that simulate_corners draws first from its stream
        state = stream.bit_generator.state
        corners = simulate_corners(BoardSetup(rig, eyes, board, views), stream)
        stream.bit_generator.state = state
        modes, sigma = board.imperfections()
        true = board.corners + np.einsum("m,mni->ni", sigma * stream.standard_normal(len(sigma)), modes)
        found_rig, places = estimate(rig, eyes, corners)
        real = [np.linalg.norm(v.sensor_from_board.points(true[v.corners]), axis=1).mean() for v in views]
        told = [
            np.linalg.norm(p.points(board.corners[v.corners]), axis=1).mean()
            for p, v in zip(places, views, strict=True)
        ]
        slope, offset = np.polyfit(real, np.subtract(told, real), 1)
        # of the rig true minus estimated, of the path told minus true
        rows.append([*-parameter_differences(rig, found_rig, found.names), offset, slope])
    scores = np.array(rows) / np.sqrt(np.diag(stated))
    spread = (scores**2).sum(axis=0)
    low, high = stats.chi2.ppf([5e-4 / scores.shape[1], 1 - 5e-4 / scores.shape[1]], 60)
    assert (spread > low).all() and (spread < high).all()
    correlation = stated / np.outer(np.sqrt(np.diag(stated)), np.sqrt(np.diag(stated)))
    distance = np.einsum("ni,ij,nj->n", scores, np.linalg.inv(correlation), scores)
    assert stats.kstest(distance, stats.chi2(scores.shape[1]).cdf).pvalue > 1e-3


def test_a_fisheye_has_a_covariance_and_no_check():
    rig, _, board, views = setting("kinect-v2", 12, Board(11, 8, 60.0, "glass"))
    camera = rig.reference
    fish = type(camera)(
        camera.matrix, np.array([0.05, -0.01, 0.002, -5e-4]), camera.width, camera.height, model="fisheye"
    )
    other = type(rig)({"depth": fish})
    seen = BoardSetup(other, other.cameras, board, views)
    found = linearise(seen)
    assert found.names == parameter_names(other)
    assert (np.diag(found.covariance()) > 0).all()
    with pytest.raises(InputError, match="fisheye"):
        estimate(other, other.cameras, simulate_corners(seen, np.random.default_rng(1)))
