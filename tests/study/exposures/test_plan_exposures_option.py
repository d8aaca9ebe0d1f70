"""`--plan-exposures` of `run`, `study state` and `study choose`: the same option, the same plan, and the same words."""

from __future__ import annotations

import json
import re
from pathlib import Path
from unittest import mock

import pytest
import typer.main

from mitsim.cli.program import app
from mitsim.running.time_limit import TimeLimit
from mitsim.study import open_study
from mitsim.study.exposures import exposure_plan, planned
from mitsim.study.reading import with_plan
from mitsim.study.session import Session
from tests.plain_pages import without_pictures
from tests.shell import mitsim_here
from tests.small_study import few_measurements, small_study
from tests.smaller_sensors import coarse_sensor

#: ground aluminium of Ra 0.37: from the side the N10's own exposure, 1.15 ms, is too short
FINISHES = "{ plane_Ra = 0.37, pillar_Ra = 0.37 }"
OWN_S = 0.00115
SAID = r"view {view}: expose (.* ms, (merged, )?at full power): every (other )?feature is at its limit with \d exposure"


# a tolerance that does not fit ends with 1
def invoked(*arguments):
    with without_pictures():
        return mitsim_here(*arguments, code=(0, 1))


def asked(renderer, view, rules, *_limit):
    """What a plan follows from: two that agree in it are the same to the last bit."""
    study = renderer.study
    light = {"scene", "parameters", "task", "seed", "unknowns", "measure", "exposure"}
    file = study.file.model_dump(mode="json", include=light)
    return file, study.sensor.name, view.number, view.world_from_sensor.matrix().tolist(), rules


class Plans:
    """Plans that were made, by what they follow from: a plan takes half of a command's time."""

    def __init__(self, plan_view):
        self.plan_view, self.made, self.taken_again = plan_view, [], 0

    def anew(self, *given):
        self.made.append((asked(*given), self.plan_view(*given)))
        return self.made[-1][1]

    def kept(self, *given):
        """The plan that was made of the same; a command that asks for another has to make it."""
        for known, plan in self.made:
            if known == asked(*given):
                self.taken_again += 1
                return plan
        return self.anew(*given)


@pytest.fixture(scope="module", autouse=True)
def quick_plans():
    """Plans of few noise samples and of exposures an octave apart: all commands plan by the same rules."""
    few = {exposure_plan.SEARCH: 1, exposure_plan.DECISION: 2, exposure_plan.REPORT: 2}
    with mock.patch.multiple(exposure_plan, DRAWS=few, STEP=2.0):
        yield


@pytest.fixture(scope="module")
def plans():
    return Plans(planned.plan_view)


@pytest.fixture(scope="module")
def chosen(tmp_path_factory, plans):
    """What `run --plan-exposures` left and said, and the number of the view that it stated."""
    folder = tmp_path_factory.mktemp("planned")
    (folder / "task.toml").write_text(few_measurements())
    (folder / "study.toml").write_text(small_study(FINISHES, coarse_sensor("ensenso-n10", 2, folder), "task.toml"))
    with mock.patch.object(planned, "plan_view", plans.anew):
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
    assert max(stated["exposure"]["exposures_s"]) > 1.3 * OWN_S


@pytest.mark.parametrize("command", ["state", "choose"])
def test_state_and_choose_plan_as_run_does(chosen, plans, command):
    """Of the same view the plan, and what is said of it, are the same; the statement holds for it.

    `study state` makes its plan anew. `choose` has to ask for the very plan that `run` made, and gets that.
    """
    folder, done, view = chosen
    more = ["--view", view] if command == "state" else ["--sensors", folder / "ensenso-n10.toml"]
    with mock.patch.object(planned, "plan_view", plans.anew if command == "state" else plans.kept):
        other = invoked("study", command, folder / "study.toml", *more, "--plan-exposures", "-o", folder / command)
    assert plans.taken_again == (command == "choose")
    where = folder / command / ("ensenso-n10" if command == "choose" else "")
    stated = statement_in(where)
    assert stated["view"] == view
    assert stated["exposure"] == statement_in(folder / "run")["exposure"]
    words = re.compile(SAID.format(view=view))
    assert words.search(other.stderr)[0] == words.search(done.stderr)[0]
    if command == "choose":
        captured = json.loads((folder / "choose/choice.json").read_text())["sensors"][0]["capture"]
        assert captured["exposures_s"] == stated["exposure"]["exposures_s"]


def test_a_plan_ends_with_its_time_holds_for_its_session_and_is_not_kept(chosen, capsys):
    folder, _, view = chosen
    study = open_study(folder / "study.toml")
    planned_study = with_plan(study, True)
    here = Session(planned_study, folder / "late")
    first = here.exposures(study.view(view), TimeLimit(0.0))
    assert "the only one that time allowed to try" in capsys.readouterr().err
    assert here.trials_of(study.view(view)).planned == first and not (folder / "late/exposures").exists()


def test_without_the_option_the_sensors_own_exposure_holds(chosen):
    folder, _, view = chosen
    done = invoked("study", "state", folder / "study.toml", "--view", view, "-o", folder / "own")
    assert "expose" not in done.stderr
    assert "exposure" not in statement_in(folder / "own")
    assert not (folder / "own/exposures").exists()


def test_exposures_that_the_study_gives_are_not_planned_again(chosen):
    folder, _, view = chosen
    (folder / "given.toml").write_text((folder / "study.toml").read_text() + "[exposure]\nexposures_s = [0.003]\n")
    done = invoked("study", "state", folder / "given.toml", "--view", view, "--plan-exposures", "-o", folder / "given")
    assert "expose" not in done.stderr
    assert statement_in(folder / "given")["exposure"] == {"exposures_s": [0.003], "power": 1.0}


def test_the_option_has_one_help_text():
    group = typer.main.get_command(app)
    texts = set()
    study = group.get_command(None, "study")
    for owner, name in ((group, "run"), (study, "state"), (study, "choose")):
        (option,) = [one for one in owner.get_command(None, name).params if "--plan-exposures" in one.opts]
        texts.add(option.help)
    assert len(texts) == 1
