"""``mitsim measure`` as a user runs it."""

import json
import re
import subprocess
import sys

import numpy as np
import pytest
from typer.testing import CliRunner

from characterisation.cloud_files import write_cloud
from characterisation.files.errors import InputError
from mitsim.capture.folder import write_capture
from mitsim.capture.simulated.rendering import Rendering
from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.cli.program import app
from mitsim.scene.load import load_scene
from mitsim.sensor.preset import load_sensor
from mitsim.sensor.transforms import look_at
from tests.seen_shapes import cloud_of, plane


def run(*arguments):
    """Run the command; errors of its user come as they are raised."""
    done = CliRunner().invoke(app, ["measure", *map(str, arguments)], catch_exceptions=True)
    if isinstance(done.exception, InputError):
        raise done.exception
    assert done.exception is None or isinstance(done.exception, SystemExit), done.exception
    return done


@pytest.fixture
def clouds(tmp_path, rng):
    """Three clouds of one plane, in a folder."""
    for number in range(3):
        write_cloud(cloud_of(plane([0, 0, 500], [0, 0.3, -1]), 0.1, rng), tmp_path / f"{number}.ply")
    return tmp_path


def test_a_table_with_units_points_and_uncertainties(clouds):
    done = run(clouds / "0.ply", "--plane", "top=20,20,100,80")
    line = next(line for line in done.stdout.splitlines() if line.startswith("top noise"))
    value, unit, uncertainty, points = line.split()[2:]
    assert unit == "mm" and re.fullmatch(r"79\d\d/8000", points)
    assert float(value) == pytest.approx(0.1, rel=0.05)
    assert float(uncertainty) == pytest.approx(0.1 / (2 * 8000) ** 0.5, rel=0.1)
    assert "it does not include: noise that neighbouring points share" in done.stderr
    assert done.stderr.splitlines()[-1] == "7 of 7 measurements"


def test_a_folder_has_repeatability(clouds):
    done = run(clouds, "--plane", "top=20,20,100,80", "--json")
    found = json.loads(done.stdout)
    assert [one["path"] for one in found["clouds"]] == [str(clouds / f"{k}.ply") for k in range(3)]
    over = {one["name"]: one for one in found["repeatability"]}
    values = [m["value"] for c in found["clouds"] for m in c["measurements"] if m["name"] == "top distance"]
    assert over["top distance"]["count"] == 3
    assert over["top distance"]["mean"] == pytest.approx(sum(values) / 3)
    assert "calibration and scale of the sensor" in found["uncertainty"]["from_fit_leaves_out"]
    assert re.search(r"top distance +3/3 ", run(clouds, "--plane", "top=20,20,100,80").stdout)


@pytest.mark.parametrize("asked", [("--plane", "top"), ("acceptance", "--plane", "top=600")])
def test_a_copy_among_repeats_is_told(asked, clouds):
    """Before, the standard deviation over a cloud and its copy was 0, without a word."""
    assert "not a repeat" not in run(*asked, clouds).stderr
    (clouds / "copy.ply").write_bytes((clouds / "1.ply").read_bytes())
    told = run(*asked, clouds).stderr
    assert "copy.ply has the points of" in told or "1.ply has the points of" in told
    assert told.count("not a repeat") == 1


@pytest.mark.parametrize("tilt", [0.0, 0.2])
def test_depths_of_one_whole_mm_say_why_u_is_0(tmp_path, rng, tilt):
    """A wall at 700.2 mm was at 700.000 mm with u = 0 and noise 0, without a word."""
    rows, columns = np.mgrid[:48, :64]
    rays = np.stack([(columns - 31.5) / 60, (rows - 23.5) / 60, np.ones((48, 64))], axis=-1)
    depth = 700.2 / (1 + tilt * rays[..., 0]) + 0.05 * rng.standard_normal((48, 64))
    np.save(tmp_path / "wall.npy", np.rint(depth)[..., None] * rays)
    done = run(tmp_path / "wall.npy", "--plane", "wall")
    told = (
        "u is 0 of wall flatness, wall noise, wall distance, ...: its points have no scatter, as depths of one whole mm"
    )
    assert (told in done.stderr) == (tilt == 0.0)


def test_a_difference_with_its_picture(clouds):
    done = run(
        clouds / "0.ply",
        "--against",
        clouds / "1.ply",
        "--window",
        20,
        20,
        100,
        80,
        "--picture",
        clouds / "difference.png",
    )
    deviation = next(line for line in done.stdout.splitlines() if "standard deviation" in line).split()
    assert float(deviation[3]) == pytest.approx(0.1 * 2**0.5, rel=0.05)
    assert deviation[-1] == "8000/8000"
    assert (clouds / "difference.png").read_bytes().startswith(b"\x89PNG")


def test_a_difference_without_a_picture_loads_no_slow_library(clouds):
    """Matplotlib, xarray and SciPy's statistics take longer to import than a window to measure."""
    arguments = [str(clouds / "0.ply"), "--against", str(clouds / "1.ply"), "--window", "20", "20", "100", "80"]
    code = (
        "import sys; from mitsim.cli.program import app; app(sys.argv[1:], standalone_mode=False);"
        " print('loaded', *sys.modules)"
    )
    ran = [sys.executable, "-c", code, "measure", *arguments]
    done = subprocess.run(ran, check=True, capture_output=True, text=True)
    loaded = done.stdout.partition("\nloaded ")[2].split()
    assert "characterisation.acceptance.cloud_difference" in loaded
    assert not {"matplotlib", "xarray", "pandas", "scipy.stats", "mitsuba"} & set(loaded)


def test_what_is_not_possible_ends_with_one(clouds, rng):
    write_cloud(cloud_of(rng.uniform(300, 900, (160, 200))), clouds / "noise.ply")
    done = run(clouds / "noise.ply", "--plane", "top=20,20,100,80")
    assert done.exit_code == 1
    assert "does the window show one plane?" in done.stdout
    assert done.stderr.splitlines()[-1].startswith("0 of 7 measurements; top flatness:")


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ((), "nothing to measure"),
        (("--plane", "top=1,2,3"), "NAME=COLUMN,ROW,WIDTH,HEIGHT"),
        (("--plane", "1,2,30,40"), "NAME=COLUMN,ROW,WIDTH,HEIGHT"),  # before, the whole cloud was measured
        (("--plane", "top=1,2,3,x"), "NAME=COLUMN,ROW,WIDTH,HEIGHT"),
        (("--plane", "top=1,2,0,4"), "width and height over 0"),
        (("--plane", "top=1.5,2,5,4"), "whole pixels"),
        (("--plane", "top=150,20,100,80"), "within 200 x 160 pixels"),
        (("--plane", "a", "--sphere", "a"), "a different name for each feature"),
        (("--plane", "a", "--angle", "a"), "NAME,NAME"),
        (("--plane", "a", "--angle", "a,b"), "'b'; allowed: a"),
        (("--dots", "p=-1"), "the pitch over 0"),
        (("--dots", "p=18.75"), "a cloud without images"),
        (("--scene", "part.xml"), "no --task"),
        (("--task", "task.toml"), "the scene of the task's part"),
        (("--against", "none.ply"), "no such file or folder"),
        (("--plane", "a", "--window", 1, 1, 5, 5), "no --against"),
        (("--plane", "a", "--by", "rays"), "no --against"),
        (("--plane", "a", "--by", "sight"), "auto, rays, surface"),
    ],
)
def test_what_cannot_be_asked_is_refused_with_what_can(options, match, clouds):
    with pytest.raises(InputError, match=match):
        run(clouds / "0.ply", *options)


def test_a_task_by_its_scene_and_the_pose_of_the_capture(scenes, tmp_path):
    folder = scenes / "two_pillars"
    sensor = load_sensor("ensenso-n10")
    scene = load_scene(folder / "matt_white.xml", sensor.wavelength_nm, {})
    pose = look_at([0, -450, 250], [0, 0, 0], [0, 0, 1]) @ sensor.rig.reference.sensor_from_camera.inverse()
    write_capture(
        SimulatedSensor(sensor).capture(scene, pose, rendering=Rendering(samples=4, depth=1), seed=1),
        tmp_path / "capture",
    )
    done = run(tmp_path / "capture", "--task", folder / "task.toml", "--scene", folder / "matt_white.xml", "--json")
    found = {one["name"]: one for one in json.loads(done.stdout)["clouds"][0]["measurements"]}
    gap = found["pillar1_pillar2_distance"]
    assert gap["value"] == pytest.approx(70.0, abs=0.5)
    assert 0.005 < gap["standard_uncertainty"] < 0.1
    assert gap["nominal"] == 70.0
    assert 0.8 * gap["points_given"] < gap["points"] <= gap["points_given"]
    assert "warning" not in done.stderr
    for per_mm in (1e-3, 0.1, 1 / 25.4, 1000):  # m, cm, inch and um: nothing is measured
        rows = pose.matrix()
        rows[:3, 3] *= per_mm
        np.savetxt(tmp_path / "pose.txt", rows)
        options = "--task", folder / "task.toml", "--scene", folder / "matt_white.xml", "--pose", tmp_path / "pose.txt"
        told = run(tmp_path / "capture", *options)
        assert told.exit_code == 1
        assert re.search(r"warning: \S+pose\.txt: by the pose the sensor is .* in mm\n", told.stderr)
    with pytest.raises(InputError, match="the pose of the sensor"):
        cloud = tmp_path / "cloud.ply"
        write_cloud(cloud_of(plane([0, 0, 500], [0, 0, -1])), cloud)
        run(cloud, "--task", folder / "task.toml", "--scene", folder / "matt_white.xml")
