"""Lens models as other programs state them, against OpenCV's projection by the coefficients of that model."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest

from characterisation.files.errors import InputError
from mitsim.capture.recordings.calibration_file import read_calibration
from tests.sensor.opencv_files import opencv_file

K = np.array([[600.0, 0, 322.0], [0, 602.0, 238.0], [0, 0, 1]])
BENT = np.array([0.01, -0.005, 0.002, -0.001])  # too small to raise a doubt by themselves
POINTS = np.random.default_rng(1).uniform([-120, -90, 400], [120, 90, 800], (50, 3))
SIZE = (640, 480)


def single(path, **more):
    camera = {"fx": 600.0, "fy": 602.0, "cx": 322.0, "cy": 238.0, "width": 640, "height": 480}
    path.write_text(json.dumps(camera | more))
    return path


def is_fisheye(path):
    seen, _ = cv2.fisheye.projectPoints(POINTS[:, None], np.zeros(3), np.zeros(3), K, BENT)
    np.testing.assert_allclose(read_calibration(path, SIZE).rig.reference.project(POINTS), seen[:, 0], atol=1e-6)


@pytest.mark.parametrize("suffix", [".yml", ".xml", ".json"])
@pytest.mark.parametrize("fisheye", [0, 1])
def test_opencvs_sample_marks_a_fisheye_lens(tmp_path, suffix, fisheye):
    """Its saveCameraParams writes fisheye_model; the coefficients were those of a perspective lens, 4.6 px off."""
    values = {"camera_matrix": K, "distortion_coefficients": BENT.reshape(4, 1)}
    path = opencv_file(tmp_path / f"a{suffix}", fisheye_model=fisheye, **values)
    if fisheye:
        is_fisheye(path)
        return
    seen, _ = cv2.projectPoints(POINTS, np.zeros(3), np.zeros(3), K, BENT)
    np.testing.assert_allclose(read_calibration(path, SIZE).rig.reference.project(POINTS), seen[:, 0], atol=1e-6)


@pytest.mark.parametrize(
    "name", ["KannalaBrandt", "kannala_brandt4", "Kannala Brandt4", "KB8", "pinhole-equi", "equi", "opencv_fisheye"]
)
@pytest.mark.parametrize("key", ["camera_model", "distortion_model", "model"])
def test_opencvs_fisheye_model_by_many_names(tmp_path, name, key):
    bent = dict(zip(("k1", "k2", "k3", "k4"), BENT, strict=True))
    is_fisheye(single(tmp_path / "a.json", **{key: name}, **bent))
    is_fisheye(single(tmp_path / "b.json", **{key: name}, distortion=BENT.tolist()))


def test_the_five_numbers_of_a_fisheye_of_librealsense_are_four(tmp_path):
    """A T265 has Kannala and Brandt's four and a 0, which was refused."""
    camera = {"width": 640, "height": 480, "ppx": 322.0, "ppy": 238.0, "fx": 600.0, "fy": 602.0}
    for model in (5, "distortion.kannala_brandt4"):
        (tmp_path / "a.json").write_text(json.dumps(camera | {"model": model, "coeffs": [*BENT.tolist(), 0.0]}))
        is_fisheye(tmp_path / "a.json")
    (tmp_path / "a.json").write_text(json.dumps(camera | {"model": 5, "coeffs": [*BENT.tolist(), 0.1]}))
    with pytest.raises(InputError, match="5 numbers; allowed: 4"):
        read_calibration(tmp_path / "a.json", SIZE)


def test_a_pinhole_with_equidistant_coefficients_is_a_fisheye_in_any_order(tmp_path):
    is_fisheye(single(tmp_path / "a.json", type="pinhole", distortion_model="equidistant", distortion=BENT.tolist()))


@pytest.mark.parametrize(
    ("more", "told"),
    [
        ({"camera_model": "THIN_PRISM_FISHEYE"}, "camera_model: found 'THIN_PRISM_FISHEYE'"),
        ({"camera_model": "FISHEYE624"}, "camera_model: found 'FISHEYE624'"),
        ({"camera_model": "RADIAL_FISHEYE"}, "camera_model: found 'RADIAL_FISHEYE'"),
        ({"camera_type": "ucm", "alpha": 0.6}, "camera_type: found 'ucm'"),
        ({"model_type": "double-sphere"}, "model_type: found 'double-sphere'"),
        ({"model": "radial_division"}, "model: found 'radial_division'"),
        ({"model": "Inverse Brown Conrady"}, "model: found 'Inverse Brown Conrady'"),
        ({"xi": 1.2}, "xi: found 1.2"),
    ],
)
def test_a_model_that_opencv_lacks_is_refused_by_any_spelling(tmp_path, more, told):
    """Its coefficients were taken for those of a perspective lens."""
    with pytest.raises(InputError, match=told):
        read_calibration(single(tmp_path / "a.json", distortion=BENT.tolist(), **more), SIZE)


def test_a_number_of_librealsense_states_the_model(tmp_path):
    camera = {"fx": 600.0, "fy": 602.0, "ppx": 322.0, "ppy": 238.0, "width": 640, "height": 480}
    (tmp_path / "a.json").write_text(json.dumps(camera | {"model": 2, "coeffs": [-0.1, 0.05, 0.0004, -0.0003, 0.0]}))
    with pytest.raises(InputError, match="model: found 2"):
        read_calibration(tmp_path / "a.json", SIZE)
    (tmp_path / "a.json").write_text(json.dumps(camera | {"model": 2, "coeffs": [0.0] * 5}))
    assert read_calibration(tmp_path / "a.json", SIZE).rig.reference.model == "perspective"


def test_the_unified_model_of_two_cameras_is_refused(tmp_path):
    """cv2.omnidir's sample of two cameras; read as perspective, points were 83 px off."""
    bent = np.array([[-0.1, 0.05, 0.001, 0.001]])
    first = {"camera_matrix_1": K, "distortion_coefficients_1": bent, "xi_1": 1.2}
    second = {"camera_matrix_2": K, "distortion_coefficients_2": bent, "xi_2": 1.2}
    pose = {"rotation": np.array([0.0, 0.1, 0.0]), "translation": np.array([-120.0, 0, 0])}
    with pytest.raises(InputError, match=r"xi_1: found 1\.2"):
        read_calibration(opencv_file(tmp_path / "a.yml", **first, **second, **pose), SIZE)


@pytest.mark.parametrize("device", ["OmniVision OV9281", "DS-2CD2143", "RealSense D435", "Basler acA1920 FOV60"])
def test_the_name_of_a_device_is_no_model(tmp_path, device):
    read = read_calibration(single(tmp_path / "a.json", model=device, distortion=[0.0] * 5), SIZE)
    assert read.rig.reference.model == "perspective"


BENT_BY_NAME = {name: float(number) for name, number in zip(("k1", "k2", "k3", "k4"), BENT, strict=True)}
WHOLE = {"camera_matrix": K.tolist(), "image_size": list(SIZE)}


@pytest.mark.parametrize(
    "table",
    [
        {"fx": 600.0, "fy": 602.0, "cx": 322.0, "cy": 238.0, **BENT_BY_NAME},
        {"fx": 600.0, "fy": 602.0, "cx": 322.0, "cy": 238.0, "distortion": BENT_BY_NAME},
        WHOLE | BENT_BY_NAME,
        WHOLE | {"distortion": BENT_BY_NAME},
        {"camera": WHOLE | {"distortion": BENT_BY_NAME}},
    ],
)
def test_k1_to_k4_alone_are_a_fisheye_lens_or_refused(tmp_path, table):
    """They were k1, k2, k3 and k4 of a rational lens, without a word: up to 55 px off in an image of 1280 px."""
    (tmp_path / "a.json").write_text(json.dumps(table))
    with pytest.raises(InputError, match=r"k4 of -0\.001 without k5 and k6.*model = \"fisheye\""):
        read_calibration(tmp_path / "a.json", SIZE)
    sensor = '[calibration]\nfile = "a.json"\nprojector = false\nmodel = "fisheye"\n'
    (tmp_path / "a.toml").write_text(sensor)
    is_fisheye(tmp_path / "a.toml")


def test_k4_of_a_polynomial_is_refused_in_a_list_with_names_too(tmp_path):
    """Metashape's K4 belongs to r^8, which is in no lens of OpenCV."""
    names = ["k1", "k2", "k3", "k4", "p1", "p2"]
    path = single(tmp_path / "a.json", distortion=[-0.1, 0.05, 0.01, 0.02, 1e-3, -1e-3], distortion_names=names)
    with pytest.raises(InputError, match=r"k4 of 0\.02 without k5 and k6"):
        read_calibration(path, SIZE)


def test_coefficients_are_read_with_underscores_in_their_names(tmp_path):
    """The tilt of the imager, tau_x and tau_y, and lenses of k_1 to k_3 were left out without a word."""
    names = ("k_1", "k_2", "p_1", "p_2", "k_3", "k_4", "k_5", "k_6", "s_1", "s_2", "s_3", "s_4", "tau_x", "tau_y")
    bent = [-0.1, 0.05, 1e-3, -5e-4, 0.01, 0.02, -0.01, 3e-3, 2e-3, -1e-3, 1.5e-3, 4e-4, 0.01, -0.008]
    for count in (5, 8, 12, 14):
        camera = read_calibration(single(tmp_path / "a.json", **dict(zip(names[:count], bent, strict=False))), SIZE)
        seen, _ = cv2.projectPoints(POINTS, np.zeros(3), np.zeros(3), K, np.array(bent[:count]))
        np.testing.assert_allclose(camera.rig.reference.project(POINTS), seen[:, 0], atol=1e-6)


def of_fisheye_calibrate(path, focal=600.0, bent=BENT, **more):
    matrix = K.copy()
    matrix[[0, 1], [0, 1]] = focal, focal + 2
    np.savez(path, K=matrix, D=np.reshape(bent, (4, 1)), DIM=SIZE, **more)
    return path


@pytest.mark.parametrize("name", ["fisheye_cam0.npz", "Kannala-Brandt.npz", "equidistant.npz"])
def test_the_name_of_a_file_tells_a_fisheye_lens(tmp_path, name):
    """Before, what cv2.fisheye.calibrate gives was k1, k2, p1, p2: 47 px off at the corner."""
    path = of_fisheye_calibrate(tmp_path / name)
    is_fisheye(path)
    assert any("is taken as a fisheye lens" in note for note in read_calibration(path, SIZE).notes)


@pytest.mark.parametrize("word", ["equidistant", "plumb_bob"])
def test_a_word_in_arrays_states_the_model(tmp_path, word):
    """Before, words in .npz files were no words, and told nothing."""
    read = read_calibration(of_fisheye_calibrate(tmp_path / "a.npz", 280.0, distortion_model=word), SIZE)
    assert (read.rig.reference.model, read.notes) == ("fisheye" if word == "equidistant" else "perspective", ())


@pytest.mark.parametrize(
    ("focal", "bent"), [(230.0, BENT), (600.0, [0.08, -0.05, 0.03, -0.01])], ids=["wide", "tangential"]
)
def test_four_numbers_that_no_perspective_lens_has_are_refused(tmp_path, focal, bent):
    with pytest.raises(InputError, match=r"four coefficients without a lens model.*distortion_model"):
        read_calibration(of_fisheye_calibrate(tmp_path / "a.npz", focal, bent), SIZE)


def test_four_numbers_that_may_be_either_are_told_and_barrels_are_not(tmp_path):
    (note,) = read_calibration(of_fisheye_calibrate(tmp_path / "a.npz"), SIZE).notes
    ray = np.array([[[(639 - 322) / 600, (479 - 238) / 602, 1.0]]])
    seen = [
        project(ray, np.zeros(3), np.zeros(3), K, BENT)[0] for project in (cv2.projectPoints, cv2.fisheye.projectPoints)
    ]
    assert (
        f"taken as k1, k2, p1, p2; as k1 to k4 the image's corner moves by {np.linalg.norm(seen[0] - seen[1]):.0f} px"
        in note
    )
    barrel = [-0.28, 0.09, 1e-3, -5e-4]
    single(tmp_path / "a.json", distortion=barrel)
    single(tmp_path / "b.json", **dict(zip(("k1", "k2", "p1", "p2"), BENT.tolist(), strict=True)))
    single(tmp_path / "c.json", distortion=BENT.tolist(), fisheye=False)
    single(tmp_path / "d.json", distortion=[0.0] * 4)
    for name in "abcd":
        read = read_calibration(tmp_path / f"{name}.json", SIZE)
        assert (read.rig.reference.model, read.notes) == ("perspective", ())
