"""Calibrations that OpenCV wrote, in all its formats, against the numbers that went in."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from characterisation.files.errors import InputError
from mitsim.sensor.calibration_formats import read_documents
from mitsim.sensor.preset import load_sensor
from tests.sensor.opencv_files import opencv_file

FRINGES = (Path(__file__).parents[1] / "data/fringes.toml").read_text(encoding="utf-8")
K = np.array([[900.5, 0, 317.2], [0, 901.25, 241.4], [0, 0, 1]])
KP = np.array([[1250.0, 0, 455.5], [0, 1251.0, 300.0], [0, 0, 1]])
D = np.array([-0.12, 0.06, 0.0004, -0.0003, -0.01])
DP = np.array([0.03, -0.02, 0.0002, 0.0001, 0.0])
R = cv2.Rodrigues(np.array([0.01, 0.22, -0.02]))[0]
T = np.array([-140.0, 5.0, 10.0])
USUAL = {
    "camera_matrix": K,
    "distortion_coefficients": D,
    "image_size": np.array([640, 480]),
    "projector_matrix": KP,
    "projector_distortion": DP,
    "projector_size": np.array([912, 570]),
    "R": R,
    "T": T.reshape(3, 1),
}


def sensor_text(table='file = "calib.yml"'):
    """The file of tests/data without its optics, and with a calibration."""
    head, _, rest = FRINGES.partition("[cameras.camera]")
    rest = rest[rest.index("flux_w") :]
    return f"{head}\n[calibration]\n{table}\n\n[projector]\n{rest}"


def loaded(folder, values=USUAL, name="calib.yml", table=None, purpose="simulation"):
    opencv_file(folder / name, **values)
    (folder / "my.toml").write_text(sensor_text(table or f'file = "{name}"'), encoding="utf-8")
    return load_sensor(folder / "my.toml", purpose)


@pytest.mark.parametrize("suffix", ["yml", "yaml", "xml", "json", "yml.gz"])
def test_every_format_gives_the_numbers_that_were_written(tmp_path, suffix):
    rig = loaded(tmp_path, name=f"calib.{suffix}").rig
    camera, projector = rig.cameras["camera"], rig.projector
    np.testing.assert_array_equal(camera.matrix, K)
    np.testing.assert_array_equal(camera.distortion, D)
    np.testing.assert_array_equal(projector.matrix, KP)
    np.testing.assert_array_equal(projector.distortion, DP)
    assert (camera.width, camera.height, projector.width, projector.height) == (640, 480, 912, 570)


@pytest.mark.skipif(sys.platform != "linux", reason="names of any bytes are of Linux")
def test_a_name_in_latin_1_gives_the_same_numbers(tmp_path):
    """Before, OpenCV ended the process with a segmentation fault."""
    opencv_file(tmp_path / "calib.xml", **USUAL)
    named = (tmp_path / "calib.xml").rename(os.fsdecode(os.fsencode(tmp_path) + b"/pr\xfcf.xml"))
    np.testing.assert_array_equal(read_documents(Path(named))[0]["camera_matrix"], K)


def test_the_projector_stands_where_stereo_calibrate_says(tmp_path):
    """cv2.projectPoints takes R and T as they are: an independent way to the projector's pixels."""
    projector = loaded(tmp_path).rig.projector
    points = np.random.default_rng(1).uniform([-100, -80, 400], [100, 80, 800], (50, 3))
    expected, _ = cv2.projectPoints(points, cv2.Rodrigues(R)[0], T, KP, DP)
    np.testing.assert_allclose(projector.project(points), expected[:, 0], atol=1e-9)


def test_metres_become_millimetres(tmp_path):
    table = 'file = "calib.yml"\nto_mm = 1000'
    centre = loaded(tmp_path, USUAL | {"T": T / 1000}, table=table).rig.projector.centre
    np.testing.assert_allclose(centre, -R.T @ T, atol=1e-9)


@pytest.mark.parametrize("beamer", ["beamer", "rig.0"])  # in a map, or in a list
def test_names_can_be_mapped_and_plain_lists_are_read(tmp_path, beamer):
    names = {
        "optics": {"cam": K.tolist(), "dist": D.tolist(), "size": [640, 480]},
        "beamer": {"K": KP.tolist(), "size": [912, 570], "pose": {"R": R.tolist(), "t": T.tolist()}},
    }
    names["rig"] = [names["beamer"]]
    (tmp_path / "rig.json").write_text(json.dumps(names), encoding="utf-8")
    table = """file = "rig.json"
[calibration.keys.camera]
matrix = "optics.cam"
distortion = "optics.dist"
size = "optics.size"
[calibration.keys.projector]
matrix = "beamer.K"
size = "beamer.size"
rotation = "beamer.pose.R"
translation = "beamer.pose.t"
""".replace("beamer.", f"{beamer}.")
    (tmp_path / "my.toml").write_text(sensor_text(table), encoding="utf-8")
    rig = load_sensor(tmp_path / "my.toml").rig
    np.testing.assert_array_equal(rig.cameras["camera"].distortion, D)
    np.testing.assert_array_equal(rig.projector.distortion, np.zeros(5))
    np.testing.assert_allclose(rig.projector.centre, -R.T @ T, atol=1e-12)


def test_two_cameras_and_a_projector_of_ones_own(tmp_path):
    """A stereo calibration under OpenCV's sample's names; the projector is not in it."""
    opencv_file(tmp_path / "stereo.yml", M1=K, D1=D, M2=K, D2=D, R=R, T=T)
    head, _, rest = FRINGES.partition("[cameras.camera]")
    _, projector = rest.split("[projector]")
    table = '[calibration]\nfile = "stereo.yml"\ncameras = ["left", "right"]\nprojector = false\n'
    sizes = "".join(f"[cameras.{name}]\nwidth = 640\nheight = 480\n" for name in ("left", "right"))
    (tmp_path / "my.toml").write_text(f"{head}{table}{sizes}[projector]{projector}", encoding="utf-8")
    rig = load_sensor(tmp_path / "my.toml").rig
    assert list(rig.cameras) == ["left", "right"]
    np.testing.assert_allclose(rig.cameras["right"].centre, -R.T @ T, atol=1e-12)
    np.testing.assert_allclose(rig.cameras["right"].sensor_from_camera.rotation, R.T, atol=1e-12)
    np.testing.assert_array_equal(rig.projector.centre, [140, 5, 10])


@pytest.mark.parametrize("turn", [[0, np.pi / 2, 0], [0.3, -np.pi / 2, 0.1], [0, 0, np.pi], [1.0, -2.0, 0.5]])
def test_any_rotation_survives_its_angles(tmp_path, turn):
    """The tables hold angles about fixed axes; at 90 deg about y they are not unique, and still give the rotation."""
    matrix = Rotation.from_euler("xyz", turn).as_matrix()
    # for decoding: most of these rigs see nothing in common, which a simulation refuses
    found = loaded(tmp_path, USUAL | {"R": matrix}, purpose="decoding").rig.projector.sensor_from_camera.rotation
    np.testing.assert_allclose(found, matrix.T, atol=1e-7)


def without(*names):
    return {name: value for name, value in USUAL.items() if name not in names}


@pytest.mark.parametrize(
    ("values", "table", "message"),
    [
        (without("camera_matrix"), None, r"camera_matrix or .*matrix of camera.*the file has distortion_coefficients"),
        (without("R"), None, "rotation of projector"),
        (USUAL | {"camera_matrix": np.eye(4)}, None, "camera_matrix: found an array of 4 x 4; allowed: 3 x 3"),
        (USUAL | {"camera_matrix": K * np.nan}, None, "finite numbers"),
        (USUAL | {"camera_matrix": -K}, None, "fx 0 cx"),
        (USUAL | {"camera_matrix": "none"}, None, "camera_matrix: found something else"),
        (USUAL | {"distortion_coefficients": np.zeros(6)}, None, "distortion_coefficients"),
        (USUAL | {"R": 2 * R}, None, "rotation matrix"),
        (USUAL | {"T": np.zeros(2)}, None, "T: found an array of 2"),
        (without("image_size"), None, "width"),
        (
            USUAL,
            'file = "other.yml"',
            "other.yml: found no such file; .* that my.toml names.*copy this file beside",
        ),
        (USUAL, 'file = "my.toml"', "cannot read"),
        (USUAL, 'file = "calib.yml"\nto_m = 1', "to_mm"),
        (USUAL, 'file = "calib.yml"\n[calibration.keys.beamer]\nmatrix = "K"', "keys.beamer"),
        (USUAL, 'file = "calib.yml"\n[calibration.keys.camera]\ndistortion = "kc"', "kc: found nothing"),
    ],
)
def test_what_cannot_be_read_is_said_with_file_and_key(tmp_path, values, table, message):
    with pytest.raises(InputError, match=message):
        loaded(tmp_path, values, table=table)


def test_an_empty_or_foreign_file_is_refused(tmp_path):
    (tmp_path / "my.toml").write_text(sensor_text(), encoding="utf-8")
    for text in ("", "fx: 3\n", "%YAML:1.0\n---\nfx: [1,"):
        (tmp_path / "calib.yml").write_text(text, encoding="utf-8")
        with pytest.raises(InputError, match=r"calib.yml"):
            load_sensor(tmp_path / "my.toml")


def test_numbers_without_names_say_how_to_name_them(tmp_path):
    (tmp_path / "param.txt").write_text("2393.99\n0\n984.887\n", encoding="utf-8")
    (tmp_path / "my.toml").write_text(sensor_text().replace("calib.yml", "param.txt"), encoding="utf-8")
    with pytest.raises(InputError, match=r"text of another form.*under the usual names: cam_K, proj_K, R, T"):
        load_sensor(tmp_path / "my.toml")


def test_a_sensor_without_cameras_and_calibration_says_what_is_missing(tmp_path):
    head, _, rest = FRINGES.partition("[cameras.camera]")
    (tmp_path / "my.toml").write_text(head + rest[rest.index("[projector]") :], encoding="utf-8")
    with pytest.raises(InputError, match="cameras: found nothing"):
        load_sensor(tmp_path / "my.toml")
