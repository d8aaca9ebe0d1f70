"""Truth at every pixel against the closed form of a sphere over a floor, and its OpenEXR image."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import OpenEXR
import pytest
from scipy.ndimage import binary_erosion

import mitsim as ms
from characterisation.files.errors import InputError
from characterisation.point_cloud import PointCloud, Status
from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.capture.simulated.truth import true_images
from mitsim.capture.truth import encode_exr, read_truth
from mitsim.decoding.matching.stereo_geometry import stereo_geometry
from mitsim.scene.backend import mi
from mitsim.scene.load import scene_from_dict
from mitsim.scene.ray_casting.raycast import PixelRays, cast
from mitsim.sensor.sensor_file import MisalignmentTable
from mitsim.sensor.transforms import look_at

POSE = look_at([40, -480, 300], [0, 0, 20], [0, 0, 1], 10)
RADIUS = 40.0


def ball_on_a_floor():
    """A white ball of radius 40 on a white floor."""
    floor = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().scale([150, 150, 1]),
        "bsdf": {"type": "matt_white"},
    }
    sphere = {"type": "sphere", "radius": RADIUS, "center": [0, 0, 40], "bsdf": {"type": "matt_white"}}
    return scene_from_dict({"ball": sphere, "floor": floor}, 850)


@pytest.fixture(scope="module")
def ball(n10):
    """Seen by the N10's distorted left camera."""
    return true_images(SimulatedSensor(n10), ball_on_a_floor(), POSE, samples=16, depth=3, seed=1)["left"]


@pytest.fixture(scope="module")
def directions(n10):
    camera = n10.rig.cameras["left"]
    return camera.rays(camera.pixel_grid())


def test_the_ball_is_where_its_equation_puts_it(ball, directions):
    centre = POSE.inverse().points(np.array([0, 0, 40.0]))
    b = directions @ centre
    inside = b**2 - (centre @ centre - RADIUS**2)
    on_ball = ball.feature == ball.feature_names.index("ball")
    assert np.array_equal(on_ball, inside > 0)
    away = on_ball & (inside > 10)
    distance = b - np.sqrt(np.maximum(inside, 0))
    assert np.abs(ball.distance - distance)[away].max() < 0.01
    assert np.abs(ball.depth - distance * directions[..., 2])[away].max() < 0.01
    points = directions * distance[..., None]
    assert np.abs(ball.normal - (points - centre) / RADIUS)[away].max() < 1e-3
    assert (ball.feature[np.isnan(ball.distance)] == -1).all()


def test_the_projector_coordinate_is_that_of_the_point(ball, directions, n10):
    there = np.isfinite(ball.distance)
    points = directions[there] * ball.distance[there][:, None]
    assert np.abs(ball.projector[there] - n10.projector.optics.project(points)).max() < 1e-3
    assert np.isnan(ball.projector[~there]).all()


def test_lit_is_facing_the_projector_and_not_behind_the_ball(ball, directions, n10):
    """On the ball: the sign of N . (lamp - P). On the floor: whether the segment to the lamp misses the sphere."""
    lamp = n10.projector.optics.centre
    centre = POSE.inverse().points(np.array([0, 0, 40.0]))
    points = directions * ball.distance[..., None].astype(float)
    to_lamp = lamp - points
    to_lamp /= np.linalg.norm(to_lamp, axis=-1, keepdims=True)
    cosine = np.einsum("ijk,ijk->ij", ball.normal, to_lamp)
    on_ball = ball.feature == 0
    clear = on_ball & (np.abs(cosine) > 0.01)
    assert np.array_equal(ball.lit[clear], cosine[clear] > 0)
    along = np.einsum("ijk,ijk->ij", centre - points, to_lamp)
    miss = np.linalg.norm(points + to_lamp * np.maximum(along, 0)[..., None] - centre, axis=-1)
    floor = (ball.feature == 1) & (np.abs(miss - RADIUS) > 0.05)
    assert (floor & (miss < RADIUS)).sum() > 100
    assert np.array_equal(ball.lit[floor], miss[floor] > RADIUS)


def test_indirect_light_is_none_on_top_and_most_below(ball):
    """The ball's top sees no other surface; its underside is lit by the floor alone."""
    world = POSE.rotation @ ball.normal[..., None].astype(float)
    up = world[..., 2, 0]
    on_ball = (ball.feature == 0) & ball.lit
    assert ball.indirect[on_ball & (up > 0.999)].max() < 1e-6
    assert ball.indirect[on_ball & (up < -0.2)].mean() > 0.05
    unlit = binary_erosion(~ball.lit, iterations=2) & (ball.feature == 1) & np.isfinite(ball.indirect)
    assert unlit.sum() > 30
    assert (ball.indirect[unlit] == 1.0).all()


def test_the_image_keeps_every_channel(ball, tmp_path):
    (tmp_path / "truth").mkdir()
    (tmp_path / "truth" / "left.exr").write_bytes(encode_exr(ball))
    again = read_truth(tmp_path)
    assert list(again) == ["left"] and again["left"].feature_names == ball.feature_names
    for name in ("distance", "depth", "normal", "feature", "projector", "lit", "indirect"):
        kept, known = getattr(again["left"], name), getattr(ball, name)
        assert kept.dtype == known.dtype and np.array_equal(kept, known, equal_nan=True), name


def test_a_rendered_capture_is_written_with_its_truth_and_copied_with_it(n10, tmp_path):
    capture, truth = ms.render(ball_on_a_floor(), n10, POSE, samples=1, depth=1, check=False, truth=True)
    ms.write_capture(capture, tmp_path / "first", truth=truth)
    read = ms.read_truth(tmp_path / "first")
    ms.write_capture(ms.read_capture(tmp_path / "first"), tmp_path / "copy", truth=read)
    for folder in ("first", "copy"):
        again = ms.read_truth(tmp_path / folder)
        assert sorted(again) == ["left", "right"]
        assert all(np.array_equal(again[name].depth, truth[name].depth, equal_nan=True) for name in truth)


def test_a_folder_without_truth_and_damaged_files_are_told(ball, tmp_path):
    with pytest.raises(InputError, match=r"truth: found no true images.*--truth"):
        read_truth(tmp_path)
    (tmp_path / "truth").mkdir()
    file = tmp_path / "truth" / "left.exr"
    for data in (b"", b"not an image", encode_exr(ball)[:400]):
        file.write_bytes(data)
        with pytest.raises(InputError, match=r"left\.exr"):
            read_truth(tmp_path)
    OpenEXR.File({"type": OpenEXR.scanlineimage}, {"Z": np.zeros((2, 2), np.float32)}).write(str(file))
    with pytest.raises(InputError, match="no 'features'"):
        read_truth(tmp_path)


def test_truth_is_of_the_camera_as_it_is_and_not_as_it_was_calibrated(n10):
    """A camera turned by 5 mrad about its x axis sees a floor elsewhere than its calibration says."""
    floor = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().scale([300, 300, 1]),
        "bsdf": {"type": "matt_white"},
    }
    scene = scene_from_dict({"floor": floor}, 850)
    turned = replace(n10, misalignment=MisalignmentTable(row_mrad=5.0))
    seen = true_images(SimulatedSensor(turned), scene, POSE, samples=1, depth=3, seed=1)["right"]
    eye = turned.true_rig.cameras["right"]
    directions = POSE.directions(eye.pixel_directions().reshape(-1, 3)).reshape(*seen.distance.shape, 3)
    distance = -POSE.points(eye.centre)[2] / directions[..., 2]
    known = np.isfinite(seen.distance)
    assert known.sum() > 1000
    np.testing.assert_allclose(seen.distance[known], distance[known], atol=0.01)
    calibrated = n10.rig.cameras["right"].pixel_directions()
    assert np.abs(calibrated - eye.pixel_directions()).max() > 4e-3  # 2 mm of distance here


def test_render_gives_the_truth_of_every_camera_beside_the_same_capture(n10):
    floor = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().scale([150, 150, 1]),
        "bsdf": {"type": "matt_white"},
    }
    scene = scene_from_dict({"floor": floor}, 850)
    alone = ms.render(scene, n10, POSE, samples=1, depth=1, check=False)
    capture, truth = ms.render(scene, n10, POSE, samples=1, depth=1, check=False, truth=True)
    assert list(truth) == list(capture.images)
    for name, seen in truth.items():
        np.testing.assert_array_equal(capture.images[name], alone.images[name])
        rays = PixelRays.of_camera(n10.rig.cameras[name])
        np.testing.assert_array_equal(seen.distance, cast(scene, rays, POSE, np.zeros((1, 3))).distance)
        assert seen.feature_names == ("floor",)
        np.testing.assert_array_equal(seen.feature == 0, np.isfinite(seen.depth))


def test_true_points_lie_on_the_surfaces_and_on_the_rays_of_the_rectified_image(n10):
    grid = stereo_geometry(n10.rig).grid
    nothing = np.full((grid.height, grid.width), Status.NO_SURFACE, np.uint8)
    cloud = PointCloud(np.full((*nothing.shape, 3), np.nan, np.float32), nothing, grid, "n10", "simulated")
    points = ms.true_points(cloud, ball_on_a_floor(), POSE.matrix())
    seen = np.isfinite(points[..., 2])
    assert 0.1 < seen.mean() < 1
    columns, rows = np.meshgrid(np.arange(grid.width), np.arange(grid.height))
    np.testing.assert_allclose(grid.project(points[seen]), np.stack([columns, rows], -1)[seen], atol=1e-6)
    x, y, z = POSE.points(points[seen]).T
    on_floor, on_ball = np.abs(z), np.abs(np.hypot(np.hypot(x, y), z - 40) - RADIUS)
    np.testing.assert_allclose(np.minimum(on_floor, on_ball), 0, atol=2e-3)
    assert (on_ball < 2e-3).sum() > 1000 and np.abs(
        np.concatenate([x[on_floor < 2e-3], y[on_floor < 2e-3]])
    ).max() < 150.1
