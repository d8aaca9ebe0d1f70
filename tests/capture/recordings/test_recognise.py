"""What ``mitsim import`` makes of whatever it is given, and of the files that say what cameras took it."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from characterisation.cloud_files import read_cloud
from characterisation.files.atomic_io import HOST
from characterisation.files.errors import InputError
from mitsim.capture.calibration import calibration_table
from mitsim.capture.folder import read_capture
from mitsim.capture.recordings.any_recording import ReadOptions, read_recording
from mitsim.capture.recordings.calibration_file import read_calibration
from mitsim.capture.recordings.depthai_recording import read_depthai_recording, recorded_streams
from mitsim.capture.recordings.recognise import NAMES, kind_of
from mitsim.cli.program import app
from mitsim.sensor.camera import Camera, Rig
from mitsim.sensor.preset import load_sensor
from tests.capture.recordings.cloud_files_of_others import pcd, pinhole_cloud, ply
from tests.capture.recordings.test_depthai_files import calibration as depthai_calibration
from tests.capture.recordings.test_ensenso_files import files as ensenso_files
from tests.capture.recordings.test_ensenso_files import node, pack, unpack

CLOUD = pinhole_cloud()
HEIGHT, WIDTH = CLOUD.shape[:2]
CAMERA = Camera(np.array([[60.0, 0, 31.3], [0, 61.0, 22.8], [0, 0, 1]]), np.zeros(5), WIDTH, HEIGHT)
PINHOLE = {"fx": 60.0, "fy": 61.0, "cx": 31.3, "cy": 22.8, "width": WIDTH, "height": HEIGHT}

TOML = """name = "mine"
[cameras.eye]
width = 64
height = 48
focal_px = [60.0, 61.0]
principal_px = [31.3, 22.8]
"""
OPENCV = """%YAML:1.0
---
camera_matrix: [[60., 0., 31.3], [0., 61., 22.8], [0., 0., 1.]]
distortion_coefficients: [0., 0., 0., 0., 0.]
"""


def save(path: Path, content: bytes | str | dict) -> Path:
    data = json.dumps(content) if isinstance(content, dict) else content
    path.write_bytes(data if isinstance(data, bytes) else data.encode())
    return path


def depth_png() -> bytes:
    levels = np.nan_to_num(CLOUD[..., 2]).astype(np.uint16)
    return cv2.imencode(".png", levels)[1].tobytes()


def run(*arguments: object):
    """The command in this process; what a user can mend is raised."""
    result = CliRunner().invoke(app, [str(each) for each in arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == 0, result.output
    return result


@pytest.mark.parametrize(
    ("name", "content", "kind"),
    [
        ("r.zip", b"PK\x03\x04", "ensenso"),
        ("r.bin", b"PK\x03\x04", "ensenso"),
        ("a.dat", b"ply\nformat", "ply"),
        ("a.pcd", b"# .PCD v0.7", "pcd"),
        ("a.txt", b"# .PCD v0.7", "pcd"),
        ("a", b"\x89PNG\r\n\x1a\n", "depth"),
        ("a.tif", b"II*\x00", "depth"),
        ("a.mcap", b"\x89MCAP0\r\n", "depthai"),
        ("a.mcap", b"", "depthai"),
    ],
)
def test_files_are_told_by_their_first_bytes(tmp_path, name, content, kind):
    assert kind_of(save(tmp_path / name, content)) == kind


def test_folders_are_told_by_the_names_in_them(tmp_path):
    assert kind_of(unpack(tmp_path / "e", ensenso_files(node(), "deep/er/"))) == "ensenso"
    (tmp_path / "d").mkdir()
    save(tmp_path / "d" / "left.mcap", b"")
    assert kind_of(tmp_path / "d") == "depthai"
    (tmp_path / "i").mkdir()
    save(tmp_path / "i" / "left.png", b"")
    assert kind_of(tmp_path / "i", calibration="c.yml") == "stereo-pair"
    assert kind_of(tmp_path / "i", sensor="ensenso-n10") == "stereo-pair"
    with pytest.raises(InputError, match=r"left\.png.*with --sensor or --calibration"):
        kind_of(tmp_path / "i")
    with pytest.raises(InputError, match="no such file or folder"):
        kind_of(tmp_path / "nowhere")
    for name, told in (("x.e57", "CloudCompare"), ("x.stl", "mitsim part"), ("x.3mf", "mitsim part")):
        with pytest.raises(InputError, match=told):
            kind_of(save(tmp_path / name, b"PK\x03\x04" if name == "x.3mf" else b"hello"))
    with pytest.raises(InputError, match=r"unknown kind.*--as"):
        kind_of(save(tmp_path / "x.docx", b"hello"))


def test_names_in_a_folder_may_have_capitals(tmp_path):
    """Windows writes them; Rec_0.mcap was looked for as rec_0.mcap, and Left.MCAP was no stream."""
    pytest.importorskip("rosbags")
    from tests.capture.recordings.ros_bags import ROS2, depth_messages, write_bag

    bag = write_bag(tmp_path / "bag", depth_messages(ROS2), "mcap")
    for name in ("Rec_0.mcap", "REC_0.MCAP"):
        folder = tmp_path / name.partition(".")[2]
        folder.mkdir()
        save(folder / name, bag.read_bytes())
        assert kind_of(folder) == "ros"
        assert read_recording(folder, ReadOptions()).capture.source == "device"
    streams = tmp_path / "oak"
    streams.mkdir()
    save(streams / "Left.MCAP", b"")
    save(streams / "RIGHT.mcap", b"")
    assert kind_of(streams) == "depthai"
    assert {side: file.name for side, file in recorded_streams(streams).items()} == {
        "left": "Left.MCAP",
        "right": "RIGHT.mcap",
    }
    with pytest.raises(InputError, match=r"DepthAI_Calib\.JSON"):
        read_depthai_recording(save(streams / "DepthAI_Calib.JSON", b"{").parent, ReadOptions())


RIGS = Path(__file__).parents[3] / "scenes" / "rigs"


@pytest.mark.parametrize(
    ("path", "told"),
    [
        (
            RIGS / "opencv.toml",
            r"found a sensor file.*FOLDER_OF_IMAGES --sensor \S+opencv.toml, with calib.yml of your rig",
        ),
        (RIGS / "pair.toml", r"with intrinsics.yml and extrinsics.yml of your rig"),
        (RIGS, r"found a folder with beat.toml, a sensor file.*--sensor \S+beat.toml"),
        ("rig.yml", r"found a calibration, or another description.*--calibration \S+rig.yml"),
        ("eyes.toml", r"found a calibration, or another description.*--calibration \S+eyes.toml"),
        ("study.toml", r"found a TOML file with scene, task; allowed: a recording, or a folder of images$"),
        ("broken.toml", r"broken.toml"),
    ],
)
def test_what_describes_a_rig_is_told_from_a_recording(tmp_path, path, told):
    """Before, these were files of an unknown kind, and the advice was --as, which no kind fits."""
    save(tmp_path / "rig.yml", b"%YAML:1.0\n---\nK: 1\n")
    save(tmp_path / "eyes.toml", b'[calibration]\nfile = ["a.yml"]\n')
    save(tmp_path / "study.toml", b'scene = "a.xml"\ntask = "b.toml"\n')
    save(tmp_path / "broken.toml", b"= 3\n")
    with pytest.raises(InputError, match=told):
        kind_of(tmp_path / path)


def test_what_a_kind_does_not_heed_is_refused(tmp_path):
    path = save(tmp_path / "a.pcd", pcd(CLOUD, "binary"))
    with pytest.raises(InputError, match="--scale for a PCD cloud; allowed: --axes, --calibration"):
        read_recording(path, ReadOptions(scale_mm=2.0))
    with pytest.raises(InputError, match="did you mean 'ply'"):
        read_recording(path, ReadOptions(), "pyl")
    for wrong, told in (
        ({"axes": "z-up"}, "--axes"),
        ({"unit": "furlong"}, "--unit"),
        ({"range_mm": (5, 4)}, "--range"),
    ):
        with pytest.raises(InputError, match=told):
            read_recording(path, ReadOptions(**wrong))


CALIBRATIONS = {
    "small.toml": TOML,
    "small.json": PINHOLE,
    "opencv.yml": OPENCV,
    "calibration.json": calibration_table(Rig({"camera": CAMERA})),
    "opencv.json": {"camera_matrix": CAMERA.matrix.tolist(), "distortion_coefficients": [0.0] * 5},
    "with.toml": '[calibration]\nfile = "opencv.yml"\nprojector = false\n',
}


@pytest.mark.parametrize("name", CALIBRATIONS)
def test_every_way_of_saying_one_camera_is_the_same_camera(tmp_path, name):
    for each in {name, "opencv.yml"}:
        save(tmp_path / each, CALIBRATIONS[each])
    camera = read_calibration(tmp_path / name, (WIDTH, HEIGHT)).rig.reference
    np.testing.assert_array_equal(camera.matrix, CAMERA.matrix)
    assert (camera.width, camera.height, camera.model) == (WIDTH, HEIGHT, "perspective")
    assert not camera.distortion.any()


def test_presets_and_depthai_are_calibrations_too(tmp_path):
    read = read_calibration("realsense-d435")
    known = load_sensor("realsense-d435")
    assert (read.sensor, read.range_mm) == (known.name, tuple(known.working_range_mm))
    np.testing.assert_array_equal(read.rig.reference.matrix, known.rig.reference.matrix)
    pair = read_calibration(save(tmp_path / "oak.json", depthai_calibration()), (128, 80))
    assert list(pair.rig.cameras) == ["left", "right"]
    assert pair.rig.reference.matrix[0, 0] == 100.0


@pytest.mark.parametrize(
    ("name", "content", "told"),
    [
        ("a.json", "{", "not JSON"),
        ("a.json", "[" * 100_000, "not JSON"),
        ("a.json", {"fx": 1.0}, "found nothing; allowed: the matrix of camera. the file has fx"),
        ("a.json", "[1]", "found a list"),
        ("a.json", PINHOLE | {"fx": -1.0}, "fx"),
        ("a.json", PINHOLE | {"distortion": [0.0] * 6}, "distortion"),
        ("a.json", PINHOLE | {"cx": "left"}, r"fx, fy, cx, cy: found \[\[60.0, 0.0, nan\]"),
        ("a.json", {"something": 1}, "camera_matrix"),
        ("a.json", {"cameras": []}, "cameras"),
        ("a.toml", "name = 3", "cameras|name"),
        ("a.toml", TOML.replace("64", "sixty-four"), "not TOML"),
        ("a.yml", "hello", "text without names"),
        ("a.csv", "1,2", "the ending '.csv'"),
        ("a", "1", "the ending ''"),
    ],
)
def test_what_is_no_calibration_is_refused_in_words(tmp_path, name, content, told):
    with pytest.raises(InputError, match=told):
        read_calibration(save(tmp_path / name, content), (WIDTH, HEIGHT))


@settings(max_examples=100)
@given(
    st.binary(max_size=120) | st.text(max_size=60).map(str.encode), st.sampled_from([".json", ".toml", ".yml", ".xml"])
)
def test_any_calibration_is_read_or_refused_in_words(data, ending):
    with tempfile.TemporaryDirectory() as place, pytest.raises(InputError):
        read_calibration(save(Path(place) / f"c{ending}", data), (WIDTH, HEIGHT))


@pytest.mark.parametrize(
    ("name", "content", "options"),
    [
        ("cloud.pcd", pcd(CLOUD, "binary_compressed"), []),
        ("cloud.ply", ply(CLOUD), []),
        ("loose.ply", ply(CLOUD, grid="none"), ["--calibration", "small.json"]),
        ("depth.png", depth_png(), ["--calibration", "small.toml", "--range", "600", "800"]),
        ("depth.png", depth_png(), ["--calibration", "opencv.yml", "--scale", "0.5", "--invalid", "0"]),
    ],
)
def test_the_command_imports_and_the_originals_are_untouched(tmp_path, monkeypatch, name, content, options):
    monkeypatch.chdir(tmp_path)
    for file in ("small.json", "small.toml", "opencv.yml"):
        save(tmp_path / file, CALIBRATIONS[file])
    save(tmp_path / name, content)
    result = run("import", name, *options)
    folder = tmp_path / f"{Path(name).stem}_capture"
    assert NAMES[kind_of(Path(name))] in result.stderr and str(folder.name) in result.stderr
    assert result.stdout == ""
    assert (folder / "vendor" / name).read_bytes() == content
    if "--calibration" in options:
        file = options[options.index("--calibration") + 1]
        assert (folder / "vendor" / file).read_bytes() == (tmp_path / file).read_bytes()
    capture = read_capture(folder)
    assert capture.source == "device"
    run("decode", folder, "-o", tmp_path / "out.ply")
    cloud = read_cloud(tmp_path / "out.ply")
    share = np.isfinite(CLOUD[..., 2]).mean()
    assert cloud.valid.mean() == pytest.approx(share, abs=1e-9)
    scale = 0.5 if "--scale" in options else 1.0
    expected = CLOUD[..., 2] if name != "depth.png" else np.floor(CLOUD[..., 2]) * scale
    np.testing.assert_allclose(cloud.points[cloud.valid][:, 2], expected[cloud.valid], rtol=1e-6)


def test_the_command_keeps_to_the_range_that_was_given(tmp_path):
    save(tmp_path / "a.pcd", pcd(CLOUD, "binary"))
    run("import", tmp_path / "a.pcd", "-o", tmp_path / "c", "--range", 690, 710)
    run("decode", tmp_path / "c", "-o", tmp_path / "c.ply")
    z = CLOUD[..., 2]
    np.testing.assert_array_equal(read_cloud(tmp_path / "c.ply").valid, (z >= 690) & (z <= 710))


def test_a_sensor_gives_its_name_and_its_range(tmp_path):
    """As a campaign over existing captures wants it: the name is that of the campaign's sensor."""
    save(tmp_path / "a.pcd", pcd(CLOUD, "binary"))
    save(tmp_path / "small.json", PINHOLE)
    run(
        "import",
        tmp_path / "a.pcd",
        "--sensor",
        "realsense-d435",
        "--calibration",
        tmp_path / "small.json",
        "-o",
        tmp_path / "c",
    )
    assert read_capture(tmp_path / "c").sensor == "realsense-d435"


def test_the_same_import_again_is_finished_and_sweeps_what_a_killed_one_left(tmp_path):
    save(tmp_path / "a.pcd", pcd(CLOUD, "binary"))
    half = tmp_path / f".c.partial-999999999-{HOST}0123456789ab"
    half.mkdir()
    call = ("import", tmp_path / "a.pcd", "-o", tmp_path / "c")
    first, second = run(*call), run(*call)
    assert not half.exists()
    assert "finished before" in second.stderr and "finished before" not in first.stderr
    with pytest.raises(InputError, match="an existing capture"):
        run(*call, "--range", 690, 710)
    (tmp_path / "c" / "settings.json").write_text("{}")
    with pytest.raises(InputError, match=r"settings\.json"):
        run(*call)


def test_odd_names_of_originals_are_made_plain(tmp_path):
    path = save(tmp_path / "S10-60,750 µ.pcd", pcd(CLOUD, "binary"))
    run("import", path, "-o", tmp_path / "c")
    assert [file.name for file in (tmp_path / "c" / "vendor").iterdir()] == ["S10-60_750__.pcd"]


def test_a_zip_imports_as_before_and_a_failure_leaves_nothing(tmp_path):
    good = pack(tmp_path / "good.zip", ensenso_files(node()))
    run("import", good, "-o", tmp_path / "c")
    assert read_capture(tmp_path / "c").sensor == "N10-304-18"
    bad = pack(tmp_path / "bad.zip", ensenso_files(node()) | {"1_150358_left.png": b"x"})
    with pytest.raises(InputError, match=r"1_150358_left\.png"):
        run("import", bad, "-o", tmp_path / "d")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bad.zip", "c", "good.zip"]


def test_an_error_is_one_message_and_exit_code_2(tmp_path):
    """In a process of its own, as a user sees it."""
    path = save(tmp_path / "flat.pcd", pcd(CLOUD[np.isfinite(CLOUD[..., 0])][None], "binary"))
    done = subprocess.run(
        [sys.executable, "-m", "mitsim", "import", str(path), "-o", str(tmp_path / "c")], capture_output=True, text=True
    )
    assert done.returncode == 2 and done.stdout == ""
    assert done.stderr.startswith(f"mitsim: {path}: HEIGHT: found 1: a cloud without a grid")
    assert "Traceback" not in done.stderr and not (tmp_path / "c").exists()


def test_a_folder_around_a_recording_says_what_to_name(tmp_path):
    (tmp_path / "camera.zip").write_bytes(b"PK\x03\x04")
    with pytest.raises(InputError, match=r"name the recording in it: .*camera\.zip"):
        kind_of(tmp_path)


def test_a_folder_that_is_no_recording_is_told_by_the_names_in_it(tmp_path):
    """Before, names were in small letters, and a folder of folders had "nothing in it"."""
    (tmp_path / "Frames").mkdir()
    with pytest.raises(InputError, match=r"found a folder with Frames/; allowed: a recording"):
        read_recording(tmp_path, ReadOptions())
    (tmp_path / "CamA.png").touch()
    with pytest.raises(InputError, match=r"found a folder with CamA\.png, Frames/; allowed: a recording"):
        read_recording(tmp_path, ReadOptions())
