"""Many captures of a scene: the jobs of a plan, a start that goes on after kill -9, and the same bytes on a cluster."""

import json
import shutil
import time
from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner

from characterisation.files.errors import InputError
from mitsim.capture.folder import read_capture
from mitsim.cli.program import app
from mitsim.scene.surface.scatter import Deviation
from mitsim.sensor.noise_sources import Noise
from mitsim.sensor.preset import load_sensor
from mitsim.study.many_captures import CaptureSettings, ManyFile, _scene, _scenes, digest_of, read_jobs
from tests.quick_process import QuickProcess
from tests.smaller_sensors import coarse_sensor

ROOT = Path(__file__).resolve().parents[2]
SCENE = ROOT / "scenes/two_pillars/two_pillars.xml"
PLAN = """
captures = 5
[views]
subdivisions = 0
standoff_mm = 500
lowest_elevation_deg = 20
rolls_deg = [0, 90]
[[finishes]]
name = "ground_0.4"
parameters = { plane_Ra = 0.4, pillar_Ra = 0.4 }
[[finishes]]
name = "wide"
parameters = { plane_Ra = 0.8 }
deviation = "alpha=1"
"""
COMMON = CaptureSettings({"pillar_Ra": "0.6"}, "", 3, 1, 1, Noise(), False)
OPTIONS = ["--samples", "1", "--depth", "1", "--seed", "3"]


@pytest.fixture(scope="module")
def coarse(tmp_path_factory):
    """The sensor file of an N10 with a sixteenth of the pixels."""
    return coarse_sensor("ensenso-n10", 4, tmp_path_factory.mktemp("sensor"))


@pytest.fixture
def plan(tmp_path):
    (tmp_path / "plan.toml").write_text(PLAN)
    return tmp_path / "plan.toml"


def render(plan, output, *options):
    call = ["render", SCENE, "--many", plan, "-o", output, *OPTIONS, *options]
    done = CliRunner().invoke(app, [*map(str, call)])
    if done.exception is not None:
        raise done.exception
    return done.stderr


def files(folder):
    return {str(one.relative_to(folder)): one.read_bytes() for one in sorted(folder.rglob("*")) if one.is_file()}


def test_jobs_are_the_pairs_of_finish_and_view(plan, n10):
    plan.write_text(PLAN.replace("captures = 5\n", ""))
    jobs = read_jobs(plan, SCENE, n10, COMMON)
    views = {job.view for job in jobs}
    assert len(jobs) == 2 * len(views) == len({job.folder for job in jobs}) == len({job.settings.seed for job in jobs})
    first, last = jobs[0], jobs[-1]
    assert first.settings.parameters == {"pillar_Ra": "0.4", "plane_Ra": "0.4"} and not first.settings.deviation
    assert last.settings.parameters == {"pillar_Ra": "0.6", "plane_Ra": "0.8"} and last.settings.deviation == "alpha=1"
    assert len({job.digest() for job in jobs}) == len(jobs)
    plan.write_text(PLAN)
    drawn = read_jobs(plan, SCENE, n10, COMMON)
    assert len(drawn) == 5 and {job.digest() for job in drawn} < {job.digest() for job in jobs}


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('name = "wide"', 'name = "ground_0.4"', "different names"),
        ('name = "wide"', 'name = "../up"', "finishes"),
        ("plane_Ra = 0.8", "plain_Ra = 0.8", "plain_Ra"),
        ('"alpha=1"', '"alfa=1"', "found 'alfa'"),
        ("standoff_mm = 500", "standoff_mm = 5000", "working range"),
    ],
)
def test_a_plan_that_cannot_be_used_is_refused(plan, tmp_path, old, new, message):
    plan.write_text(PLAN.replace(old, new))
    with pytest.raises(InputError, match=message):
        render(plan, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_second_start_goes_on_after_kill_9(plan, tmp_path):
    process = QuickProcess("-m", "mitsim", "render", SCENE, "--many", plan, "-o", tmp_path / "killed", *OPTIONS)
    deadline = time.monotonic() + 120
    while len(list((tmp_path / "killed").glob("*/view_*"))) < 2 and time.monotonic() < deadline:
        time.sleep(0.005)
    process.kill()
    finished = sorted((tmp_path / "killed").glob("*/view_*"))
    assert 2 <= len(finished) < 5, "killed too late to show anything"
    for folder in finished:
        read_capture(folder)  # every checksum
    before = {folder: (folder / "capture.json").stat().st_mtime_ns for folder in finished}
    half = tmp_path / "killed/wide/.view_0001.partial-0123456789ab"  # as a kill in the midst of writing leaves it
    half.mkdir(parents=True)
    said = render(plan, tmp_path / "killed")
    assert f"{len(finished)} of 5 captures exist already" in said
    assert f"5, {5 - len(finished)} of them new" in said
    assert {folder: (folder / "capture.json").stat().st_mtime_ns for folder in finished} == before
    assert not half.exists()
    render(plan, tmp_path / "whole")
    assert files(tmp_path / "killed") == files(tmp_path / "whole")
    assert "5, all of them finished before" in render(plan, tmp_path / "whole")


def test_captures_of_another_plan_are_not_mixed_in(plan, tmp_path, coarse):
    plan.write_text(PLAN.replace("captures = 5", "captures = 1"))
    render(plan, tmp_path / "out", "--truth", "--sensor", coarse)
    (folder,) = (tmp_path / "out").glob("*/view_*")
    assert sorted(one.name for one in (folder / "truth").iterdir()) == ["left.exr", "right.exr"]
    settings = json.loads((folder / "settings.json").read_text())["many"]
    assert settings["finish"] == folder.parent.name and settings["scene"] == str(SCENE)
    before = files(tmp_path / "out")
    with pytest.raises(InputError, match="another scene, sensor or plan"):
        render(plan, tmp_path / "out", "--sensor", coarse)  # without the truth it is another
    with pytest.raises(InputError, match="neither --position nor --many"):
        CliRunner().invoke(app, ["render", str(SCENE), "-o", "x"], standalone_mode=False, catch_exceptions=False)
    assert files(tmp_path / "out") == before


def test_a_folder_with_json_nested_too_deep_holds_no_job(tmp_path):
    """Before, a RecursionError."""
    (tmp_path / "settings.json").write_text("[" * 100_000)
    assert digest_of(tmp_path) is None


def test_a_worker_gives_the_same_capture(plan, coarse):
    from mitsim.capture.simulated.simulate import SimulatedSensor
    from mitsim.study.many_captures import in_turn, take_job

    sensor = load_sensor(coarse)
    job = read_jobs(plan, SCENE, sensor, COMMON)[0]
    ((_, here),) = in_turn([job], SimulatedSensor(sensor))
    there = take_job(job)
    assert {"capture.json", "settings.json", "images/left_000.png"} <= here.keys()
    assert here == there


def test_a_worker_reads_a_scene_again_that_was_changed(plan, coarse, tmp_path):
    shutil.copytree(SCENE.parent, tmp_path / "scene")
    scene = tmp_path / "scene" / SCENE.name
    text, roughness = SCENE.read_text(), []
    for value in ("0.3", "0.6"):
        scene.write_text(text.replace('name="pillar_Ra" value="0.37"', f'name="pillar_Ra" value="{value}"'))
        job = read_jobs(plan, scene, load_sensor(coarse), replace(COMMON, parameters={}))[-1]
        loaded = _scene(job, dict(job.settings.parameters), Deviation())
        roughness.append({finish.roughness for finish in loaded.finishes})
    assert 0.3 in roughness[0] and 0.6 in roughness[1] and 0.3 not in roughness[1]
    scene.write_text(text)
    _scenes.clear()
    with pytest.raises(InputError, match="another content"):
        _scene(job, dict(job.settings.parameters), Deviation())


def test_smoothed_interreflections_are_part_of_the_job_and_of_its_capture(plan, coarse):
    from mitsim.study.many_captures import take_job

    sensor, deep = load_sensor(coarse), replace(COMMON, depth=2)
    (plain, *_), (smoothed, *_) = (
        read_jobs(plan, SCENE, sensor, settings) for settings in (deep, replace(deep, smoothing_px=1.5))
    )
    assert plain.digest() != smoothed.digest()
    settings = [json.loads(take_job(job)["settings.json"]) for job in (plain, smoothed)]
    assert "indirect_light" not in settings[0] and settings[1]["indirect_light"]["smoothing_px"] == 1.5


def test_finishes_have_a_default():
    file = ManyFile.model_validate({"views": {"subdivisions": 0}})
    assert [one.name for one in file.finishes] == ["as_drawn"] and file.captures is None
