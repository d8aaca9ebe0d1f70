"""`mitsim study state` as its user runs it: the statement of one view, stopped and started again."""

import json
import re
from functools import partial
from pathlib import Path

import pytest

from tests import shell
from tests.small_study import MEASUREMENTS, few_measurements
from tests.smaller_sensors import coarse_sensor

SCENES = Path(__file__).parents[2] / "scenes" / "two_pillars"

STUDY = f"""
scene = "{SCENES / "matt_white.xml"}"
task = "task.toml"
sensor = "ensenso-n10.toml"
[views]
subdivisions = 0
lowest_elevation_deg = 20
[measure]
light_path_depth = 1
[statement]
trials = 4
"""


mitsim_here = partial(shell.mitsim_here, code=None)


@pytest.fixture(scope="module")
def stated(tmp_path_factory):
    folder = tmp_path_factory.mktemp("statement")
    (folder / "study.toml").write_text(STUDY)
    coarse_sensor("ensenso-n10", 2, folder)
    task = few_measurements()
    place = task.index("[measurements.pillar1_radius]")
    (folder / "task.toml").write_text(
        task[:place] + task[place:].replace("nominal = 20.0", "nominal = 20.0\ntolerance = 1e-6", 1)
    )
    done = mitsim_here("study", "state", folder / "study.toml", "--view", 1, "-o", folder / "out", "--require-fit")
    return folder, done


def test_a_statement_on_stdout_and_in_a_file(stated):
    folder, done = stated
    assert done.returncode == 1, done.stderr  # a micrometre of a micrometre is not held
    lines = [line for line in done.stdout.splitlines() if not line.startswith("no value in")]
    assert lines[0].startswith("measurement") and len(lines) == 1 + len(MEASUREMENTS)
    last = done.stderr.splitlines()[-1]
    told = r"fits 0 of 1 tolerances; pillar1_radius is undecidable: standard uncertainty [\d.]+ mm, [\d.]+ mm needed"
    assert re.match(told, last)
    document = json.loads((folder / "out" / "statement.json").read_text())
    assert document["view"] == 1 and document["measured_by"] == "render"
    assert set(document["measurements"]) == {line.split()[0] for line in lines[1:]}
    assert document["measurements"]["pillar1_radius"]["verdict"] == "undecidable"
    assert document["measurements"]["pillar1_radius"]["decision"]["accepted"] is None
    assert any(not one["included"] for one in document["influences"])


def test_a_second_start_goes_on_and_ends_in_the_same_bytes(stated):
    folder, _ = stated
    statement = folder / "out" / "statement.json"
    before = statement.read_bytes()
    trials = folder / "out" / "trials" / "view_0001.jsonl"
    whole = trials.read_bytes()
    trials.write_bytes(b"".join(whole.splitlines(keepends=True)[:3]) + b'{"day": 10485')  # as a kill leaves it
    statement.unlink()
    again = mitsim_here("study", "state", folder / "study.toml", "--view", 1, "-o", folder / "out")
    assert again.returncode == 0  # an answer, though no fit
    assert statement.read_bytes() == before
    assert sorted(trials.read_bytes().splitlines()) == sorted(whole.splitlines())


def test_a_view_that_is_none_is_one_message(stated):
    folder, _ = stated
    done = mitsim_here("study", "state", folder / "study.toml", "--view", 999, "-o", folder / "other")
    assert done.returncode == 2 and "--view" in done.stderr and "Traceback" not in done.stderr
