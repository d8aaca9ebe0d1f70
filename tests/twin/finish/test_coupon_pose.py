"""The pose over a coupon from its points, against the pose that the points were made with."""

from __future__ import annotations

import numpy as np
import pytest

from characterisation.files.errors import InputError
from characterisation.point_cloud import PointCloud, Status, ViewGrid
from characterisation.region_of_interest import Roi
from mitsim.sensor.transforms import Transform, look_at
from mitsim.twin.finish.specimen import pose_over_coupon

GRID = ViewGrid(fx=300, fy=300, cx=159.5, cy=119.5, width=320, height=240)
WINDOW = Roi(110, 80, 101, 81)


def cloud_of(pose: Transform, noise_mm: float = 0.0) -> PointCloud:
    """Points of the plane z = 0 of the world around the window, 60 mm behind it elsewhere."""
    rays, rng = GRID.rays(), np.random.default_rng(2)
    normal, origin = pose.rotation[2], pose.inverse().translation
    distance = (origin @ normal) / (rays @ normal)
    aside = np.ones(distance.shape, bool)
    aside[WINDOW.slices] = False
    distance += 60.0 * aside + noise_mm * rng.standard_normal(distance.shape)
    points = (rays * distance[..., None]).astype(np.float32)
    return PointCloud(points, np.full(distance.shape, Status.VALID, np.uint8), GRID, "mine", "device")


@pytest.mark.parametrize("place", [(0, 0, 500), (200, -150, 400), (-400, 100, 300)])
def test_the_pose_is_that_of_the_points(place):
    true = look_at(place, (0, 0, 0), (0, 1, 0))
    found = pose_over_coupon(cloud_of(true), WINDOW, "mine")
    middle = GRID.rays_at(np.array([160]), np.array([120]))[0]
    np.testing.assert_allclose(found.rotation[2], true.rotation[2], atol=1e-5)  # the normal
    assert found.translation[2] == pytest.approx(true.translation[2], abs=1e-2)  # the height over the plane
    np.testing.assert_allclose(np.cross(found.inverse().translation, middle), 0, atol=1e-2)  # origin: on the middle ray
    # x lies in the plane through the middle row
    pixels = GRID.project(found.inverse().points(np.array([[-20.0, 0, 0], [20.0, 0, 0]])))
    np.testing.assert_allclose(pixels[:, 1], 120, atol=1e-2)
    assert pixels[0, 0] < pixels[1, 0]


def test_noise_moves_it_as_far_as_a_mean_moves():
    true = look_at((100, 0, 450), (0, 0, 0), (0, 1, 0))
    found = pose_over_coupon(cloud_of(true, 0.5), WINDOW, "mine")
    u = 0.5 / np.sqrt(WINDOW.width * WINDOW.height)
    assert abs(found.translation[2] - true.translation[2]) < 6 * u
    assert np.linalg.norm(np.cross(found.rotation[2], true.rotation[2])) < 6 * u / 40  # the window spans over 100 mm


@pytest.mark.parametrize(
    ("window", "told"),
    [(Roi(300, 0, 50, 50), "--coupon: found 300 0 50 50"), (Roi(0, 0, 3, 3), "plane")],
)
def test_a_window_without_a_coupon_is_refused(window, told):
    with pytest.raises(InputError, match=told):
        pose_over_coupon(cloud_of(look_at((0, 0, 500), (0, 0, 0), (0, 1, 0))), window, "mine")
