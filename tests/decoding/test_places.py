"""Where features are and which way they point: closed forms in three frames, and uncertainties as the scatter."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from characterisation.cloud_files import write_cloud
from characterisation.features.robust_fit import FitError
from characterisation.files.errors import InputError
from characterisation.region_of_interest import Roi
from characterisation.tasks.windows import WindowPlan, measure_windows
from mitsim.cli.measure_frame import read_frame
from mitsim.decoding.board_frame import BoardCorners, board_frame
from mitsim.decoding.input_clouds import InputCloud
from tests.seen_shapes import GRID, cloud_of, cylinder, plane, sphere
from tests.shell import mitsim_here

TURN = Rotation.from_rotvec([0.4, -0.3, 1.1]).as_matrix()
FRAME = np.eye(4)
FRAME[:3, :3], FRAME[:3, 3] = TURN, [30.0, -200.0, 80.0]

NORMAL = np.array([0.3, 0.1, -1.0]) / np.linalg.norm([0.3, 0.1, -1.0])
CENTRE, POINT, AXIS = np.array([-30.0, 5, 450]), np.array([40.0, 0, 470]), np.array([0.1, 1, 0.05])


def found(distance, shape, frame=None, window=None, sigma=0.0, rng=None):
    results = measure_windows(cloud_of(distance, sigma, rng), WindowPlan({"a": (shape, window)}), frame)
    return {one.name.removeprefix("a "): one for one in results}


def xyz(results, name):
    return np.array([results[f"{name} {axis}"].value for axis in "xyz"])


@pytest.mark.parametrize("frame", [np.eye(4), FRAME])
def test_features_without_noise_are_where_they_were_made(frame):
    R, t = frame[:3, :3], frame[:3, 3]
    flat = found(plane([0, 0, 500], NORMAL), "plane", frame)
    assert xyz(flat, "normal") == pytest.approx(R @ NORMAL, abs=1e-6)
    # the distance of the frame's origin, which is -R^T t in the sensor frame
    expected = abs((np.array([0, 0, 500]) + R.T @ t) @ NORMAL)
    assert flat["perpendicular distance"].value == pytest.approx(expected, abs=1e-3)
    ball = found(sphere(CENTRE, 20), "sphere", frame)
    assert xyz(ball, "centre") == pytest.approx(R @ CENTRE + t, abs=1e-3)
    pin = found(cylinder(POINT, AXIS, 15), "cylinder", frame)
    along = R @ AXIS / np.linalg.norm(AXIS)
    along *= np.sign(along[np.abs(along).argmax()])
    assert xyz(pin, "axis") == pytest.approx(along, abs=1e-5)
    beside = xyz(pin, "axis point") - (R @ POINT + t)
    assert np.linalg.norm(beside - (beside @ along) * along) < 1e-3


def test_uncertainties_of_places_are_the_scatter_of_independent_noise(rng):
    """Over 60 trials s / u lies within 1 +- 4 / sqrt(2 * 59) for each of thirteen numbers."""
    scenes = {
        "plane": (plane([0, 0, 500], NORMAL), Roi(60, 40, 50, 50)),
        "sphere": (sphere([0, 0, 450], 20), Roi(60, 45, 80, 70)),
        "cylinder": (cylinder([0, 0, 470], AXIS, 15), Roi(70, 30, 60, 100)),
    }
    for shape, (distance, window) in scenes.items():
        trials = [found(distance, shape, FRAME, window, 0.2, rng) for _ in range(60)]
        for name in trials[0]:
            if name.split()[0] in ("perpendicular", "normal", "centre", "axis") and not name.startswith("axis point"):
                values = np.array([one[name].value for one in trials])
                stated = np.sqrt(np.mean([one[name].uncertainty ** 2 for one in trials]))
                assert abs(values.std(ddof=1) / stated - 1) < 4 / np.sqrt(2 * 59), name


BOARD = BoardCorners(8, 5, 14.0)


def board_in_view(frame, pixels_each=4):
    """Cloud and image (160, 200) of a chequerboard; ``frame`` (4, 4) takes the sensor frame to that of the board."""
    R, t = frame[:3, :3], frame[:3, 3]
    normal, origin = R.T[:, 2], -R.T @ t
    cloud = cloud_of(plane(origin, normal))
    image = np.zeros(GRID.rays().shape[:2])
    columns, rows = np.meshgrid(np.arange(GRID.width), np.arange(GRID.height))
    for a in (np.arange(pixels_each) + 0.5) / pixels_each - 0.5:
        for b in (np.arange(pixels_each) + 0.5) / pixels_each - 0.5:
            rays = np.stack(
                [(columns + a - GRID.cx) / GRID.fx, (rows + b - GRID.cy) / GRID.fy, np.ones(image.shape)], -1
            )
            on_board = (rays * (origin @ normal / (rays @ normal))[..., None]) @ R.T + t
            x, y = on_board[..., 0] / BOARD.pitch, on_board[..., 1] / BOARD.pitch
            within = (x > -1) & (x < BOARD.columns) & (y > -1) & (y < BOARD.rows)
            dark = (np.floor(x) + np.floor(y)) % 2 == 1
            image += np.where(within & dark, 20, 220) / pixels_each**2
    return cloud, image.astype(np.uint8)


@pytest.mark.parametrize("roll", [0.1, 1.4, 3.1, -1.7])
def test_the_frame_of_a_board_is_found(roll):
    """Its colours tell the first corner, however the board is turned in the image."""
    turn = (Rotation.from_euler("z", roll) * Rotation.from_rotvec([0.2, -0.25, 0])).as_matrix()
    expected = np.eye(4)
    expected[:3, :3] = turn
    expected[:3, 3] = np.array([49, 28, 0]) - turn @ np.array([0, 0, 520])
    frame, scale, rms = board_frame(BOARD, *board_in_view(expected))
    assert np.rad2deg(Rotation.from_matrix(frame[:3, :3] @ turn.T).magnitude()) < 0.1
    corner = np.array([3 * BOARD.pitch, 2 * BOARD.pitch, 0])
    there = np.linalg.solve(expected, [*corner, 1])
    assert (frame @ there)[:3] == pytest.approx(corner, abs=0.1)  # 0.8 mm is one pixel
    assert scale == pytest.approx(1, abs=1e-3)
    assert rms < 0.1


def test_a_wrong_board_is_refused():
    straight = np.eye(4)
    straight[:3, 3] = [50, 30, -500]
    cloud, image = board_in_view(straight)
    with pytest.raises(FitError, match="no chequerboard of 9 x 6"):
        board_frame(BoardCorners(9, 6, 14.0), cloud, image)
    with pytest.raises(FitError, match="is its pitch 40 mm"):
        board_frame(BoardCorners(8, 5, 40.0), cloud, image)
    cloud = replace(cloud, status=np.zeros_like(cloud.status), points=np.full_like(cloud.points, np.nan))
    with pytest.raises(FitError, match="0 points of the cloud on the board"):
        board_frame(BOARD, cloud, image)


@pytest.mark.parametrize("text", ["world", "board=9,6", "board=9,6,0", "board=1,6,20", "board=a,b,c", "none.json"])
def test_other_frames_are_refused(text):
    with pytest.raises(InputError, match="--points-in"):
        read_frame(text)


def test_a_cloud_has_no_workspace_and_no_board():
    given = InputCloud("a.ply", cloud_of(plane([0, 0, 500], NORMAL)), None)
    with pytest.raises(InputError, match="give the capture folder"):
        read_frame("workspace").of(given)
    with pytest.raises(InputError, match="images that show the board"):
        read_frame("board=9,6,20").of(given)


def test_the_command_states_places_in_the_frame_of_a_pose(tmp_path):
    write_cloud(cloud_of(sphere(CENTRE, 20)), tmp_path / "cloud.ply")
    (tmp_path / "pose.json").write_text(json.dumps({"world_from_sensor": FRAME.tolist()}), encoding="utf-8")
    options = ("--sphere", "ball", "--json")
    for frame, expected in (("sensor", CENTRE), (tmp_path / "pose.json", TURN @ CENTRE + FRAME[:3, 3])):
        done = mitsim_here("measure", tmp_path / "cloud.ply", *options, "--points-in", frame)
        values = {one["name"]: one["value"] for one in json.loads(done.stdout)["clouds"][0]["measurements"]}
        assert [values[f"ball centre {axis}"] for axis in "xyz"] == pytest.approx(expected, abs=1e-3)
