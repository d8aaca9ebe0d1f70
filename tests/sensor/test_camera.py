"""Cameras are exact in both directions, also with strong distortion."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from characterisation.files.errors import InputError
from mitsim.sensor.camera import Camera, Rectification, Rig, stereo_rectification
from mitsim.sensor.preset import load_sensor
from mitsim.sensor.sensor_file import OpticsTable
from mitsim.sensor.transforms import Transform

K = np.array([[626.18, 0, 372.16], [0, 626.13, 240.86], [0, 0, 1.0]])
ENSENSO = np.array([-0.43676, 0.24510, 0.000151, 0.000188, -0.09039])
FOURTEEN = np.array([-0.2, 0.1, 1e-4, -2e-4, 0.01, 0.05, 0.02, 0.01, 1e-4, 1e-5, -1e-4, 1e-5, 0.002, -0.006])
FISHEYE = np.array([0.05, -0.01, 0.002, -0.0005])


@pytest.mark.parametrize(
    ("distortion", "model"), [(ENSENSO, "perspective"), (FOURTEEN, "perspective"), (FISHEYE, "fisheye")]
)
def test_pixel_to_ray_to_pixel(distortion, model):
    place = Transform.from_degrees([3, -8, 1], [100, 2, 7])
    camera = Camera(K, distortion, 752, 480, place, model)
    grid = camera.pixel_grid()
    points = place.points(camera.rays(grid) * 700)
    assert np.abs(camera.project(points) - grid).max() < 1e-6
    assert np.allclose(np.linalg.norm(camera.rays(grid), axis=-1), 1)


@pytest.mark.parametrize(("distortion", "model"), [(ENSENSO, "perspective"), (FISHEYE, "fisheye")])
@pytest.mark.parametrize("threads", ["1", "3"])
def test_the_ray_of_a_pixel_does_not_depend_on_the_others(distortion, model, threads, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", threads)
    camera = Camera(K, distortion, 752, 480, model=model)
    grid = camera.pixel_grid()
    rays = camera.rays(grid)
    for row in (0, 21, 22, 479):  # a part of 16384 pixels ends in row 21
        assert camera.rays(grid[row]).tobytes() == rays[row].tobytes()
    assert camera.rays(grid[:0]).shape == (0, 752, 3)


@pytest.mark.parametrize(("distortion", "model"), [(FOURTEEN, "perspective"), (FISHEYE, "fisheye")])
def test_many_points_are_projected_as_all_at_once(distortion, model):
    camera = Camera(K, distortion, 752, 480, Transform.from_degrees([3, -8, 1], [100, 2, 7]), model)
    points = np.random.default_rng(1).uniform([-200, -200, 300], [200, 200, 900], (70_000, 3))
    local = np.ascontiguousarray(camera.sensor_from_camera.inverse().points(points)).reshape(-1, 1, 3)
    project = cv2.projectPoints if model == "perspective" else cv2.fisheye.projectPoints
    whole = project(local, np.zeros(3), np.zeros(3), K, distortion)[0].reshape(-1, 2)
    assert camera.project(points).tobytes() == whole.tobytes()


@pytest.mark.parametrize("distortion", [np.zeros(0), ENSENSO[:4], ENSENSO, FOURTEEN[:8], FOURTEEN[:12]])
def test_points_are_projected_as_by_opencv(distortion):
    """To the last bits: a compiler may fuse a product and a sum."""
    camera = Camera(K, distortion, 752, 480)
    points = np.random.default_rng(1).uniform([-200, -200, 300], [200, 200, 900], (20_000, 3))
    other = cv2.projectPoints(points.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), K, distortion)[0].reshape(-1, 2)
    np.testing.assert_allclose(camera.project(points), other, rtol=0, atol=1e-11)


def test_a_pinhole_is_the_textbook_one():
    camera = Camera(K, np.zeros(5), 752, 480)
    assert np.allclose(camera.project(np.array([30.0, -20.0, 600.0])), [626.18 * 0.05 + 372.16, 240.86 - 626.13 / 30])


def test_a_point_behind_the_camera_has_no_image():
    camera = Camera(K, ENSENSO, 752, 480)
    assert np.isnan(camera.project(np.array([[0.0, 0.0, -100.0]]))).all()


def test_cameras_with_equal_values_are_equal_and_others_are_not():
    """Tables of pixels are kept by camera: a change of any field must give another camera."""
    camera, same = (load_sensor("ensenso-n10").rig.cameras["right"] for _ in range(2))
    assert camera == same and hash(camera) == hash(same)
    moved = Transform(camera.sensor_from_camera.rotation, camera.sensor_from_camera.translation + 1e-9)
    others = [
        replace(camera, matrix=camera.matrix * [[1, 1, 1 + 1e-12]] * 3),
        replace(camera, distortion=-camera.distortion),
        replace(camera, width=camera.width + 1),
        replace(camera, height=camera.height + 1),
        replace(camera, model="fisheye"),
        replace(camera, sensor_from_camera=moved),
    ]
    assert len({camera, *others}) == len(others) + 1


def test_an_unknown_model_is_refused():
    with pytest.raises(ValueError, match="perspective, fisheye"):
        Camera(K, ENSENSO, 752, 480, model="pinhole")


def test_rectification_aligns_rows_and_gives_depth(n10):
    left, right = n10.rig.cameras.values()
    rectified = stereo_rectification(left, right)
    points = np.random.default_rng(1).uniform([-150, -100, 400], [150, 100, 800], (200, 3))
    turned = {}
    for name, camera, rotation, matrix in (
        ("left", left, rectified.rotation_left, rectified.matrix_left),
        ("right", right, rectified.rotation_right, rectified.matrix_right),
    ):
        local = camera.sensor_from_camera.inverse().points(points) @ rotation.T
        turned[name] = (local / local[:, 2:]) @ matrix.T, local[:, 2]
    (x_left, depth), (x_right, _) = turned["left"], turned["right"]
    assert np.abs(x_left[:, 1] - x_right[:, 1]).max() < 1e-6
    assert np.allclose(rectified.depth(x_left[:, 0] - x_right[:, 0]), depth, rtol=1e-9)
    assert np.isclose(rectified.baseline, 101.04, atol=0.01)


@pytest.mark.parametrize("roll", [0, 45, 89.9, 90, 135, 180, -179.9, -90, -45])
@pytest.mark.parametrize("shift", [(100, 0, 0), (0, 100, 0), (0, -100, 0), (-100, 0, 0), (70, 70, 0)], ids=str)
def test_a_pair_is_rectified_at_any_roll_and_baseline(roll, shift):
    """OpenCV rectifies along columns if half the roll makes the baseline steep: depths were NaN in most pairs."""
    left = Camera(
        np.array([[800.0, 0, 330], [0, 810, 250], [0, 0, 1]]), np.array([-0.1, 0.02, 1e-3, -1e-3, 0]), 640, 480
    )
    right = replace(left, sensor_from_camera=Transform.from_degrees([4.0, -6.0, roll], shift))
    points = np.random.default_rng(1).uniform([-80, -60, 450], [80, 60, 650], (50, 3))
    pair = stereo_rectification(left, right)
    turned = {}
    for eye, rotation, matrix in (
        (left, pair.rotation_left, pair.matrix_left),
        (right, pair.rotation_right, pair.matrix_right),
    ):
        local = eye.rays(eye.project(points)) @ rotation.T
        turned[eye] = (local / local[:, 2:]) @ matrix.T
    assert np.abs(turned[left][:, 1] - turned[right][:, 1]).max() < 1e-6
    depth = pair.depth(turned[left][:, 0] - turned[right][:, 0])
    found = depth[:, None] * (turned[left] @ np.linalg.inv(pair.matrix_left).T) @ pair.rotation_left
    np.testing.assert_allclose(found, points, atol=1e-8)
    middle = np.array([(left.width - 1) / 2, (left.height - 1) / 2, 1.0])
    shown = pair.matrix_left @ pair.rotation_left @ np.linalg.inv(left.matrix) @ middle
    assert (np.abs(shown[:2] / shown[2] / [pair.width, pair.height] - 0.5) < 0.3).all()


@given(st.floats(100, 5000))
def test_disparity_and_depth_are_inverse(depth):
    matrix = np.array([[600.0, 0, 300], [0, 600, 240], [0, 0, 1]])
    shifted = matrix + np.array([[0, 0, 150], [0, 0, 0], [0, 0, 0]])
    rectified = Rectification(matrix, shifted, np.eye(3), np.eye(3), 100.0, 752, 480)
    assert np.isclose(rectified.depth(rectified.disparity(depth)), depth)


def test_a_disparity_beyond_infinity_has_no_depth():
    rectified = Rectification(K, K, np.eye(3), np.eye(3), 100.0, 752, 480)
    assert np.isnan(rectified.depth(np.array([0.0, -5.0]))).all()


def test_the_baseline_points_to_the_second_eye(n10):
    direction = n10.rig.baseline_direction
    assert np.allclose(direction, [np.cos(np.radians(4.15)), 0, np.sin(np.radians(4.15))], atol=1e-4)
    assert np.array_equal(Rig({"one": n10.rig.reference}).baseline_direction, [1, 0, 0])


def test_a_pair_in_one_place_is_refused():
    """OpenCV's assertion ended the program."""
    camera = Camera(np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]), np.zeros(5), 640, 480)
    with pytest.raises(InputError, match="both cameras of the pair in the same place"):
        stereo_rectification(camera, camera)


@pytest.mark.parametrize(("count", "fits"), [(4, True), (5, False), (14, False)])
def test_a_fisheye_lens_has_up_to_four_coefficients(count, fits):
    """Before, more were accepted, and projecting was an error of OpenCV."""
    optics = {"width": 64, "height": 48, "focal_px": [60, 60], "principal_px": [32, 24], "model": "fisheye"}
    if fits:
        assert np.isfinite(OpticsTable(**optics, distortion=[0.01] * count).camera().project(np.ones(3))).all()
    else:
        with pytest.raises(ValidationError, match=f"at most four coefficients of distortion .*, not {count}"):
            OpticsTable(**optics, distortion=[0.01] * count)
