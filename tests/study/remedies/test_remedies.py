"""Changes that would make measurements fit: bounds by the budget, the order of trials, and their words."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.stats import norm

from characterisation.files.documents import read_toml
from characterisation.files.errors import InputError
from characterisation.statements.budget import BudgetLine
from characterisation.statements.decision import demand
from characterisation.statements.statement import Statement, statement
from characterisation.statements.tolerance import plus_minus
from characterisation.tasks.decision_table import Decision
from mitsim.running.time_limit import TimeLimit
from mitsim.study import Study, open_study
from mitsim.study.remedies import changes as proposals
from mitsim.study.remedies.bounds import EXPOSURE, Effect, can_fit, least_shares, least_uncertainty
from mitsim.study.remedies.change import Change, Shortfall, changed_file, session_of_views
from mitsim.study.remedies.changes import changes
from mitsim.study.remedies.confirm import Remedies, find_remedies, of_missed, remedies_document
from mitsim.study.remedies.entries import MissedEntry, RemediesEntry, UntriedChange, remedies_in_words
from mitsim.study.remedies.sensors import _with_sensor
from mitsim.study.session import Session
from mitsim.study.tables import StudyFile
from mitsim.views import View
from tests.two_balls import TASK

#: equally likely errors of a standard normal distribution
NORMAL = norm.ppf((np.arange(200) + 0.5) / 200)


def stated(name: str, u: float, bias: float = 0.0, tolerance: float = 1.0, count: int = 200) -> Statement:
    """A statement from errors of a normal distribution, in a random order."""
    errors = bias + u * np.random.default_rng(1).permutation(norm.ppf((np.arange(count) + 0.5) / count))
    return statement(name, "mm", errors, plus_minus(20.0, tolerance))


def with_budget(one: Statement, **shares: float) -> Statement:
    """The statement with a budget of shares of its variance, exactly known."""
    lines = [
        BudgetLine(group, share * one.standard_uncertainty**2, 0.0, share * one.standard_uncertainty**2, share, (0, 1))
        for group, share in shares.items()
    ]
    return replace(one, budget=tuple(lines))


def test_a_change_leaves_the_variance_of_the_groups_that_it_does_not_touch() -> None:
    one = with_budget(stated("radius", 0.5), calibration=0.64, noise=0.3, light=0.06)
    u = one.standard_uncertainty
    assert least_uncertainty(one, Effect({"calibration": 0.0})) == pytest.approx(0.6 * u)
    assert least_uncertainty(one, Effect({"calibration": 0.5})) == pytest.approx(u * math.sqrt(1 - 0.75 * 0.64))
    assert least_uncertainty(one, Effect({"form": 0.0})) == pytest.approx(u)
    assert least_uncertainty(replace(one, budget=()), Effect({"form": 0.0})) == 0


def test_a_bias_that_the_rule_subtracts_excludes_no_change() -> None:
    errors = 1 + 0.1 * NORMAL
    one = statement("m", "mm", errors, plus_minus(70.0, 0.5, Decision(subtract_bias=True)))
    assert can_fit(one, 0.05, unbiased=False) and not can_fit(one, 0.08, unbiased=False)
    assert not can_fit(statement("m", "mm", errors, plus_minus(70.0, 0.5)), 0.05, unbiased=False)


def test_an_uncertain_line_of_the_budget_counts_with_its_high_end() -> None:
    one = stated("radius", 0.5)
    u2 = one.standard_uncertainty**2
    unsure = replace(one, budget=(BudgetLine("calibration", 0.2 * u2, 0.0, 0.96 * u2, 0.2, (0.0, 0.96), False),))
    assert least_uncertainty(unsure, Effect({"calibration": 0.0})) == pytest.approx(0.2 * one.standard_uncertainty)


def test_a_line_that_stays_counts_with_its_low_end_however_wide_the_others_are() -> None:
    one = stated("radius", 0.5)
    u2 = one.standard_uncertainty**2
    lines = [BudgetLine("calibration", 0.8 * u2, 0.49 * u2, u2, 0.8, (0.49, 1.0))]
    lines += [BudgetLine(name, 0.1 * u2, 0.0, 0.6 * u2, 0.1, (0.0, 0.6), False) for name in ("noise", "light")]
    wide = replace(one, budget=tuple(lines))
    assert least_uncertainty(wide, EXPOSURE) == pytest.approx(0.7 * one.standard_uncertainty)


@pytest.mark.parametrize("rule", ["iso_14253_1", "simple_acceptance"])
@pytest.mark.parametrize("bias", [0.0, 0.06, 0.3])
@pytest.mark.parametrize("ratio", [0.1, 0.2, 0.35, 0.8])
def test_the_bound_agrees_with_the_decision_rule_on_scaled_errors(rule: str, bias: float, ratio: float) -> None:
    tolerance = plus_minus(20.0, 1.0, Decision(rule=rule))
    errors = bias + 0.4 * NORMAL
    one = statement("radius", "mm", errors, tolerance)
    u = ratio * one.standard_uncertainty
    assert can_fit(one, u, unbiased=False) == (demand(bias + ratio * (errors - bias), tolerance) <= 1)
    assert can_fit(one, u, unbiased=True) == (demand(ratio * (errors - bias), tolerance) <= 1)


def test_only_changes_that_can_give_values_help_a_measurement_without_any() -> None:
    lost = statement("radius", "mm", np.full(40, math.nan), plus_minus(20.0, 1.0))
    assert can_fit(lost, 0.0, unbiased=True)
    assert not can_fit(lost, 0.0, unbiased=False)


def test_the_largest_share_of_a_group_that_suffices() -> None:
    one = with_budget(stated("radius", 0.22), calibration=1.0)  # half of it is below the 0.12 that is needed
    assert least_shares(one, "calibration", (0.5, 0.25, 0.125)) == 0.5
    half = with_budget(stated("radius", 0.22), calibration=0.5, noise=0.5)
    assert least_shares(half, "calibration", (0.5, 0.25, 0.125)) is None


class Fake:
    """A change after which measurements have given uncertainties; it notes the trials that are asked for."""

    def __init__(self, kind: str, expected: tuple[str, ...], error: str = "", **u: float) -> None:
        self.u, self.error, self.asked = u, error, list[int]()
        least, own = dict.fromkeys(expected, 0.0), kind != "bias"
        self.change = Change(kind, f"with {kind}", {}, (1,), least, self.state, needs_trials=own)

    def state(self, count: int, _limit: TimeLimit) -> list[Statement]:
        if self.error:
            raise InputError("study.toml", "", self.error, "another")
        self.asked.append(count)
        return [stated(name, u, count=count) for name, u in self.u.items()]


def missed(*names: str) -> dict[str, Statement]:
    return {name: stated(name, 0.8) for name in names}


def untried(found: Remedies) -> dict[str, list[str]]:
    return {one.words: one.measurements for one in found.untried}


def test_the_least_effort_is_tried_first_and_no_change_for_a_measurement_that_fits_already() -> None:
    view = Fake("view", ("a", "b"), a=0.02, b=0.7)
    spray = Fake("spray", ("a",), a=0.01, b=0.01)
    sensor = Fake("sensor", ("a", "b"), a=0.01, b=0.02)
    never = Fake("calibration", ("b",), b=0.01)
    found = find_remedies(missed("a", "b"), [one.change for one in (view, spray, sensor, never)], 40)
    assert [one.change.kind for one in found.tried] == ["view", "sensor"]
    assert not spray.asked and not never.asked and not found.open
    document = RemediesEntry.model_validate(remedies_document(found))
    assert {name: one.fits_by for name, one in document.measurements.items()} == {"a": 0, "b": 1}
    first, second = remedies_in_words(document)
    assert first == "with view: a (u 0.020 mm, before 0.80 mm) fits (40 virtual measurements)"
    assert second == "with sensor: b (u 0.020 mm, before 0.80 mm) fits (40 virtual measurements)"


def test_a_quarter_of_the_trials_excludes_a_hopeless_change_and_more_decide_a_good_one() -> None:
    hopeless, good = Fake("view", ("a",), a=0.9), Fake("spray", ("a",), a=0.02)
    find_remedies(missed("a"), [hopeless.change, good.change], 40)
    assert hopeless.asked == [10]
    assert good.asked == [10, 40]
    near = Fake("view", ("a",), a=0.11)  # 0.128 is needed: the interval of the demand of 40 trials contains 1
    find_remedies(missed("a"), [near.change], 40)
    assert near.asked == [10, 40, 160]
    missing = Fake("view", ("a",), a=0.14)  # open after ten trials, but a third above the demand of a fit
    assert stated("a", 0.14, count=10).verdict == "not decided"
    find_remedies(missed("a"), [missing.change], 40)
    assert missing.asked == [10]


def test_an_impossible_change_is_reported_and_the_next_one_tried() -> None:
    wrong, good = Fake("exposure", ("a",), "exposures cannot be merged"), Fake("spray", ("a",), a=0.02)
    found = find_remedies(missed("a"), [wrong.change, good.change], 40)
    assert "cannot be merged" in remedies_document(found)["impossible"][0]["reason"]
    assert [one.change.kind for one in found.tried] == ["spray"]


def test_without_time_nothing_is_confirmed_and_the_changes_are_named() -> None:
    good = Fake("spray", ("a",), a=0.02)
    found = find_remedies(missed("a"), [good.change], 40, TimeLimit(0.0))
    assert not good.asked and found.open == ["a"]
    lines = remedies_in_words(RemediesEntry.model_validate(remedies_document(found)))
    assert lines == ["not tried for lack of time: with spray; with another sensor"]


def test_a_change_that_time_cannot_confirm_takes_none() -> None:
    """Of a part of two million pixels, a change took 72 s and had seven trials: the statement stayed at thirteen."""
    spray, bias = Fake("spray", ("a",), a=0.02), Fake("bias", ("a",), a=0.7)
    found = find_remedies(missed("a"), [bias.change, spray.change], 40, TimeLimit(60.0), trial_s=8.0)
    assert bias.asked and not spray.asked and untried(found) == {"with spray": ["a"]}
    # half of the time is too short for the fewest: it had none, though all of the time suffices
    find_remedies(missed("a"), [spray.change], 40, TimeLimit(60.0), trial_s=5.0)
    assert spray.asked


def test_a_longer_statement_takes_remedies_away_and_names_what_was_not_tried() -> None:
    spray = Fake("spray", ("a", "b"), a=0.02, b=0.02, c=0.02)
    found = find_remedies(missed("a", "b"), [spray.change], 40)
    assert of_missed(found, {}) is None and of_missed(None, {}) is None
    longer = of_missed(found, missed("c", "d"))  # the change was not chosen for c, and helps it
    assert longer is not None
    assert remedies_in_words(RemediesEntry.model_validate(remedies_document(longer))) == [
        "with spray: c (u 0.020 mm, before 0.80 mm) fits (40 virtual measurements)",
        "not tried for lack of time: any change",
    ]


def test_the_nearest_of_insufficient_changes_is_named() -> None:
    far, near = Fake("view", ("a",), a=0.9), Fake("spray", ("a",), a=0.4)
    lines = remedies_in_words(
        RemediesEntry.model_validate(remedies_document(find_remedies(missed("a"), [far.change, near.change], 40)))
    )
    a = "a (u 0.40 mm, before 0.80 mm, 0.12 mm needed)"
    assert lines == [f"{a}: none of 2 changes tried suffices; nearest is with spray"]
    worse, worst = Fake("view", ("a",), a=0.9), Fake("spray", ("a",), a=1.4)
    lines = remedies_in_words(
        RemediesEntry.model_validate(remedies_document(find_remedies(missed("a"), [worse.change, worst.change], 40)))
    )
    assert lines == ["a (u 0.80 mm, 0.12 mm needed): none of 2 changes tried helps"]
    nothing = RemediesEntry.model_validate(remedies_document(Remedies(missed("a"))))
    assert remedies_in_words(nothing) == ["a: by its budget, no single change that mitsim knows suffices"]


def test_the_keys_of_the_bias_name_every_decision_that_they_change() -> None:
    """Before, the measurement kept its own decision in a task with these keys."""
    one = stated("radius", 0.05, bias=2.0)
    measurement = TASK.measurements["radius"].model_copy(update={"decision": Decision()})
    for own in ({}, {"radius": measurement}):
        task = TASK.model_copy(update={"measurements": TASK.measurements | own})
        view = SimpleNamespace(view=SimpleNamespace(number=1), statements=[one])
        now = SimpleNamespace(study=SimpleNamespace(task=task), session=None, stated=view, missed={"radius": one})
        keys = next(changes(cast(Shortfall, now))).keys
        changed = {"decision": {"subtract_bias": True}}
        assert keys == changed | ({"measurements": {"radius": changed}} if own else {})


@pytest.mark.parametrize(("short", "first"), [(False, "views"), (True, "spray")])
def test_the_spray_comes_before_other_views_if_time_is_short(
    short: bool, first: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a bare part with --minutes 5, views and a standoff took seven eighths of the time: it was never tried."""

    def proposal(kind: str) -> Callable[[Shortfall], Iterator[Change]]:
        return lambda _: iter([Fake(kind, ("a",)).change])

    for name in ("bias", "views", "nearer", "spray", "exposure", "repeats", "room", "fresh_calibration"):
        monkeypatch.setattr(proposals, f"_{name}", proposal(name))
    for name in ("several_views", "temperature", "better_calibration", "decoder"):
        monkeypatch.setattr(proposals, f"_{name}", lambda _: iter(()))
    kinds = [one.kind for one in changes(cast(Shortfall, None), short)]
    assert kinds[:2] == ["bias", first]
    assert sorted(kinds) == sorted(one.kind for one in changes(cast(Shortfall, None)))


@pytest.mark.parametrize(("sensor", "share"), [("zivid-2-m70", 0.25), ("ensenso-n10", 1.0)])
def test_other_views_that_a_remedy_tries_have_fewer_paths_of_fringes(sensor: str, share: float, tmp_path: Path) -> None:
    path = Path("scenes/two_pillars/tolerances.toml")
    file = read_toml(path, StudyFile).model_copy(update={"sensor": sensor})
    session = Session(open_study(path, file, mapped=False), tmp_path)
    others = session_of_views(session, tmp_path / "view")
    stated, tried = session.renderer, others.renderer
    assert stated is not None and tried is not None
    assert tried.rendering.kept.kept == share * stated.rendering.kept.kept
    assert tried.rendering.kept.samples == share * stated.rendering.kept.samples
    assert tried.simulated is stated.simulated, "prepared once"
    assert (others.digest == session.digest) == (share == 1), "trials of one kind are not taken for the other"


def test_keys_of_a_change_replace_single_keys_of_the_study() -> None:
    unknowns = {"calibration": {"row_mrad": 0.5}, "light": {"room": "dark cell"}}
    file = StudyFile.model_validate(
        {"scene": "a.xml", "task": "t.toml", "sensor": "ensenso-n10", "views": {}, "unknowns": unknowns}
    )
    changed = changed_file(file, {"unknowns": {"calibration": {"scale": 0.25}}, "sprayed": True})
    assert changed.unknowns.calibration.row_mrad == 0.5 and changed.unknowns.calibration.scale == 0.25
    assert changed.unknowns.light.room == "dark cell" and changed.sprayed
    assert changed.views == file.views


def test_measurements_with_no_change_tried_are_one_line() -> None:
    names = "abcdef"
    found = RemediesEntry(
        measurements={
            name: MissedEntry.model_validate({"unit": "mm", "standard_uncertainty": None, "needed": None})
            for name in names
        },
        tried=[],
        untried=[
            UntriedChange(change="any", words="any change", measurements=list(names)),
            UntriedChange(change="sensor", words="with another sensor", measurements=list(names)),
        ],
    )
    assert remedies_in_words(found) == ["not tried for lack of time: any change"]
    found.untried[0].measurements.remove("f")
    assert remedies_in_words(found) == [
        "not tried for lack of time: any change for a, b, c and 2 more; with another sensor for f"
    ]


def test_a_change_tried_without_a_value_was_tried() -> None:
    """Its line said "not tried", and the last line said it again of the changes that were left."""
    lost = Change("view", "from view 3", {}, (3,), {"a": 0.0}, lambda count, _: [stated("a", math.nan, count=count)])
    found = find_remedies(missed("a"), [lost, Fake("spray", ("a",), a=0.02).change], 40, TimeLimit(60.0), trial_s=0.0)
    assert [one.change.words for one in found.tried] == ["from view 3", "with spray"]
    found.tried.pop()
    found.untried.append(UntriedChange(change="spray", words="with spray", measurements=["a"]))
    assert remedies_in_words(RemediesEntry.model_validate(remedies_document(found))) == [
        "a (u 0.80 mm, 0.12 mm needed): the one change tried, from view 3, does not help",
        "not tried for lack of time: with spray",
    ]


def test_what_was_not_tried_is_told_of_the_measurements_that_it_was_for() -> None:
    good = Fake("spray", ("a",), a=0.02)
    found = find_remedies(missed("a", "b", "c"), [good.change], 40)
    found.untried.append(UntriedChange(change="light", words="in a dark cell", measurements=["b", "a"]))
    assert remedies_in_words(RemediesEntry.model_validate(remedies_document(found))) == [
        "with spray: a (u 0.020 mm, before 0.80 mm) fits (40 virtual measurements)",
        "c: by its budget, no single change that mitsim knows suffices",
        "not tried for lack of time: in a dark cell for b",
    ]


@pytest.mark.parametrize("fits_by, name", [(0, "b"), (1, "a"), (-1, "a")])
def test_a_measurement_that_fits_by_no_change_tried_is_refused(fits_by: int, name: str) -> None:
    """Before, a change without the measurement gave a KeyError, and one that does not exist no line at all."""
    spray = Fake("spray", ("a",), a=0.02)
    document = remedies_document(find_remedies(missed("a", "b"), [spray.change], 40))
    document["measurements"][name]["fits_by"] = fits_by
    with pytest.raises(ValidationError, match=f"fits_by {fits_by} of {name} must be the index of a change"):
        RemediesEntry.model_validate(document)


def test_more_than_four_measurements_that_fit_are_counted() -> None:
    names = "abcdef"
    spray = Fake("spray", tuple(names), a=0.02, b=0.02, c=0.02, d=0.02, e=0.02, f=0.02)
    (line,) = remedies_in_words(
        RemediesEntry.model_validate(remedies_document(find_remedies(missed(*names), [spray.change], 40)))
    )
    one = "(u 0.020 mm, before 0.80 mm)"
    assert line == f"with spray: a {one}, b {one}, c {one} and 3 more fit (40 virtual measurements)"


def test_another_sensor_states_every_key_that_it_needs() -> None:
    """Before, the sensor alone: with the first one's map and standoff that is another study, or an error."""
    table = {"scene": "a.xml", "task": "t.toml", "sensor": "ensenso-n10"}
    before = StudyFile.model_validate(table | {"characterisation": {"map": "own.nc"}, "views": {"standoff_mm": 500}})
    after = StudyFile.model_validate(table | {"sensor": "zivid-2-m70", "views": {}})
    now = cast(Shortfall, SimpleNamespace(study=SimpleNamespace(file=before), folder=None))
    study, view = cast(Study, SimpleNamespace(file=after)), cast(View, SimpleNamespace(number=3))
    keys = dict(_with_sensor(now, "zivid-2-m70", study, view, {}).keys)
    assert keys == {"sensor": "zivid-2-m70", "characterisation": {"map": None}, "views": {"standoff_mm": None}}
    assert changed_file(before, keys) == after
