"""The ROBI data set's layout: made here, for its images are not ours to keep."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from characterisation.files.errors import InputError
from mitsim.capture.folder import read_capture
from mitsim.capture.recordings.any_recording import ReadOptions, read_recording
from mitsim.capture.recordings.recognise import kind_of
from mitsim.capture.recordings.robi import read_robi
from mitsim.capture.simulated.rendering import Rendering
from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.cli.program import app
from mitsim.decoding.cloud import capture_cloud, decoder_settings
from mitsim.scene.test_targets import plate
from mitsim.sensor.camera import Rig
from mitsim.sensor.pattern import RandomDots
from mitsim.sensor.preset import load_sensor
from mitsim.sensor.transforms import look_at

#: the disparity at this distance is a whole number, to which SGBM draws what lies between
WIDTH, HEIGHT, FOCAL, BASELINE, UNIT, DISTANCE = 400, 300, 420.0, 100.0, 0.03125, 525.0
LEFT_X, RIGHT_X = 120.3, 235.3

CAMERA = "width: {width}\nheight: {height}\nfx: {f}\nfy: {f}\ncx: {cx}\ncy: 149.5\n"


def write_cameras(folder: Path, sensor: str, shift: float) -> None:
    """Camera files as the toolkit has them, with a shift of the disparities [px]."""
    folder.mkdir(parents=True)
    left = CAMERA.format(width=WIDTH, height=HEIGHT, f=FOCAL, cx=LEFT_X)
    (folder / f"{sensor}_LEFT.yml").write_text(left)
    (folder / f"{sensor}_RIGHT.yml").write_text(CAMERA.format(width=WIDTH, height=HEIGHT, f=FOCAL, cx=RIGHT_X))
    (folder / f"{sensor}_DEPTH.yml").write_text(
        f"depth_unit: {UNIT}\n{left}# read from camera\nbaseline: {BASELINE}\ndisparity_shift: {shift:g}"
    )


def write_view(folder: Path, view: str, left, right, depth, pose) -> None:
    """One view of a scene."""
    for name in ("StereoPattern", "Depth"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(folder / "StereoPattern" / f"LEFT_{view}.bmp"), left)
    cv2.imwrite(str(folder / "StereoPattern" / f"RIGHT_{view}.bmp"), right)
    cv2.imwrite(str(folder / "Depth" / f"DEPTH_{view}.png"), depth)
    (folder / "Depth" / f"DEPTH_{view}.json").write_text(json.dumps({"cam_pose": pose.ravel().tolist()}))


@pytest.fixture(scope="module", params=[("Ensenso", 0.0), ("RealSense", 78.0)], ids=lambda each: each[0])
def scene(request, tmp_path_factory):
    """A scene of two views, of a plate at 525 mm; the second view is blank."""
    sensor, shift = request.param
    root = tmp_path_factory.mktemp("robi")
    write_cameras(root / "cam", sensor, shift)
    folder = root / "Zigzag" / "Scene_1" / sensor
    blank, pose = np.zeros((HEIGHT, WIDTH), np.uint8), look_at([0, 0, DISTANCE], [0, 0, 0], [0, 1, 0])
    depth = np.full((HEIGHT, WIDTH), round(DISTANCE / UNIT), np.uint16)
    depth[:40] = 0
    for view in ("view_0", "view_1"):
        write_view(folder, view, blank, blank, depth, pose.matrix())
    (folder / "list.txt").write_text("view_0\nview_1\n")
    rig = read_robi(folder, ReadOptions(frame=0))[0].rig
    preset = load_sensor("ensenso-n35")
    assert isinstance(preset.pattern, RandomDots)
    taker = replace(preset, rig=Rig(rig.cameras, preset.rig.projector, rig.rectification))
    taken = SimulatedSensor(taker).capture(
        plate(400, "matt white", 550), pose, rendering=Rendering(samples=4, depth=1), seed=2
    )
    write_view(folder, "view_0", taken.images["left"][0], taken.images["right"][0], depth, pose.matrix())
    return folder


def test_disparities_are_those_of_the_toolkits_own_formula(tmp_path):
    """f B / Z - (cx_right - cx_left) + disparity_shift (inout.py: convertDepthToDisparity)."""
    for sensor, shift in (("Ensenso", 0.0), ("RealSense", 78.0)):
        root = tmp_path / sensor
        write_cameras(root / "cam", sensor, shift)
        blank = np.zeros((HEIGHT, WIDTH), np.uint8)
        folder = root / "Gear" / "Scene_3" / sensor
        write_view(folder, "view_0", blank, blank, np.ones((HEIGHT, WIDTH), np.uint16), np.eye(4))
        (folder / "list.txt").write_text("view_0\n")
        rig = read_robi(folder, ReadOptions())[0].rig
        assert rig.rectification is not None
        for depth in (400.0, 900.0):
            wanted = FOCAL * BASELINE / depth - (RIGHT_X - LEFT_X) + shift
            assert float(rig.rectification.disparity(depth)) == pytest.approx(wanted)
            left, right = (camera.project(np.array([30.0, -20.0, depth])) for camera in rig.cameras.values())
            assert left - right == pytest.approx([wanted, 0.0])


def test_a_view_is_recognised_and_decodes_to_the_depth_beside_it(scene):
    assert kind_of(scene) == "robi"
    imported = read_recording(scene, ReadOptions(frame=0))
    capture = imported.capture
    assert {"LEFT_view_0.bmp", f"{scene.name}_LEFT.yml", "DEPTH_view_0.json"} <= set(imported.originals)
    assert capture.decoding.near_mm == pytest.approx(0.85 * DISTANCE, rel=1e-3)
    depth = capture.derived["depth"]
    assert np.isnan(depth[:40]).all() and depth[60, 60] == pytest.approx(DISTANCE, abs=UNIT)
    settings, imager = decoder_settings(capture)
    cloud = capture_cloud(capture, settings, imager=imager)
    decoded = cloud.points[..., 2][cloud.valid & np.isfinite(depth)]
    assert len(decoded) > 0.3 * depth.size
    # disparities come in steps of 1/16 px
    assert np.median(decoded) == pytest.approx(DISTANCE, abs=DISTANCE**2 / (FOCAL * BASELINE) / 16)
    assert capture.world_from_sensor is not None
    assert capture.world_from_sensor.translation == pytest.approx([0, 0, DISTANCE])


def test_one_command_from_the_scene_to_the_verdict(scene, tmp_path):
    done = CliRunner().invoke(
        app,
        [
            "compare",
            str(scene),
            "--frame",
            "0",
            "--sensor",
            "ensenso-n35",
            "--window",
            "130",
            "90",
            "160",
            "120",
            "-o",
            str(tmp_path / "out"),
        ],
    )
    assert done.exception is None or isinstance(done.exception, SystemExit), done.exception
    rows = {line.split("|")[1].strip(): line for line in done.stdout.splitlines() if line.startswith("|")}
    assert "agrees" in rows["distance"]
    assert "agrees" in rows["vertical error"]
    assert read_capture(tmp_path / "out" / "recorded").sensor == scene.name
    assert (tmp_path / "out" / "index.md").exists()


def test_several_views_are_asked_about(scene):
    with pytest.raises(InputError, match="choose with --frame 0 to 1"):
        read_robi(scene, ReadOptions())
    with pytest.raises(InputError, match=r"0 to 1: views of list\.txt, in their order"):
        read_robi(scene, ReadOptions(frame=2))


def test_what_is_missing_is_named_all_at_once(tmp_path):
    folder = tmp_path / "Scene_1" / "Ensenso"
    (folder / "StereoPattern").mkdir(parents=True)
    (folder / "list.txt").write_text("view_0\n")
    with pytest.raises(InputError, match="--calibration ROBI_Toolkit/cam"):
        read_robi(folder, ReadOptions())
    write_cameras(tmp_path / "cam", "Ensenso", 0.0)
    with pytest.raises(InputError, match=r"LEFT_view_0\.bmp, .*RIGHT_view_0\.bmp, .*DEPTH_view_0\.png"):
        read_robi(folder, ReadOptions())
    blank = np.zeros((HEIGHT, WIDTH), np.uint8)
    write_view(folder, "view_0", blank, blank, np.ones((HEIGHT, WIDTH), np.uint16), np.diag([1, 1, 2.0, 1]))
    with pytest.raises(InputError, match="not a rigid motion"):
        read_robi(folder, ReadOptions())
    (tmp_path / "cam" / "Ensenso_DEPTH.yml").write_text("width: 400\n")
    (tmp_path / "cam" / "Ensenso_RIGHT.yml").write_text("width: 400\n")
    with pytest.raises(InputError, match=r"RIGHT.yml: height; .*DEPTH.yml: baseline; .*depth_unit"):
        read_robi(folder, ReadOptions())


def small_scene(tmp_path: Path, depth) -> Path:
    """One view with a depth image of its own and blank images; the folder of its sensor."""
    write_cameras(tmp_path / "cam", "Ensenso", 0.0)
    folder, blank = tmp_path / "Scene_1" / "Ensenso", np.zeros((HEIGHT, WIDTH), np.uint8)
    write_view(folder, "view_0", blank, blank, depth, np.eye(4))
    (folder / "list.txt").write_text("view_0\n")
    return folder


def test_the_largest_level_is_no_depth(tmp_path):
    """Before, it was the farthest depth."""
    depth = np.full((HEIGHT, WIDTH), round(DISTANCE / UNIT), np.uint16)
    depth[7, 9] = 65535
    capture, _ = read_robi(small_scene(tmp_path, depth), ReadOptions())
    np.testing.assert_array_equal(np.isnan(capture.derived["depth"]), depth == 65535)
    assert ["the level 65535" in warning for warning in capture.settings["warnings"]] == [True]


@pytest.mark.parametrize(
    ("pose", "told"),
    [
        ("[" * 100_000, "found text that is not JSON"),
        ('{"cam_pose": [' + "9, " * 15 + "1" + "0" * 400 + "]}", "cam_pose: found .*; allowed: 16 finite numbers"),
        ('{"cam_pose": [NaN, 0, 0, 0]}', "cam_pose: found .*; allowed: 4 x 4 finite numbers"),
        ("[]", "cam_pose: found nothing"),
    ],
)
def test_a_pose_that_is_none_is_refused(tmp_path, pose, told):
    """Before, a RecursionError and an OverflowError."""
    folder = small_scene(tmp_path, np.ones((HEIGHT, WIDTH), np.uint16))
    (folder / "Depth" / "DEPTH_view_0.json").write_text(pose)
    with pytest.raises(InputError, match=f"DEPTH_view_0.json: {told}"):
        read_robi(folder, ReadOptions())


@pytest.mark.parametrize("number", ["nan", "inf", "-inf"])
@pytest.mark.parametrize("key", ["width", "fx", "disparity_shift"])
def test_numbers_of_cameras_are_finite(tmp_path, key, number):
    """Before, a ValueError of the width, and others in the rig."""
    folder = small_scene(tmp_path, np.ones((HEIGHT, WIDTH), np.uint16))
    table = tmp_path / "cam" / f"Ensenso_{'DEPTH' if key == 'disparity_shift' else 'LEFT'}.yml"
    table.write_text(f"{table.read_text()}\n{key}: {number}\n")
    with pytest.raises(InputError, match=f"{table.name}: {key}: found {float(number):g}; allowed: a number up to"):
        read_robi(folder, ReadOptions())


@pytest.mark.parametrize(
    ("sensor", "focal", "baseline", "shift"),
    [
        ("Ensenso", 1083.097, 101.184, 0.0),
        ("RealSense", 905.906, 54.919, 78.0),
    ],
)
@pytest.mark.real
def test_the_data_sets_own_camera_files(sensor, focal, baseline, shift, tmp_path):
    root = Path(__file__).resolve().parents[3].parent / "shared" / "real" / "robi" / "cam"
    if not root.is_dir():
        pytest.skip(f"no camera files in {root}")
    size = (1024, 1280) if sensor == "Ensenso" else (720, 1280)
    folder, blank = tmp_path / "Scene_1" / sensor, np.zeros(size, np.uint8)
    write_view(folder, "view_0", blank, blank, np.ones(size, np.uint16), np.eye(4))
    (folder / "list.txt").write_text("view_0\n")
    capture, _ = read_robi(folder, ReadOptions(calibration=root))
    pair = capture.rig.rectification
    assert pair is not None
    assert (pair.matrix_left[0, 0], pair.baseline) == pytest.approx((focal, baseline), abs=1e-3)
    assert capture.settings["disparity_shift_px"] == shift
    assert capture.derived["depth"][0, 0] == pytest.approx(0.03125)
