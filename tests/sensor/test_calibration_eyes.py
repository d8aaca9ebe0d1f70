"""Cameras that stand in maps of any nesting, spelling and order are read with their lens, or refused with the reason.

Before these tests the lens of a map beside that of the matrix was left out without a word, a matrix by columns had its
principal point in the image's corner, and of the cameras of colour and depth the first was used for either's images.
"""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
import yaml

from characterisation.files.errors import InputError
from mitsim.capture.recordings.calibration_file import camera_of, read_calibration
from mitsim.capture.recordings.depth_image import read_depth_image
from mitsim.capture.recordings.read_options import ReadOptions
from mitsim.sensor.preset import load_sensor

SIZE = (640, 480)
FX, FY, CX, CY = 600.0, 601.2, 322.3, 241.7
K = np.array([[FX, 0, CX], [0, FY, CY], [0, 0, 1]])
K2 = np.array([[598.0, 0, 318.9], [0, 599.0, 238.2], [0, 0, 1]])
D = [-0.3, 0.1, 0.001, -0.002, 0.01]
OM, T = np.array([0.01, 0.2, -0.02]), np.array([-60.0, 0.5, 2.0])
R = cv2.Rodrigues(OM)[0]

#: pose of the first camera in another frame
R_LEFT, T_LEFT = cv2.Rodrigues(np.array([0.3, -0.1, 1.2]))[0], np.array([20.0, -30.0, 400.0])

NUMBERS = {"fx": FX, "fy": FY, "cx": CX, "cy": CY}
OF_LIBREALSENSE = {"fx": FX, "fy": FY, "ppx": CX, "ppy": CY, "width": 640, "height": 480}
SINGLES = dict(zip(("k1", "k2", "p1", "p2", "k3"), D, strict=True))
CAPITALS = {name.upper(): value for name, value in NUMBERS.items()}

#: one camera in the words of many programs
FILES = {
    "vins": {"distortion_parameters": SINGLES, "projection_parameters": NUMBERS, "image_width": 640, "model_type": "x"},
    "zivid": {"CameraIntrinsics": {"CameraMatrix": CAPITALS, "Distortion": {k.upper(): v for k, v in SINGLES.items()}}},
    "librealsense": OF_LIBREALSENSE | {"model": "distortion.brown_conrady", "coeffs": D},
    "nested librealsense": {"intrinsics": OF_LIBREALSENSE | {"coeffs": D}, "depth_scale": 0.001},
    # as COLMAP writes them for instant-ngp and nerfstudio: the centre of the first pixel is at 0.5, 0.5
    "nerf": {"fl_x": FX, "fl_y": FY, "cx": CX + 0.5, "cy": CY + 0.5, "w": 640, "h": 480, **SINGLES},
    "lists of two": {"focal_length": [FX, FY], "principal_point": [CX, CY], "distortion": D},
    "euroc": {
        "camera_model": "pinhole",
        "distortion_model": "radial-tangential",
        "intrinsics": [FX, FY, CX, CY],
        "distortion_coefficients": D,
        "resolution": [640, 480],
    },
    "nine numbers": {"K": K.ravel().tolist(), "dist": D},
    "nine numbers by columns": {"intrinsic_matrix": K.T.ravel().tolist(), "dist": D, "width": 640, "height": 480},
    "transposed": {"camera_matrix": K.T.tolist(), "dist": D},
    "capital letters": {"Camera_Matrix": K.tolist(), "Distortion_Coefficients": D, "image_Width": 640},
    "a size in a map": {"intrinsics": NUMBERS, "distortion": SINGLES, "resolution": {"width": 640, "height": 480}},
    "texts": {name: str(value) for name, value in {**NUMBERS, **SINGLES}.items()},
    "a list of one": {"cameras": [{"name": "only", **NUMBERS, "dist_coeffs": D}]} | {"rms": 0.1},
    "coefficients in a map": {"K": K.tolist(), "distortion": SINGLES},
    "coefficients beside": {"K": K.tolist(), **SINGLES},
    "radial and tangential": {**NUMBERS, "radial_distortion": [*D[:2], D[4]], "tangential_distortion": D[2:4]},
    "both in a map": {"camera_matrix": K.tolist(), "dist": {"radial": [*D[:2], D[4]], "tangential": D[2:4]}},
    "both beside": {"camera_matrix": K.tolist(), "radial_distortion": [*D[:2], D[4]], "tangential_distortion": D[2:4]},
    "equal frames": {"frames": {f"frame_{number}": {**NUMBERS, **SINGLES} for number in range(3)}},
}


def saved(path, table):
    path.write_text(json.dumps(table) if path.suffix == ".json" else yaml.dump(table), encoding="utf-8")
    return path


def sees(camera, matrix, bent, rotation=None, translation=None):
    """The camera sees points where cv2.projectPoints puts them."""
    points = np.random.default_rng(1).uniform([-80, -60, 400], [80, 60, 800], (50, 3))
    turn, shift = np.zeros(3) if rotation is None else rotation, np.zeros(3) if translation is None else translation
    expected, _ = cv2.projectPoints(points, turn, shift, matrix, np.array(bent))
    np.testing.assert_allclose(camera.project(points), expected[:, 0], atol=1e-6)


@pytest.mark.parametrize("ending", ["json", "yaml"])
@pytest.mark.parametrize("name", FILES)
def test_one_camera_in_the_words_of_many_programs(tmp_path, name, ending):
    read = read_calibration(saved(tmp_path / f"a.{ending}", FILES[name]), SIZE)
    assert len(read.rig.cameras) == 1
    sees(read.rig.reference, K, D)
    assert (read.rig.reference.width, read.rig.reference.height) == SIZE
    by_columns = [f"calibration a.{ending}: camera: its matrix is written by columns"]
    assert list(read.notes) == (by_columns if name in ("nine numbers by columns", "transposed") else [])


def test_the_size_beside_a_matrix_suffices(tmp_path):
    """As in the files of Open3D, without any image."""
    read = read_calibration(saved(tmp_path / "a.json", FILES["nine numbers by columns"]))
    assert (read.rig.reference.width, read.rig.reference.height) == SIZE


def motion(rotation, translation):
    return np.vstack([np.column_stack([rotation, translation]), [0, 0, 0, 1]]).tolist()


PAIRS = {
    "nine numbers of a rotation": {
        "K1": K.ravel().tolist(),
        "D1": D,
        "K2": K2.ravel().tolist(),
        "D2": D,
        "R": R.ravel().tolist(),
        "T": T.tolist(),
    },
    "left and right": {
        "right": {"camera_matrix": K2.tolist(), "dist_coeffs": D},
        "left": {"camera_matrix": K.tolist(), "dist_coeffs": D},
        "R": R.tolist(),
        "T": T.tolist(),
    },
    "a pose in the second": {
        "one": {"intrinsics": NUMBERS, "distortion": SINGLES},
        "two": {
            "intrinsics": {"fx": 598.0, "fy": 599.0, "cx": 318.9, "cy": 238.2},
            "distortion": SINGLES,
            "extrinsics": {"R": R.tolist(), "T": T.tolist()},
        },
    },
    "librealsense, whose rotation is by columns and in metres": {
        "left": OF_LIBREALSENSE | {"coeffs": D},
        "right": {"fx": 598.0, "fy": 599.0, "ppx": 318.9, "ppy": 238.2, "coeffs": D}
        | {"rotation": R.T.ravel().tolist(), "translation": (T / 1000).tolist()},
    },
    "both in a common frame": {
        "left": {"K": K.tolist(), "D": D, "R": R_LEFT.tolist(), "T": T_LEFT.tolist()},
        "right": {"K": K2.tolist(), "D": D, "R": (R @ R_LEFT).tolist(), "T": (R @ T_LEFT + T).tolist()},
    },
    "Kalibr, of both from the IMU": {
        "cam0": {"K": K.tolist(), "D": D, "T_cam_imu": motion(R_LEFT, T_LEFT / 1000)},
        "cam1": {"K": K2.tolist(), "D": D, "T_cam_imu": motion(R @ R_LEFT, (R @ T_LEFT + T) / 1000)},
    },
    "numbers, and a map of the pose": {
        "cameras": {"cam1": {"K": K2.tolist(), "D": D}, "cam0": {"K": K.tolist(), "D": D}},
        "R": OM.tolist(),
        "t": T.tolist(),
    },
}


def test_lengths_of_a_format_in_metres_are_refused_if_they_are_those_of_a_file_in_centimetres(tmp_path):
    """The eyes of a RealSense D405 stand 1.8 cm apart: they were read as 1.8 m. A stated unit is followed."""
    cameras = {"left": OF_LIBREALSENSE, "right": OF_LIBREALSENSE | {"rotation": np.eye(3).ravel().tolist()}}
    cameras["right"] |= {"translation": [-1.8, 0.0, 0.0]}
    with pytest.raises(InputError, match=r"baseline of 1\.8 .*up to 1\.5, as in its format.*to_mm"):
        read_calibration(saved(tmp_path / "a.json", cameras))
    cameras["right"] |= {"unit": "cm"}
    right = read_calibration(saved(tmp_path / "b.json", cameras)).rig.cameras["right"]
    np.testing.assert_allclose(right.centre, (18, 0, 0), atol=1e-12)


def test_all_single_numbers_of_opencvs_lens_are_read(tmp_path):
    """Before, the thin prism and the tilt were left out without a word."""
    names = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tauX", "tauY")
    bent = [0.1, -0.02, 1e-3, -2e-3, 0.01, 0.12, -0.01, 0.005, 3e-3, 1e-3, -2e-3, 5e-4, 0.01, -0.02]
    for count in (12, 14):
        table = NUMBERS | dict(zip(names[:count], bent[:count], strict=True))
        sees(read_calibration(saved(tmp_path / "a.json", table), SIZE).rig.reference, K, bent[:count])


def test_coefficients_are_read_by_the_names_beside_them(tmp_path):
    """Before, k3 was p1: a point at the edge of the image moved by more than a pixel."""
    named = {"k1": -0.11, "k2": 0.08, "p1": 1.2e-3, "p2": -8e-4, "k3": -0.02}
    table = {"K": K.tolist(), "distortion": [named[name] for name in ("k1", "k2", "k3", "p1", "p2")]}
    x, y = 0.5, 0.4  # on the plane z = 1: OpenCV's formula, written out
    r2 = x * x + y * y
    radial = 1 + named["k1"] * r2 + named["k2"] * r2**2 + named["k3"] * r2**3
    bent_x = x * radial + 2 * named["p1"] * x * y + named["p2"] * (r2 + 2 * x * x)
    bent_y = y * radial + named["p1"] * (r2 + 2 * y * y) + 2 * named["p2"] * x * y
    for order in (["k1", "k2", "k3", "p1", "p2"], "K1, K2, K3, P1, P2"):
        camera = read_calibration(saved(tmp_path / "a.json", table | {"distortion_names": order}), SIZE).rig.reference
        pixels = cv2.projectPoints(np.array([[x, y, 1]]), np.zeros(3), np.zeros(3), camera.matrix, camera.distortion)[0]
        np.testing.assert_allclose(pixels.ravel(), (FX * bent_x + CX, FY * bent_y + CY), atol=1e-9)
    round_lens = table | {"distortion": [4.0, 3.0, 2.0, 1.0], "distortion_names": ["k4", "k3", "k2", "k1"]}
    for folded in (round_lens | {"model": "fisheye"}, {"camera": round_lens | {"model": "fisheye"}}):
        read = read_calibration(saved(tmp_path / "a.json", folded), SIZE)
        assert read.rig.reference.distortion.tolist() == [1, 2, 3, 4]
    for wrong in (["k1", "k2", "k3", "p1", "q2"], ["k1", "k2", "k3", "p1", "p1"], ["k1", "k2"]):
        with pytest.raises(InputError, match=r"distortion_names: .* each of the 5 coefficients, of k1, k2, p1"):
            read_calibration(saved(tmp_path / "a.json", table | {"distortion_names": wrong}), SIZE)


@pytest.mark.parametrize("name", ["distortionCoefficients", "DistortionCoefficients", "distortion_params"])
def test_a_lens_is_read_by_more_spellings(tmp_path, name):
    """Before, the camera was straight, with a note that a list was not read: 20 px off at the corner."""
    for table in ({"camera_matrix": K.tolist()}, {"intrinsics": NUMBERS}):
        read = read_calibration(saved(tmp_path / "a.json", table | {name: D}), SIZE)
        sees(read.rig.reference, K, D)
        assert read.notes == ()


DOUBTS = {
    "has four coefficients without a lens model": {"K": K.tolist(), "D": [-0.05, 0.03, 0.001, -0.004]},
    "has p1 and p2 of 0.08 and 0.001": {"K": K.tolist(), "D": [-0.2, 0.1, 0.08, 0.001, -0.0005]},
    "the principal point 100, 70 is far from the middle": NUMBERS | {"cx": 100.0, "cy": 70.0},
    "the principal point 2, -3 is far from the middle": NUMBERS | {"cx": 2.0, "cy": -3.0},
    "focal lengths of 600 and 322 px differ": {"intrinsics": [600.0, 322.0, 602.0, 238.0], "resolution": [640, 480]},
    "right looks 69 deg away": {"K1": K.tolist(), "K2": K2.tolist(), "R": [0.1, 1.2, -0.3], "T": [-60, 0, 0]},
    "right looks 172 deg away": {"K1": K.tolist(), "K2": K2.tolist(), "R": [0.0, 3.0, 0.0], "T": [-60, 0, 0]},
}


@pytest.mark.parametrize("words", DOUBTS)
def test_numbers_that_seldom_are_right_raise_a_doubt(tmp_path, words):
    notes = read_calibration(saved(tmp_path / "a.json", DOUBTS[words]), SIZE).notes
    assert [words in note for note in notes] == [True]


@pytest.mark.parametrize(
    ("rotation", "matrices", "message"),
    [
        ([0.0, 8.0, 0.0], (K, K2), "a rotation vector in rad, up to pi"),
        (R.ravel().tolist(), (K.T, K2.T), "both by rows"),
    ],
)
def test_a_rotation_that_is_not_known_is_refused(tmp_path, rotation, matrices, message):
    """Before, degrees were radians, and a rotation by columns beside a matrix by columns was transposed."""
    pair = {"K1": matrices[0].tolist(), "K2": matrices[1].tolist(), "R": rotation, "T": T.tolist()}
    with pytest.raises(InputError, match=message):
        read_calibration(saved(tmp_path / "a.json", pair), SIZE)


@pytest.mark.parametrize("name", PAIRS)
def test_a_pair(tmp_path, name):
    read = read_calibration(saved(tmp_path / "a.json", PAIRS[name]), SIZE)
    sees(read.rig.cameras["left"], K, D)
    sees(read.rig.cameras["right"], K2, D, OM, T)
    assert read.notes == ()


def test_a_camera_and_a_projector_in_maps(tmp_path):
    table = {
        "projector": {"K": K2.tolist(), "D": [0.0] * 5, "R": R.tolist(), "T": T.tolist(), "resolution": [912, 570]},
        "camera": {"intrinsics": NUMBERS, "distortion": SINGLES, "resolution": [640, 480]},
    }
    saved(tmp_path / "a.json", table)
    (tmp_path / "my.toml").write_text(
        'name = "rig"\ntechnology = "structured_light"\n[calibration]\nfile = "a.json"\n[pattern]\nkind = "gray_code"\n'
        "[decoder]\n"
    )
    sensor = load_sensor(tmp_path / "my.toml", "decoding")
    sees(sensor.rig.reference, K, D)
    sees(sensor.rig.projector, K2, np.zeros(5), OM, T)
    assert (sensor.projector.optics.width, sensor.projector.optics.height, sensor.notes) == (912, 570, ())


def test_a_pose_as_one_matrix_that_a_toml_names(tmp_path):
    cameras = {"left": {"K": K.tolist(), "D": D}, "right": {"K": K2.tolist(), "D": D}}
    saved(tmp_path / "a.json", cameras | {"left_to_right": motion(R, T)})
    (tmp_path / "a.toml").write_text(
        '[calibration]\nfile = "a.json"\ncameras = ["left", "right"]\nprojector = false\n[calibration.keys.right]\n'
        'rotation = "left_to_right"\ntranslation = "left_to_right"\n'
    )
    read = read_calibration(tmp_path / "a.toml", SIZE)
    sees(read.rig.cameras["left"], K, D)
    sees(read.rig.cameras["right"], K2, D, OM, T)


FOUR = [600.0, 602.0, 331.0, 245.0]


@pytest.mark.parametrize("four", [FOUR, [[number] for number in FOUR]])
@pytest.mark.parametrize(("name", "keys"), [("optik.mine", "optik.mine"), ("K", ""), ("cam.K", ""), ("cam.K", "cam")])
def test_four_numbers_are_the_focal_lengths_and_the_principal_point(tmp_path, four, name, keys):
    """In a map or not, under a usual name or one that the sensor file gives; kc beside it is the lens."""
    inner = {name.rpartition(".")[2]: four, "kc": [0.1, -0.2, 0.001, 0.002]}
    saved(tmp_path / "a.json", {name.partition(".")[0]: inner} if "." in name else inner)
    given = f'[calibration.keys.camera]\nmatrix = "{keys}"\n' if keys else ""
    (tmp_path / "a.toml").write_text(f'[calibration]\nfile = "a.json"\nprojector = false\n{given}')
    camera = read_calibration(tmp_path / "a.toml", SIZE).rig.reference
    assert camera.matrix.tolist() == [[600, 0, 331], [0, 602, 245], [0, 0, 1]]


def test_four_numbers_in_another_order_raise_a_doubt(tmp_path):
    saved(tmp_path / "a.json", {"K": [600.0, 331.0, 602.0, 245.0]})
    assert any("are these fx and fy" in note for note in read_calibration(tmp_path / "a.json", SIZE).notes)


def colour_and_depth(size):
    colour = {"fx": 900.0, "fy": 900.0, "ppx": 331.0, "ppy": 245.0, "width": size[0], "height": size[1]}
    return {"color": colour, "depth": OF_LIBREALSENSE | {"coeffs": D}}


def test_of_several_cameras_the_one_of_the_images_is_used(tmp_path):
    read = read_calibration(saved(tmp_path / "a.json", colour_and_depth((1280, 720))), SIZE)
    assert list(read.rig.cameras) == ["color", "depth"]
    sees(camera_of(read, None, SIZE, "depth.png")[1], K, D)


def test_of_several_cameras_of_one_size_one_is_to_be_named(tmp_path):
    cv2.imwrite(str(tmp_path / "depth.png"), np.full(SIZE[::-1], 1000, np.uint16))
    saved(tmp_path / "a.json", colour_and_depth(SIZE))
    with pytest.raises(InputError, match="--camera: found 2 cameras: color 640 x 480 px, depth 640 x 480 px"):
        read_depth_image(tmp_path / "depth.png", ReadOptions(calibration=tmp_path / "a.json"))
    capture = read_depth_image(tmp_path / "depth.png", ReadOptions(calibration=tmp_path / "a.json", camera="depth"))
    sees(capture.rig.reference, K, D)


def test_a_map_named_in_a_sensor_file(tmp_path):
    """With its matrix come its lens and its size."""
    saved(tmp_path / "a.yaml", colour_and_depth(SIZE))
    text = '[calibration]\nfile = "a.yaml"\nprojector = false\n'
    (tmp_path / "a.toml").write_text(text)
    with pytest.raises(InputError, match=r"the file has color\.fx"):
        read_calibration(tmp_path / "a.toml")
    (tmp_path / "a.toml").write_text(text + '[calibration.keys.camera]\nmatrix = "depth"\n')
    sees(read_calibration(tmp_path / "a.toml").rig.reference, K, D)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"camera_type": "ds"}, "camera_type: found 'ds'"),
        ({"model": "distortion.inverse_brown_conrady", "coeffs": D}, "model: found 'distortion.inverse_brown_conrady'"),
        ({"fx": float("nan")}, r"fx, fy, ppx, ppy: found \[\[nan"),
        ({"fx": "600,5"}, r"fx, fy, ppx, ppy: found \[\[nan"),
        ({"coeffs": [0.1] * 6}, "coeffs: found an array of 6"),
        ({"skew": 1.5}, r"matrix of camera: found a skew of 1\.5 px"),
        ({"fx": 10**400}, r"fx, fy, ppx, ppy: found \[\[nan"),
    ],
)
def test_what_no_model_of_opencv_describes_is_refused(tmp_path, more, message):
    with pytest.raises(InputError, match=message):
        read_calibration(saved(tmp_path / "a.json", OF_LIBREALSENSE | more), SIZE)


def test_a_model_of_zeros_is_straight(tmp_path):
    table = OF_LIBREALSENSE | {"model": "distortion.inverse_brown_conrady", "coeffs": [0.0] * 5}
    sees(read_calibration(saved(tmp_path / "a.json", table), SIZE).rig.reference, K, np.zeros(5))


def test_a_matrix_that_is_none_is_refused(tmp_path):
    """Its principal point would be in the image's corner."""
    bad = np.array([[FX, 0, 0], [0, FY, 0], [CX, CY, 2]])
    with pytest.raises(InputError, match="matrix of camera"):
        read_calibration(saved(tmp_path / "a.yaml", {"K": bad.tolist(), "D": D}), SIZE)


def test_a_list_of_cameras_is_no_file_of_an_ensenso(tmp_path):
    """Of calib.io's JSON the message asked for the baseline of an Ensenso."""
    with pytest.raises(InputError, match=r"the file has Calibration\.cameras"):
        read_calibration(saved(tmp_path / "a.json", {"Calibration": {"cameras": [{"model": {"f": 600.0}}]}}))


def test_arrays_of_python_objects_are_left_out(tmp_path):
    np.savez(tmp_path / "a.npz", mtx=K, dist=D, about=np.array({"rms": 0.2}, dtype=object))
    sees(read_calibration(tmp_path / "a.npz", SIZE).rig.reference, K, D)


def test_xml_of_other_programs_is_named(tmp_path):
    (tmp_path / "a.xml").write_text('<?xml version="1.0"?>\n<calibration><f>600</f><cx>2.3</cx></calibration>\n')
    with pytest.raises(InputError, match=r"XML of another program: it begins with <calibration>"):
        read_calibration(tmp_path / "a.xml", SIZE)
