"""Clouds survive the disk, and damaged files are told."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from characterisation.cloud_files import read_cloud, write_cloud
from characterisation.files.errors import InputError
from characterisation.point_cloud import PointCloud, Status, ViewGrid


def a_cloud(labelled=True, sigma=True):
    rng = np.random.default_rng(3)
    grid = ViewGrid(60.0, 61.0, 19.5, 14.5, 40, 30, np.eye(3)[[1, 0, 2]] * [1, 1, -1], np.array([1.0, 2.0, 3.0]))
    valid = rng.random((30, 40)) < 0.6
    points = np.where(valid[..., None], rng.normal(0, 100, (30, 40, 3)), np.nan).astype(np.float32)
    status = np.where(valid, Status.VALID, rng.integers(1, 10, (30, 40))).astype(np.uint8)
    feature = np.where(valid, rng.integers(-1, 2, (30, 40)), -1).astype(np.int16) if labelled else None
    spread = np.where(valid, rng.random((30, 40)), np.nan).astype(np.float32) if sigma else None
    return PointCloud(points, status, grid, "n10", "simulated", np.array([1.0, 0, 0]), feature, ("a", "b"), spread)


@pytest.mark.parametrize(("labelled", "sigma"), [(True, True), (False, False), (True, False)])
def test_round_trip(tmp_path, labelled, sigma):
    cloud = a_cloud(labelled, sigma)
    write_cloud(cloud, tmp_path / "cloud.ply")
    again = read_cloud(tmp_path / "cloud.ply")
    for name in ("points", "status", "feature", "sigma", "baseline"):
        expected = getattr(cloud, name)
        if expected is None:
            assert getattr(again, name) is None
        else:
            assert np.array_equal(getattr(again, name), expected, equal_nan=name in ("points", "sigma"))
    assert (again.sensor, again.source, again.feature_names) == (cloud.sensor, cloud.source, cloud.feature_names)
    assert np.array_equal(again.grid.rotation, cloud.grid.rotation)
    assert [p.name for p in tmp_path.iterdir()] == ["cloud.ply"]


def test_a_grid_that_is_too_wide_for_the_format_is_refused(tmp_path):
    """Columns have 16 bits: point 65536 would come back as point 0."""
    count = 65537
    points = np.tile(np.array([0, 0, 500], np.float32), (1, count, 1))
    grid = ViewGrid(1e5, 1e5, 0.0, 0.0, count, 1)
    cloud = PointCloud(points, np.full((1, count), Status.VALID, np.uint8), grid, "scanner", "device")
    with pytest.raises(InputError, match="65537 x 1 px"):
        write_cloud(cloud, tmp_path / "cloud.ply")
    assert not list(tmp_path.iterdir())


def test_a_status_that_contradicts_its_point_is_told(tmp_path):
    cloud = a_cloud()
    cloud.status[2, 3] = Status.VALID if not cloud.valid[2, 3] else Status.NO_SURFACE
    with pytest.raises(InputError, match="at row 2, column 3, 1 pixels in all"):
        write_cloud(cloud, tmp_path / "cloud.ply")
    write_cloud(a_cloud(), tmp_path / "cloud.ply")
    data = bytearray((tmp_path / "cloud.ply").read_bytes())
    data[-40 * 30 + 2 * 40 + 3] = cloud.status[2, 3]
    (tmp_path / "cloud.ply").write_bytes(data)
    with pytest.raises(InputError, match="at row 2, column 3, 1 pixels in all"):
        read_cloud(tmp_path / "cloud.ply")


def test_other_software_reads_the_points(tmp_path):
    cloud = a_cloud()
    write_cloud(cloud, tmp_path / "cloud.ply")
    vertices = trimesh.load(tmp_path / "cloud.ply").vertices
    assert np.allclose(vertices, cloud.points[cloud.valid], atol=1e-4)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6), st.integers(0, 255), st.booleans())
def test_damage_is_told_or_harmless(tmp_path_factory, where, value, truncate):
    folder = tmp_path_factory.mktemp("ply")
    write_cloud(a_cloud(), folder / "cloud.ply")
    data = bytearray((folder / "cloud.ply").read_bytes())
    where %= len(data)
    if truncate:
        del data[where:]
    else:
        data[where] = value
    (folder / "cloud.ply").write_bytes(data)
    try:
        read_cloud(folder / "cloud.ply")
    except InputError as error:
        assert "cloud.ply" in str(error)


def test_a_cloud_without_a_grid_is_refused(tmp_path):
    trimesh.PointCloud(np.zeros((3, 3))).export(tmp_path / "other.ply")
    with pytest.raises(InputError, match="no grid"):
        read_cloud(tmp_path / "other.ply")
    with pytest.raises(InputError, match="no such file"):
        read_cloud(tmp_path / "missing.ply")
