"""``mitsim measure acceptance``: figures of planes and spheres whose errors are known."""

import json

import numpy as np
import pytest
from scipy.stats import norm

from characterisation.cloud_files import write_cloud
from characterisation.files.errors import InputError
from mitsim.cli.acceptance_request import Artefacts, joint_figures, read_artefacts
from tests.seen_shapes import GRID, cloud_of, plane, sphere
from tests.shell import mitsim_here

SIGMA = 0.05


def of(folder, *arguments, code=0):
    done = mitsim_here("measure", "acceptance", *arguments, "--json", code=code, cwd=folder)
    document = json.loads(done.stdout)
    lists = [one["measurements"] for one in document["clouds"]] + [document["all_clouds"]]
    return [{one["name"]: one for one in measured} for measured in lists]


@pytest.fixture
def walls(tmp_path, rng):
    """Four clouds of a wall that stands 3 mm behind 600 mm, with independent noise along the rays and a hole."""
    (tmp_path / "walls").mkdir()
    for number in range(4):
        distance = plane([0, 0, 603], [0, 0, -1])
        distance[:8] = np.nan
        write_cloud(cloud_of(distance, SIGMA, rng), tmp_path / f"walls/{number}.ply")
    return tmp_path


def test_a_wall_has_the_offset_the_noise_and_the_gap_that_it_was_made_with(walls):
    """The cut of 1 % of the depths leaves 0.962 sigma; a patch of 81 pixels and 30 000 of them give 1 % each."""
    *each, together = of(walls, "walls", "--plane", "wall=600", "--baseline", 50)
    assert len(each) == 4
    for one in each:
        assert one["wall fill rate"]["value"] == pytest.approx(95.0)
        assert one["wall Z accuracy"]["value"] == pytest.approx(0.5, abs=0.002)
        assert one["wall plane-fit RMS"]["value"] == pytest.approx(0.962 * SIGMA, rel=0.03)
        assert one["wall plane-fit RMS over distance"]["value"] == pytest.approx(100 * 0.962 * SIGMA / 603, rel=0.03)
        assert one["wall local planarity precision"]["value"] == pytest.approx(SIGMA, rel=0.05)
        assert one["wall sub-pixel RMS"]["value"] == pytest.approx(50 * 600 * 0.962 * SIGMA / 603**2, rel=0.06)
        # without the farthest 3 per mille the range is from -2.968 to 2.968 sigma, +- 1.1 %
        assert one["wall flatness error"]["value"] == pytest.approx(2 * 2.968 * SIGMA, rel=0.05)
        # it is known as well as the quantile of 0.15 % at either end: sqrt(2 * 0.0015 / n) over the density there
        scatter = np.sqrt(2 * 0.0015 / (152 * 200)) / norm.pdf(2.968) * SIGMA
        assert one["wall flatness error"]["standard_uncertainty"] == pytest.approx(scatter, rel=0.4)
        assert one["wall fill rate"]["points"] == 152 * 200 and one["wall fill rate"]["points_given"] == 160 * 200
    assert together["wall mean depth error"]["value"] == pytest.approx(0.5, abs=0.002)
    assert together["wall temporal noise"]["value"] == pytest.approx(SIGMA, rel=0.03)
    # noise of a mean of four; the 95th percentile of its absolute value is 1.96 standard deviations
    assert together["wall global planarity trueness"]["value"] == pytest.approx(1.96 * SIGMA / 2, rel=0.04)


@pytest.mark.parametrize("captures", [2, 3, 12])
def test_temporal_noise_does_not_depend_on_the_number_of_captures_or_on_gaps(captures, rng):
    distance = plane([0, 0, 603], [0, 0, -1])
    gaps = rng.random((captures, *distance.shape)) < 0.2
    clouds = [cloud_of(np.where(gap, np.nan, distance), SIGMA, rng) for gap in gaps]
    found = {result.name: result.value for result in joint_figures(clouds, Artefacts({"wall": (None, None)}, {}, []))}
    assert found["wall temporal noise"] == pytest.approx(SIGMA, rel=0.03)


def test_without_a_distance_or_repeats_there_are_no_figures_that_need_them(walls):
    only, together = of(walls, "walls/0.ply", "--plane", "wall=20,30,100,90")
    assert sorted(only) == [
        f"wall {what}"
        for what in (
            "fill rate",
            "flatness error",
            "local planarity precision",
            "plane-fit RMS",
            "plane-fit RMS over distance",
        )
    ]
    assert only["wall fill rate"]["value"] == 100.0 and together == {}


def test_spheres_have_the_errors_of_diameter_and_spacing_that_they_were_made_with(tmp_path):
    """Without noise: PS and SD are the differences from what is called calibrated, PF is rounding alone."""
    left, right = sphere([-35, 0, 450], 20), sphere([35, 0, 460], 25)
    write_cloud(cloud_of(np.where(np.arange(GRID.width) < 100, left, right)), tmp_path / "bar.ply")
    true = float(np.hypot(70, 10))
    found, _ = of(
        tmp_path,
        *("bar.ply", "--sphere", "a=0,0,100,160,39.9", "--sphere", "b=100,0,100,160,50.2"),
        *("--spacing", f"a,b,{true - 0.3}"),
    )
    assert found["a size error PS"]["value"] == pytest.approx(0.1, abs=1e-3)
    assert found["b size error PS"]["value"] == pytest.approx(-0.2, abs=1e-3)
    assert found["a-b spacing error SD"]["value"] == pytest.approx(0.3, abs=1e-3)
    assert 0 <= found["a form error PF"]["value"] < 1e-3


def test_the_table_names_figures_and_a_figure_that_cannot_be_is_told(walls, tmp_path):
    done = mitsim_here("measure", "acceptance", "walls", "--plane", "wall=600", cwd=walls)
    assert "all clouds" in done.stdout and "wall temporal noise" in done.stdout
    assert done.stderr.splitlines()[-1].startswith("27 of 27 measurements")
    done = mitsim_here("measure", "acceptance", "walls/0.ply", "--plane", "wall=0,0,50,5", code=1, cwd=walls)
    assert "not possible: 0 points in the window" in done.stdout
    done = mitsim_here("measure", "acceptance", "walls/0.ply", "--sphere", "ball=40", code=1, cwd=walls)
    assert "not possible: probing_error" in done.stdout


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ((["wall=1,2,3"], [], []), r"--plane: found 'wall=1,2,3'"),
        ((["wall=-600"], [], []), r"lengths over 0 mm"),
        ((["a=600"], ["a=30"], []), "a different name for each feature"),
        (([], ["ball"], []), r"--sphere: found 'ball'.*DIAMETER"),
        (([], ["ball=1,1,5,5"], []), "DIAMETER"),
        (([], ["a=30"], ["a,b,100"]), r"'a,b,100'; allowed: .*, a"),
        (([], ["a=30", "b=30"], ["a,a,100"]), "'a,a,100'; allowed: two different spheres"),
        (([], ["a=30", "b=30"], ["a,b"]), "NAME,NAME,DISTANCE"),
        (([], ["a=30", "b=30"], ["a,b,0"]), "lengths over 0 mm"),
    ],
)
def test_options_that_make_no_sense_are_refused_with_what_can_be_asked(options, match):
    with pytest.raises(InputError, match=match):
        read_artefacts(*options)


def test_nothing_asked_is_refused(walls):
    assert "--plane or --sphere" in mitsim_here("measure", "acceptance", "walls", code=2, cwd=walls).stderr


def test_a_plane_that_false_matches_turn_on_edge_has_no_figures(tmp_path, rng):
    """A twentieth of the points of a small window lies at up to four times the distance."""
    wall = plane([0, 0, 600], [0, 0, -1])
    wall = np.where(rng.random(wall.shape) < 0.05, wall * rng.uniform(1, 4, wall.shape), wall)
    write_cloud(cloud_of(wall), tmp_path / "wall.ply")
    only, _ = of(tmp_path, "wall.ply", "--plane", "wall=80,60,40,40,600", code=1)
    for name in ("plane-fit RMS", "Z accuracy"):
        assert only[f"wall {name}"]["value"] is None
        assert "stands on edge" in only[f"wall {name}"]["reason"]
    assert only["wall fill rate"]["value"] == 100.0
