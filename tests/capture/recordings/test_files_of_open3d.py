"""Clouds and a camera that Open3D wrote are read as they went in; the tests run where Open3D is installed."""

from __future__ import annotations

import numpy as np
import pytest

from mitsim.capture.recordings.calibration_file import read_calibration
from mitsim.decoding.input_clouds import read_cloud
from tests.capture.recordings.cloud_files_of_others import pinhole_cloud

open3d = pytest.importorskip("open3d", exc_type=ImportError)

POINTS = pinhole_cloud().reshape(-1, 3).astype(float)
SEEN = POINTS[np.isfinite(POINTS[:, 0])]
WAYS = {"text": {"write_ascii": True}, "binary": {}, "packed": {"compressed": True}}


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("suffix", [".ply", ".pcd"])
def test_a_cloud_with_a_point_for_each_pixel_keeps_its_grid(tmp_path, suffix, way):
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(POINTS))
    assert open3d.io.write_point_cloud(str(tmp_path / f"a{suffix}"), cloud, **WAYS[way])
    read = read_cloud(tmp_path / f"a{suffix}").cloud
    assert read.points.shape == pinhole_cloud().shape
    np.testing.assert_allclose(read.points[read.valid], SEEN, atol=1e-3)


@pytest.mark.parametrize("suffix", [".ply", ".pcd", ".xyz", ".xyzn", ".xyzrgb", ".pts"])
def test_a_cloud_with_colours_and_normals(tmp_path, suffix):
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(SEEN))
    cloud.paint_uniform_color([0.2, 0.4, 0.6])
    cloud.estimate_normals()
    assert open3d.io.write_point_cloud(str(tmp_path / f"a{suffix}"), cloud)
    read = read_cloud(tmp_path / f"a{suffix}").cloud
    np.testing.assert_allclose(read.points[read.valid], SEEN, atol=1e-3)


def test_a_camera_is_read_by_columns(tmp_path):
    camera = open3d.camera.PinholeCameraIntrinsic(640, 480, 600.0, 601.2, 322.3, 241.7)
    assert open3d.io.write_pinhole_camera_intrinsic(str(tmp_path / "a.json"), camera)
    read = read_calibration(tmp_path / "a.json").rig.reference
    np.testing.assert_array_equal(read.matrix, [[600.0, 0, 322.3], [0, 601.2, 241.7], [0, 0, 1]])
    assert (read.width, read.height) == (640, 480)
