"""`mitsim study choose` as users run it, with clouds drawn from the maps: table, page, sheet, and a second start."""

import json
import re
import shutil
import time
from functools import partial
from pathlib import Path
from unittest import mock

import pytest
import trimesh

from mitsim.running.time_limit import TimeLimit
from mitsim.study.choose import choose_sensor, read_candidates
from mitsim.study.choose.table import document
from mitsim.study.session import Session
from mitsim.views.scoring_time import FEWEST_VIEWS
from tests import shell
from tests.small_study import MEASUREMENTS, few_measurements
from tests.smaller_sensors import coarse_sensor

SCENES = Path(__file__).parents[2] / "scenes" / "two_pillars"

STUDY = f"""
scene = "{SCENES / "matt_white.xml"}"
task = "task.toml"
sensor = "ensenso-n10"
[views]
subdivisions = 0
standoff_mm = 500
lowest_elevation_deg = 20
[score]
light_path_depth = 1
[measure]
by = "map"
[race]
shortlist = 1
trials = 4
[statement]
trials = 16
"""

#: plus or minus, of radii and of the distance [mm]: ones that the better sensor holds, although it is judged by its map
#: alone, with all that maps do not know
RADIUS, DISTANCE = 8.0, 60.0


mitsim_here = partial(shell.mitsim_here, code=None)


@pytest.fixture(scope="module")
def chosen(tmp_path_factory):
    folder = tmp_path_factory.mktemp("choose")
    (folder / "study.toml").write_text(STUDY)
    task = re.sub(r"(nominal = 20.0)", rf"\1\ntolerance = {RADIUS}", few_measurements())
    task = re.sub(r"(nominal = 70.0)", rf"\1\ntolerance = {DISTANCE}", task)
    (folder / "task.toml").write_text(task)
    david = coarse_sensor("david-sls-3", 4, folder)
    arguments = ("study", "choose", folder / "study.toml", "--sensors", f"kinect-v2,{david}", "-o")
    return folder, arguments, mitsim_here(*arguments, folder / "out")


def test_sensors_are_listed_best_first_with_what_they_fit(chosen):
    folder, _, done = chosen
    assert done.returncode == 0, done.stderr
    choice = json.loads((folder / "out" / "choice.json").read_text())
    names = [one["name"] for one in choice["sensors"]]
    assert names == ["david-sls-3", "kinect-v2"]
    assert [line.split()[0] for line in done.stdout.splitlines()[1:3]] == names
    best, last = choice["sensors"][0], choice["sensors"][-1]
    assert best["status"] == "stated" and best["fits"] == len(MEASUREMENTS) and best["ratio"] <= 1
    assert last["status"] == "screened" and last["why"] == "fewer measurements possible"
    assert last["ratio"] == max(cell["demand"] for cell in last["measurements"].values() if cell["by"] != "none")
    assert "by screening, no view can make it" in last["words"]
    assert {cell["by"] for cell in last["measurements"].values()} == {"screening", "none"}
    for cell in best["measurements"].values():
        low, high = cell["accepted"]
        assert cell["verdict"] == "fits" and cell["trials"] == 16 and (low is None or low < high)
    assert best["capture"]["seconds"] == pytest.approx(best["capture"]["images"] * sum(best["capture"]["exposures_s"]))
    assert best["ratio"] == max(cell["demand"] for cell in best["measurements"].values())


def test_progress_names_the_leader_and_the_last_line_is_the_result(chosen):
    _, _, done = chosen
    lines = done.stderr.splitlines()
    assert any(re.match(r"choose: 2 of 2 screened; \S+ leads by the screening, at worst", line) for line in lines)
    assert any("leads measured" in line for line in lines)
    assert lines[-1] == "david-sls-3: fits 3 of 3 tolerances"


def test_a_finished_comparison_is_kept_and_overwritten_on_request_from_its_own_trials(chosen):
    folder, arguments, first = chosen
    before = (folder / "out" / "choice.json").read_bytes()
    again = mitsim_here(*arguments, folder / "out")
    assert again.returncode == 2 and "--overwrite" in again.stderr and "Traceback" not in again.stderr
    assert (folder / "out" / "choice.json").read_bytes() == before
    trials = {path: path.read_bytes() for path in (folder / "out").rglob("view_*.jsonl")}
    (folder / "out" / "kinect-v2" / "scores.nc").unlink()  # as if it had been killed there
    again = mitsim_here(*arguments, folder / "out", "--overwrite")
    assert again.returncode == 0 and again.stdout == first.stdout
    assert trials and {path: path.read_bytes() for path in (folder / "out").rglob("view_*.jsonl")} == trials
    assert "choose: kinect-v2," in again.stderr and "choose: david-sls-3," not in again.stderr


def test_page_and_sheet(chosen):
    folder, _, _ = chosen
    page = (folder / "out" / "choice.html").read_text()
    assert page.count("<svg") == 2 and "fits 3 of 3 tolerances" in page
    assert "screened only: fewer measurements possible" in page and "2 of 3 measurements possible" in page
    done = mitsim_here("report", folder / "out", "--pdf")
    assert done.returncode == 0, done.stderr
    sheet = (folder / "out" / "sheet.pdf").read_bytes()
    assert sheet.startswith(b"%PDF") and len(re.findall(rb"/Type /Page\b", sheet)) == 1


def test_the_best_sensor_is_exported_without_the_study(chosen, tmp_path, monkeypatch):
    folder, _, _ = chosen
    shutil.copytree(folder / "out", tmp_path / "moved")
    choice = json.loads((tmp_path / "moved" / "choice.json").read_text())
    monkeypatch.chdir(tmp_path)
    for name in ("study.toml", "task.toml"):
        (folder / name).rename(folder / f"away_{name}")
    try:
        for command, name in (("run", "out.glb"), ("results", "out.json"), ("results", "out.qif")):
            assert mitsim_here("export", command, "moved", "-o", name, cwd=tmp_path).returncode == 0
        options = ("--robot", "moveit", "-o", "out.yaml")
        assert mitsim_here("export", "targets", "moved", *options, cwd=tmp_path).returncode == 0
        assert mitsim_here("report", "moved/david-sls-3", cwd=tmp_path).returncode == 0
    finally:
        for name in ("study.toml", "task.toml"):
            (folder / f"away_{name}").rename(folder / name)
    best = choice["sensors"][0]
    said = json.loads((tmp_path / "out.json").read_text())
    common = best["poses"][0]
    assert said["sensor"] == best["name"] and [one["view"] for one in said["plan"]] == [common["view"]]
    assert said["plan"][0]["part_from_sensor"] == common["world_from_sensor"]
    for one in said["results"]:
        cell = best["measurements"][one["measurement"]]
        if cell["view"] == common["view"]:
            assert (one["uncertainty"], one["bias"]) == (cell["uncertainty"], cell["bias"])
    targets = re.findall(r"view_(\d+):", (tmp_path / "out.yaml").read_text())
    views = {cell["view"] for cell in best["measurements"].values()} | {common["view"]}
    assert int(targets[0]) == common["view"] and {*map(int, targets)} == views


@pytest.mark.parametrize(
    ("sensors", "told"),
    [("ensenso-n01", "ensenso-n10"), ("kinect-v2,kinect-v2", "twice"), ("", "all"), ("nobody.toml", "no such file")],
)
def test_sensors_that_are_none_are_one_message(chosen, sensors, told):
    folder, _, _ = chosen
    done = mitsim_here("study", "choose", folder / "study.toml", "--sensors", sensors, "-o", folder / "other")
    assert done.returncode == 2 and told in done.stderr and "Traceback" not in done.stderr


def test_screening_leaves_time_for_virtual_measurements_and_the_result_says_what_it_lacks(chosen, tmp_path):
    folder, _, _ = chosen
    study = (folder / "study.toml").read_text().replace("subdivisions = 0", "subdivisions = 1\nrolls_deg = [0, 90]")
    (tmp_path / "study.toml").write_text(study.replace('"task.toml"', f'"{folder / "task.toml"}"'))
    candidates, excluded = read_candidates(tmp_path / "study.toml", ["kinect-v2,zivid-2-plus-m60"])
    assert [(one.name, one.reason) for one in excluded] == [
        ("zivid-2-plus-m60", "no performance map of it comes with mitsim: make one, and give zivid-2-plus-m60=MAP")
    ]
    over = TimeLimit(1.0, time.monotonic() - 2.0)
    final = list[bool]()
    (result,) = choose_sensor(candidates, tmp_path / "out", over, lambda _, finished: final.append(finished))
    views = len(candidates[0].study.views)
    lacks = f"only {FEWEST_VIEWS} of {views} views screened, for lack of time"
    choice = document(candidates[0].study, [result], excluded, 1.0, True)
    entry = choice.sensors[0]
    assert not any(final) and not choice.finished  # the same command goes on
    assert views > FEWEST_VIEWS and entry.lacks == lacks and lacks in entry.words
    over = TimeLimit(1.0, time.monotonic() - 2.0)
    with mock.patch.object(Session, "screen", side_effect=AssertionError):  # the same time again: the views are kept
        (again,) = choose_sensor(candidates, tmp_path / "out", over, lambda *_: None)
    assert again.scores.attrs["views_scored"] == FEWEST_VIEWS
    (whole,) = choose_sensor(candidates, tmp_path / "out", TimeLimit(60.0), lambda _, end: final.append(end))
    assert final[-1] and document(candidates[0].study, [whole], excluded, 60.0, True).finished
    assert whole.scores.attrs["views_scored"] == views  # with more time, more views


def test_another_mesh_of_the_same_size_is_measured_anew(tmp_path):
    """Balls of 30 mm and 29 mm in a box of the same bounds: the text of the scene stays, and so do its views."""

    def ball(radius):
        mesh = trimesh.creation.icosphere(4, radius)
        mesh.apply_translation((0, 0, 30))
        mesh.export(tmp_path / "ball.ply", vertex_normal=True)

    def radius_error(name):
        candidates, _ = read_candidates(tmp_path / "study.toml", [str(tmp_path / "ensenso-n10.toml")])
        (result,) = choose_sensor(candidates, tmp_path / name, TimeLimit(60.0), lambda *_: None)
        return next(row[2].bias for row in result.best() if row is not None)

    coarse_sensor("ensenso-n10", 2, tmp_path)
    (tmp_path / "balls.xml").write_text(
        '<scene version="3.0.0"><bsdf type="matt_white" id="white"/>'
        '<shape type="cube" id="box"><transform name="to_world"><scale x="80" y="80" z="1"/></transform>'
        '<ref id="white"/></shape><shape type="cylinder" id="post"><point name="p0" x="70" y="0" z="0"/>'
        '<point name="p1" x="70" y="0" z="65"/><float name="radius" value="3"/><ref id="white"/></shape>'
        '<shape type="ply" id="ball"><string name="filename" value="ball.ply"/><ref id="white"/></shape></scene>'
    )
    (tmp_path / "task.toml").write_text(
        '[features.ball]\nkind = "sphere"\npoint_mm = [0, 0, 30]\nradius_mm = 30\n'
        '[measurements.radius]\nkind = "radius"\nfeatures = ["ball"]\nnominal = 30\nunit = "mm"\n'
    )
    (tmp_path / "study.toml").write_text(
        STUDY.replace(f"{SCENES / 'matt_white.xml'}", "balls.xml").replace('"ensenso-n10"', '"ensenso-n10.toml"')
    )
    ball(30)
    large = radius_error("kept")
    ball(29)
    small = radius_error("kept")
    assert small == radius_error("new") != large
