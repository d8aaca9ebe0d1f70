"""Clouds with covariances in other programs' formats, read back by readers that are not ours."""

import json
import sys

import numpy as np
import pytest
import trimesh
import yaml

from characterisation.files.errors import MissingEnvironmentError
from mitsim.capture.recordings.pcd import decode_pcd
from mitsim.report.export.cloud_points import COVARIANCE, cloud_points
from mitsim.report.export.cloud_writers import write_cloud_pcd, write_cloud_ply
from mitsim.report.export.e57 import PREFIX, write_e57
from mitsim.report.export.ros_bag import Stamped, write_mcap
from tests.report.export.known_cloud import POSE, expected, known_cloud, symmetric

FLOAT = 2e-6  # of single precision, relative


def check_covariance(found, wanted):
    assert np.isfinite(wanted).any() and np.isnan(wanted).any()  # both kinds of point are in the cloud
    np.testing.assert_allclose(symmetric(found), wanted, rtol=FLOAT, atol=1e-9 * np.nanmax(wanted))


def test_covariance_lies_along_the_ray_and_is_unknown_where_sigma_is():
    cloud = known_cloud()
    for pose in (None, POSE):
        points, wanted = cloud_points(cloud, pose), expected(cloud, pose)
        np.testing.assert_allclose(points.points, wanted["points"], atol=1e-9)
        check_covariance(points.covariance, wanted["covariance"])
        known = symmetric(points.covariance)[np.isfinite(points.sigma)]
        values = np.linalg.eigvalsh(known)
        np.testing.assert_allclose(values[:, 2], points.sigma[np.isfinite(points.sigma)] ** 2, rtol=1e-9)
        assert np.abs(values[:, :2]).max() < 1e-12
    metres = cloud_points(cloud).in_metres()
    np.testing.assert_allclose(metres.covariance, cloud_points(cloud).covariance * 1e-6, rtol=1e-9)
    assert metres.in_metres() is metres


@pytest.mark.parametrize("unit", ["mm", "m"])
def test_ply_is_read_by_trimesh(tmp_path, unit):
    cloud = known_cloud()
    points = cloud_points(cloud, POSE) if unit == "mm" else cloud_points(cloud, POSE).in_metres()
    write_cloud_ply(points, tmp_path / "cloud.ply")
    wanted = expected(cloud, POSE, 1.0 if unit == "mm" else 0.001)
    read = trimesh.load(tmp_path / "cloud.ply")
    np.testing.assert_allclose(read.vertices, wanted["points"], rtol=FLOAT)
    data = read.metadata["_ply_raw"]["vertex"]["data"]
    check_covariance(np.stack([data[name] for name in COVARIANCE], axis=-1), wanted["covariance"])
    assert np.array_equal(np.stack([data["row"], data["col"]], axis=-1), wanted["place"])
    header = (tmp_path / "cloud.ply").read_bytes().partition(b"end_header")[0].decode()
    assert f"comment units {unit}\ncomment frame part\n" in header
    said = json.loads(header.partition("comment mitsim ")[2].splitlines()[0])
    assert said["feature_names"] == ["plane", "bore"] and said["sensor"] == "test-sensor"


def test_pcd_is_read_by_pypcd4(tmp_path):
    pypcd4 = pytest.importorskip("pypcd4")
    cloud = known_cloud()
    write_cloud_pcd(cloud_points(cloud), tmp_path / "cloud.pcd", POSE)
    read, wanted = pypcd4.PointCloud.from_path(tmp_path / "cloud.pcd"), expected(cloud, None)
    np.testing.assert_allclose(read.numpy(("x", "y", "z")), wanted["points"], rtol=FLOAT)
    check_covariance(read.numpy(COVARIANCE), wanted["covariance"])
    assert np.array_equal(read.numpy(("row", "col")), wanted["place"])
    again, header = decode_pcd((tmp_path / "cloud.pcd").read_bytes(), "cloud.pcd")  # mitsim import's, tested on PCL's
    assert np.array_equal(again[0], read.numpy(("x", "y", "z"))) and header["FIELDS"].endswith("row col feature")
    x, y, z, *turn = read.metadata.viewpoint
    np.testing.assert_allclose([x, y, z], POSE.translation)
    w, i, j, k = turn  # w first; the rotation written out
    rotation = [
        [1 - 2 * (j * j + k * k), 2 * (i * j - k * w), 2 * (i * k + j * w)],
        [2 * (i * j + k * w), 1 - 2 * (i * i + k * k), 2 * (j * k - i * w)],
        [2 * (i * k - j * w), 2 * (j * k + i * w), 1 - 2 * (i * i + j * j)],
    ]
    np.testing.assert_allclose(rotation, POSE.rotation, atol=1e-12)
    write_cloud_pcd(cloud_points(cloud, POSE), tmp_path / "part.pcd", POSE)  # there already: no second turn
    assert pypcd4.PointCloud.from_path(tmp_path / "part.pcd").metadata.viewpoint == (0, 0, 0, 1, 0, 0, 0)


def test_e57_is_read_by_pye57(tmp_path):
    pye57 = pytest.importorskip("pye57")
    cloud = known_cloud()
    path = tmp_path / "cloud.e57"
    write_e57([("one", cloud_points(cloud), POSE), ("two", cloud_points(cloud), None)], path)
    in_part, in_sensor = expected(cloud, POSE, 0.001), expected(cloud, None, 0.001)
    with pye57.E57(str(path)) as file:
        assert file.scan_count == 2
        with pytest.raises(ValueError, match="cartesianInvalidState"):  # all points are valid: there is no such field
            file.read_scan(0)
        placed = file.read_scan(0, row_column=True, ignore_missing_fields=True)  # moved by the pose of the scan
        found = np.stack([placed[f"cartesian{axis}"] for axis in "XYZ"], axis=-1)
        np.testing.assert_allclose(found, in_part["points"], rtol=FLOAT, atol=1e-7)
        assert np.array_equal(np.stack([placed["rowIndex"], placed["columnIndex"]], axis=-1), in_part["place"])
        raw = file.read_scan_raw(1, ignore_unsupported_fields=True)
        found = np.stack([raw[f"cartesian{axis}"] for axis in "XYZ"], axis=-1)
        np.testing.assert_allclose(found, in_sensor["points"], rtol=FLOAT)
        header = file.get_header(0)
        assert header["name"].value() == "one" and header["sensorModel"].value() == "test-sensor"
        check_covariance(extension(pye57.libe57, file, header, COVARIANCE), in_sensor["covariance"])
        assert file.image_file.extensionsCount() == 2


def extension(libe57, file, header, names):
    """Fields of the extension, by the library below pye57: (n, names)."""
    out = np.zeros((len(names), header.point_count), np.float32)
    buffers = libe57.VectorSourceDestBuffer()
    for name, values in zip(names, out, strict=True):
        buffers.append(libe57.SourceDestBuffer(file.image_file, f"{PREFIX}:{name}", values, len(values), True, True))
    header.points.reader(buffers).read()
    return out.T


def test_mcap_is_read_by_another_library(tmp_path):
    pytest.importorskip("rosbags")
    reader = pytest.importorskip("mcap_ros2.reader")
    cloud, path = known_cloud(), tmp_path / "cloud.mcap"
    points = cloud_points(cloud)
    write_mcap(
        [Stamped("/view_0007/predicted", "view_0007_optical", points, POSE), Stamped("/other", "camera", points, None)],
        path,
    )
    assert list(tmp_path.iterdir()) == [path]
    every = list(reader.read_ros2_messages(str(path)))
    read = [(one.channel.topic, one.log_time_ns, one.ros_msg) for one in every]
    assert [topic for topic, *_ in read] == ["/tf_static", "/view_0007/predicted", "/other"]
    assert [when for _, when, _ in read] == [1e9, 1e9, 2e9]
    (profile,) = yaml.safe_load(every[0].channel.metadata["offered_qos_profiles"])
    assert profile["durability"] == "transient_local" and profile["reliability"] == "reliable"
    (frame,) = read[0][2].transforms  # of the clouds, one has a pose
    assert (frame.header.frame_id, frame.child_frame_id) == ("part", "view_0007_optical")
    message = read[1][2]
    assert message.header.frame_id == "view_0007_optical" and message.width == int(cloud.valid.sum())
    types = {7: "<f4", 4: "<u2", 3: "<i2"}
    columns = [(one.name, types[one.datatype], one.offset) for one in message.fields]
    names, formats, offsets = zip(*columns, strict=True)
    dtype = np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": message.point_step})
    table = np.frombuffer(bytes(message.data), dtype)
    wanted = expected(cloud, None, 0.001)
    found = np.stack([table[axis] for axis in "xyz"], axis=-1)
    np.testing.assert_allclose(found, wanted["points"], rtol=FLOAT)
    check_covariance(np.stack([table[name] for name in COVARIANCE], axis=-1), wanted["covariance"])
    moved = rotate(frame.transform.rotation, found.astype(float)) + [
        getattr(frame.transform.translation, axis) for axis in "xyz"
    ]
    np.testing.assert_allclose(moved, expected(cloud, POSE, 0.001)["points"], atol=1e-6)


def rotate(q, points):
    """Points turned by a ROS quaternion: v + 2 u x (u x v + w v)."""
    u = np.array([q.x, q.y, q.z])
    return points + 2 * np.cross(u, np.cross(u, points) + q.w * points)


def test_a_library_that_is_missing_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pye57", None)
    with pytest.raises(MissingEnvironmentError, match=r"needs pye57.*pip install 'mitsim\[export\]'"):
        write_e57([], tmp_path / "cloud.e57")
    assert not list(tmp_path.iterdir())
