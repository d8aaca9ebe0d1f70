"""Corners in the forms of other programs give the same calibration, whose halves must agree."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from characterisation.files.errors import InputError
from mitsim.sensor.camera import Camera, Rig
from mitsim.sensor.drift import Drift
from mitsim.sensor.fitted_to import FittedCapture, images_digest
from mitsim.sensor.opencv_calibration import with_calibration
from mitsim.sensor.preset import load_sensor
from mitsim.sensor.preset_covariance import with_drift
from mitsim.sensor.rig_covariance import read_rig_covariance
from mitsim.sensor.rig_parameters import parameter_differences
from mitsim.sensor.transforms import Transform
from mitsim.study.calibration.board import Board
from mitsim.study.calibration.corner_files import read_corners, turned_alike
from mitsim.study.calibration.halves import calibrate_checked, in_words
from mitsim.study.calibration.recorded import RecordedBoard, RecordedCorners
from mitsim.study.calibration.written import noisy_pose_hints, opencv_text, write_calibration
from tests.shell import mitsim_here

BOARD = Board(9, 7, 20.0, "glass")
SIZE = (1280, 960)
SIZES = {"left": SIZE, "right": SIZE}


def pair() -> Rig:
    matrix = np.array([[1500.0, 0, 640], [0, 1502, 470], [0, 0, 1]])
    turned = Transform(Rotation.from_rotvec([0.0, -0.1, 0.01]).as_matrix(), np.array([100.0, 1.0, 3.0]))
    left = Camera(matrix, np.array([-0.1, 0.05, 0, 0, 0]), *SIZE)
    return Rig({"left": left, "right": Camera(matrix, np.array([-0.1, 0.06, 0, 0, 0]), *SIZE, turned)})


def pixels_of(seed, count=10, tilt=0.5, noise=0.08):
    """Pixels (poses, n, 2) of each camera; the board is tilted by up to ``tilt`` rad."""
    rng = np.random.default_rng(seed)
    out = {"left": [], "right": []}
    for number in range(count):
        turn = tilt * np.array([np.cos(2.4 * number), np.sin(2.4 * number), 0.2])
        shift = np.array([40 * np.cos(number), 30 * np.sin(2 * number), 520 + 20 * (number % 4)])
        place = Transform(Rotation.from_rotvec(turn).as_matrix(), shift)
        for name, eye in pair().cameras.items():
            seen = eye.project(place.points(BOARD.corners))
            out[name].append(seen + noise * rng.standard_normal(seen.shape))
    return {name: np.array(values) for name, values in out.items()}


def boards_of(pixels):
    every = np.arange(len(BOARD.corners))
    return [
        RecordedBoard(every, {name: values[k] for name, values in pixels.items()}) for k in range(len(pixels["left"]))
    ]


def write_table(path, pixels):
    lines = [*(f"# size {name} 1280 960" for name in pixels), "pose,camera,column,row,x_px,y_px"]
    for name, values in pixels.items():
        for pose, places in enumerate(values):
            for corner, (x, y) in enumerate(places):
                lines.append(f"{pose},{name},{corner % 8},{corner // 8},{x:.17g},{y:.17g}")
    path.write_text("\n".join(lines) + "\n")


def test_every_form_gives_the_same_corners(tmp_path):
    pixels = pixels_of(1)
    write_table(tmp_path / "corners.csv", pixels)
    np.savez(tmp_path / "corners.npz", imgpoints_l=pixels["left"], imgpoints_r=pixels["right"], image_size=SIZE)
    for name in ("corners.yml", "corners.xml", "corners.json"):
        storage = cv2.FileStorage(str(tmp_path / name), cv2.FILE_STORAGE_WRITE)
        storage.write("image_width", SIZE[0])
        storage.write("image_height", SIZE[1])
        for number, values in enumerate(pixels.values(), 1):
            storage.write(f"image_points{number}", values)
        storage.release()
    spaced = (tmp_path / "corners.csv").read_text().replace(",", " , ")
    (tmp_path / "spaced.csv").write_text(spaced)
    for file in sorted(tmp_path.iterdir()):
        found = read_corners(file, BOARD)
        assert found.sizes == SIZES and not found.left_out
        for number, board in enumerate(found.boards):
            for name in pixels:
                np.testing.assert_allclose(board.pixels[name], pixels[name][number], rtol=1e-12, err_msg=file.name)


def test_corners_outside_the_images_are_refused(tmp_path):
    """Before, images of half the size had a calibration with the principal point in their corner."""
    pixels = pixels_of(1)
    for wrong, size in ((pixels, (640, 480)), ({name: each[..., ::-1] for name, each in pixels.items()}, SIZE)):
        np.savez(tmp_path / "c.npz", imgpoints_l=wrong["left"], imgpoints_r=wrong["right"], image_size=size)
        with pytest.raises(InputError, match=r"a corner at .* px; allowed: corners within"):
            read_corners(tmp_path / "c.npz", BOARD)


def test_a_pose_that_is_there_twice_counts_once(tmp_path):
    """Before, copies of poses lowered the uncertainty, and the two halves of one pose agreed."""
    pixels = {name: np.concatenate([each, each[2:5]]) for name, each in pixels_of(1).items()}
    write_table(tmp_path / "c.csv", pixels)
    found = read_corners(tmp_path / "c.csv", BOARD)
    assert len(found.boards) == 10
    assert found.left_out == ["10: the same as 2", "11: the same as 3", "12: the same as 4"]


def test_corners_of_a_board_with_twice_as_many_are_refused(tmp_path):
    """Before, every pose became two."""
    np.savez(tmp_path / "c.npz", imgpoints=pixels_of(1)["left"], image_size=SIZE)
    assert len(read_corners(tmp_path / "c.npz", BOARD).boards) == 10
    with pytest.raises(InputError, match=r"\(10, 48, 2\); allowed: \(poses, 24, 2\)"):
        read_corners(tmp_path / "c.npz", Board(9, 4, 20.0, "glass"))


ORDERS = {
    "reversed": lambda corners: corners[::-1],
    "rows mirrored": lambda corners: corners.reshape(6, 8, 2)[:, ::-1].reshape(-1, 2),
    "columns mirrored": lambda corners: corners.reshape(6, 8, 2)[::-1].reshape(-1, 2),
}


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("count", [10, 24])
def test_one_pose_in_another_order_is_refused_by_name(tmp_path, order, count):
    """Of 10 poses the calibration took it, at residuals of 133 px; of 24 it did not converge and named no pose."""
    pixels = pixels_of(1, count)
    pixels["right"][3] = ORDERS[order](pixels["right"][3])
    write_table(tmp_path / "c.csv", pixels)
    with pytest.raises(InputError, match=r"right, pose 3: found corners that turn right by 1[78]\d deg"):
        calibrate_checked(read_corners(tmp_path / "c.csv", BOARD), "test")


def test_a_pose_that_the_calibration_does_not_explain_is_told(tmp_path):
    """The right image of another moment: its residuals were in the printed range, of no pose."""
    pixels = pixels_of(1)
    pixels["right"][3] += [0.0, 15.0]
    write_table(tmp_path / "c.csv", pixels)
    corners = read_corners(tmp_path / "c.csv", BOARD)
    (hint,) = noisy_pose_hints(calibrate_checked(corners, "test"), corners)
    assert hint.startswith("pose 3: residuals of ")


def test_corners_in_the_order_of_another_board_are_said(tmp_path):
    mixed = {
        name: each.reshape(-1, 6, 8, 2).transpose(0, 2, 1, 3).reshape(-1, 48, 2) for name, each in pixels_of(1).items()
    }
    with pytest.raises(InputError, match="in the order of --board, COLUMNSxROWS"):
        calibrate_checked(RecordedCorners(BOARD, boards_of(mixed), SIZES), "x")


def write_images(folder, name="{camera}-{pose:04d}.png", colour=(1.0,)):
    """Images of the board by two cameras at two poses; the right one is shifted by 30 px along both axes.

    ``colour``: levels of the channels, relative.
    """
    squares = np.kron(np.indices((7, 9)).sum(axis=0) % 2, np.ones((40, 40)))
    for pose, angle in enumerate((0.0, 8.0)):
        for camera, shift in (("left", 60), ("right", 90)):
            motion = cv2.getRotationMatrix2D((240, 200), angle, 1.0)
            motion[:, 2] += shift
            image = cv2.warpAffine(255 * squares.astype(np.uint8), motion, (640, 480), borderValue=200)
            file = folder / name.format(camera=camera, pose=pose)
            file.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(file), (image[..., None] * np.array(colour)).astype(np.uint8))


def test_colour_images_of_a_board_are_read(tmp_path):
    """ROS's calibrator saves them of a colour camera; they were refused, though mitsim import reads such captures."""
    write_images(tmp_path / "colour", colour=(0.8, 0.9, 1.0))
    write_images(tmp_path / "grey", colour=(0.9,))
    found, grey = (read_corners(folder, BOARD) for folder in (tmp_path / "colour", tmp_path / "grey"))
    assert len(found.boards) == 2
    np.testing.assert_array_equal(found.boards[0].pixels["left"], grey.boards[0].pixels["left"])


@pytest.mark.parametrize("name", ["{camera}-{pose:04d}.png", "{camera}/{camera}{pose:02d}.png", "{camera}/{pose}.png"])
def test_images_of_ros_give_the_corners_of_the_board(tmp_path, name):
    write_images(tmp_path, name)
    found = read_corners(tmp_path, BOARD)
    assert found.sizes == {"left": (640, 480), "right": (640, 480)} and len(found.boards) == 2
    for board in found.boards:  # the right image is the left one, shifted by 30 px along both axes
        np.testing.assert_allclose(board.pixels["right"] - board.pixels["left"], 30.0, atol=0.05)
    # the same images as a capture are recognised, whichever program reads them
    pair = [str(tmp_path / name.format(camera=camera, pose=1)) for camera in ("left", "right")]
    images = {path: cv2.imread(path, cv2.IMREAD_GRAYSCALE)[None] for path in pair}
    assert [board.images.images_sha256 == images_digest(images) for board in found.boards] == [False, True]


def test_the_covariance_keeps_the_images_that_decided_it(tmp_path):
    shown = [FittedCapture(name=f"boards/{k}", images_sha256=f"{k:064x}") for k in range(10)]
    boards = [replace(board, images=one) for board, one in zip(boards_of(pixels_of(2)), shown, strict=True)]
    checked = calibrate_checked(RecordedCorners(BOARD, boards, SIZES), "recorded")
    write_calibration(checked, tmp_path / "unit.toml")
    again = read_rig_covariance(tmp_path / "unit.toml", checked.calibration.rig)
    drifted = with_drift(
        again, replace(load_sensor("ensenso-n10"), rig=checked.calibration.rig), Drift(temperature_k=1.0)
    )
    assert again.fitted_to == drifted.fitted_to == tuple(shown)
    rig_file = tmp_path / "unit.yml"
    assert f'# fitted to "boards/9", SHA-256 {9:064x}' in rig_file.read_text()
    table = {"calibration": {"file": "unit.yml", "cameras": ["left", "right"], "projector": False}}
    assert with_calibration(tmp_path / "sensor.toml", table)[0]["cameras"]["left"]["width"] == SIZE[0]
    opened = cv2.FileStorage(str(rig_file), cv2.FILE_STORAGE_READ)
    assert opened.getNode("cameraMatrix1").mat().shape == (3, 3)


def test_a_calibration_whose_halves_agree_is_not_widened():
    factors = [
        calibrate_checked(RecordedCorners(BOARD, boards_of(pixels_of(seed)), SIZES), "x").factor for seed in range(6)
    ]
    assert sorted(factors)[4] == 1.0  # each differs with a probability of 2 % at most


def test_errors_of_the_lens_at_like_poses_are_refused():
    """Half a pixel that differs between poses, and a board that is hardly tilted."""
    pixels = pixels_of(3, 12, tilt=0.02)
    for values in pixels.values():
        for number in range(12):
            values[number] += 0.5 * np.sin(values[number, :, ::-1] / 150.0 + number)
    with pytest.raises(InputError, match="tilted by 20 to 40 deg"):
        calibrate_checked(RecordedCorners(BOARD, boards_of(pixels), SIZES), "x")


def test_the_files_written_are_those_that_a_sensor_reads(tmp_path):
    checked = calibrate_checked(RecordedCorners(BOARD, boards_of(pixels_of(2)), SIZES), "recorded")
    write_calibration(checked, tmp_path / "unit.toml")
    table = {"calibration": {"file": "unit.yml", "cameras": ["left", "right"], "projector": False}}
    cameras = with_calibration(tmp_path / "sensor.toml", table)[0]["cameras"]
    assert cameras["right"]["width"] == SIZE[0]
    covariance = read_rig_covariance(tmp_path / "unit.toml", checked.calibration.rig)
    off = parameter_differences(checked.calibration.rig, pair(), covariance.names)
    told = [not name.endswith((".k2", ".k3")) for name in covariance.names]
    assert np.abs(off / covariance.one_sigma)[told].max() < 4.5
    assert "agree" in in_words(checked)


def test_the_command_calibrates_a_table(tmp_path):
    write_table(tmp_path / "corners.csv", pixels_of(4))
    done = mitsim_here("calibrate", tmp_path / "corners.csv", "--board", "9x7x20:glass", "-o", tmp_path / "unit.toml")
    assert "two halves of the poses agree" in done.stdout
    assert (tmp_path / "unit.toml").is_file() and (tmp_path / "unit.yml").is_file()
    assert 'covariance = "unit.toml"' in done.stderr


def test_an_argument_that_is_neither_sensor_nor_recording_is_named(tmp_path):
    """Before, a path without a file was an unknown preset."""
    (tmp_path / "board.png").write_bytes(b"an image")
    for name, told in (("board.png", "found one image; allowed: a folder"), ("none", "no such file or folder")):
        done = mitsim_here("calibrate", tmp_path / name, "--board", "9x7x20:glass", "-o", tmp_path / "u.toml", code=2)
        assert told in done.stderr


@pytest.mark.parametrize(
    "name, text",
    [
        ("a.csv", "pose,camera\n"),
        ("a.csv", "# size left 10 10\npose,camera,column,row,x_px,y_px\n0,left,99,0,1,1\n"),
        ("a.csv", "pose,camera,column,row,x_px,y_px\n0,left,0,0,1,1\n"),
        ("a.csv", "pose,camera,column,row,x_px,y_px\n0\n"),
        ("a.csv", '"' + "x" * 200_000),
        ("a.yml", "%YAML:1.0\n---\nimage_points: [1, 2\n"),
        ("a.yml", "%YAML:1.0\n---\nother: 3\n"),
        ("a.npz", "no archive"),
        ("a.json", "{}"),
        ("a.json", '{"image_points": [], "image_width": Infinity, "image_height": 480}'),
        ("a.json", '{"image_points": [1%s], "image_width": 640, "image_height": 480}' % ("0" * 400)),
        ("a.json", '{"image_points": [[1, 2], [3]], "image_width": 640, "image_height": 480}'),
        ("a.yml", "%YAML:1.0\n---\nimage_points: " + "[" * 100_000),
        ("a.json", '{"image_points": ' + "[" * 100_000),
    ],
)
def test_files_without_corners_are_refused(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError):
        read_corners(tmp_path / name, BOARD)


def test_two_sessions_with_the_same_names_of_poses_are_refused(tmp_path):
    """Before, the second session replaced the first one without a word, also at another resolution."""
    write_table(tmp_path / "c.csv", pixels_of(4))
    text = (tmp_path / "c.csv").read_text()
    (tmp_path / "twice.csv").write_text(text + "".join(text.splitlines(keepends=True)[3:]))
    with pytest.raises(InputError, match="pose 0: found corner 0, 0 of left a second time"):
        read_corners(tmp_path / "twice.csv", BOARD)
    (tmp_path / "sizes.csv").write_text("# size left 640 480\n" + text)
    with pytest.raises(InputError, match="a size of 1280 x 960 px after 640 x 480 px"):
        read_corners(tmp_path / "sizes.csv", BOARD)


def test_corners_of_images_half_as_large_as_stated_are_named(tmp_path):
    """Before, a principal point at 640, 470 px of 2560 x 1920 px without a word."""
    write_table(tmp_path / "c.csv", {"camera": pixels_of(4)["left"]})
    text = (tmp_path / "c.csv").read_text()
    (tmp_path / "large.csv").write_text(text.replace("1280 960", "2560 1920"))
    for name, warned in (("c.csv", False), ("large.csv", True)):
        done = mitsim_here("calibrate", tmp_path / name, "--board", "9x7x20:glass", "-o", tmp_path / "unit.toml")
        assert ("far from the middle of 2560 x 1920 px" in done.stderr) == warned


def test_the_reference_is_a_camera_whatever_the_order_of_the_sizes(tmp_path):
    """Before, a projector named first was the reference, and the pose of the camera was lost: T was nearly 0."""
    pixels = pixels_of(4)
    write_table(tmp_path / "c.csv", {"projector": pixels["right"], "camera": pixels["left"]})
    found = read_corners(tmp_path / "c.csv", BOARD)
    assert list(found.sizes) == ["camera", "projector"]
    rig = calibrate_checked(found, "x").calibration.rig
    assert np.linalg.norm(rig.projector.centre) == pytest.approx(100.0, rel=0.02)


@pytest.mark.parametrize("names", [("left", "right", "third"), ("left", "projector", "right"), ("projector",)])
def test_eyes_that_no_calibration_file_holds_are_refused(tmp_path, names):
    """Before, the third camera was left out of the file, which had R twice for a projector beside two cameras."""
    write_table(tmp_path / "c.csv", dict.fromkeys(names, pixels_of(4)["left"]))
    with pytest.raises(InputError, match="allowed: one or two cameras, or a camera and a projector"):
        read_corners(tmp_path / "c.csv", BOARD)


@pytest.mark.parametrize(
    "name, cameras",
    [
        ("{camera}/{pose:04d}.png", ["left", "right"]),
        ("poses/{camera}-{pose:04d}.png", ["left", "right"]),
        ("poses/{pose:04d}_{camera}.png", ["left", "right"]),
        ("unit-{camera}/room{pose}.png", ["unit-left", "unit-right"]),
        ("img_{camera}_{pose:03d}.png", ["left", "right"]),
        ("poses/board-{pose}-{camera}-image.png", ["left", "right"]),
        ("{camera}/img_{camera}_{pose}.png", ["left", "right"]),
    ],
)
def test_a_folder_whose_images_name_two_cameras_is_no_camera(tmp_path, name, cameras):
    """Before, the images of both were calibrated as those of one camera, named after the folder."""
    write_images(tmp_path, name)
    found = read_corners(tmp_path, BOARD)
    assert list(found.sizes) == cameras and len(found.boards) == 2
    for board in found.boards:
        np.testing.assert_allclose(board.pixels[cameras[1]] - board.pixels[cameras[0]], 30.0, atol=0.05)


@pytest.mark.parametrize(("inner", "within"), [("data", ""), ("images", ""), ("data", "left")])
def test_folders_within_that_of_a_camera_do_not_name_it(tmp_path, inner, within):
    """Before, the images of EuRoC's cam0/data and cam1/data were refused as two of one camera named data."""
    write_images(tmp_path, "{camera}/" + inner + "/140363657976355558{pose}.png")
    (tmp_path / "left" / "sensor.yaml").touch()
    found = read_corners(tmp_path / within, BOARD)
    assert list(found.sizes) == (["left"] if within else ["left", "right"]) and len(found.boards) == 2


@pytest.mark.parametrize(
    "names, cameras",
    [
        (["001_cam0", "001_cam1", "002_cam0", "002_cam1"], ["cam0", "cam1"]),
        (["ir1_0", "ir2_0"], ["ir1", "ir2"]),
        (["cam_0_12", "cam_1_12", "cam_0_13", "cam_1_13"], ["cam_0", "cam_1"]),
        (["imageL1", "imageR1", "imageL2", "imageR2", "imageL3"], ["left", "right"]),
        (["board_left_1", "board_right_1", "board_middle_1"], ["camera"]),
        (["board_left_1", "board_right_2", "board_left_3"], ["camera"]),
        (["cam_01", "cam_02", "cam_03"], ["cam"]),
    ],
)
def test_the_camera_stands_anywhere_in_the_names_of_most_pairs(tmp_path, names, cameras):
    """Images of two cameras, such as img_left_1 and img_right_1, were calibrated as those of one."""
    write_images(tmp_path, "{camera}-{pose}.png")
    shown = (tmp_path / "left-0.png").read_bytes()
    for file in tmp_path.iterdir():
        file.unlink()
    for name in names:
        (tmp_path / f"{name}.png").write_bytes(shown)
    assert list(read_corners(tmp_path, BOARD).sizes) == cameras


@pytest.mark.parametrize("upside_down", [False, True])
@pytest.mark.parametrize("count", [3, 10])
def test_a_second_camera_may_stand_upside_down(upside_down, count):
    """Its corners were always put in the reverse order, so that the calibration did not converge."""
    pixels = pixels_of(2, count)
    right = np.array(SIZE) - 1 - pixels["right"] if upside_down else pixels["right"]
    detected = [corners if corners[0, 1] < corners[-1, 1] else corners[::-1] for corners in right]  # from the top
    found = turned_alike(list(zip(pixels["left"], detected, strict=True)))
    np.testing.assert_array_equal(found, right)


def test_images_of_one_pose_in_two_folders_are_refused(tmp_path):
    """Before, the later ones replaced the others."""
    for place in ("monday", "tuesday"):
        write_images(tmp_path, place + "/{camera}-{pose:04d}.png")
    with pytest.raises(InputError, match=r"tuesday.*: found a second image of left, pose 0000"):
        read_corners(tmp_path, BOARD)


def test_a_projector_beside_two_cameras_has_a_pose_of_its_own(tmp_path):
    """R, T and the unit were written twice, and OpenCV read the R and T of one of them."""
    turned = Transform(Rotation.from_rotvec([0.02, 0.15, 0.0]).as_matrix(), np.array([-60.0, 5.0, 1.0]))
    rig = replace(pair(), projector=Camera(pair().cameras["left"].matrix, np.zeros(5), 912, 1140, turned))
    (tmp_path / "rig.yml").write_text(opencv_text(rig))
    stored = cv2.FileStorage(str(tmp_path / "rig.yml"), cv2.FILE_STORAGE_READ)
    assert len(stored.root().keys()) == len(set(stored.root().keys())) == 14
    for prefix, eye in (("", rig.cameras["right"]), ("proj_", rig.projector)):
        rotation, shift = eye.sensor_from_camera.rotation, eye.sensor_from_camera.translation
        np.testing.assert_allclose(stored.getNode(f"{prefix}R").mat(), rotation.T, atol=1e-12)
        np.testing.assert_allclose(stored.getNode(f"{prefix}T").mat().ravel(), -rotation.T @ shift, atol=1e-9)
    stored.release()
    table = {"calibration": {"file": "rig.yml", "cameras": ["left", "right"]}}
    read, _ = with_calibration(tmp_path / "sensor.toml", table)
    for eye, place in ((read["cameras"]["right"], [100.0, 1.0, 3.0]), (read["projector"], [-60.0, 5.0, 1.0])):
        np.testing.assert_allclose(eye["position_mm"], place, atol=1e-9)
