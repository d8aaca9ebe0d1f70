"""Depth images beside files that state the depth of a level, as the programs and data sets that write them."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest

from characterisation.files.errors import InputError
from mitsim.capture.recordings.depth_image import read_depth_image
from mitsim.capture.recordings.read_options import ReadOptions

WIDTH, HEIGHT = 64, 48
K = [150.0, 0, 31.5, 0, 150.0, 23.5, 0, 0, 1]
FLAT = {"fx": 150.0, "fy": 150.0, "cx": 31.5, "cy": 23.5, "width": WIDTH, "height": HEIGHT}
ORB_SLAM = (
    "%YAML:1.0\nCamera.fx: 150.0\nCamera.fy: 150.0\nCamera.cx: 31.5\nCamera.cy: 23.5\nCamera.width: 64\n"
    "Camera.height: 48\n"
)

#: each file, the levels of 600 mm in its convention, and the depth of one level [mm]
STATED = {
    "camera.json": (json.dumps(FLAT | {"depth_scale": 0.1}), 6000, "0.1"),  # BOP: mm per level
    "scene_camera.json": (json.dumps({str(i): {"cam_K": K, "depth_scale": 0.1} for i in range(3)}), 6000, "0.1"),
    "tum.yaml": (f"{ORB_SLAM}DepthMapFactor: 5000.0\n", 3000, "0.2"),  # ORB-SLAM: levels per metre
    "orb3.yaml": (f"{ORB_SLAM}RGBD.DepthMapFactor: 5000.0\n", 3000, "0.2"),
    "replica.yaml": (f"cam: {json.dumps(FLAT | {'png_depth_scale': 6553.5})}\n", 3932, "0.15259"),
    "cam_params.json": (json.dumps({"camera": FLAT | {"scale": 6553.5}}), 3932, "0.15259"),  # Replica
    "nerfstudio.json": (json.dumps(FLAT | {"depth_unit_scale_factor": 0.0002}), 3000, "0.2"),
    "bundlefusion.json": (json.dumps(FLAT | {"depthShift": 5000}), 3000, "0.2"),
    "divisor.json": (json.dumps(FLAT | {"depth_divisor": 5000}), 3000, "0.2"),
    "d405.json": (json.dumps(FLAT | {"depth_scale": 0.0001}), 6000, "0.1"),  # librealsense: metres per level
}


@pytest.mark.parametrize("name", STATED)
def test_a_stated_scale_is_asked_for_and_not_passed_over(tmp_path, name):
    """The depths were 5 to 10 times too large."""
    text, level, scale = STATED[name]
    (tmp_path / name).write_text(text)
    cv2.imwrite(str(tmp_path / "depth.png"), np.full((HEIGHT, WIDTH), level, np.uint16))
    with pytest.raises(InputError, match=f"--scale {scale},") as error:
        read_depth_image(tmp_path / "depth.png", ReadOptions(calibration=tmp_path / name))
    assert name in str(error.value)
    capture = read_depth_image(tmp_path / "depth.png", ReadOptions(calibration=tmp_path / name, scale_mm=float(scale)))
    np.testing.assert_allclose(capture.derived["depth"], 600, rtol=2e-4)


@pytest.mark.parametrize("stated", [{}, {"depth_scale": 1000}])
def test_the_folder_of_tums_data_tells_the_scale(tmp_path, stated):
    """Their depths were 5 times too large, without a word; a calibration that states another scale knows better."""
    for name in ("depth.txt", "rgb.txt"):
        (tmp_path / name).write_text("# timestamp filename\n")
    (tmp_path / "depth").mkdir()
    (tmp_path / "a.json").write_text(json.dumps(FLAT | stated))
    image = tmp_path / "depth/1305031102.160407.png"
    cv2.imwrite(str(image), np.full((HEIGHT, WIDTH), 3000, np.uint16))
    options = ReadOptions(calibration=tmp_path / "a.json")
    if not stated:
        with pytest.raises(InputError, match=r"depth\.txt: found 5000.*--scale 0\.2,"):
            read_depth_image(image, options)
        options = ReadOptions(calibration=tmp_path / "a.json", scale_mm=0.2)
    np.testing.assert_allclose(read_depth_image(image, options).derived["depth"], 3000 if stated else 600, rtol=1e-6)


@pytest.mark.parametrize("number", [1, 1000.0, 0.001, 0.0010000000474974513, 0, "millimetre", None])
def test_a_scale_of_one_millimetre_needs_no_option(tmp_path, number):
    (tmp_path / "a.json").write_text(json.dumps(FLAT | {"depth_scale": number}))
    cv2.imwrite(str(tmp_path / "depth.png"), np.full((HEIGHT, WIDTH), 600, np.uint16))
    capture = read_depth_image(tmp_path / "depth.png", ReadOptions(calibration=tmp_path / "a.json"))
    np.testing.assert_allclose(capture.derived["depth"], 600)


def test_a_scale_beside_the_levels_in_an_archive(tmp_path):
    (tmp_path / "a.json").write_text(json.dumps(FLAT))
    np.savez(tmp_path / "a.npz", depth=np.full((HEIGHT, WIDTH), 6000, np.uint16), depth_scale=0.0001)
    with pytest.raises(InputError, match=r"depth_scale: found 0\.0001.*--scale 0\.1,"):
        read_depth_image(tmp_path / "a.npz", ReadOptions(calibration=tmp_path / "a.json"))


def test_depths_of_floating_point_are_no_levels(tmp_path):
    (tmp_path / "a.json").write_text(json.dumps(FLAT | {"depth_scale": 1000}))
    (tmp_path / "b.json").write_text(json.dumps(FLAT | {"depth_scale": 5000}))
    np.save(tmp_path / "a.npy", np.full((HEIGHT, WIDTH), 0.6, np.float32))
    for name in ("a.json", "b.json"):
        np.testing.assert_allclose(
            read_depth_image(tmp_path / "a.npy", ReadOptions(calibration=tmp_path / name)).derived["depth"], 600
        )
