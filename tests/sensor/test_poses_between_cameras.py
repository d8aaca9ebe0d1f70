"""Poses between cameras in maps, motions and vectors of many names, against OpenCV's projection of points.

Before, ``stereo: {R, T}``, ``T_cam1_cam0`` and ``rvec`` gave no pair, mostly without a word; of a chain of three
cameras the pose of the third from the second was read as that from the first; a skew beside the matrix was left out.
"""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest

from characterisation.files.errors import InputError
from mitsim.capture.recordings.calibration_file import read_calibration
from mitsim.capture.recordings.stereo_pair import names_of_pair
from mitsim.sensor.preset import load_sensor

SIZE = (640, 480)
K = [np.array([[600.0 + 5 * i, 0, 322 - i], [0, 601 + 4 * i, 241 + i], [0, 0, 1]]) for i in range(3)]
D = [-0.1, 0.05, 0.001, -0.002, 0.01]
SOLO = [{"K": matrix.tolist(), "D": D} for matrix in K]


def motion(vector, shift):
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = cv2.Rodrigues(np.array(vector))[0], shift
    return out


#: from a frame of their own to each of three cameras [mm]
POSES = [motion([0.1, -0.3, 0.2], [20, 5, 30]), motion([0.12, -0.2, 0.22], [-60, 3, 20])]
POSES.append(motion([0.05, -0.1, 0.15], [-150, -4, 25]))
STEP = [None, POSES[1] @ np.linalg.inv(POSES[0]), POSES[2] @ np.linalg.inv(POSES[1])]
R, T = STEP[1][:3, :3].tolist(), STEP[1][:3, 3].tolist()
OM = cv2.Rodrigues(STEP[1][:3, :3])[0].ravel().tolist()
FLAT = {"K1": K[0].tolist(), "D1": D, "K2": K[1].tolist(), "D2": D}
BACK = np.linalg.inv(STEP[1]).tolist()


def saved(path, table):
    path.write_text(json.dumps(table))
    return path


def sees(camera, number, from_first):
    points = np.random.default_rng(1).uniform([-80, -60, 400], [80, 60, 800], (50, 3))
    turn, shift = cv2.Rodrigues(from_first[:3, :3])[0], from_first[:3, 3]
    expected, _ = cv2.projectPoints(points, turn, shift, K[number], np.array(D))
    np.testing.assert_allclose(camera.project(points), expected[:, 0], atol=1e-6)


PAIRS = {
    "a map beside the matrices": FLAT | {"stereo": {"R": R, "T": T}},
    "a map beside the cameras": {
        "cam0": SOLO[0],
        "cam1": SOLO[1],
        "stereo_extrinsics": {"rotation": R, "translation": T},
    },
    "a map around all": {"rig": {"left": SOLO[0], "right": SOLO[1], "extrinsics": {"R": R, "T": T}}},
    "vectors of Rodrigues": FLAT | {"rvec": OM, "tvec": T},
    "vectors of Rodrigues in a camera": {"cam0": SOLO[0], "cam1": SOLO[1] | {"rvec": OM, "tvec": T}},
    "vectors of Rodrigues from a board": {
        f"cam{i}": SOLO[i] | {"rvec": cv2.Rodrigues(POSES[i][:3, :3])[0].tolist(), "tvec": POSES[i][:3, 3].tolist()}
        for i in range(2)
    },
    "a motion of names": {"cam0": SOLO[0], "cam1": SOLO[1], "T_cam1_cam0": STEP[1].tolist()},
    "a motion of names, back": {"cam0": SOLO[0] | {"T_cam0_cam1": BACK}, "cam1": SOLO[1]},
    "both motions": {"cam0": SOLO[0] | {"T_cam0_cam1": BACK}, "cam1": SOLO[1] | {"T_cam1_cam0": STEP[1].tolist()}},
    "short names": {"camera_0": SOLO[0], "camera_1": SOLO[1], "T_c1_c0": STEP[1][:3].tolist()},
    "sides": {"left": SOLO[0], "right": SOLO[1], "extrinsics": {"T_right_left": STEP[1].tolist()}},
    "a common frame": {"cam0": SOLO[0], "cam1": SOLO[1], "T_cam0_rig": POSES[0].tolist()}
    | {"T_rig_cam1": np.linalg.inv(POSES[1]).tolist()},
}


@pytest.mark.parametrize("name", PAIRS)
def test_a_pair(tmp_path, name):
    read = read_calibration(saved(tmp_path / "a.json", PAIRS[name]), SIZE)
    assert (list(read.rig.cameras), read.notes) == (["left", "right"], ())
    sees(read.rig.cameras["left"], 0, np.eye(4))
    sees(read.rig.cameras["right"], 1, STEP[1])


def test_a_motion_of_unknown_direction_is_named(tmp_path):
    pair = {"cam0": SOLO[0], "cam1": SOLO[1] | {"extrinsic": STEP[1].tolist()}, "T_cam0_to_cam1": BACK}
    read = read_calibration(saved(tmp_path / "a.json", pair), SIZE)
    assert "values not read: cam1.extrinsic, T_cam0_to_cam1" in read.notes[0]
    with pytest.raises(InputError, match=r"without the pose of the second.*values not read: cam1\.extrinsic"):
        names_of_pair(read, "a.json")


def kalibr():
    metres = [step if step is None else np.vstack([np.c_[step[:3, :3], step[:3, 3] / 1000], step[3]]) for step in STEP]
    return {"cam0": SOLO[0]} | {f"cam{i}": SOLO[i] | {"T_cn_cnm1": metres[i].tolist()} for i in (1, 2)}


COMMON = {f"cam{i}": SOLO[i] | {"R": POSES[i][:3, :3].tolist(), "T": POSES[i][:3, 3].tolist()} for i in range(3)}


@pytest.mark.parametrize("table", [kalibr(), COMMON], ids=["chain", "common frame"])
@pytest.mark.parametrize(("first", "second"), [(0, 1), (0, 2), (1, 2), (2, 0)])
def test_two_of_three_cameras_are_named(tmp_path, table, first, second):
    """Unnamed ones were the first two, without a word, whatever cameras took the images."""
    read = read_calibration(saved(tmp_path / "a.json", table), SIZE)
    assert (list(read.rig.cameras), read.unrelated) == (["cam0", "cam1", "cam2"], True)
    with pytest.raises(InputError, match=r"found cam0, cam1, cam2; allowed: two cameras.*name two of them in a TOML"):
        names_of_pair(read, "a.json")
    keys = "".join(
        f'[calibration.keys.{side}]\nmatrix = "cam{number}"\n' for side, number in (("left", first), ("right", second))
    )
    toml = f'[calibration]\nfile = "a.json"\ncameras = ["left", "right"]\nprojector = false\n{keys}'
    (tmp_path / "a.toml").write_text(toml)
    read = read_calibration(tmp_path / "a.toml", SIZE)
    sees(read.rig.cameras["left"], first, np.eye(4))
    sees(read.rig.cameras["right"], second, POSES[second] @ np.linalg.inv(POSES[first]))


def test_of_three_cameras_left_and_right_are_the_pair(tmp_path):
    table = {"color": SOLO[2] | {"R": R, "T": [-50, 0, 0]}, "right": SOLO[1] | {"R": R, "T": T}, "left": SOLO[0]}
    read = read_calibration(saved(tmp_path / "a.json", table), SIZE)
    sees(read.rig.cameras["left"], 0, np.eye(4))
    sees(read.rig.cameras["right"], 1, STEP[1])
    keys = '[calibration.keys.left]\nmatrix = "left"\n[calibration.keys.right]\nmatrix = "color"\n'
    toml = f'[calibration]\nfile = "a.json"\ncameras = ["left", "right"]\nprojector = false\n{keys}'
    (tmp_path / "a.toml").write_text(toml)
    chosen = read_calibration(tmp_path / "a.toml", SIZE).rig.cameras["right"]
    sees(chosen, 2, motion(OM, [-50, 0, 0]))


@pytest.mark.parametrize("keys", ["", '[calibration.keys.camera]\nmatrix = "camera"\n'])
def test_a_camera_and_a_projector_in_a_common_frame(tmp_path, keys):
    """Before, the pose of the projector in that frame was its pose from the camera."""
    table = {name: COMMON[f"cam{i}"] | {"resolution": [640, 480]} for i, name in enumerate(("camera", "projector"))}
    saved(tmp_path / "a.json", table)
    text = 'name = "rig"\ntechnology = "structured_light"\n[calibration]\nfile = "a.json"\n'
    (tmp_path / "my.toml").write_text(f'{text}{keys}[pattern]\nkind = "gray_code"\n[decoder]\n')
    sensor = load_sensor(tmp_path / "my.toml", "decoding")
    sees(sensor.rig.projector, 1, STEP[1])


def test_the_pose_of_a_board_is_not_that_of_a_projector(tmp_path):
    """A file of the camera alone may have its pose of a board under the names of vectors."""
    saved(tmp_path / "cam.json", {"camera_matrix": K[0].tolist(), "dist": D, "rvec": OM, "tvec": T})
    saved(tmp_path / "proj.json", {"proj_K": K[1].tolist(), "proj_kc": D})
    text = 'name = "rig"\ntechnology = "structured_light"\n[calibration]\nfile = ["cam.json", "proj.json"]\n'
    (tmp_path / "my.toml").write_text(f'{text}[pattern]\nkind = "gray_code"\n[decoder]\n')
    with pytest.raises(InputError, match="the rotation of projector"):
        load_sensor(tmp_path / "my.toml", "decoding", SIZE)


NUMBERS = {"fx": 600.0, "fy": 601.0, "cx": 322.0, "cy": 241.0}


@pytest.mark.parametrize(
    ("table", "told"),
    [
        (NUMBERS | {"s": 2.5}, "2.5 px"),
        ({"camera": NUMBERS | {"S": 2.5}}, "2.5 px"),
        ({"K": K[0].tolist(), "skew": 2.5}, "2.5 px"),
        (NUMBERS | {"alpha_c": 0.005}, "3 px"),
    ],
)
def test_a_skew_beside_the_matrix_is_refused(tmp_path, table, told):
    with pytest.raises(InputError, match=f"a skew of {told}"):
        read_calibration(saved(tmp_path / "a.json", table), SIZE)
    (names,) = (set(table) & {"s", "skew", "alpha_c"} or {"camera"},)
    without = {key: value for key, value in table.items() if key not in names} or {"camera": NUMBERS | {"s": 0.0}}
    assert read_calibration(saved(tmp_path / "a.json", without), SIZE).rig.reference.matrix[0, 1] == 0


@pytest.mark.parametrize("table", [{"K": ...}, {"camera": {"intrinsic_matrix": ...}}, {"camera": {"intrinsics": ...}}])
@pytest.mark.parametrize("flat", [False, True])
def test_a_camera_matrix_of_four_rows(tmp_path, table, flat):
    padded = np.eye(4)
    padded[:3, :3] = K[0]
    text = json.dumps(table, default=lambda _: (padded.ravel() if flat else padded).tolist())
    (tmp_path / "a.json").write_text(text)
    np.testing.assert_array_equal(read_calibration(tmp_path / "a.json", SIZE).rig.reference.matrix, K[0])
