"""A board on a pan-tilt table, rendered, found by OpenCV, and the table's axes found from that."""

from __future__ import annotations

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from characterisation.stage.calibration import axis_deviations, calibrate_with_board, calibration_angles
from characterisation.stage.turning_axes import TurningAxes
from mitsim.capture.simulated.lens_blur import gaussian_blur
from mitsim.scene.backend import mi
from mitsim.scene.light_transport.light_paths import LightPaths
from mitsim.scene.light_transport.projected_codes import ProjectedPatterns
from mitsim.scene.light_transport.transport import trace
from mitsim.scene.load import scene_from_dict
from mitsim.scene.ray_casting.camera_rays import CameraRays
from mitsim.sensor.transforms import Transform
from tests.characterisation.stage.known_stage import axes_error, unit

COLUMNS, ROWS, SQUARE, MARKER, TEXELS = 11, 8, 32.0, 19.0, 96
STEP = np.radians(185.1428 / 3600)  # of a PTU-D46


def board_scene(board):
    """The board in its own frame, x right, y down, z away from the viewer, printed in 5 % and 85 % grey."""
    printed = board.generateImage((COLUMNS * TEXELS, ROWS * TEXELS), marginSize=0, borderBits=1)
    grey = 0.05 + 0.8 * printed.astype(np.float32) / 255
    middle = [COLUMNS * SQUARE / 2, ROWS * SQUARE / 2, 0]
    to_world = mi.ScalarTransform4f().translate(middle).rotate([1, 0, 0], 180).scale([middle[0], middle[1], 1])
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(grey[::-1, :, None].copy()), "raw": True}
    bsdf = {"type": "diffuse", "reflectance": texture}
    return scene_from_dict({"board": {"type": "rectangle", "to_world": to_world, "bsdf": bsdf}}, 850)


def test_the_axes_come_back_from_rendered_captures_of_a_board(n10):
    rng, camera = np.random.default_rng(7), n10.rig.reference
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_250)
    board = cv2.aruco.CharucoBoard((COLUMNS, ROWS), SQUARE, MARKER, dictionary)
    detector, scene = cv2.aruco.CharucoDetector(board), board_scene(board)
    white = ProjectedPatterns(np.ones((1, n10.projector.optics.height, n10.projector.optics.width)), n10.projector)
    rays = CameraRays(camera, 2.09, 600.0)

    zero = np.eye(4)
    zero[:3, :3] = Rotation.from_euler("xyz", [2, -1, 3], degrees=True).as_matrix()
    middle = np.array([0.0, 20.0, 520.0])
    zero[:3, 3] = middle - zero[:3, :3] @ [COLUMNS * SQUARE / 2, ROWS * SQUARE / 2, 0]
    axes = TurningAxes(
        np.array([unit([0.02, 1.0, -0.04]), unit([1.0, 0.03, 0.05])]),
        middle + np.array([[3, 0, 40], [0, -8, 25]]),
    )
    read = np.round(calibration_angles(np.radians([[-35, 35], [-30, 30]]), 3) / STEP) * STEP
    poses = []
    for pose in axes.motion(read) @ zero:
        light = trace(scene, rays, white, Transform.from_matrix(pose).inverse(), LightPaths(samples=16, seed=1))[0]
        light = gaussian_blur(light, n10.imager.blur_px)
        electrons = light / np.percentile(light, 99.9) * 0.9 * n10.imager.full_well
        noisy = [rng.poisson(electrons) + rng.normal(0, n10.imager.read_noise, light.shape) for _ in range(4)]
        grey = np.clip(np.rint(4 + np.mean(noisy, 0) / n10.imager.full_well * 251), 0, 255).astype(np.uint8)
        pixels, ids, *_ = detector.detectBoard(grey)
        pixels = cv2.cornerSubPix(grey, np.float32(pixels), (4, 4), (-1, -1), (3, 100, 1e-5))
        corners, pixels = (part.reshape(len(ids), -1).astype(float) for part in board.matchImagePoints(pixels, ids))
        _, turn, place = cv2.solvePnP(corners, pixels, camera.matrix, camera.distortion)
        found = np.eye(4)
        found[:3, :3], found[:3, 3] = cv2.Rodrigues(turn)[0], place.ravel()
        poses.append(found)

    fit = calibrate_with_board(read, np.array(poses))
    tilts, shifts = axis_deviations(fit)
    errors = np.linalg.norm(axes_error(axes, fit.axes).reshape(2, 2, 2), axis=2)  # axis, (direction, point)
    # two standard deviations in one number: 1 in 3000 is over four of them
    assert (errors[:, 0] < 4 * tilts).all()
    assert (errors[:, 1] < 4 * shifts).all()
    assert np.degrees(tilts).max() < 0.02
    assert shifts.max() < 0.06
    place, stated = zero[:3, 3] - fit.zero_pose[:3, 3], np.sqrt(np.diag(fit.covariance)[-3:])
    print(
        f"directions off by {np.degrees(errors[:, 0]).round(4)} deg (stated {np.degrees(tilts).round(4)}), "
        f"points by {errors[:, 1].round(4)} mm ({shifts.round(4)}), "
        f"the board at zero by {place.round(4)} mm ({stated.round(4)})"
    )
