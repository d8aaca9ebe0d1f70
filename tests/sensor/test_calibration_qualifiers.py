"""What qualifies the numbers of a calibration: read from files of ROS, Kalibr and MATLAB, or refused."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
import yaml
from scipy.io import savemat

from characterisation.files.errors import InputError
from mitsim.capture.recordings.calibration_file import read_calibration
from mitsim.sensor.calibration_qualifiers import ReadOut, check_intrinsics, of_images
from mitsim.sensor.camera import Camera
from mitsim.sensor.preset import load_sensor
from tests.sensor.opencv_files import opencv_file

K = np.array([[600.0, 0, 322.3], [0, 601.2, 241.7], [0, 0, 1]])
K2 = np.array([[598.0, 0, 318.9], [0, 599.0, 238.2], [0, 0, 1]])
D = np.array([-0.12, 0.06, 0.0004, -0.0003, -0.01])
R = cv2.Rodrigues(np.array([-0.007, 0.021, 0.002]))[0]
T = np.array([-60.0, -0.5, 2.0])
SIZE = (640, 480)


def ros(matrix, size=SIZE, bent=D, **more):
    """A calibration file as camera_calibration of ROS writes it."""

    def table(values):
        values = np.atleast_2d(values)
        return {"rows": values.shape[0], "cols": values.shape[1], "data": values.ravel().tolist()}

    whole = {
        "image_width": size[0],
        "image_height": size[1],
        "camera_name": "left",
        "camera_matrix": table(matrix),
        "distortion_model": "plumb_bob",
        "distortion_coefficients": table(bent),
        "rectification_matrix": table(np.eye(3)),
        "projection_matrix": table(np.c_[matrix, np.zeros(3)]),
    }
    return whole | {key: table(value) if isinstance(value, np.ndarray) else value for key, value in more.items()}


def saved(path, table):
    path.write_text(yaml.dump(table), encoding="utf-8")
    return path


def sees(camera, matrix, bent, rotation=None, translation=None):
    """The camera has the pixels of cv2.projectPoints: an independent way through K, distortion, R and T."""
    points = np.random.default_rng(1).uniform([-80, -60, 400], [80, 60, 800], (50, 3))
    turn = np.zeros(3) if rotation is None else cv2.Rodrigues(rotation)[0]
    shift = np.zeros(3) if translation is None else translation
    expected, _ = cv2.projectPoints(points, turn, shift, matrix, bent)
    np.testing.assert_allclose(camera.project(points), expected[:, 0], atol=2e-5)


# --- the part of the imager


@pytest.mark.parametrize("binning", [1, 2])
def test_a_part_of_the_imager_shows_what_the_full_imager_shows_there(tmp_path, binning):
    """A point in the middle of a bin of the part is at the same place of the full image."""
    full = Camera(K, D, *SIZE)
    roi = {"x_offset": 120, "y_offset": 80, "width": 400, "height": 300, "do_rectify": False}
    path = saved(tmp_path / "a.yaml", ros(K, roi=roi, binning_x=binning, binning_y=binning))
    size = (400 // binning, 300 // binning)
    read = read_calibration(path, size)
    assert (read.rig.reference.width, read.rig.reference.height) == size
    points = np.random.default_rng(1).uniform([-50, -40, 400], [50, 40, 800], (50, 3))
    inner = read.rig.reference.project(points) * binning + (binning - 1) / 2 + [120, 80]
    np.testing.assert_allclose(inner, full.project(points), atol=1e-9)
    assert "from column 120 and row 80" in read.notes[0]


def test_images_of_the_full_imager_are_not_cut(tmp_path):
    roi = {"x_offset": 120, "y_offset": 80, "width": 400, "height": 300}
    read = read_calibration(saved(tmp_path / "a.yaml", ros(K, roi=roi)), SIZE)
    np.testing.assert_array_equal(read.rig.reference.matrix, K)
    assert "roi is not applied" in read.notes[0]
    plain = dict.fromkeys(roi, 0)
    read = read_calibration(saved(tmp_path / "b.yaml", ros(K, roi=plain, binning_x=0, binning_y=0)), SIZE)
    np.testing.assert_array_equal(read.rig.reference.matrix, K)
    assert read.notes == ()


@pytest.mark.parametrize("centre", [631.0, 311.0])
def test_a_size_that_is_that_of_the_part(tmp_path, centre):
    """The file states the size of the images as that of the imager: the principal point tells what it belongs to."""
    matrix = np.array([[600.0, 0, centre], [0, 600, 240], [0, 0, 1]])
    roi = {"x_offset": 320, "y_offset": 0, "width": 640, "height": 480}
    read = read_calibration(saved(tmp_path / "a.yaml", ros(matrix, roi=roi)), SIZE)
    assert read.rig.reference.matrix[0, 2] == 311.0
    assert len(read.notes) == 1


def test_a_part_without_size_extends_to_the_end():
    matrix, size, _ = of_images(K, SIZE, ReadOut((100.0, 80.0), None, (1, 1)))
    assert size == (540, 400)
    np.testing.assert_allclose(matrix[:2, 2], [222.3, 161.7], atol=1e-12)


def test_a_part_of_broken_pixels_is_refused(tmp_path):
    path = saved(tmp_path / "a.yaml", ros(K, roi={"x_offset": 0.5}))
    with pytest.raises(InputError, match=r"roi\.x_offset: found 0\.5; allowed: a whole number"):
        read_calibration(path, SIZE)


def test_a_sensor_file_has_the_part_too(tmp_path):
    """By the path of image folders: the size of the images is known, or it is that of the part."""
    roi = {"x_offset": 120, "y_offset": 80, "width": 400, "height": 300}
    saved(tmp_path / "a.yaml", ros(K, roi=roi))
    (tmp_path / "my.toml").write_text(
        'name = "rig"\ntechnology = "structured_light"\n[calibration]\nfile = "a.yaml"\nprojector = false\n'
        "[projector]\nwidth = 912\nheight = 570\nfocal_px = [1000.0, 1000.0]\nprincipal_px = [455.5, 284.5]\n"
        'position_mm = [100.0, 0.0, 0.0]\n[pattern]\nkind = "gray_code"\n[decoder]\n'
    )
    for size in (None, (400, 300)):
        rig = load_sensor(tmp_path / "my.toml", "decoding", size)
        np.testing.assert_allclose(rig.rig.reference.matrix[:2, 2], [202.3, 161.7], atol=1e-9)
        assert len(rig.notes) == 1
    np.testing.assert_array_equal(load_sensor(tmp_path / "my.toml", "decoding", SIZE).rig.reference.matrix, K)


# --- values that are no pixels


@pytest.mark.parametrize(
    ("matrix", "cause"),
    [
        ([[0.77, 0, 0.55], [0, 1.37, 0.44], [0, 0, 1]], "normalised"),
        ([[3.9, 0, 2.4], [0, 3.9, 1.8], [0, 0, 1]], "in mm"),
        ([[0.0039, 0, 2.4], [0, 0.0039, 1.8], [0, 0, 1]], "in metres"),
    ],
)
def test_values_that_are_no_pixels_are_refused_by_every_reader(tmp_path, matrix, cause):
    matrix = np.array(matrix)
    (fx, _, cx), (_, fy, cy), _ = matrix.tolist()
    small = {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "width": 640, "height": 480}
    (tmp_path / "a.json").write_text(json.dumps(small))
    saved(tmp_path / "a.yaml", ros(matrix))
    np.savez(tmp_path / "a.npz", K=matrix)
    savemat(tmp_path / "a.mat", {"fc": [fx, fy], "cc": [cx, cy], "kc": D})
    optics = f"width = 640\nheight = 480\nfocal_px = [{fx}, {fy}]\nprincipal_px = [{cx}, {cy}]\n"
    (tmp_path / "a.toml").write_text(f"[cameras.left]\n{optics}")
    camera = {"name": "left", "model": "perspective", "width": 640, "height": 480, "matrix": matrix.tolist()}
    capture = {"cameras": [camera | {"distortion": [], "sensor_from_camera": np.eye(4).tolist()}]}
    (tmp_path / "capture.json").write_text(json.dumps(capture))
    for name in ("a.json", "a.yaml", "a.npz", "a.mat", "a.toml", "capture.json"):
        with pytest.raises(InputError, match=cause) as caught:
            read_calibration(tmp_path / name, SIZE)
        assert "from 32 to 640000 for images of 640 x 480 px" in str(caught.value), name


def test_lenses_that_exist_pass():
    for focal in (0.3, 1.0, 50.0):  # fields of view from 118 deg to 1 deg
        check_intrinsics((640 * focal, 640 * focal), (319.5, 239.5), *SIZE)
    check_intrinsics((600.0, 600.0), (-700.0, 1400.0), *SIZE)  # a part of the imager far off the axis


# --- pairs of ROS and Kalibr


def ros_pair(folder, to_m=1e-3):
    """Both files as the rectification of OpenCV gives their matrices, in metres."""
    R1, R2, P1, P2, *_ = cv2.stereoRectify(K, D, K2, -D, SIZE, R, T * to_m, flags=0, alpha=0)
    saved(folder / "left.yaml", ros(K, rectification_matrix=R1, projection_matrix=P1))
    saved(folder / "right.yaml", ros(K2, bent=-D, rectification_matrix=R2, projection_matrix=P2))


@pytest.mark.parametrize(
    "keys",
    [
        "",
        "to_mm = 1000\n",
        '[calibration.keys.left]\nfile = "left.yaml"\n[calibration.keys.right]\nfile = "right.yaml"\n',
    ],
)
def test_a_pair_of_ros(tmp_path, keys):
    ros_pair(tmp_path)
    text = '[calibration]\nfile = ["left.yaml", "right.yaml"]\ncameras = ["left", "right"]\nprojector = false\n'
    (tmp_path / "pair.toml").write_text(text + keys)
    read = read_calibration(tmp_path / "pair.toml")
    sees(read.rig.cameras["left"], K, D)
    sees(read.rig.cameras["right"], K2, -D, R, T)
    assert read.notes == ()


def test_a_pair_of_ros_vertical_and_in_other_order(tmp_path):
    """The baseline is along y, and the first camera of the rig is the one whose P has it."""
    ros_pair(tmp_path)
    text = '[calibration]\nfile = ["right.yaml", "left.yaml"]\ncameras = ["a", "b"]\nprojector = false\n'
    (tmp_path / "pair.toml").write_text(text)
    sees(read_calibration(tmp_path / "pair.toml").rig.cameras["b"], K, D, R.T, -R.T @ T)
    down = np.array([0.3, -80.0, 1.0])
    R1, R2, P1, P2, *_ = cv2.stereoRectify(K, D, K2, D, SIZE, R, down / 1000, flags=0, alpha=0)
    assert P2[1, 3] != 0
    saved(tmp_path / "left.yaml", ros(K, rectification_matrix=R1, projection_matrix=P1))
    saved(tmp_path / "right.yaml", ros(K2, rectification_matrix=R2, projection_matrix=P2))
    (tmp_path / "pair.toml").write_text(text.replace('"right.yaml", "left.yaml"', '"left.yaml", "right.yaml"'))
    sees(read_calibration(tmp_path / "pair.toml").rig.cameras["b"], K2, D, R, down)


@pytest.mark.parametrize("upper", [True, False])
def test_a_message_of_ros_as_echo_prints_it(tmp_path, upper):
    """Flat lists under single letters; R is the rectification, not the pose of another camera."""
    numbers = {"k": K.ravel().tolist(), "d": D.tolist(), "r": R.ravel().tolist(), "p": np.c_[K, np.zeros(3)].ravel()}
    numbers = {name.upper() if upper else name: np.asarray(value).tolist() for name, value in numbers.items()}
    message = {"header": {"stamp": {"sec": 1}}, "height": 480, "width": 640, "distortion_model": "plumb_bob"}
    path = tmp_path / "echo.yaml"
    path.write_text(yaml.dump(message | numbers) + "---\n" + yaml.dump(message | numbers) + "---\n")
    read = read_calibration(path)
    assert list(read.rig.cameras) == ["camera"] and read.notes == ()
    sees(read.rig.reference, K, D)


def kalibr(**first):
    camera = {
        "cam_overlaps": [1],
        "camera_model": "pinhole",
        "distortion_coeffs": [-0.1, 0.05, 0.001, -0.002],
        "distortion_model": "radtan",
        "intrinsics": [600.0, 601.2, 322.3, 241.7],
        "resolution": [640, 480],
        "rostopic": "/cam0/image_raw",
    }
    step = np.eye(4)
    step[:3, :3], step[:3, 3] = R, T / 1000
    second = camera | {"intrinsics": [598.0, 599.0, 318.9, 238.2], "T_cn_cnm1": step.tolist()}
    return {"cam0": camera | first, "cam1": second | first}


def test_a_chain_of_kalibr_is_in_metres(tmp_path):
    read = read_calibration(saved(tmp_path / "camchain.yaml", kalibr()))
    bent = np.array([-0.1, 0.05, 0.001, -0.002])
    sees(read.rig.cameras["left"], K, bent)
    sees(read.rig.cameras["right"], K2, bent, R, T)
    assert read.notes == () and read.rig.cameras["right"].width == 640


def test_the_lens_model_that_a_file_states(tmp_path):
    read = read_calibration(saved(tmp_path / "a.yaml", kalibr(distortion_model="equidistant")))
    assert {camera.model for camera in read.rig.cameras.values()} == {"fisheye"}
    with pytest.raises(InputError, match=r"camera_model: found 'omni'; allowed: OpenCV's models"):
        read_calibration(saved(tmp_path / "b.yaml", kalibr(camera_model="omni")))
    with pytest.raises(InputError, match=r"distortion_model: found 'fov'"):
        read_calibration(saved(tmp_path / "c.yaml", ros(K, distortion_model="fov")))
    straight = ros(K, bent=np.zeros(5), distortion_model="inverse_brown_conrady")
    assert read_calibration(saved(tmp_path / "d.yaml", straight)).rig.reference.model == "perspective"
    (tmp_path / "e.toml").write_text('[calibration]\nfile = "a.yaml"\nprojector = false\nmodel = "perspective"\n')
    with pytest.raises(InputError, match=r"found 'perspective'; allowed: fisheye, which the calibration states"):
        read_calibration(tmp_path / "e.toml")


# --- MATLAB


@pytest.mark.parametrize(("unit", "length"), [("millimeters", 1.0), ("meters", 1e-3), ("inches", 1 / 25.4)])
def test_the_structures_of_newer_matlab(tmp_path, unit, length):
    """K and PoseCamera2 act on column vectors, pixels count from 1, sizes are rows and columns."""

    def camera(matrix, bent):
        return {
            "K": np.add(matrix, [[0, 0, 1], [0, 0, 1], [0, 0, 0]]),
            "RadialDistortion": bent[[0, 1, 4]],
            "TangentialDistortion": bent[2:4],
            "ImageSize": [480, 640],
            "WorldUnits": unit,
        }

    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = R, T * length
    pair = {"CameraParameters1": camera(K, D), "CameraParameters2": camera(K2, -D)}
    for number, written in enumerate((pose, {"A": pose}, {"R": R, "Translation": T * length})):
        savemat(tmp_path / f"{number}.mat", {"s": pair | {"PoseCamera2": written}})
        read = read_calibration(tmp_path / f"{number}.mat")
        sees(read.rig.cameras["left"], K, D)
        sees(read.rig.cameras["right"], K2, -D, R, T)
        assert read.notes == ()
    savemat(tmp_path / "alone.mat", camera(K, D))
    sees(read_calibration(tmp_path / "alone.mat").rig.reference, K, D)


def vision_camera(matrix, bent):
    """Return the structure of a camera, whose pixels count from 1."""
    return {
        "K": np.add(matrix, [[0, 0, 1], [0, 0, 1], [0, 0, 0]]).tolist(),
        "RadialDistortion": bent[[0, 1, 4]].tolist(),
        "TangentialDistortion": bent[2:4].tolist(),
        "ImageSize": [480, 640],
    }


@pytest.mark.parametrize("suffix", [".mat", ".json"])
def test_a_pair_of_matlab_without_a_structure_around_it(tmp_path, suffix):
    """``save('a.mat', '-struct', 's')``, or jsonencode(s): the first camera got the matrix of the second."""
    pair = {"CameraParameters1": vision_camera(K, D), "CameraParameters2": vision_camera(K2, -D)}
    pair |= {"PoseCamera2": {"R": R.tolist(), "Translation": T.tolist()}}
    path = tmp_path / f"a{suffix}"
    savemat(path, pair) if suffix == ".mat" else path.write_text(json.dumps(pair))
    read = read_calibration(path)
    sees(read.rig.cameras["left"], K, D)
    sees(read.rig.cameras["right"], K2, -D, R, T)
    assert read.notes == ()


def test_of_several_cameras_of_matlab_none_is_taken_unasked(tmp_path):
    """The last structure was taken, and a name of a matrix alone kept pixels that count from 1."""
    savemat(tmp_path / "a.mat", {"unit": {"colour": vision_camera(K, D), "depth": vision_camera(K2, -D)}})
    with pytest.raises(InputError, match=r"the file has unit\.colour\.K"):
        read_calibration(tmp_path / "a.mat")
    for name in ("unit.depth", "unit.depth.K"):
        (tmp_path / "a.toml").write_text(
            f'[calibration]\nfile = "a.mat"\nprojector = false\n[calibration.keys.camera]\nmatrix = "{name}"\n'
        )
        sees(read_calibration(tmp_path / "a.toml").rig.reference, K2, -D)


# --- units and warnings


@pytest.mark.parametrize("header", ["calibration", "calibration.keys.camera", "unknowns", "unknowns.calibration"])
@pytest.mark.parametrize("key", ['name = "mine"', "depth_scale = 0.1"])
def test_a_key_of_the_file_after_the_header_of_a_table_is_refused_with_the_cause(tmp_path, header, key):
    """Before, all of [unknowns] was left out unread, and other tables did not say why the key is in them."""
    opencv_file(tmp_path / "c.yml", camera_matrix=K, distortion=D)
    base = '[calibration]\nfile = "c.yml"\nprojector = false\n'
    (tmp_path / "a.toml").write_text(f"{base}{f'[{header}]' * (header != 'calibration')}\n{key}\n")
    with pytest.raises(InputError) as refusal:
        read_calibration(tmp_path / "a.toml", SIZE)
    assert refusal.value.field == f"{header}.{key.split()[0]}"
    assert f"after the header [{header}]" in refusal.value.hint or "did you mean 'scale'" in refusal.value.hint


def test_units_of_length(tmp_path):
    pair = {"K1": K, "D1": D, "K2": K2, "D2": D, "R": R}
    read = read_calibration(opencv_file(tmp_path / "a.yml", **pair, T=T), SIZE)
    assert read.notes == ()
    for factor, unit, others in ((1e-3, "m", ("mm", "cm")), (1e-1, "cm", ("m",)), (1e3, "um", ("mm", "m"))):
        with pytest.raises(InputError, match=r"baseline of .* the file does not state.*to_mm") as refused:
            read_calibration(opencv_file(tmp_path / "b.yml", **pair, T=T * factor), SIZE)
        # before, cm was proposed for all: of metres that are 0.05 to 1.5, it makes less than 15 mm
        assert f'unit: "{unit}" ({np.linalg.norm(T):.4g} mm)' in str(refused.value)
        assert all(f'unit: "{other}"' not in str(refused.value) for other in others)
    read = read_calibration(opencv_file(tmp_path / "b.yml", **pair, T=T / 10, unit="cm"), SIZE)
    sees(read.rig.cameras["right"], K2, D, R, T)
    read = read_calibration(opencv_file(tmp_path / "c.yml", **pair, T=T / 25.4, unit="inch"), SIZE)
    sees(read.rig.cameras["right"], K2, D, R, T)
    with pytest.raises(InputError, match=r"unit: found 'furlong'; allowed: .*to_mm"):
        read_calibration(opencv_file(tmp_path / "d.yml", **pair, T=T, unit="furlong"), SIZE)
    text = '[calibration]\nfile = "c.yml"\ncameras = ["left", "right"]\nprojector = false\nto_mm = 1\n'
    (tmp_path / "my.toml").write_text(text)
    assert "to_mm = 1 is used, though the file states 25.4 mm" in read_calibration(tmp_path / "my.toml", SIZE).notes[0]


@pytest.mark.parametrize("name", ["dist_coeff", "dist_coeffs", "distortion_coeffs"])
def test_names_of_distortion(tmp_path, name):
    read = read_calibration(opencv_file(tmp_path / "a.yml", camera_matrix=K, **{name: D}), SIZE)
    sees(read.rig.reference, K, D)
    assert read.notes == ()


def test_names_of_a_projector_of_three_letters(tmp_path):
    opencv_file(tmp_path / "a.yml", cam_K=K, cam_kc=D, pro_K=K2, pro_kc=-D, pro_size=np.array([912, 570]), R=R, T=T)
    (tmp_path / "my.toml").write_text(
        'name = "rig"\ntechnology = "structured_light"\n[calibration]\nfile = "a.yml"\n[pattern]\nkind = "gray_code"\n'
        "[decoder]\n"
    )
    rig = load_sensor(tmp_path / "my.toml", "decoding", SIZE)
    sees(rig.rig.projector, K2, -D, R, T)
    assert (rig.projector.optics.width, rig.projector.optics.height, rig.notes) == (912, 570, ())


def test_dotted_names_and_maps_are_read_or_named(tmp_path):
    table = {"LEFT.K": K.tolist(), "LEFT.lens": D.tolist(), "inner": {"K": K2.tolist(), "lens": D.tolist()}}
    saved(tmp_path / "a.yaml", table)
    text = '[calibration]\nfile = "a.yaml"\nprojector = false\n[calibration.keys.camera]\nmatrix = "LEFT.K"\n'
    (tmp_path / "a.toml").write_text(text)
    (note,) = read_calibration(tmp_path / "a.toml", SIZE).notes
    assert "values not read: LEFT.lens, inner.K, inner.lens; camera without distortion" in note
    (tmp_path / "b.toml").write_text(text.replace("LEFT.K", "inner.K") + 'distortion = "inner.lens"\n')
    (note,) = read_calibration(tmp_path / "b.toml", SIZE).notes
    assert "values not read: LEFT.K, LEFT.lens." in note


def test_a_bad_value_of_the_second_camera_is_told(tmp_path):
    """Before, the pair was read as one camera."""
    path = opencv_file(tmp_path / "a.yml", K1=K, K2=K2, R=2 * R, T=T)
    with pytest.raises(InputError, match="rotation of right"):
        read_calibration(path, SIZE)


def test_documents_of_a_file_that_differ_are_refused(tmp_path):
    path = tmp_path / "a.yaml"
    path.write_text(yaml.dump({"K": K.tolist()}) + "---\n" + yaml.dump({"K": K2.tolist()}))
    with pytest.raises(InputError, match="K: found other values in a later document"):
        read_calibration(path, SIZE)


def test_files_of_one_name_in_two_folders(tmp_path):
    for name, matrix in (("left", K), ("right", K2)):
        (tmp_path / name).mkdir()
        saved(tmp_path / name / "info.yaml", ros(matrix, rectification_matrix=np.eye(3)))
    text = '[calibration]\nfile = ["left/info.yaml", "right/info.yaml"]\ncameras = ["a"]\nprojector = false\n'
    (tmp_path / "my.toml").write_text(text + '[calibration.keys.a]\nfile = "right/info.yaml"\n')
    np.testing.assert_array_equal(read_calibration(tmp_path / "my.toml").rig.reference.matrix, K2)


@pytest.mark.parametrize("before", ["", "Camera.", "inner"])
def test_values_that_are_single_numbers(tmp_path, before):
    """As ORB-SLAM and librealsense write them; the order of distortion is OpenCV's, whatever that of the file."""
    names = {"k3": D[4], "p2": D[3], "p1": D[2], "k2": D[1], "k1": D[0], "fx": 600.0, "fy": 601.2, "cx": 322.3}
    names |= {"cy": 241.7, "width": 640, "height": 480}
    table = {before: {name: float(value) for name, value in names.items()}}
    if before != "inner":
        table = {f"{before}{name}": float(value) for name, value in names.items()}
    read = read_calibration(saved(tmp_path / "a.yaml", table))
    sees(read.rig.reference, K, D)
    assert read.rig.reference.width == 640 and read.notes == ()
    if before == "Camera.":
        bent = {"Camera.type": "KannalaBrandt8", "Camera.k4": 0.001}
        camera = read_calibration(saved(tmp_path / "b.yaml", table | bent)).rig.reference
        assert camera.model == "fisheye"
        np.testing.assert_array_equal(camera.distortion, [D[0], D[1], D[4], 0.001])
