"""`--plan-exposures` of `run`, `budget` and `choose`: the same option, the same plan, and the same words."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
import typer.main
from typer.testing import CliRunner

from mitsim.cli import app

SCENES = Path(__file__).parents[2] / "scenes" / "two_pillars"

#: ground aluminium of Ra 0.37: from the side the N10's own exposure, 1.15 ms, is too short
STUDY = f"""
scene = "{SCENES / "two_pillars.xml"}"
parameters = {{ plane_Ra = 0.37, pillar_Ra = 0.37 }}
task = "{SCENES / "task.toml"}"
sensor = "ensenso-n10"
[views]
subdivisions = 0
lowest_elevation_deg = 20
[score]
light_path_depth = 1
[measure]
light_path_depth = 1
[race]
shortlist = 1
trials = 4
[statement]
trials = 2
pairs = 0
[check]
views = 0
"""
OWN_S = 0.00115
SAID = r"view {view}: expose (.* ms, at full power): every (other )?feature is at its limit with 1 exposure"


def invoked(*arguments):
    done = CliRunner().invoke(app, list(map(str, arguments)))
    assert done.exception is None or isinstance(done.exception, SystemExit), (done.output, done.exception)
    assert done.exit_code in (0, 1), done.output
    return done


@pytest.fixture(scope="module")
def chosen(tmp_path_factory):
    """What `run --plan-exposures` left and said, and the number of the view that it stated."""
    folder = tmp_path_factory.mktemp("planned")
    (folder / "study.toml").write_text(STUDY)
    done = invoked("run", folder / "study.toml", "--plan-exposures", "-o", folder / "run")
    return folder, done, json.loads((folder / "run/statement.json").read_text())["view"]


def statement_in(folder: Path) -> dict:
    return json.loads((folder / "statement.json").read_text())


def test_run_states_its_view_with_the_planned_exposure(chosen):
    folder, done, view = chosen
    said = re.search(SAID.format(view=view), done.stderr)
    assert said, done.stderr
    stated = statement_in(folder / "run")
    plan = json.loads((folder / f"run/exposures/view_{view:04d}.json").read_text())
    assert stated["exposure"] == {"exposures_s": plan["exposures_s"], "power": plan["power"]}
    assert stated["exposure"]["exposures_s"][0] > 1.3 * OWN_S


@pytest.mark.parametrize("command", ["budget", "choose"])
def test_budget_and_choose_plan_as_run_does(chosen, command):
    """Of the same view the plan, and what is said of it, are the same; the statement holds for it."""
    folder, done, view = chosen
    more = ["--view", view] if command == "budget" else ["--sensors", "ensenso-n10"]
    other = invoked(command, folder / "study.toml", *more, "--plan-exposures", "-o", folder / command)
    where = folder / command / ("ensenso-n10" if command == "choose" else "")
    stated = statement_in(where)
    assert stated["view"] == view
    assert stated["exposure"] == statement_in(folder / "run")["exposure"]
    words = re.compile(SAID.format(view=view))
    assert words.search(other.stderr)[0] == words.search(done.stderr)[0]
    if command == "choose":
        captured = json.loads((folder / "choose/choice.json").read_text())["sensors"][0]["capture"]
        assert captured["exposures_s"] == stated["exposure"]["exposures_s"]


def test_without_the_option_the_sensors_own_exposure_holds(chosen):
    folder, _, view = chosen
    done = invoked("budget", folder / "study.toml", "--view", view, "-o", folder / "own")
    assert "expose" not in done.stderr
    assert "exposure" not in statement_in(folder / "own")
    assert not (folder / "own/exposures").exists()


def test_exposures_that_the_study_gives_are_not_planned_again(chosen):
    folder, _, view = chosen
    (folder / "given.toml").write_text(STUDY + "[exposure]\nexposures_s = [0.003]\n")
    done = invoked("budget", folder / "given.toml", "--view", view, "--plan-exposures", "-o", folder / "given")
    assert "expose" not in done.stderr
    assert statement_in(folder / "given")["exposure"] == {"exposures_s": [0.003], "power": 1.0}


def test_the_option_has_one_help_text():
    group = typer.main.get_command(app)
    texts = set()
    for name in ("run", "budget", "choose"):
        (option,) = [one for one in group.get_command(None, name).params if "--plan-exposures" in one.opts]
        texts.add(option.help)
    assert len(texts) == 1
