"""Images of a part follow it to another pose, as its points do."""

from dataclasses import replace

import numpy as np
import pytest

from characterisation.region_of_interest import Roi
from mitsim.capture.simulated.image_motion import code_motion, image_motion, moved_images
from mitsim.sensor.preset import load_sensor
from mitsim.sensor.transforms import Transform, look_at

POSE = look_at((0.0, -300.0, 450.0), (0.0, 0.0, 20.0), (0.0, 0.0, 1.0))
POINTS = np.array([(x, y, z) for x in (-40, 0, 40) for y in (-30, 30) for z in (0, 40)], float)


@pytest.fixture(scope="module")
def camera():
    return next(iter(load_sensor("ensenso-n10").rig.cameras.values()))


def placed(step_mm, angle_deg):
    angle = np.radians(angle_deg)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    return Transform(turn, np.array(step_mm, float)).inverse() @ POSE


@pytest.mark.parametrize(("step_mm", "angle_deg"), [((1.0, -0.7, 0.5), 0.4), ((0.0, 0.0, 3.0), 0.0), ((2, 2, 0), -1.0)])
def test_a_bright_spot_moves_with_its_point_of_the_part(camera, step_mm, angle_deg):
    roi = Roi(60, 40, 600, 400)
    other = placed(step_mm, angle_deg)
    motion = image_motion(camera, POSE, camera, other, POINTS, roi)
    rows, columns = np.mgrid[: roi.height, : roi.width]
    for point in POINTS:
        column, row = camera.project(POSE.inverse().points(point[None]))[0] - [roi.left, roi.top]
        spot = np.exp(-((columns - column) ** 2 + (rows - row) ** 2) / 18).astype(np.float32)
        image = moved_images(spot[None], motion)[0]
        found = np.array([(columns * image).sum(), (rows * image).sum()]) / image.sum()
        expected = camera.project(other.inverse().points(point[None]))[0] - [roi.left, roi.top]
        assert np.abs(expected - (column, row)).max() > 0.5
        assert np.abs(found - expected).max() < 0.5 * np.abs(expected - (column, row)).max()


def test_another_calibration_moves_the_image_too(camera):
    matrix = camera.matrix.copy()
    matrix[0, 2] += 1.5
    motion = image_motion(camera, POSE, replace(camera, matrix=matrix), POSE, POINTS, Roi(0, 0, 200, 100))
    np.testing.assert_allclose(motion, [[1, 0, -1.5], [0, 1, 0]], atol=1e-6)


def test_no_motion_without_points_in_sight(camera):
    behind = POSE.inverse().points(POINTS) * [1, 1, -1]
    points = POSE.points(behind)
    images = np.random.default_rng(1).random((2, 5, 6), np.float32)
    motion = image_motion(camera, POSE, camera, POSE, points, Roi(0, 0, 6, 5))
    assert motion is None and moved_images(images, motion) is images
    assert moved_images(images[:0], np.eye(2, 3)).shape == (0, 5, 6)


@pytest.mark.parametrize(("step_mm", "angle_deg"), [((1.0, -0.7, 0.5), 0.4), ((0.0, 0.0, 3.0), 0.0), ((2, 2, 0), -1.0)])
def test_the_code_of_a_point_moves_with_it(step_mm, angle_deg):
    """A map of texture coordinates, from 0 to 1 between the edges of the pattern; parallax within the part remains."""
    projector = load_sensor("zivid-2-m70").rig.projector
    other = placed(step_mm, angle_deg)

    def code(pose):
        return (projector.project(pose.inverse().points(POINTS)) + 0.5) / [projector.width, projector.height]

    motion = code_motion(projector, POSE, projector, other, POINTS)
    found = code(POSE) @ motion[:, :2].T + motion[:, 2]
    moved = np.abs(code(other) - code(POSE)).max()
    assert moved > 5e-4 and np.abs(found - code(other)).max() < 0.2 * moved


def test_no_motion_of_the_code_without_points_in_sight():
    projector = load_sensor("zivid-2-m70").rig.projector
    points = POSE.points(POSE.inverse().points(POINTS) * [1, 1, -1])
    assert code_motion(projector, POSE, projector, POSE, points) is None
