"""Rounds of a comparison: which sensors can still win, and from which view each is stated; nothing is rendered."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr

from characterisation.files.errors import InputError
from characterisation.statements.statement import statement
from characterisation.statements.tolerance import plus_minus
from mitsim.study import StatementTable
from mitsim.study.choose import read_candidates, rounds
from mitsim.study.choose.rounds import able_to_win, race_and_state, state_by_screening
from mitsim.study.choose.sensor_result import SensorResult
from mitsim.study.virtual.race import ALL
from mitsim.study.virtual.stated import StatedView
from tests.small_study import MEASUREMENTS, few_measurements, small_study
from tests.smaller_sensors import coarse_sensor

MOST = 96

LIMIT = SimpleNamespace(over=lambda: False, part=lambda *_: LIMIT)


@pytest.fixture(scope="module")
def candidates(tmp_path_factory):
    """Three sensors, each measurement with a tolerance of 1."""
    folder = tmp_path_factory.mktemp("rounds")
    (folder / "task.toml").write_text(few_measurements())
    (folder / "study.toml").write_text(small_study("{ }", task="task.toml"))
    made = read_candidates(folder / "study.toml", ["ensenso-n10,kinect-v2,zivid-2-m70"])[0]
    return [replace(one, study=with_tolerances(one.study)) for one in made]


def with_tolerances(study):
    asked = {name: one.model_copy(update={"tolerance": 1.0}) for name, one in study.task.measurements.items()}
    file = study.file.model_copy(update={"statement": StatementTable(trials=MOST)})
    return replace(study, task=study.task.model_copy(update={"measurements": asked}), file=file)


def stated_view(view, spread, trials=24):
    """Statements of errors of a standard deviation; no value where it is infinite."""
    errors = np.linspace(-1, 1, trials)
    errors = errors / errors.std(ddof=1) * spread if math.isfinite(spread) else np.full(trials, np.nan)
    return StatedView(view, [statement(name, "mm", errors, plus_minus(0.0, 1.0)) for name in MEASUREMENTS], None)


def result(candidate, spread, *, raced, trials=24):
    session = SimpleNamespace(study=candidate.study)
    none = np.zeros(len(MEASUREMENTS))
    one = SensorResult(candidate, session, xr.Dataset(), none, none, none.astype(int))
    one.stated[0] = stated_view(candidate.study.views[0], spread, trials)
    one.raced = SimpleNamespace(views=np.array([0])) if raced else None
    return one


def test_a_sensor_with_a_race_to_come_can_still_win_with_a_larger_error(candidates):
    def able(first, second):
        found = [result(candidates[0], 0.1, **first), result(candidates[1], **second)]
        return [one.candidate.name for one in able_to_win(found, found)]

    names = [one.name for one in candidates[:2]]
    raced, unraced = {"raced": True}, {"raced": False}
    assert able(raced, {"spread": 0.12, **raced}) == names
    assert able(raced, {"spread": 0.5, **raced}) == names[:1]
    assert able(raced, {"spread": 0.5, **unraced}) == names
    assert able(raced, {"spread": 5.0, **unraced}) == names[:1]
    assert able(raced, {"spread": math.inf, **raced}) == names[:1]
    assert able(raced, {"spread": math.inf, **unraced}) == names  # another view may have a value
    assert able({"trials": MOST, **raced}, {"spread": 0.5, **raced}) == []  # the leader has all of its trials


class _Session:
    """A session whose views have errors of known standard deviations."""

    def __init__(self, candidate, folder, spreads, leader):
        self.study, self.folder, self.spreads, self.asked = candidate.study, folder, spreads, []
        risk = np.array(list(spreads.values()))
        standing = SimpleNamespace(leader=list(spreads).index(leader), risk=risk)
        self.raced = SimpleNamespace(
            views=np.array(list(spreads)),
            standings=dict.fromkeys([ALL, *MEASUREMENTS], standing),
            leader=lambda name: leader,
        )

    def race(self, *_):
        return self.raced

    def state(self, view, table, limit):
        self.asked.append((view.number, table.trials))
        return stated_view(view, self.spreads[view.number], 2 if limit.over() else table.trials)

    def release(self):
        pass


@pytest.mark.parametrize(("won", "better"), [(0.05, 1), (0.3, 0)])
def test_the_view_of_the_race_replaces_that_of_the_screening_if_its_statement_is_better(
    candidates, tmp_path, monkeypatch, won, better
):
    monkeypatch.setattr(rounds, "shortlist", lambda *_: [0])
    monkeypatch.setattr(rounds, "_finish", lambda *_: None)
    one = result(candidates[0], 1.0, raced=False)
    one.stated, one.session = {}, _Session(candidates[0], tmp_path, {0: 0.1, 1: won}, leader=1)
    state_by_screening(one, 24, LIMIT, LIMIT)
    assert list(one.stated) == [0] and one.raced is None
    race_and_state(one, 48, LIMIT)
    assert next(iter(one.stated)) == better and one.raced is one.session.raced
    race_and_state(one, 96, LIMIT)
    assert one.session.asked == [(0, 24), (1, 48), (better, 96)]


def test_a_sensor_whose_share_ends_early_gets_a_few_trials(candidates, tmp_path, monkeypatch):
    monkeypatch.setattr(rounds, "shortlist", lambda *_: [0])
    monkeypatch.setattr(rounds, "_finish", lambda *_: None)
    one, short = result(candidates[0], 1.0, raced=False), SimpleNamespace(over=lambda: True)
    one.stated, one.session = {}, _Session(candidates[0], tmp_path, {0: 0.1, 1: 0.1}, leader=1)
    state_by_screening(one, 24, short, LIMIT)
    assert one.session.asked == [(0, 24), (0, 4)] and one.trials == 4


def test_the_sensor_file_of_the_study_keeps_the_map_of_the_study(tmp_path, monkeypatch):
    """Before, a path was compared as text: the map was dropped, and a name was taken relative to another folder."""
    sensor = coarse_sensor("ensenso-n10", 3, tmp_path)
    study = small_study("{ }", sensor.name) + '[characterisation]\nmap = "ensenso-n10"\n'
    (tmp_path / "study.toml").write_text(study)
    (opened,), excluded = read_candidates(tmp_path / "study.toml", [str(sensor)])
    assert not excluded and opened.study.performance_map is not None
    monkeypatch.chdir(tmp_path.parent)
    with pytest.raises(InputError, match="no such file"):
        read_candidates(tmp_path / "study.toml", [sensor.name])
