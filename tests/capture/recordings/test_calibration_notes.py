"""Warnings about a calibration reach the user, whatever recording it is for; a wall stands where it is."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from characterisation.files.errors import InputError
from mitsim.capture.folder import read_capture
from mitsim.capture.recordings.calibration_file import read_calibration
from mitsim.capture.recordings.depth_image import read_depth_image
from mitsim.capture.recordings.read_options import ReadOptions
from mitsim.cli.program import app
from tests.capture.recordings.cloud_files_of_others import pcd, pinhole_cloud

CLOUD = pinhole_cloud()
HEIGHT, WIDTH = CLOUD.shape[:2]
CAMERA = f"camera_matrix: [[60., 0., {(WIDTH - 1) / 2}], [0., 60., {(HEIGHT - 1) / 2}], [0., 0., 1.]]\n"
UNKNOWN = "bent_glass: [-0.3, 0.1, 0., 0., 0.]\n"


def recordings(folder):
    """A depth image, a cloud and a stereo pair of one camera's size."""
    cv2.imwrite(str(folder / "depth.png"), np.full((HEIGHT, WIDTH), 1000, np.uint16))
    (folder / "cloud.pcd").write_bytes(pcd(CLOUD, "binary"))
    (folder / "pair").mkdir()
    for name in ("left", "right"):
        cv2.imwrite(str(folder / "pair" / f"{name}_0.png"), np.full((HEIGHT, WIDTH), 100, np.uint8))


@pytest.mark.parametrize("name", ["depth.png", "cloud.pcd", "pair"])
def test_an_unread_distortion_is_told(tmp_path, name):
    recordings(tmp_path)
    pair = "K2: [[60., 0., 31.5], [0., 60., 23.5], [0., 0., 1.]]\nT: [-60., 0., 0.]\n"
    pair += "R: [[1., 0., 0.], [0., 1., 0.], [0., 0., 1.]]\n"
    matrix = _camera_of_cloud() if name == "cloud.pcd" else CAMERA
    (tmp_path / "calib.yml").write_text(f"{matrix}{pair if name == 'pair' else ''}{UNKNOWN}")
    arguments = ["import", tmp_path / name, "--calibration", tmp_path / "calib.yml", "-o", tmp_path / "out"]
    done = CliRunner().invoke(app, [str(each) for each in arguments])
    assert done.exit_code == 0, done.output
    assert "warning: calibration calib.yml: values not read: bent_glass" in done.stderr
    assert "bent_glass" in read_capture(tmp_path / "out").settings["warnings"][0]


@pytest.mark.parametrize(
    "pose", [{}, {"baseline": 60.0}, {"right_to_left": {"R": np.eye(3).tolist(), "T": [60, 0, 0]}}]
)
def test_a_pair_without_the_pose_of_its_second_camera_is_refused(tmp_path, pose):
    """Both cameras stood in the same place, without a word; mitsim decode then ended with a traceback."""
    recordings(tmp_path)
    camera = {"K": [[60.0, 0.0, 31.5], [0.0, 60.0, 23.5], [0.0, 0.0, 1.0]], "D": [0.0] * 5}
    (tmp_path / "calib.json").write_text(json.dumps({"left": camera, "right": camera | {"D": [0.1] * 5}} | pose))
    arguments = ["import", tmp_path / "pair", "--calibration", tmp_path / "calib.json", "-o", tmp_path / "out"]
    done = CliRunner().invoke(app, [str(each) for each in arguments])
    assert isinstance(done.exception, InputError), done.output
    assert "found left, right, without the pose of the second" in str(done.exception)
    assert not (tmp_path / "out").exists()


def _camera_of_cloud():
    from mitsim.capture.recordings.pinhole_fit import fit_pinhole

    fitted = fit_pinhole(CLOUD)
    assert fitted is not None
    return f"camera_matrix: {fitted[0].matrix.tolist()}\n"


def test_a_wall_seen_by_a_part_of_the_imager(tmp_path):
    """cx and cy of the full imager put the edge of the wall half a field of view aside."""
    recordings(tmp_path)
    (tmp_path / "info.yaml").write_text(
        f"image_width: {WIDTH}\nimage_height: {HEIGHT}\ncamera_matrix:\n  rows: 3\n  cols: 3\n"
        f"  data: [60.0, 0.0, {WIDTH + 31.5}, 0.0, 60.0, {HEIGHT + 23.5}, 0.0, 0.0, 1.0]\n"
        f"roi:\n  x_offset: {WIDTH}\n  y_offset: {HEIGHT}\n  height: {HEIGHT}\n  width: {WIDTH}\n"
    )
    capture = read_depth_image(tmp_path / "depth.png", ReadOptions(calibration=tmp_path / "info.yaml"))
    middle = capture.rig.reference.rays(np.array([[31.5, 23.5]]))[0]
    np.testing.assert_allclose(middle, [0, 0, 1], atol=1e-12)
    assert "principal point 95.5, 71.5 of the full imager, 31.5, 23.5 of the images" in capture.settings["warnings"][0]


def test_images_scaled_from_the_calibrated_size_get_the_optics_to_write(tmp_path):
    recordings(tmp_path)
    (tmp_path / "calib.yml").write_text(
        "camera_matrix: [[120., 0., 63.5], [0., 120., 47.5], [0., 0., 1.]]\nimage_width: 128\nimage_height: 96\n"
    )
    with pytest.raises(InputError, match="found 64 x 48 px; allowed: 128 x 96 px") as caught:
        read_depth_image(tmp_path / "depth.png", ReadOptions(calibration=tmp_path / "calib.yml"))
    assert "focal_px = [60.0, 60.0], principal_px = [31.5, 23.5]" in caught.value.hint


def test_a_calibration_of_depthai_without_cameras(tmp_path):
    """As of a device that was never calibrated; the sockets of its pair are 255."""
    table = {"version": 7, "cameraData": [], "stereoRectificationData": {"leftCameraSocket": 255}}
    (tmp_path / "empty.json").write_text(json.dumps(table))
    with pytest.raises(InputError, match="cameraData: found no cameras in this calibration"):
        read_calibration(tmp_path / "empty.json")
    table["cameraData"] = [[0, {"width": 640, "height": {"px": True}}]]
    (tmp_path / "empty.json").write_text(json.dumps(table))
    with pytest.raises(InputError, match=r'height: found \{"px": true\}; allowed: a whole number'):
        read_calibration(tmp_path / "empty.json")


@pytest.mark.parametrize(
    "unread",
    [
        {"dist_k1": -0.1, "dist_k2": 0.05},
        {"distortion_k1": -0.1},
        {"kc1": -0.1, "kc2": 0.05},
        {"k1_left": -0.1},
        {"radial_distortion": [-0.1, 0.05, 0.01, 0.02, -0.01, 0.003]},
    ],
)
def test_coefficients_under_unusual_names_are_told(tmp_path, unread):
    """They were left out without a word: 60 px at the corner of an image of 1280 px with k1 = -0.1."""
    camera = {"fx": 60.0, "fy": 60.0, "cx": 31.5, "cy": 23.5, "width": 64, "height": 48}
    (tmp_path / "a.json").write_text(json.dumps(camera | unread))
    (note,) = read_calibration(tmp_path / "a.json").notes
    assert f"values not read: {next(iter(unread))}" in note and "camera without distortion" in note


@pytest.mark.parametrize("other", [{"task_1": 5.0}, {"k1": 0.0}, {"dist_m": 0.7}, {"max_distortion_px": 0.4}])
def test_other_numbers_are_no_coefficients(tmp_path, other):
    camera = {"fx": 60.0, "fy": 60.0, "cx": 31.5, "cy": 23.5, "width": 64, "height": 48}
    (tmp_path / "a.json").write_text(json.dumps(camera | other))
    assert read_calibration(tmp_path / "a.json").notes == ()
