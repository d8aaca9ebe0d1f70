"""Maps that a device has measured itself, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from characterisation.files.errors import InputError
from characterisation.point_cloud import Status, ViewGrid
from characterisation.region_of_interest import Roi
from mitsim.decoding.device_maps import (
    camera_map_geometry,
    decode_device_map,
    disparity_map_geometry,
    roi_of_other_grid,
)
from mitsim.sensor.camera import Camera, Rectification, Rig
from mitsim.sensor.transforms import Transform

WIDTH, HEIGHT = 60, 40
K = np.array([[70.0, 0, 31.0], [0, 72.0, 18.0], [0, 0, 1]])
PLACE = Transform.from_degrees([3, -5, 10], [20, 5, -2])
NORMAL, OFFSET = np.array([0.2, -0.1, -1.0]) / np.linalg.norm([0.2, -0.1, -1.0]), -600.0

LENSES = pytest.mark.parametrize(
    ("distortion", "model"),
    [
        (np.zeros(5), "perspective"),
        (np.array([-0.2, 0.05, 1e-3, 2e-3, 0.0]), "perspective"),
        (np.array([0.05, -0.01, 0.0, 0.0]), "fisheye"),
    ],
    ids=["pinhole", "distorted", "fisheye"],
)


def plane_depths(camera: Camera) -> np.ndarray:
    """Depth along the axis of a plane n.p = c of the sensor frame, on the camera's own rays."""
    local = camera.rays(camera.pixel_grid())
    ray = camera.sensor_from_camera.directions(local)
    along = (OFFSET - camera.centre @ NORMAL) / (ray @ NORMAL)
    return along * local[..., 2]


@LENSES
def test_depths_of_a_plane_become_points_of_the_plane(distortion, model):
    camera = Camera(K, distortion, WIDTH, HEIGHT, PLACE, model)
    depth = plane_depths(camera)
    cloud = decode_device_map(
        "depth", depth, camera_map_geometry(Rig({"camera": camera})), (1.0, 1e5), sensor="s", source="device"
    )
    assert cloud.valid.all()
    # rays of bent grids are kept in float32: 6e-8 of 600 mm
    np.testing.assert_allclose(cloud.points @ NORMAL, OFFSET, atol=5e-4)
    np.testing.assert_allclose(camera.project(cloud.points.astype(float)), camera.pixel_grid(), atol=1e-3)


def test_pixels_beyond_the_fold_of_the_distortion_are_left_out_with_their_reason():
    """r (1 - 1.5 r^2) ends at 0.3143, 22 px from the axis."""
    camera = Camera(K, np.array([-1.5, 0, 0, 0, 0]), WIDTH, HEIGHT)
    depth = np.full((HEIGHT, WIDTH), 500.0, np.float32)
    depth[::3] = np.nan
    cloud = decode_device_map(
        "depth", depth, camera_map_geometry(Rig({"camera": camera})), (1.0, 1e5), sensor="s", source="device"
    )
    radius = np.linalg.norm((camera.pixel_grid() - K[:2, 2]) / [70.0, 72.0], axis=-1)
    assert (cloud.status[radius > 0.3145] == Status.UNCALIBRATED).all()
    assert cloud.valid[(radius < 0.314) & np.isfinite(depth)].all()
    assert (cloud.status[(radius < 0.314) & np.isnan(depth)] == Status.NO_SURFACE).all()


def test_what_is_missing_or_out_of_range_says_so():
    camera = Camera(K, np.zeros(5), WIDTH, HEIGHT)
    depth = np.full((HEIGHT, WIDTH), 500.0, np.float32)
    depth[0, 0], depth[1, 1], depth[2, 2] = np.nan, 299.0, 801.0
    cloud = decode_device_map(
        "depth", depth, camera_map_geometry(Rig({"c": camera})), (300.0, 800.0), sensor="s", source="device"
    )
    assert cloud.status[0, 0] == Status.NO_SURFACE
    assert cloud.status[1, 1] == cloud.status[2, 2] == Status.OUT_OF_RANGE
    assert cloud.valid.sum() == WIDTH * HEIGHT - 3
    np.testing.assert_array_equal(cloud.valid, cloud.status == Status.VALID)


def test_disparities_are_triangulated_with_the_offset_of_the_principal_points():
    turn = Rotation.from_euler("y", 4, degrees=True).as_matrix()
    right = K + np.array([[0, 0, 12.5], [0, 0, 0], [0, 0, 0]])
    pair = Rectification(K, right, turn, turn, 75.0, WIDTH, HEIGHT)
    rig = Rig({"left": Camera(K, np.zeros(5), WIDTH, HEIGHT)}, rectification=pair)
    disparity = np.full((HEIGHT, WIDTH), 3.0, np.float32)
    disparity[5, 6], disparity[7, 8] = np.nan, -12.5
    cloud = decode_device_map(
        "disparity", disparity, disparity_map_geometry(rig), (1.0, 1e5), sensor="s", source="device"
    )
    depth = 70.0 * 75.0 / (3.0 + 12.5)  # f B / (d + cx_right - cx_left)
    local = np.array([(50 - 31.0) / 70.0, (30 - 18.0) / 72.0, 1.0]) * depth
    np.testing.assert_allclose(cloud.points[30, 50], turn.T @ local, rtol=1e-6)
    assert not cloud.valid[5, 6] and not cloud.valid[7, 8] and cloud.valid.sum() == WIDTH * HEIGHT - 2
    with pytest.raises(InputError, match="rectification"):
        disparity_map_geometry(Rig(rig.cameras))


@LENSES
def test_points_are_taken_as_they_are(distortion, model):
    camera = Camera(K, distortion, WIDTH, HEIGHT, PLACE, model)
    geometry = camera_map_geometry(Rig({"camera": camera}))
    depth = plane_depths(camera)
    points = decode_device_map("depth", depth, geometry, (1.0, 1e5), sensor="s", source="device").points
    cloud = decode_device_map("points", points, geometry, (1.0, 1e5), sensor="s", source="device")
    np.testing.assert_array_equal(cloud.points, points)
    middle = float(np.median(depth))
    cut = decode_device_map("points", points, geometry, (middle, 1e5), sensor="s", source="device")
    # at the median itself float32 decides
    np.testing.assert_array_equal(cut.valid[depth > middle * (1 + 1e-6)], True)
    np.testing.assert_array_equal(cut.valid[depth < middle * (1 - 1e-6)], False)


@LENSES
def test_a_window_is_cut_out_of_the_whole(distortion, model):
    camera = Camera(K, distortion, WIDTH, HEIGHT, PLACE, model)
    geometry, depth = camera_map_geometry(Rig({"camera": camera})), plane_depths(camera)
    roi = Roi.between(7, 11, 33, 29)
    whole = decode_device_map("depth", depth, geometry, (1.0, 1e5), sensor="s", source="device")
    part = decode_device_map("depth", depth, geometry, (1.0, 1e5), sensor="s", source="device", roi=roi)
    inside = np.zeros((HEIGHT, WIDTH), bool)
    inside[11:29, 7:33] = True
    np.testing.assert_array_equal(part.points[inside], whole.points[inside])
    assert not part.valid[~inside].any() and (part.status[~inside] == Status.NO_SURFACE).all()


def test_maps_of_another_size_are_refused():
    geometry = camera_map_geometry(Rig({"c": Camera(K, np.zeros(5), WIDTH, HEIGHT)}))
    with pytest.raises(InputError, match="60 x 40 px, as the calibration says"):
        decode_device_map("depth", np.ones((4, 4)), geometry, (1.0, 2.0), sensor="s", source="device")
    with pytest.raises(InputError, match="map of points: size: found 4 x 4 px"):
        decode_device_map("points", np.ones((4, 4, 3)), geometry, (1.0, 2.0), sensor="s", source="device")


def test_a_window_of_another_grid_holds_all_that_it_shows(rng):
    """Random points in the frustum of a window, seen by a camera that is turned and moved."""
    one = ViewGrid(70.0, 72.0, 31.0, 18.0, WIDTH, HEIGHT)
    turn = Rotation.from_euler("xyz", [5, -8, 30], degrees=True).as_matrix()
    other = ViewGrid(150.0, 150.0, 80.0, 60.0, 160, 120, turn, np.array([30.0, -10.0, 5.0]))
    roi = Roi.between(20, 10, 35, 22)
    found = roi_of_other_grid(one, other, roi, 300.0, 900.0)
    columns, rows = rng.uniform(20, 34, 2000), rng.uniform(10, 21, 2000)
    depth = rng.uniform(300, 900, 2000)
    points = np.stack([(columns - 31) / 70 * depth, (rows - 18) / 72 * depth, depth], axis=-1)
    seen = other.project(points)
    within = ((seen >= 0) & (seen <= [159, 119])).all(axis=-1)
    assert within.any()
    low, high = np.floor(seen[within].min(axis=0)), np.ceil(seen[within].max(axis=0))
    assert (low >= [found.left, found.top]).all() and (high < [found.right, found.bottom]).all()


def test_a_window_of_the_same_grid_is_the_window():
    grid = ViewGrid(70.0, 72.0, 31.0, 18.0, WIDTH, HEIGHT)
    found = roi_of_other_grid(grid, grid, Roi.between(20, 10, 35, 22), 300.0, 900.0)
    # rounding may take one pixel more
    assert found.left in (19, 20) and found.top in (9, 10) and found.right in (35, 36) and found.bottom in (22, 23)


def test_a_window_that_the_other_grid_does_not_see_is_none():
    one = ViewGrid(70.0, 72.0, 31.0, 18.0, WIDTH, HEIGHT)
    aside = ViewGrid(700.0, 720.0, 31.0, 18.0, WIDTH, HEIGHT, origin=np.array([500.0, 0, 0]))
    assert roi_of_other_grid(one, aside, Roi.between(20, 10, 35, 22), 300.0, 400.0) is None
    behind = ViewGrid(70.0, 72.0, 31.0, 18.0, WIDTH, HEIGHT, origin=np.array([0.0, 0, 350.0]))
    assert roi_of_other_grid(one, behind, Roi.between(20, 10, 35, 22), 300.0, 400.0) == Roi.whole(WIDTH, HEIGHT)
