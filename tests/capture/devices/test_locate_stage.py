"""The script that locates a stage, as it is, on an emulated stage and an emulated camera."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from characterisation.stage.turning_axes import TurningAxes
from mitsim.maps.campaign.stage_pose import read_stage_calibration
from tests.capture.devices.emulated_port import emulated
from tests.capture.devices.emulator_process import PTU
from tests.capture.devices.nxlib_standin import StandInCamera, installed, small_node

nxlib = pytest.importorskip("nxlib", reason="pip install ensenso-nxlib: live Ensenso cameras")

SCRIPT = Path(__file__).resolve().parents[3] / "scenes/coupon/locate_stage.py"
SIZE, PX_PER_MM = (1280, 1024), 8


def seen(board, node, pose):
    """The board at a pose, by the homography of its plane; drawn twice as large as the image."""
    picture = board.generateImage((int(105 * PX_PER_MM), int(75 * PX_PER_MM)))
    matrix = np.array(node["Calibration"]["Monocular"]["Left"]["Camera"]).T
    # OpenCV's warp has pixel centres at integers, and so has our camera: (u + 1/2) / 8 mm is where u is
    on_board = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, PX_PER_MM]]) / PX_PER_MM
    large = np.array([[2, 0, 0.5], [0, 2, 0.5], [0, 0, 1.0]])
    homography = large @ matrix @ np.column_stack([pose[:3, 0], pose[:3, 1], pose[:3, 3]]) @ on_board
    drawn = cv2.warpPerspective(picture, homography, (2 * SIZE[0], 2 * SIZE[1]), borderValue=160)
    return cv2.resize(drawn, SIZE, interpolation=cv2.INTER_AREA)


def test_the_script_calibrates_a_stage(tmp_path, monkeypatch):
    stage, port = emulated("ptu")
    monkeypatch.setattr("mitsim.capture.devices.stage.open_stage", lambda connection: stage)
    directions = np.array([[0.02, -1.0, 0.03], [1.0, 0.01, -0.02]])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    axes = TurningAxes(directions, np.array([[4.0, 0.0, 505.0], [0.0, -3.0, 492.0]]))
    zero = np.eye(4)
    zero[:3, :3] = Rotation.from_euler("xyz", [2.0, -3.0, 1.5], degrees=True).as_matrix()
    zero[:3, 3] = zero[:3, :3] @ [-52.5, -37.5, 0.0] + [1.0, 2.0, 500.0]
    drawn = cv2.aruco.CharucoBoard((7, 5), 15.0, 11.0, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50))

    def shoot(node):
        angles = np.array([port.device.axes[name].at(port.time) for name in "PT"]) * np.radians(185.1428 / 3600)
        image = seen(drawn, node, axes.motion(angles[None])[0] @ zero)
        return image[None], image[None]

    camera = StandInCamera(small_node("150358", SIZE), shoot)
    installed(monkeypatch, camera)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "board.toml").write_text("projector = false\nfront_light = true\nexposure_s = 0.01\nmaps = false\n")
    entries = ", ".join(
        f'{{ name = "{a["name"]}", channel = "{a["channel"]}", limits_deg = {a["limits_deg"]} }}' for a in PTU["axes"]
    )
    (tmp_path / "stage.toml").write_text(f'kind = "ptu"\nport = "emulated"\naxes = [{entries}]\n')
    exec(compile(SCRIPT.read_text(encoding="utf-8"), str(SCRIPT), "exec"), {})
    nxlib.api._nxlib.reset()
    read = read_stage_calibration("stage_calibration.json")
    angles = np.radians([12.0, -17.0])
    true = axes.motion(angles[None])[0] @ zero
    found = read.sensor_from_coupon(angles)
    # f 1536 px and 500 mm: 0.1 px of a corner are 0.03 mm across; of 24 corners over 80 mm 0.1 px are under 0.1 deg
    assert np.linalg.norm(found.translation - (true[:3, :3] @ [52.5, 37.5, 0.0] + true[:3, 3])) < 0.5
    assert found.rotation[:, 2] @ -true[:3, 2] > np.cos(np.radians(0.2))
