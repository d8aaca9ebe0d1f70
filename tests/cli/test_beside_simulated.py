"""Figures of a recorded cloud beside those of a simulated sensor before the same targets."""

import json

import numpy as np
import pytest

from characterisation.cloud_files import write_cloud
from characterisation.features.fits import fit_plane, fit_sphere
from characterisation.features.surfaces import Plane
from characterisation.files.errors import InputError
from characterisation.region_of_interest import Roi
from characterisation.tasks.result import Result
from characterisation.tasks.windows import window_points
from mitsim.capture.folder import write_capture
from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.cli.simulated_beside import beside_table
from mitsim.scene import backend
from mitsim.scene.test_targets import plate
from mitsim.sensor.fitted_to import images_digest
from mitsim.sensor.preset import load_sensor
from mitsim.sensor.transforms import Transform
from mitsim.twin.compare.target_twin import Target, seen_target, simulated_target
from tests.seen_shapes import GRID, cloud_of, plane, sphere
from tests.shell import mitsim_here
from tests.smaller_sensors import coarse_sensor

NORMAL = np.array([0.25, -0.1, -1]) / np.linalg.norm([0.25, -0.1, -1])
WINDOW = Roi(40, 30, 120, 100)


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    backend.activate()
    return coarse_sensor("zivid-2-m70", 4, tmp_path_factory.mktemp("sensor"))


def test_the_twin_of_a_plane_is_where_the_plane_was_seen(small):
    recorded, sensor = cloud_of(plane([0, 0, 600], NORMAL)), load_sensor(small)
    target = seen_target("plane", WINDOW, recorded, "wall")
    cloud, window = simulated_target(target, recorded, sensor, "wall")
    found = fit_plane(window_points(window, cloud, "wall"), cloud.grid.origin)
    assert np.rad2deg(np.arccos(found.normal @ NORMAL)) < 0.1
    # noise of 0.2 mm over thousands of points
    middle = np.array([0, 0, 600]) - found.point
    assert abs(middle @ found.normal) < 0.3
    # both windows show the same part, but for the edge that is given up
    for side, focal, other in (("width", "fx", cloud.grid), ("height", "fy", cloud.grid)):
        expected = getattr(WINDOW, side) / getattr(GRID, focal) * getattr(other, focal)
        assert abs(getattr(window, side) - expected) < 9  # two pixels at each edge, and the tilt


def test_a_true_distance_replaces_the_recorded_plane():
    recorded = cloud_of(plane([0, 0, 603], [0, 0, -1]))
    surface = seen_target("plane", None, recorded, "wall", 600.0).surface
    assert surface.point.tolist() == [0, 0, 600]
    assert surface.normal.tolist() == [0, 0, -1]


def test_the_twin_of_a_ball_has_its_size_and_place(small):
    recorded = cloud_of(sphere([-20, 5, 500], 40))
    target = seen_target("sphere", None, recorded, "ball")
    cloud, window = simulated_target(target, recorded, load_sensor(small), "ball")
    found = fit_sphere(window_points(window, cloud, "ball"), cloud.grid.origin)
    assert np.linalg.norm(found.centre - [-20, 5, 500]) < 0.5
    assert abs(found.radius - 40) < 0.5


def test_a_target_beside_the_field_of_view_is_refused(small):
    recorded = cloud_of(plane([0, 0, 600], [0, 0, -1]))
    far = Plane(np.array([0.0, 3000.0, 600.0]), np.array([0.0, -1.0, 0.0]))
    with pytest.raises(InputError, match="outside the field of view of"):
        simulated_target(Target(far, Roi(0, 0, 4, 4)), recorded, load_sensor(small), "wall")


@pytest.mark.parametrize("distance", [150, 5000])
def test_a_target_that_the_decoder_does_not_search_has_no_twin(tmp_path, small, distance):
    """Before, a plane through the false points of the matcher, with a small uncertainty."""
    write_cloud(cloud_of(plane([0, 0, distance], [0, 0, -1])), tmp_path / "wall.ply")
    options = (tmp_path / "wall.ply", "--plane", "wall=40,30,120,100", "--simulated", small)
    document = json.loads(mitsim_here("measure", *options, "--json", code=None).stdout)["beside"]
    settings = load_sensor(small).settings
    searched = f"beyond {settings.near_mm:g} to {settings.far_mm:g} mm"
    assert all(result["value"] is None and searched in result["reason"] for result in document["simulated"])


@pytest.mark.parametrize("command", [["measure"], ["measure", "acceptance"]])
def test_one_command_states_both(tmp_path, small, rng, command):
    write_cloud(cloud_of(plane([0, 0, 600], [0, 0, -1]), 0.5, rng), tmp_path / "wall.ply")
    options = (tmp_path / "wall.ply", "--plane", "wall=40,30,120,100", "--simulated", small)
    document = json.loads(mitsim_here(*command, *options, "--json").stdout)["beside"]
    recorded, simulated = ({one["name"]: one for one in document[side]} for side in ("recorded", "simulated"))
    assert list(recorded) == list(simulated)
    assert recorded["wall F"]["value"] == 1.0
    assert recorded["wall sigma"]["value"] == pytest.approx(0.5, rel=0.05)
    assert 0.005 < simulated["wall sigma"]["value"] < 1
    assert simulated["wall F"]["value"] > 0.5
    table = mitsim_here(*command, *options).stdout
    assert "simulated / recorded" in table and "wall sigma" in table


def test_a_sensor_fitted_to_the_recording_is_told(tmp_path, small):
    """Before, the figures of a fit stood beside those of its own recording as if they predicted them."""
    sensor, wall = load_sensor(small), plate(2000.0, "matt white", 520.0)
    at = Transform(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 600.0]))
    captures = [SimulatedSensor(sensor).capture(wall, at, seed=seed) for seed in (1, 2)]
    for number, capture in enumerate(captures):
        write_capture(capture, tmp_path / f"wall_{number}")
    listed = f'fitted_to = [{{ name = "first wall", images_sha256 = "{images_digest(captures[0].images)}" }}]\n'
    (small.parent / "mine.toml").write_text(listed + small.read_text())
    write_cloud(cloud_of(plane([0, 0, 600], [0, 0, -1])), tmp_path / "wall.ply")
    told = []
    for name in ("wall_0", "wall_1", "wall.ply"):
        options = ("--plane", "wall=60,40,80,60", "--simulated", small.parent / "mine.toml")
        told.append(mitsim_here("measure", "acceptance", tmp_path / name, *options).stderr)
    assert "fitted to these images (first wall)" in told[0]
    assert "first wall" not in told[1]
    assert "fitted to first wall: if" in told[2]


def test_a_simulation_needs_a_target_and_a_grid(tmp_path, small):
    write_cloud(cloud_of(plane([0, 0, 600], [0, 0, -1])), tmp_path / "wall.ply")
    done = mitsim_here("measure", tmp_path / "wall.ply", "--picture", "a.png", "--simulated", small, code=2)
    assert "a plane or a sphere to simulate" in done.stderr


@pytest.mark.parametrize(("recorded", "ratio"), [(2.2e-13, "-"), (0.0, "-"), (0.2, "2.05"), (2e-4, "2.05e+03")])
def test_no_ratio_to_the_rounding_of_a_patch_in_one_step_of_depth(recorded, ratio):
    """The depths of an OAK's card have whole millimetres: in most patches all are equal, sigma is 2.2e-13 mm."""
    sigma = [Result("card sigma", "mm", value, 0.018, "fit") for value in (recorded, 0.41)]
    row = beside_table(sigma[:1], sigma[1:], "oak-d-pro").splitlines()[1]
    assert row.split()[-1] == ratio
