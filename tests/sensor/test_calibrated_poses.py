"""Pairs whose programs write the pose of each camera, a motion of the other direction, or a quaternion.

Before, EuRoC, ORB-SLAM3 and MC-Calib gave no pose, fisheye lenses of ORB-SLAM3 and MC-Calib were read as perspective
ones, and the lens of MC-Calib was left out. The expected pixels are OpenCV's, of points in the common frame.
"""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from characterisation.files.errors import InputError
from mitsim.capture.recordings.any_recording import ReadOptions, read_recording
from mitsim.capture.recordings.calibration_file import read_calibration
from tests.shell import mitsim_here

SIZE = (752, 480)
K = (
    np.array([[458.6, 0, 367.2], [0, 457.3, 248.4], [0, 0, 1]]),
    np.array([[457.6, 0, 379.9], [0, 456.1, 255.2], [0, 0, 1]]),
)
BENT = ([-0.28, 0.07, 2e-4, 2e-5], [-0.27, 0.06, -1e-4, -3e-5])
ROUND = ([0.02, -0.005, -0.004, 8e-4], [0.03, -0.01, -0.007, 2e-3])


def motion(degrees, metres):
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = Rotation.from_euler("xyz", degrees, degrees=True).as_matrix(), metres
    return out


#: poses of both cameras in a common frame [m]
BODY = (motion([2, -3, 89], [-0.022, -0.065, 0.010]), motion([1, 2, 91], [-0.020, 0.045, 0.008]))


def matrix_text(name, values, more=""):
    rows, columns = values.shape
    return f"{name}: {more}\n  rows: {rows}\n  cols: {columns}\n  dt: d\n  data: {values.ravel().tolist()}\n"


def sees_the_points(rig, lenses, model="perspective"):
    """Points about 2 m before the first camera, in the common frame, lie where OpenCV projects them into both."""
    points = np.random.default_rng(3).uniform([-500, -300, 1500], [500, 300, 2500], (40, 3))
    body = points @ BODY[0][:3, :3].T + 1000 * BODY[0][:3, 3]
    for camera, pose, matrix, lens in zip(rig.cameras.values(), BODY, K, lenses, strict=True):
        own = (body - 1000 * pose[:3, 3]) @ pose[:3, :3]
        project = cv2.fisheye.projectPoints if model == "fisheye" else cv2.projectPoints
        expected, _ = project(own[:, None], np.zeros(3), np.zeros(3), matrix, np.array(lens))
        assert camera.model == model
        np.testing.assert_allclose(camera.project(points), expected[:, 0], atol=1e-6)


def pair_of_files(folder, write):
    for number in range(2):
        (folder / f"cam{number}").mkdir()
        (folder / f"cam{number}/sensor.yaml").write_text(write(number))
    (folder / "pair.toml").write_text(
        '[calibration]\nfile = ["cam0/sensor.yaml", "cam1/sensor.yaml"]\n'
        'cameras = ["left", "right"]\nprojector = false\n'
    )
    return folder / "pair.toml"


def euroc(number, pose="T_BS"):
    return (
        f"sensor_type: camera\ncomment: cam{number}\n{matrix_text(pose, BODY[number])}rate_hz: 20\n"
        f"resolution: [752, 480]\ncamera_model: pinhole\n"
        f"intrinsics: {K[number][[0, 1, 0, 1], [0, 1, 2, 2]].tolist()} #fu, fv, cu, cv\n"
        f"distortion_model: radial-tangential\ndistortion_coefficients: {BENT[number]}\n"
    )


def test_two_files_of_euroc(tmp_path):
    read = read_calibration(pair_of_files(tmp_path, euroc))
    sees_the_points(read.rig, BENT)
    assert read.notes == ()
    assert {(each.width, each.height) for each in read.rig.cameras.values()} == {SIZE}


def test_two_files_of_which_one_has_no_pose_are_refused(tmp_path):
    with pytest.raises(InputError, match="the rotation of right"):
        read_calibration(pair_of_files(tmp_path, lambda number: euroc(number, "T_BS" if number else "T_other")))


def test_a_folder_of_euroc_is_a_pair_by_its_own_calibration(tmp_path):
    """Before, it needed a TOML of both files, and images in the folder itself."""
    pair_of_files(tmp_path, euroc)
    for number in range(2):
        (tmp_path / f"cam{number}/data").mkdir()
        for at in range(2):
            image = np.full(SIZE[::-1], 20 * number + at, np.uint8)
            cv2.imwrite(str(tmp_path / f"cam{number}/data/14036365797635555{at}4.png"), image)
    capture = read_recording(tmp_path, ReadOptions(frame=1)).capture
    assert {name: images[0, 0, 0] for name, images in capture.images.items()} == {"cam0": 1, "cam1": 21}
    assert capture.settings["files"]["cam1"] == "cam1/data/1403636579763555514.png"
    sees_the_points(capture.rig, BENT)


def orb_slam(kind, lenses, names, pose):
    text = f'%YAML:1.0\n\nFile.version: "1.0"\nCamera.type: "{kind}"\n'
    for number, (matrix, lens) in enumerate(zip(K, lenses, strict=True), 1):
        values = dict(zip(("fx", "fy", "cx", "cy"), matrix[[0, 1, 0, 1], [0, 1, 2, 2]].tolist(), strict=True))
        values |= dict(zip(names, lens, strict=True))
        text += "".join(f"Camera{number}.{name}: {value}\n" for name, value in values.items())
    text += "Camera.width: 752\nCamera.height: 480\nCamera.fps: 20\nStereo.ThDepth: 60.0\n"
    return text + matrix_text("Stereo.T_c1_c2", pose, "!!opencv-matrix")


FIRST_FROM_SECOND = np.linalg.inv(BODY[0]) @ BODY[1]


@pytest.mark.parametrize(
    ("kind", "lenses", "names", "model"),
    [
        ("PinHole", BENT, ("k1", "k2", "p1", "p2"), "perspective"),
        ("KannalaBrandt8", ROUND, ("k1", "k2", "k3", "k4"), "fisheye"),
    ],
)
def test_settings_of_orb_slam3(tmp_path, kind, lenses, names, model):
    (tmp_path / "a.yaml").write_text(orb_slam(kind, lenses, names, FIRST_FROM_SECOND))
    read = read_calibration(tmp_path / "a.yaml")
    sees_the_points(read.rig, lenses, model)
    assert read.notes == ()
    assert {(each.width, each.height) for each in read.rig.cameras.values()} == {SIZE}


def test_a_rectified_pair_of_orb_slam3(tmp_path):
    """A point at 2 m has the disparity f b / z."""
    fx, fy, cx, cy = K[0][[0, 1, 0, 1], [0, 1, 2, 2]]
    (tmp_path / "a.yaml").write_text(
        f'%YAML:1.0\nFile.version: "1.0"\nCamera.type: "Rectified"\nCamera1.fx: {fx}\nCamera1.fy: {fy}\n'
        f"Camera1.cx: {cx}\nCamera1.cy: {cy}\nCamera.width: 752\nCamera.height: 480\nStereo.b: 0.11\n"
    )
    left, right = read_calibration(tmp_path / "a.yaml").rig.cameras.values()
    point = np.array([[100.0, 50.0, 2000.0]])
    np.testing.assert_allclose(left.project(point) - right.project(point), [[fx * 110 / 2000, 0]], atol=1e-9)


def old_orb_slam(lines):
    """Settings of ORB-SLAM2 and of ORB-SLAM3 before its version 1.0: no File.version, mostly no Camera.type."""
    written = {"Camera.fx": 435.2, "Camera.fy": 435.2, "Camera.cx": 367.5, "Camera.cy": 252.2} | lines
    text = "%YAML:1.0\nCamera.width: 752\nCamera.height: 480\nCamera.fps: 20.0\nThDepth: 35\n"
    for name, value in written.items():
        is_matrix = isinstance(value, np.ndarray)
        text += matrix_text(name, np.atleast_2d(value), "!!opencv-matrix") if is_matrix else f"{name}: {value}\n"
    return text


def test_an_old_pair_of_orb_slam_has_the_cameras_before_rectification(tmp_path):
    """R turns a camera's coordinates into those of the rectified pair; the right camera stands at b along its x."""
    baseline, turns = (
        0.110,
        [Rotation.from_euler("xyz", each, degrees=True).as_matrix() for each in ([1, -2, 3], [2, 1, 2])],
    )
    P = np.array([[435.2, 0, 367.5, 0], [0, 435.2, 252.2, 0], [0, 0, 1, 0]])
    lines = {"Camera.k1": 0.0, "Camera.k2": 0.0, "Camera.p1": 0.0, "Camera.p2": 0.0, "Camera.bf": 435.2 * baseline}
    for number, side in enumerate(("LEFT", "RIGHT")):
        lines |= {f"{side}.height": 480, f"{side}.width": 752, f"{side}.D": np.array([*BENT[number], 0.0])}
        lines |= {f"{side}.K": K[number], f"{side}.R": turns[number], f"{side}.P": P.copy()}
        P[0, 3] = -435.2 * baseline
    (tmp_path / "a.yaml").write_text(old_orb_slam(lines))
    read = read_calibration(tmp_path / "a.yaml")
    assert read.notes == () and not read.unrelated
    points = np.random.default_rng(3).uniform([-400, -250, 1500], [400, 250, 2500], (40, 3))
    rectified = points @ turns[0].T
    own = (points, (rectified - (1000 * baseline, 0, 0)) @ turns[1])
    for camera, seen, matrix, lens in zip(read.rig.cameras.values(), own, K, BENT, strict=True):
        expected, _ = cv2.projectPoints(seen[:, None], np.zeros(3), np.zeros(3), matrix, np.array(lens))
        np.testing.assert_allclose(camera.project(points), expected[:, 0], atol=1e-6)
        assert (camera.width, camera.height) == SIZE


@pytest.mark.parametrize("kind", [{}, {"Camera.type": '"PinHole"'}])
def test_an_old_rectified_pair_of_orb_slam(tmp_path, kind):
    """A point at 2 m has the disparity bf / z, with bf in metres times pixels."""
    (tmp_path / "a.yaml").write_text(old_orb_slam({"Camera.k1": 0.0, "Camera.bf": 47.906} | kind))
    read = read_calibration(tmp_path / "a.yaml")
    left, right = read.rig.cameras.values()
    point = np.array([[100.0, 50.0, 2000.0]])
    np.testing.assert_allclose(left.project(point) - right.project(point), [[47.906 / 2, 0]], atol=1e-9)
    assert read.notes == ()


def test_a_depth_camera_of_orb_slam_is_no_pair(tmp_path):
    """Its bf is that of the depth sensor's projector, and its images are one camera's."""
    (tmp_path / "a.yaml").write_text(old_orb_slam({"Camera.k1": 0.26, "Camera.bf": 40.0, "DepthMapFactor": 5000.0}))
    read = read_calibration(tmp_path / "a.yaml")
    assert list(read.rig.cameras) == ["camera"]
    assert read.rig.reference.distortion[0] == 0.26


def test_an_old_fisheye_pair_of_orb_slam(tmp_path):
    """Tlr takes coordinates of the right camera to the left, 3 x 4."""
    lines = {"Camera.type": '"KannalaBrandt8"', "Camera.bf": 40.0, "Tlr": FIRST_FROM_SECOND[:3]}
    for prefix, matrix, lens in zip(("Camera", "Camera2"), K, ROUND, strict=True):
        names = ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")
        numbers = [*matrix[[0, 1, 0, 1], [0, 1, 2, 2]].tolist(), *lens]
        lines |= {f"{prefix}.{name}": number for name, number in zip(names, numbers, strict=True)}
    (tmp_path / "a.yaml").write_text(old_orb_slam(lines))
    read = read_calibration(tmp_path / "a.yaml")
    sees_the_points(read.rig, ROUND, "fisheye")
    assert read.notes == ()


def test_a_motion_by_columns_is_refused(tmp_path):
    """Its translation would be 0."""
    (tmp_path / "a.yaml").write_text(orb_slam("PinHole", BENT, ("k1", "k2", "p1", "p2"), FIRST_FROM_SECOND.T))
    with pytest.raises(InputError, match=r"Stereo.T_c1_c2: found .*the last row 0 0 0 1"):
        read_calibration(tmp_path / "a.yaml")


def mc_calib(folder, kind, lenses, groups=(0, 0)):
    """As its program writes: the pose of each camera in the frame of the first, in the unit of the board, here mm."""
    text = "%YAML:1.0\n---\nnb_camera: 2\n"
    for number in range(2):
        pose = np.linalg.inv(BODY[0]) @ BODY[number]
        pose[:3, 3] *= 1000
        inner = matrix_text("camera_matrix", K[number], "!!opencv-matrix")
        inner += matrix_text("distortion_vector", np.array([lenses[number]]), "!!opencv-matrix")
        inner += f"distortion_type: {kind}\ncamera_group: {groups[number]}\nimg_width: 752\nimg_height: 480\n"
        inner += matrix_text("camera_pose_matrix", pose, "!!opencv-matrix")
        text += f"camera_{number}:\n" + "".join(f"   {line}\n" for line in inner.splitlines())
    (folder / "calibrated_cameras_data.yml").write_text(text)
    return folder / "calibrated_cameras_data.yml"


@pytest.mark.parametrize(
    ("kind", "lenses", "model"), [(0, [[*each, 0.01] for each in BENT], "perspective"), (1, ROUND, "fisheye")]
)
def test_cameras_of_mc_calib(tmp_path, kind, lenses, model):
    file = mc_calib(tmp_path, kind, lenses)
    read = read_calibration(file)
    sees_the_points(read.rig, lenses, model)
    # the unit is that of the board's square in the user's settings, which the file does not have
    (note,) = read.notes
    assert "right stands 110 mm from the first camera, if the square of MC-Calib's board was given in mm" in note
    eyes = 'cameras = ["left", "right"]\nprojector = false\n'
    (tmp_path / "pair.toml").write_text(f'[calibration]\nfile = "{file.name}"\nto_mm = 1\n{eyes}')
    told = read_calibration(tmp_path / "pair.toml")
    assert told.notes == ()
    sees_the_points(told.rig, lenses, model)
    assert {(each.width, each.height) for each in read.rig.cameras.values()} == {SIZE}


def test_an_import_says_the_baseline_and_the_unit_that_it_assumed(tmp_path):
    for side in ("left", "right"):
        cv2.imwrite(str(tmp_path / f"{side}.png"), np.full((480, 752), 90, np.uint8))
    calibration = mc_calib(tmp_path, 0, [[*each, 0.01] for each in BENT])
    done = mitsim_here("import", tmp_path, "--calibration", calibration, "-o", tmp_path / "capture")
    assert "baseline: 110 mm\n" in done.stderr
    assert "if the square of MC-Calib's board was given in mm" in done.stderr


def test_groups_of_mc_calib_are_not_posed_to_one_another(tmp_path):
    assert read_calibration(mc_calib(tmp_path, 0, BENT, groups=(0, 1))).unrelated


def test_an_unknown_lens_of_mc_calib_is_refused(tmp_path):
    with pytest.raises(InputError, match="distortion_type: found 2"):
        read_calibration(mc_calib(tmp_path, 2, BENT))


def posed(quaternion, metres=1000.0, **names):
    """A pair whose second camera is posed by a quaternion under some name, and a translation."""
    step = np.linalg.inv(FIRST_FROM_SECOND)
    x, y, z, w = Rotation.from_matrix(step[:3, :3]).as_quat().tolist()
    cameras = {
        name: {"K": matrix.tolist(), "D": lens} for name, matrix, lens in zip(("left", "right"), K, BENT, strict=True)
    }
    return cameras, quaternion(x, y, z, w), (metres * step[:3, 3]).tolist()


def xyz(values):
    return dict(zip("xyz", values, strict=True))


QUATERNIONS = {
    "quaternion_xyzw": lambda x, y, z, w: [x, y, z, w],
    "quaternion_wxyz": lambda x, y, z, w: [w, x, y, z],
    "quaternion": lambda x, y, z, w: {"w": w, "x": x, "y": y, "z": z},
    "rotation": lambda x, y, z, w: {"qx": x, "qy": y, "qz": z, "qw": w},
}


@pytest.mark.parametrize("inside", [True, False])
@pytest.mark.parametrize("name", QUATERNIONS)
def test_a_quaternion_of_known_order(tmp_path, name, inside):
    cameras, quaternion, shift = posed(QUATERNIONS[name])
    holder = cameras["right"] if inside else cameras
    holder |= {name: quaternion, "translation": shift}
    (tmp_path / "a.json").write_text(json.dumps(cameras))
    read = read_calibration(tmp_path / "a.json", SIZE)
    sees_the_points(read.rig, BENT)
    assert read.notes == ()


def test_a_transform_of_ros_is_in_metres(tmp_path):
    cameras, quaternion, shift = posed(QUATERNIONS["quaternion"], metres=1.0)
    cameras["right"]["extrinsics"] = {"rotation": quaternion, "translation": xyz(shift)}
    (tmp_path / "a.json").write_text(json.dumps(cameras))
    sees_the_points(read_calibration(tmp_path / "a.json", SIZE).rig, BENT)


@pytest.mark.parametrize("vector", [False, True])
def test_poses_of_ros_are_those_of_the_cameras(tmp_path, vector):
    """Before, a rotation vector beside a position was that from the common frame, of another pose."""
    cameras, _, _ = posed(QUATERNIONS["quaternion"])
    for camera, pose in zip(cameras.values(), BODY, strict=True):
        rotation = Rotation.from_matrix(pose[:3, :3])
        turn = dict(zip("xyzw", rotation.as_quat().tolist(), strict=True))
        turn = rotation.as_rotvec().tolist() if vector else turn
        position = (1000 * pose[:3, 3]).tolist() if vector else xyz(pose[:3, 3].tolist())  # metres by ROS alone
        camera["pose"] = {"position": position, "orientation": turn}
    (tmp_path / "a.json").write_text(json.dumps(cameras))
    read = read_calibration(tmp_path / "a.json", SIZE)
    sees_the_points(read.rig, BENT)
    assert read.notes == ()


@pytest.mark.parametrize(
    ("name", "change"), [("quaternion", 1.0), ("rotation", 1.0), ("quaternion_xyzw", 1.1), ("quaternion_wxyz", 0.0)]
)
@pytest.mark.parametrize("inside", [True, False])
def test_a_quaternion_of_unknown_order_or_length_is_refused(tmp_path, name, change, inside):
    cameras, quaternion, shift = posed(lambda *values: [change * each for each in values])
    holder = cameras["right"] if inside else cameras
    holder |= {name: quaternion, "translation": shift}
    (tmp_path / "a.json").write_text(json.dumps(cameras))
    with pytest.raises(InputError, match=rf"{name}: found four numbers.*a name that ends in xyzw or wxyz"):
        read_calibration(tmp_path / "a.json", SIZE)


def test_a_pose_of_the_second_camera_in_a_common_frame_is_not_its_pose_from_the_first(tmp_path):
    """Before, T_cam_imu of one camera was read as its pose from the other."""
    cameras = {f"cam{number}": {"K": matrix.tolist(), "D": BENT[number]} for number, matrix in enumerate(K)}
    cameras["cam1"]["T_cam_imu"] = BODY[1].tolist()
    (tmp_path / "a.json").write_text(json.dumps(cameras))
    assert read_calibration(tmp_path / "a.json", SIZE).unrelated
