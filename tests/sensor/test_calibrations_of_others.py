"""Calibrations of MATLAB, of NumPy, of ROS and of OpenCV's sample, against the numbers that went in."""

from __future__ import annotations

import gzip
import json

import cv2
import numpy as np
import pytest
from scipy.io import savemat

from characterisation.files.errors import InputError
from mitsim.capture.recordings.calibration_file import read_calibration
from mitsim.sensor.calibration_tree import read_tree
from mitsim.sensor.preset import load_sensor
from tests.sensor.opencv_files import opencv_file

K1 = np.array([[900.5, 0, 317.2], [0, 901.25, 241.4], [0, 0, 1]])
K2 = np.array([[1250.0, 0, 455.5], [0, 1251.0, 300.0], [0, 0, 1]])
D1 = np.array([-0.12, 0.06, 0.0004, -0.0003, -0.01])
D2 = np.array([0.03, -0.02, 0.0002, 0.0001, 0.0])
OM = np.array([0.01, 0.22, -0.02])
R = cv2.Rodrigues(OM)[0]
T = np.array([-140.0, 5.0, 10.0])

PAIR = """name = "rig"
technology = "structured_light"
[calibration]
file = FILE
cameras = ["left", "right"]
projector = false
[projector]
width = 912
height = 570
[pattern]
kind = "gray_code"
[decoder]
triangulate = "cameras"
"""
ALONE = """name = "rig"
technology = "structured_light"
[calibration]
file = FILE
[projector]
width = 912
height = 570
[pattern]
kind = "gray_code"
"""


def loaded(folder, text, file, size=(640, 480), more=""):
    (folder / "my.toml").write_text(text.replace("FILE", file) + more, encoding="utf-8")
    return load_sensor(folder / "my.toml", "decoding", size)


def is_the_rig(rig, second, distortion=D2):
    """Both eyes see points where cv2.projectPoints puts them: an independent way through K, distortion, R and T."""
    points = np.random.default_rng(1).uniform([-80, -60, 400], [80, 60, 800], (50, 3))
    first, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K1, D1)
    np.testing.assert_allclose(rig.reference.project(points), first[:, 0], atol=1e-6)
    other, _ = cv2.projectPoints(points, OM, T, K2, distortion)
    np.testing.assert_allclose(second.project(points), other[:, 0], atol=1e-6)


def test_the_pair_of_files_of_opencvs_sample(tmp_path):
    """intrinsics.yml and extrinsics.yml of stereo_calib: no size, which the images have."""
    opencv_file(tmp_path / "intrinsics.yml", M1=K1, D1=D1, M2=K2, D2=D2)
    beside = {"R1": R, "R2": R, "P1": np.eye(3, 4), "P2": np.eye(3, 4), "Q": np.eye(4)}
    opencv_file(tmp_path / "extrinsics.yml", R=R, T=T.reshape(3, 1), **beside)
    found = loaded(tmp_path, PAIR, '["intrinsics.yml", "extrinsics.yml"]')
    is_the_rig(found.rig, found.rig.cameras["right"])
    assert (found.rig.reference.width, found.rig.reference.height) == (640, 480)
    assert found.rig.projector is None
    assert (found.projector.optics.width, found.projector.optics.height) == (912, 570)
    assert found.notes == ()
    with pytest.raises(InputError, match=r"width, cameras.left.height, cameras.right.width, cameras.right.height"):
        loaded(tmp_path, PAIR, '["intrinsics.yml", "extrinsics.yml"]', size=None)


def test_the_toolbox_of_matlab_pair(tmp_path):
    """Calib_Results_stereo.mat, with what the toolbox saves beside it."""
    savemat(
        tmp_path / "Calib_Results_stereo.mat",
        {
            "fc_left": K1[[0, 1], [0, 1]].reshape(2, 1),
            "cc_left": K1[:2, 2].reshape(2, 1),
            "alpha_c_left": 0.0,
            "kc_left": D1.reshape(5, 1),
            "fc_right": K2[[0, 1], [0, 1]].reshape(2, 1),
            "cc_right": K2[:2, 2].reshape(2, 1),
            "alpha_c_right": 0.0,
            "kc_right": D2.reshape(5, 1),
            "om": OM.reshape(3, 1),
            "T": T.reshape(3, 1),
            "kc_left_error": D1.reshape(5, 1),
            "om_error": OM.reshape(3, 1),
            "nx": 640,
            "ny": 480,
            "active_images": np.ones(14),
            "X_left_1": np.ones((3, 48)),
        },
    )
    found = loaded(tmp_path, PAIR, '"Calib_Results_stereo.mat"', size=None)
    is_the_rig(found.rig, found.rig.cameras["right"])
    assert found.rig.reference.width == 640
    assert found.notes == ()


def test_the_toolbox_of_matlab_one_camera_and_the_projector_by_its_name(tmp_path):
    """Two Calib_Results, one of each eye, and R and T of a third file: the file of each eye is told."""
    camera = {"fc": K1[[0, 1], [0, 1]], "cc": K1[:2, 2], "alpha_c": 0.0, "kc": D1, "nx": 640, "ny": 480}
    savemat(tmp_path / "cam.mat", camera)
    savemat(tmp_path / "proj.mat", camera | {"fc": K2[[0, 1], [0, 1]], "cc": K2[:2, 2], "kc": D2, "nx": 912, "ny": 570})
    savemat(tmp_path / "stereo.mat", {"R": R, "T": T})
    files = '["cam.mat", "proj.mat", "stereo.mat"]'
    with pytest.raises(InputError, match=r"other values in cam.mat than in proj.mat"):
        loaded(tmp_path, ALONE, files)
    keys = '\n[calibration.keys.camera]\nfile = "cam.mat"\n[calibration.keys.projector]\nfile = "proj.mat"\n'
    found = loaded(tmp_path, ALONE, files, more=keys)
    is_the_rig(found.rig, found.rig.projector)
    assert found.notes == ()


def test_skew_is_refused(tmp_path):
    savemat(tmp_path / "a.mat", {"fc": [900.0, 901.0], "cc": [317.0, 241.0], "alpha_c": 0.001, "kc": D1})
    with pytest.raises(InputError, match=r"a skew of 0.9 px.*est_alpha"):
        loaded(tmp_path, ALONE, '"a.mat"')


def test_a_structure_of_the_vision_toolbox(tmp_path):
    """x2 = x1 R + t of row vectors, K transposed, sizes by rows and columns, the first pixel at 1."""

    def camera(K, D):
        return {
            "IntrinsicMatrix": (K + np.eye(3)[[2, 2, 2]] * [[1], [1], [0]]).T,
            "RadialDistortion": D[[0, 1, 4]],
            "TangentialDistortion": D[2:4],
            "ImageSize": [480, 640],
        }

    pair = {
        "CameraParameters1": camera(K1, D1),
        "CameraParameters2": camera(K2, D2),
        "RotationOfCamera2": R.T,
        "TranslationOfCamera2": T,
    }
    savemat(tmp_path / "stereo.mat", {"params": pair})
    found = loaded(tmp_path, PAIR, '"stereo.mat"', size=None)
    is_the_rig(found.rig, found.rig.cameras["right"])
    assert (found.rig.reference.width, found.rig.reference.height) == (640, 480)


@pytest.mark.parametrize("suffix", [".json", ".mat"])
def test_fields_of_a_structure_of_the_vision_toolbox_alone(tmp_path, suffix):
    """jsonencode(toStruct(cameraParams)): its size was (columns, rows), so images of 640 x 480 px were refused."""
    camera = {
        "IntrinsicMatrix": (K1 + np.eye(3)[[2, 2, 2]] * [[1], [1], [0]]).T.tolist(),
        "RadialDistortion": D1[[0, 1, 4]].tolist(),
        "TangentialDistortion": D1[2:4].tolist(),
        "ImageSize": [480, 640],
    }
    path = tmp_path / f"camera{suffix}"
    if suffix == ".mat":
        savemat(path, camera)
    else:
        path.write_text(json.dumps(camera))
    read = read_calibration(path).rig.reference
    np.testing.assert_allclose(read.matrix, K1)
    assert (read.width, read.height) == (640, 480)


def test_names_that_go_together_are_found_together(tmp_path):
    """``matrix = "Kc"`` alone made the distortion zero in silence."""
    opencv_file(tmp_path / "c.yml", Kc=K1, kc=D1, Kp=K2, kp=D2, R=R, T=T, cam_size=np.array([640, 480]))
    found = loaded(tmp_path, ALONE, '"c.yml"', size=None, more='\n[calibration.keys.camera]\nmatrix = "Kc"\n')
    is_the_rig(found.rig, found.rig.projector)
    assert found.notes == ()


def test_what_is_left_unread_is_said(tmp_path):
    opencv_file(tmp_path / "c.yml", Kc=K1, my_lens=D1, Kp=K2, kp=D2, R=R, T=T, E=R, rms=0.2, R1=R, fc_error=D2)
    found = loaded(tmp_path, ALONE, '"c.yml"')
    assert found.notes == (
        "calibration c.yml: values not read: my_lens; camera without distortion. If it belongs to the rig, name it in "
        "[calibration.keys.NAME] of the sensor file",
    )
    named = loaded(tmp_path, ALONE, '"c.yml"', more='\n[calibration.keys.camera]\ndistortion = "my_lens"\n')
    is_the_rig(named.rig, named.rig.projector)
    assert named.notes == ()


def test_numpy_and_ros(tmp_path):
    np.savez(tmp_path / "c.npz", mtx=K1, dist=D1.reshape(1, 5), proj_mtx=K2, proj_dist=D2, R=R, T=T.reshape(3, 1))
    found = loaded(tmp_path, ALONE, '"c.npz"')
    is_the_rig(found.rig, found.rig.projector)
    (tmp_path / "left.yaml").write_text(
        "image_width: 640\nimage_height: 480\ncamera_name: left\n"
        f"camera_matrix:\n  rows: 3\n  cols: 3\n  data: {K1.ravel().tolist()}\ndistortion_model: plumb_bob\n"
        f"distortion_coefficients:\n  rows: 1\n  cols: 5\n  data: {D1.tolist()}\n"
    )
    opencv_file(tmp_path / "beamer.yml", Kp=K2, kp=D2, R=OM, T=T)
    found = loaded(tmp_path, ALONE, '["left.yaml", "beamer.yml"]', size=None)
    is_the_rig(found.rig, found.rig.projector)


def test_all_that_a_calibration_lacks_comes_in_one_message(tmp_path):
    opencv_file(tmp_path / "c.yml", A=K1, dist=D1, B=K2)
    with pytest.raises(
        InputError,
        match=r"matrix of camera, the matrix of projector, the rotation of projector, the "
        r"translation of projector\. the file has A, dist, B",
    ):
        loaded(tmp_path, ALONE, '"c.yml"')


def test_a_second_camera_is_not_taken_for_the_projector(tmp_path):
    """R and T of two cameras, and a projector calibrated beside them under its own names."""
    opencv_file(tmp_path / "c.yml", M1=K1, D1=D1, M2=K2, D2=D2, R=R, T=T, Kp=K2, kp=D2, proj_R=R.T, proj_T=-T)
    text = PAIR.replace("projector = false\n", "")
    rig = loaded(tmp_path, text, '"c.yml"').rig
    is_the_rig(rig, rig.cameras["right"])
    np.testing.assert_allclose(rig.projector.centre, R @ T, atol=1e-9)


@pytest.mark.parametrize("name", ["a.mat", "a.npz", "a.yml", "a.json"])
def test_files_that_are_nothing_are_refused(tmp_path, name):
    for data in (b"", b"MATLAB 5.0 MAT-file", b"PK\x03\x04 nothing", bytes(range(256)) * 4):
        (tmp_path / name).write_bytes(data)
        with pytest.raises(InputError, match=name):
            loaded(tmp_path, ALONE, f'"{name}"')


def test_a_packed_calibration_that_is_cut_off_is_refused(tmp_path):
    """Its first half is YAML too, without the distortion."""
    opencv_file(tmp_path / "c.yml", A=K1, dist=D1)
    packed = gzip.compress((tmp_path / "c.yml").read_bytes())
    (tmp_path / "c.yml.gz").write_bytes(packed)
    assert read_tree([tmp_path / "c.yml.gz"]).names() == ["A", "dist"]
    for end in (*range(len(packed) // 2, len(packed), 16), len(packed) - 1):
        (tmp_path / "c.yml.gz").write_bytes(packed[:end])
        with pytest.raises(InputError, match="cut off"):
            read_tree([tmp_path / "c.yml.gz"])
