"""A ChArUco board, rendered at 15 poses and calibrated with OpenCV as if it were real, gives the preset back.

Nothing of mitsim's own geometry is used on the way back, so a convention that is wrong anywhere - pixel centres, axes,
the order of distortion coefficients - would show.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy import stats

from mitsim.capture.simulated.lens_blur import gaussian_blur
from mitsim.scene.backend import mi
from mitsim.scene.light_transport.light_paths import LightPaths
from mitsim.scene.light_transport.projected_codes import ProjectedPatterns
from mitsim.scene.light_transport.transport import trace
from mitsim.scene.load import scene_from_dict
from mitsim.scene.ray_casting.camera_rays import CameraRays
from mitsim.sensor.rig_parameters import parameter_differences
from mitsim.sensor.transforms import Transform, look_at
from mitsim.study.calibration.board import Board
from mitsim.study.calibration.bundle import BoardSetup, BoardView, linearise
from mitsim.study.calibration.corner_noise import corner_noise
from mitsim.study.calibration.simulated import SimulatedCorners, estimate

COLUMNS, ROWS, SQUARE, MARKER, TEXELS = 11, 8, 32.0, 19.0, 96
MIDDLE = np.array([COLUMNS * SQUARE / 2, ROWS * SQUARE / 2, 0.0])
POSES = 15
EXPOSURES = 4  # averaged, as one does when calibrating


def board_scene(board):
    """The board in its own frame, x right, y down, z away from the viewer, printed in 5 % and 85 % grey."""
    print_ = board.generateImage((COLUMNS * TEXELS, ROWS * TEXELS), marginSize=0, borderBits=1)
    grey = 0.05 + 0.8 * print_.astype(np.float32) / 255
    to_world = mi.ScalarTransform4f().translate(MIDDLE.tolist()).rotate([1, 0, 0], 180)
    to_world = to_world.scale([COLUMNS * SQUARE / 2, ROWS * SQUARE / 2, 1])
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(grey[::-1, :, None].copy()), "raw": True}
    return scene_from_dict(
        {"board": {"type": "rectangle", "to_world": to_world, "bsdf": {"type": "diffuse", "reflectance": texture}}}, 850
    )


def poses():
    rng = np.random.default_rng(4)
    for i in range(POSES):
        azimuth, tilt = 4 * np.pi * i / POSES, np.radians([10, 25, 38][i % 3])
        distance = [330, 400, 480][i // 3 % 3]
        target = MIDDLE + np.array([rng.uniform(-50, 50), rng.uniform(-30, 30), 0])
        away = np.array([np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), -np.cos(tilt)])
        yield look_at(target + distance * away, target, [0, -1, 0], rng.uniform(-20, 20))


@pytest.fixture(scope="module")
def corners(n10):
    """Camera name -> per pose (board corners (n, 3) [mm], pixels (n, 2)), as OpenCV's detector finds them."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_250)
    board = cv2.aruco.CharucoBoard((COLUMNS, ROWS), SQUARE, MARKER, dictionary)
    detector = cv2.aruco.CharucoDetector(board)
    scene = board_scene(board)
    optics = n10.projector.optics
    white = ProjectedPatterns(np.ones((1, optics.height, optics.width)), n10.projector)
    rays = {name: CameraRays(camera, 2.09, 600.0) for name, camera in n10.rig.cameras.items()}
    rng = np.random.default_rng(7)
    found = {name: [] for name in rays}
    for pose in poses():
        for name in rays:
            light = gaussian_blur(
                trace(scene, rays[name], white, pose, LightPaths(samples=9, seed=1))[0], n10.imager.blur_px
            )
            electrons = light / np.percentile(light, 99.9) * 0.9 * n10.imager.full_well
            # a sum of Poisson numbers is one, too
            noisy = rng.poisson(EXPOSURES * electrons) / EXPOSURES
            noisy += rng.normal(0, n10.imager.read_noise / np.sqrt(EXPOSURES), electrons.shape)
            grey = np.clip(np.rint(4 + noisy / n10.imager.full_well * 251), 0, 255).astype(np.uint8)
            pixels, ids, *_ = detector.detectBoard(grey)
            # the detector's own window reaches markers and bends with the distortion: refine in a smaller one
            pixels = cv2.cornerSubPix(grey, np.float32(pixels), (4, 4), (-1, -1), (3, 100, 1e-5))
            object_points, image_points = board.matchImagePoints(pixels, ids)
            found[name].append((object_points.reshape(-1, 3), image_points.reshape(-1, 2), ids.ravel()))
    return found


@pytest.mark.parametrize("name", ["left", "right"])
def test_the_camera_comes_back(name, corners, n10):
    camera = n10.rig.cameras[name]
    objects, images, _ = zip(*corners[name], strict=True)
    rms, matrix, distortion, _, _, deviations, *_ = cv2.calibrateCameraExtended(
        objects, images, (camera.width, camera.height), None, None
    )
    assert sum(map(len, images)) > 800
    assert rms < 0.05
    found = np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *distortion.ravel()[:5]])
    true = np.array([*camera.matrix[[0, 1, 0, 1], [0, 1, 2, 2]], *camera.distortion[:5]])
    # OpenCV's own standard deviations: four of them, for nine parameters of each of two cameras
    assert (np.abs(found - true) < 4 * deviations.ravel()[:9]).all()
    assert np.abs(found[:4] - true[:4]).max() < 0.5
    print(f"{name}: rms {rms:.4f} px, f, c off by {np.round(found[:4] - true[:4], 3).tolist()} px")


def test_the_corners_are_where_they_are(corners, n10):
    """The detector's error against the exact projection has no mean: pixel centres lie at integers."""
    for name, camera in n10.rig.cameras.items():
        errors = np.concatenate(
            [
                image - camera.project(pose.inverse().points(points.astype(float)))
                for (points, image, _), pose in zip(corners[name], poses(), strict=True)
            ]
        )
        assert np.abs(errors.mean(axis=0)).max() < 5 * 0.05 / np.sqrt(len(errors))


def test_corners_are_as_noisy_as_patches_predict(corners, n10):
    """Noise of corners simulated one by one (mitsim.study.calibration) against that of whole rendered boards."""
    predicted = np.mean(
        [
            corner_noise(replace(n10, focus_mm=600.0), d, SQUARE * 626 / d, patches=150, window_px=4).sigma ** 2
            for d in (330, 400, 480)
        ]
    )
    for name, camera in n10.rig.cameras.items():
        errors = np.concatenate(
            [
                image - camera.project(pose.inverse().points(points.astype(float)))
                for (points, image, _), pose in zip(corners[name], poses(), strict=True)
            ]
        )
        # four exposures averaged here, one there; most of the error is the detector's own, place by place in a pixel
        assert np.sqrt(np.mean(errors**2)) == pytest.approx(np.sqrt(predicted), rel=0.15)


def test_the_estimated_rig_lies_within_its_stated_covariance(corners, n10):
    """All parameters at once: their squared distance from the known rig, in units of the covariance, is chi-squared."""
    board = Board(COLUMNS, ROWS, SQUARE, "glass")
    points, pixels, views = [], {"left": [], "right": []}, []
    for (_, left, ids), (_, right, other_ids), pose in zip(corners["left"], corners["right"], poses(), strict=True):
        both, here, there = np.intersect1d(ids, other_ids, return_indices=True)
        points.append(board.corners[both])
        pixels["left"].append(left[here].astype(float)), pixels["right"].append(right[there].astype(float))
        place = pose.inverse() @ Transform(np.eye(3), MIDDLE)
        views.append(BoardView(place, both, 0.03))
    found, _ = estimate(n10.measuring_rig, n10.rig.cameras, SimulatedCorners(points, pixels))
    linear = linearise(BoardSetup(n10.measuring_rig, n10.rig.cameras, board, views))
    exact = replace(linear, board_sigma=0 * linear.board_sigma).covariance()  # the rendered board has no errors
    wrong = parameter_differences(n10.rig, found, linear.names)
    distance = wrong @ np.linalg.solve(exact, wrong)
    low, high = stats.chi2.ppf([0.001, 0.999], len(wrong))
    assert low < distance < high
    print(f"squared distance {distance:.1f} of {len(wrong)} parameters")


def test_the_rig_comes_back(corners, n10):
    """Baseline and vergence from stereo calibration, intrinsics found on the way."""
    left, right = n10.rig.cameras.values()
    objects, lefts, rights = [], [], []
    for (points, pixels, ids), (_, others, other_ids) in zip(corners["left"], corners["right"], strict=True):
        both, here, there = np.intersect1d(ids, other_ids, return_indices=True)
        assert len(both) > 10
        objects.append(points[here]), lefts.append(pixels[here]), rights.append(others[there])
    size = (left.width, left.height)
    intrinsics = [cv2.calibrateCamera(objects, images, size, None, None)[1:3] for images in (lefts, rights)]
    rms, *_, R, t, _, _ = cv2.stereoCalibrate(
        objects, lefts, rights, *intrinsics[0], *intrinsics[1], size, flags=cv2.CALIB_FIX_INTRINSIC
    )
    true = right.sensor_from_camera.inverse() @ left.sensor_from_camera
    turn = np.degrees(np.linalg.norm(cv2.Rodrigues(R @ true.rotation.T)[0]))
    assert rms < 0.06
    assert abs(np.linalg.norm(t) - np.linalg.norm(true.translation)) < 0.05
    # a principal point that is off by its own 0.12 px turns a camera by 0.011 deg: two cameras, four of them
    assert turn < 4 * 0.011 * np.sqrt(2)
    print(f"stereo rms {rms:.4f} px, baseline {np.linalg.norm(t):.3f} mm, turned by {turn:.4f} deg")
