"""Captures and clouds of one Ensenso stand in one frame, that of the raw left camera, and in its workspace on request.

Truth: a plane in the raw left camera's frame, met by the view rays of the rectified left pixels. NxLib's point map of
it is in the rectified frame, or moved from there by ``Link``.
"""

import copy
import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from characterisation.cloud_files import WrittenFrame, read_cloud, write_cloud
from characterisation.files.errors import InputError
from mitsim.capture.capture import Capture
from mitsim.capture.folder import read_capture, write_capture
from mitsim.capture.recordings.any_recording import ReadOptions, read_recording
from mitsim.capture.recordings.calibration_file import read_calibration
from mitsim.capture.recordings.ensenso import read_ensenso
from mitsim.capture.workspace import written_frame
from mitsim.cli.program import app
from mitsim.decoding.device_maps import camera_map_geometry, decode_device_map
from mitsim.sensor.transforms import Transform
from tests.capture.recordings.cloud_files_of_others import pcd
from tests.capture.recordings.test_ensenso_files import LEFT_ROTATION, files, intrinsic, node, pack

WIDTH, HEIGHT, F, CX, CY = 80, 60, 66.0, 37.0, 31.0
TURN = Rotation.from_euler("xyz", [175, -8, 40], degrees=True)
RECTIFIED_FROM_WORKSPACE = Transform(TURN.as_matrix(), np.array([12.0, -30.0, 680.0]))


def tree_of(scale: float = 1.0) -> dict:
    """A node of a unit of 80 x 60 pixels whose maps are shrunk by ``scale``, with a Link to a workspace."""
    tree = copy.deepcopy(node())
    tree["Sensor"]["Size"] = [WIDTH, HEIGHT]
    tree["Parameters"]["DisparityMap"]["Scaling"] = scale
    for side, column in (("Left", CX), ("Right", CX + 7)):
        tree["Calibration"]["Monocular"][side]["Camera"] = intrinsic(70.0, 39.5, 29.5)
        tree["Calibration"]["Dynamic"]["Stereo"][side]["Camera"] = intrinsic(F, column, CY, scale)
    angle = float(np.linalg.norm(TURN.as_rotvec()))
    tree["Link"] = {
        "Target": "Bin",
        "Translation": RECTIFIED_FROM_WORKSPACE.translation.tolist(),
        "Rotation": {"Angle": angle, "Axis": (TURN.as_rotvec() / angle).tolist()},
    }
    return tree


def rectified_map(scale: float = 1.0) -> np.ndarray:
    """Points (H, W, 3) [mm] of the plane z = 600 + 0.1 x of the raw left frame, as NxLib has them without a Link."""
    rows, columns = np.mgrid[: int(HEIGHT * scale), : int(WIDTH * scale)] / scale
    rays = np.stack([(columns - CX) / F, (rows - CY) / F, np.ones(rows.shape)], axis=-1)
    seen = rays @ LEFT_ROTATION  # R^T ray, in the raw left frame
    return rays * (600 / (seen[..., 2] - 0.1 * seen[..., 0]))[..., None]


def off_plane(points: np.ndarray) -> float:
    return float(np.nanmax(np.abs(points[..., 2] - 0.1 * points[..., 0] - 600)))


@pytest.mark.parametrize("scale", [1.0, 0.5])
@pytest.mark.parametrize(
    ("linked", "calibration"), [(True, None), (True, "calib"), (True, "folder"), (False, "calib"), (False, "folder")]
)
def test_a_cloud_of_nxlib_comes_to_the_frame_of_the_raw_left_camera(tmp_path, scale, linked, calibration):
    tree = tree_of(scale)
    calib = tmp_path / "1_2_calib.json"
    calib.write_text(json.dumps(tree))
    capture = Capture(
        sensor="N10",
        technology="point_map",
        source="device",
        rig=read_node(tmp_path, tree).rig,
        images={},
        bits=16,
        settings={},
        derived={"points": np.zeros((HEIGHT, WIDTH, 3), np.float32)},
    )
    folder = write_capture(capture, tmp_path / "unit")
    given = {None: None, "calib": str(calib), "folder": str(folder / "calibration.json")}[calibration]
    points = rectified_map(scale)
    if linked:
        points = RECTIFIED_FROM_WORKSPACE.inverse().points(points)
    path = tmp_path / "cloud.pcd"
    path.write_bytes(pcd(points.astype(np.float32), "binary"))
    found = read_recording(path, ReadOptions(link=str(calib) if linked else None, calibration=given, unit="mm")).capture
    assert off_plane(found.derived["points"]) < 2e-3  # single precision of 700 mm, moved twice
    assert off_plane(rectified_map()) > 10  # as it was imported before
    assert ("sensor_from_workspace" in found.settings) == linked


def read_node(folder, tree):
    """The calibration of a node."""
    path = folder / "of_unit_calib.json"
    path.write_text(json.dumps(tree))
    return read_calibration(path)


def test_a_calibration_of_another_unit_is_refused(tmp_path):
    tree = tree_of()
    other = copy.deepcopy(tree)
    other["Calibration"]["Dynamic"]["Stereo"]["Left"]["Camera"] = intrinsic(F, CX + 3, CY)
    calib = tmp_path / "1_2_calib.json"
    calib.write_text(json.dumps(other))
    path = tmp_path / "cloud.pcd"
    path.write_bytes(pcd(rectified_map().astype(np.float32), "binary"))
    with pytest.raises(InputError, match=r"px from the view rays of their pixels"):
        read_recording(path, ReadOptions(calibration=str(calib), unit="mm"))


def test_a_recording_keeps_the_way_from_its_workspace(tmp_path):
    """By the definition of Link: workspace -> rectified left -> raw left, which is R^T of rectified."""
    tree = node()
    tree["Link"] = {"Target": "Bin", "Translation": [1, 2, 500], "Rotation": {"Angle": np.pi / 2, "Axis": [0, 0, 1]}}
    path = pack(tmp_path / "r.zip", files(tree))
    stored = read_ensenso(path).settings["sensor_from_workspace"]
    in_rectified = np.array([1.0, 12.0, 500.0])  # of (10, 0, 0): a quarter turn about z, then the translation
    np.testing.assert_allclose(
        Transform.from_matrix(stored).points(np.array([10.0, 0, 0])), LEFT_ROTATION.T @ in_rectified, atol=1e-9
    )
    tree["Link"] = {"Target": "", "Translation": None, "Rotation": None}
    assert "sensor_from_workspace" not in read_ensenso(pack(tmp_path / "s.zip", files(tree))).settings


def test_decode_writes_the_cloud_in_the_workspace(tmp_path):
    """A cloud that NxLib moved to its workspace, imported and decoded again, comes out as it was."""
    calib, path, out = tmp_path / "1_2_calib.json", tmp_path / "cloud.pcd", tmp_path / "out.ply"
    calib.write_text(json.dumps(tree_of()))
    moved = RECTIFIED_FROM_WORKSPACE.inverse().points(rectified_map()).astype(np.float32)
    path.write_bytes(pcd(moved, "binary"))
    run = CliRunner()
    done = run.invoke(app, ["import", str(path), "--link", str(calib), "--unit", "mm", "-o", str(tmp_path / "c")])
    assert done.exit_code == 0, done.output
    done = run.invoke(app, ["decode", str(tmp_path / "c"), "-o", str(out), "--points-in", "workspace"])
    assert done.exit_code == 0, done.output
    header, _, body = out.read_bytes().partition(b"end_header\n")
    assert b"comment frame of the workspace 'Bin' of the device's Link" in header
    written = np.frombuffer(body, "<f4, <f4, <f4, <f4, <u2, <u2, <i2", WIDTH * HEIGHT)
    points = np.stack([written["f0"], written["f1"], written["f2"]], axis=-1).reshape(HEIGHT, WIDTH, 3)
    np.testing.assert_allclose(points, moved, atol=1e-3)
    assert off_plane(read_cloud(out).points) < 2e-3  # read again it is in the sensor frame
    capture = read_capture(tmp_path / "c")
    with pytest.raises(InputError, match=r"--points-in: found 'robot'; allowed: sensor \| workspace"):
        written_frame(capture, "robot", "c")
    assert written_frame(capture, "sensor", "c") is None


@pytest.mark.parametrize("stored", [None, [[1, 2], [3]], np.eye(3).tolist(), (2 * np.eye(4)).tolist(), "x", {"a": 1}])
def test_a_capture_without_a_workspace_is_refused(tmp_path, stored):
    capture = read_ensenso(pack(tmp_path / "r.zip", files(node())))
    capture.settings["sensor_from_workspace"] = stored
    with pytest.raises(InputError, match=r"settings\.sensor_from_workspace.*4 x 4"):
        written_frame(capture, "workspace", "r")


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_a_cloud_written_in_any_frame_is_the_cloud_that_was_written(tmp_path_factory, seed):
    rng = np.random.default_rng(seed)
    moved = Transform(Rotation.random(random_state=rng).as_matrix(), rng.uniform(-1000, 1000, 3))
    rig = read_node(tmp_path_factory.mktemp("rig"), tree_of()).rig
    geometry = camera_map_geometry(rig)
    depth = np.where(rng.random((HEIGHT, WIDTH)) < 0.9, rng.uniform(400, 800, (HEIGHT, WIDTH)), np.nan)
    cloud = decode_device_map("depth", depth.astype(np.float32), geometry, (300, 900), sensor="s", source="device")
    path = tmp_path_factory.mktemp("cloud") / "c.ply"
    write_cloud(cloud, path, WrittenFrame("of a robot", moved.matrix()))
    back = read_cloud(path)
    np.testing.assert_array_equal(back.status, cloud.status)
    np.testing.assert_allclose(back.points, cloud.points, atol=2e-3)
