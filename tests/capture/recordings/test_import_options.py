"""What ``mitsim import`` and ``decode`` are told beside a path, and what they say of what they do not know."""

from __future__ import annotations

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from characterisation.files.errors import InputError
from mitsim.capture.folder import read_capture
from mitsim.capture.recordings.any_recording import ReadOptions, read_recording
from mitsim.capture.recordings.pose_file import read_pose
from mitsim.capture.recordings.recording_files import frame_of
from mitsim.cli.program import app
from mitsim.sensor.camera import Camera
from mitsim.sensor.light_code import GrayCode
from mitsim.sensor.transforms import Transform
from tests.simulated_rigs import images_seen, save_images, surface_seen

K = np.array([[260.0, 0, 110.0], [0, 260, 85.0], [0, 0, 1]])
LEFT = Camera(K, np.zeros(5), 220, 170)
RIGHT = replace(LEFT, sensor_from_camera=Transform(np.eye(3), np.array([40.0, 0, 0])))
POSE = Transform.from_degrees([10.0, -20.0, 30.0], [100.0, -50.0, 600.0])


def texture(camera, shift=0.0):
    x, y, _ = np.moveaxis(surface_seen(camera, ball=False, tilt=0.0), -1, 0)
    waves = np.sin((x + shift) / 6.1) * np.cos(y / 5.7) + np.sin((x + y) / 8.3)
    return np.rint(120 + 40 * waves).astype(np.uint8)


@pytest.fixture
def pairs(tmp_path):
    """Three pairs under names of their own, and the calibration."""
    for number in range(3):
        for name, eye in (("cam0", LEFT), ("cam1", RIGHT)):
            save_images(tmp_path / "pairs", [texture(eye, 3.0 * number)], f"{name}_{{}}.png", number)
    storage = cv2.FileStorage(str(tmp_path / "stereo.yml"), cv2.FILE_STORAGE_WRITE)
    for name, value in {"M1": K, "M2": K, "R": np.eye(3), "T": np.array([-40.0, 0, 0])}.items():
        storage.write(name, value)
    storage.release()
    return tmp_path


def run(*arguments, code=0):
    done = CliRunner().invoke(app, [str(each) for each in arguments])
    assert done.exit_code == code, done.output
    return done


def imported(folder, *options):
    return run(
        "import",
        folder / "pairs",
        "--calibration",
        folder / "stereo.yml",
        "--images",
        "left=cam0_*.png",
        "--images",
        "right=cam1_*.png",
        "-o",
        folder / "capture",
        *options,
    )


def test_the_plane_of_a_coupon_gives_the_pose(pairs):
    done = imported(pairs, "--frame", "0", "--sample", "matt_white", "--coupon", 80, 60, 80, 60)
    height = surface_seen(LEFT, ball=False, tilt=0.0)[..., 2].mean()
    capture = read_capture(pairs / "capture")
    assert capture.world_from_sensor is not None and capture.settings["coupon"] == {"sample": "matt_white"}
    bias = 0.15 / (260 * 40 / height)  # the matcher's toward whole pixels, over the disparity
    assert capture.world_from_sensor.translation[2] == pytest.approx(height, rel=bias)
    np.testing.assert_allclose(capture.world_from_sensor.rotation[2], [0, 0, -1], atol=0.02)
    distance = np.linalg.norm(capture.world_from_sensor.translation)
    assert f"pose: {distance:.1f} mm from the coupon" in done.stderr and "next: mitsim decode" in done.stderr


def test_a_pose_is_given_or_taken_from_the_coupon(pairs):
    (pairs / "pose.txt").write_text("\n".join(" ".join(map(str, row)) for row in POSE.matrix()))
    options = ("--frame", "0", "--pose", pairs / "pose.txt", "--coupon", 80, 60, 80, 60)
    with pytest.raises(AssertionError, match="--coupon: found --pose too"):
        imported(pairs, *options)
    assert not (pairs / "capture").exists()


def test_a_pair_by_patterns_with_all_that_is_known_of_it(pairs):
    (pairs / "pose.txt").write_text("# world_from_sensor\n" + "\n".join(" ".join(map(str, r)) for r in POSE.matrix()))
    imported(
        pairs,
        "--frame",
        "1",
        "--exposure",
        "0.02",
        "--pose",
        pairs / "pose.txt",
        "--sample",
        "steel/ground",
        "--projector",
        "off",
        "--range",
        "300",
        "900",
    )
    capture = read_capture(pairs / "capture")
    np.testing.assert_array_equal(capture.images["right"][0], texture(RIGHT, 3.0))
    np.testing.assert_allclose(capture.world_from_sensor.matrix(), POSE.matrix(), atol=1e-12)
    settings = capture.settings
    assert (capture.decoding.exposure_s, settings["coupon"], settings["projector_on"]) == (
        0.02,
        {"sample": "steel/ground"},
        False,
    )
    done = run("decode", pairs / "capture", "-o", pairs / "cloud.ply")
    assert "300 to 900 mm" in done.output
    assert "row error of the second camera" in done.output
    done = run("decode", pairs / "capture", "-o", pairs / "cloud.ply", "--range", "400", "700", "--block", "9")
    assert "400 to 700 mm" in done.output


def test_contrast_is_heeded(pairs):
    imported(pairs, "--frame", "cam0_2")

    lines = run("decode", pairs / "capture", "-o", pairs / "cloud.ply").output.splitlines()
    assert sum(int(line.split("\t")[1].split()[0]) for line in lines if line.startswith("valid\t")) > 10
    done = run("decode", pairs / "capture", "-o", pairs / "cloud.ply", "--contrast", "200", code=1)
    assert "valid\t0 of" in done.output
    assert "an odd number" in str(run("decode", pairs / "capture", "-o", pairs / "a", "--block", "4", code=1).exception)


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["--frame", "7"], r"0 \(cam0_0\), 1 \(cam0_1\), 2 \(cam0_2\)"),
        (["--frame", "cam0_7"], r"0 \(cam0_0\), 1 \(cam0_1\), 2 \(cam0_2\)"),
        ([], "3 pairs, cam0_0 to cam0_2.*choose with --frame 0 to 2"),
        (["--frame", "0", "--exposure", "0"], "--exposure: found 0"),
        (["--frame", "0", "--projector", "dim"], r"--projector: found 'dim'; allowed: on \| off"),
        (["--frame", "0", "--pose", "nowhere.txt"], "nowhere.txt"),
        (["--frame", "0", "--images", "middle=*.png"], "--images: found 'middle'; allowed: left, right"),
        (["--frame", "0", "--images", "left"], "NAME=PATTERN"),
        (["--frame", "0", "--images", "left=../*"], "inside the folder"),
        (["--frame", "0", "--images", "left=none*"], r"0 of left and 3 of right.*--images left='cam0_"),
        (["--frame", "0", "--channel", "grey"], r"--channel: found 'grey'; allowed: blue \| green \| red"),
        (["--frame", "0", "--unit", "m"], "--unit for a stereo pair; allowed: .*--pose"),
    ],
)
def test_what_is_told_wrongly_names_what_is_right(pairs, options, told):
    arguments = [
        "import",
        str(pairs / "pairs"),
        "--calibration",
        str(pairs / "stereo.yml"),
        "--images",
        "left=cam0_*.png",
        "--images",
        "right=cam1_*.png",
        "-o",
        str(pairs / "capture"),
        *options,
    ]
    done = CliRunner().invoke(app, arguments)
    assert isinstance(done.exception, InputError)
    with pytest.raises(InputError, match=told):
        raise done.exception
    assert not (pairs / "capture").exists()


def test_frames_by_number_or_name(tmp_path):
    names = [f"set_{number}" for number in range(12)]
    assert frame_of(None, tmp_path, names) is None
    assert frame_of("3", tmp_path, names) == frame_of("set_3", tmp_path, names) == 3
    with pytest.raises(InputError, match=r"7 \(set_7\) to 11 \(set_11\)"):
        frame_of("set_12", tmp_path, names)
    with pytest.raises(InputError, match="a number, from 0"):
        frame_of("left", tmp_path)


@pytest.mark.parametrize(
    "text",
    [
        json.dumps(POSE.matrix().tolist()),
        json.dumps({"world_from_sensor": POSE.matrix().tolist()}),
        "\n".join(",".join(f"{value:.12g}" for value in row) for row in POSE.matrix()),
        "\n".join("\t".join(f"{value:.12g}" for value in row) for row in POSE.matrix()) + "\n\n",
    ],
)
def test_poses_in_the_usual_files(tmp_path, text):
    (tmp_path / "pose").write_text(text)
    pose = read_pose(tmp_path / "pose")
    np.testing.assert_allclose(pose.matrix(), POSE.matrix(), atol=1e-9)


@pytest.mark.parametrize(("unit", "doubted"), [(1.0, False), (1e-3, True), (0.0, False)])
def test_a_pose_in_metres_raises_a_doubt(pairs, unit, doubted):
    """It was taken in mm in silence: a sensor 0.6 mm from the coupon."""
    rows = POSE.matrix()
    rows[:3, 3] *= unit
    np.savetxt(pairs / "pose.txt", rows)
    said = imported(pairs, "--frame", 0, "--pose", pairs / "pose.txt").output
    assert ("the sensor is 0.61 mm from the origin" in said) == doubted


@pytest.mark.parametrize("text", ["", "1 2 3", "{}", "[1]", "nothing", json.dumps((2 * POSE.matrix()).tolist()), "[[["])
def test_what_is_no_pose_is_refused(tmp_path, text):
    (tmp_path / "pose").write_text(text)
    with pytest.raises(InputError, match="pose"):
        read_pose(tmp_path / "pose")


def test_a_coded_folder_by_patterns_carries_the_exposure_of_its_file(tmp_path):
    """Two cameras whose names are not those of the sensor file."""
    text = """name = "rig"
technology = "structured_light"
[cameras.left]
width = 220
height = 170
focal_px = [260.0, 260.0]
principal_px = [110.0, 85.0]
[cameras.right]
width = 220
height = 170
focal_px = [260.0, 260.0]
principal_px = [110.0, 85.0]
position_mm = [40, 0, 0]
[projector]
width = 64
height = 48
[pattern]
kind = "gray_code"
[decoder]
triangulate = "cameras"
[exposure]
rule = "fixed"
exposure_s = 0.04
"""
    (tmp_path / "rig.toml").write_text(text)
    beamer = Camera(np.array([[70.0, 0, 31.5], [0, 70, 23.5], [0, 0, 1]]), np.zeros(5), 64, 48)
    for name, eye in (("a", LEFT), ("b", RIGHT)):
        save_images(tmp_path / "images", images_seen(GrayCode(), eye, beamer, surface_seen(eye)), f"{name}{{:02d}}.png")
    given = ReadOptions(sensor=str(tmp_path / "rig.toml"), images={"left": "a*.png", "right": "b*.png"})
    capture = read_recording(tmp_path / "images", given).capture
    assert set(capture.images) == {"left", "right"}
    assert capture.decoding.exposure_s == 0.04
    assert capture.decoding.projector_size_px == (64, 48)
    assert "warnings" not in capture.settings


def test_depths_that_nobody_has_named_are_said_to_be_assumed(pairs):
    imported(pairs, "--frame", 1)
    words = "assumed: the capture has no range; set --range"
    assert words in run("decode", pairs / "capture", "-o", pairs / "cloud.ply").output
    assert words not in run("decode", pairs / "capture", "--range", 300, 900, "-o", pairs / "cloud.ply").output


TURN = Rotation.from_euler("xyz", [170.0, 12.0, 40.0], degrees=True)
X, Y, Z, W = TURN.as_quat().tolist()
PLACE = {"x": 0.1, "y": -0.02, "z": 0.5}
FOUR = {"x": X, "y": Y, "z": Z, "w": W}

#: the sensor at 100, -20, 500 mm in the world, turned by TURN
OF_QUATERNIONS = {
    "echo of ROS": yaml.dump({"header": {"frame_id": "map"}, "pose": {"position": PLACE, "orientation": FOUR}})
    + "---\n",
    "transform": json.dumps({"child_frame_id": "sensor", "transform": {"translation": PLACE, "rotation": FOUR}}),
    "x, y, z, w": json.dumps({"position": [100, -20, 500], "quaternion_xyzw": [X, Y, Z, W]}),
    "w, x, y, z in cm": json.dumps({"translation": [10, -2, 50], "quaternion_wxyz": [W, X, Y, Z], "unit": "cm"}),
    "matrix": json.dumps({"translation": [100, -20, 500], "rotation": TURN.as_matrix().tolist()}),
}


@pytest.mark.parametrize("name", OF_QUATERNIONS)
def test_a_pose_of_a_position_and_an_orientation(tmp_path, name):
    (tmp_path / "pose").write_text(OF_QUATERNIONS[name])
    pose = read_pose(tmp_path / "pose")
    points = np.array([[0.0, 0.0, 0.0], [30.0, -40.0, 600.0]])
    np.testing.assert_allclose(pose.points(points), TURN.apply(points) + np.array([100, -20, 500]), atol=1e-9)


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"position": [0, 0, 500], "orientation": [0, 0, 0, 1]}, "position, orientation of unknown order or length"),
        ({"position": [0, 0, 500], "quaternion_xyzw": [0, 0, 0, 2]}, "of unknown order or length"),
        ({"pose": {"pose": {"position": PLACE}}}, "found position; allowed"),
        ({"position": PLACE, "orientation": FOUR, "covariance": [0.0] * 36}, "found position, orientation, covariance"),
        ({"position": PLACE, "orientation": FOUR, "unit": "miles"}, "unit: found 'miles'"),
        ({"position": [1, 2], "orientation": FOUR}, "found position, orientation; allowed"),
    ],
)
def test_a_pose_of_unknown_meaning_is_refused(tmp_path, table, words):
    for text in (json.dumps(table), yaml.dump(table, sort_keys=False)):
        (tmp_path / "pose").write_text(text)
        with pytest.raises(InputError, match=words):
            read_pose(tmp_path / "pose")


def test_images_of_different_numbers_are_no_pair(pairs):
    """Before, left 0, 1, 3 and right 0, 2, 3 paired 1 with 2."""
    folder = pairs / "pairs"
    (folder / "cam0_2.png").rename(folder / "cam0_3.png")
    (folder / "cam1_2.png").rename(folder / "cam1_3.png")
    (folder / "cam1_1.png").rename(folder / "cam1_2.png")
    patterns = {"left": "cam0_*.png", "right": "cam1_*.png"}
    options = {"calibration": str(pairs / "stereo.yml"), "images": patterns}
    with pytest.raises(InputError, match=r"pair 1: found cam0_1.png with cam1_2.png; allowed: images of the same"):
        read_recording(folder, ReadOptions(frame=1, **options))
    assert read_recording(folder, ReadOptions(frame=2, **options)).capture.settings["files"]["right"] == "cam1_3.png"
    one = {"left": "cam0_1.png", "right": "cam1_2.png"}
    assert read_recording(folder, ReadOptions(**options | {"images": one})).capture.images.keys() == one.keys()


@pytest.mark.parametrize("left", [(10, 20, 30), (0, 2, 4)])
def test_numbers_that_no_two_images_share_are_paired_in_order(pairs, left):
    """Stamps of two clocks, or one count of both cameras."""
    folder = pairs / "pairs"
    for number in (2, 1, 0):
        (folder / f"cam0_{number}.png").rename(folder / f"cam0_{left[number]}.png")
        (folder / f"cam1_{number}.png").rename(folder / f"cam1_{left[number] + 1}.png")
    options = {"calibration": str(pairs / "stereo.yml"), "images": {"left": "cam0_*.png", "right": "cam1_*.png"}}
    files = read_recording(folder, ReadOptions(frame=1, **options)).capture.settings["files"]
    assert files == {"left": f"cam0_{left[1]}.png", "right": f"cam1_{left[1] + 1}.png"}


@pytest.mark.parametrize("decimals", [4, 6, 12])
@pytest.mark.parametrize("comment", ["# pose: mm\n", ""])
def test_a_pose_of_few_decimals_is_the_nearest_rotation(tmp_path, decimals, comment):
    """Before, six were "no rotation matrix"; and a colon in a comment was YAML."""
    rows = [" ".join(f"{value:.{decimals}f}" for value in row) for row in POSE.matrix()]
    (tmp_path / "pose").write_text(comment + "\n".join(rows))
    pose = read_pose(tmp_path / "pose")
    np.testing.assert_allclose(pose.matrix(), POSE.matrix(), atol=10.0**-decimals)
    assert np.abs(pose.rotation @ pose.rotation.T - np.eye(3)).max() < 1e-6


def test_a_matrix_that_is_not_rounded_but_no_rotation_is_refused(tmp_path):
    matrix = POSE.matrix()
    matrix[:3, :3] *= 1.01
    np.savetxt(tmp_path / "pose", matrix)
    with pytest.raises(InputError, match="a rotation matrix"):
        read_pose(tmp_path / "pose")
