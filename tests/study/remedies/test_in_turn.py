"""How the statement and the changes of a study share the time after the race."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from mitsim.running.time_limit import TimeLimit
from mitsim.study.remedies import in_turn as module
from mitsim.study.remedies.change import Shortfall
from mitsim.study.remedies.confirm import Remedies
from mitsim.study.remedies.in_turn import in_turn, state_and_mend
from mitsim.study.virtual.stated import StatedView

#: verdicts of two measurements after each part of a statement
OPEN, MISSED, GOOD = ("fits", "not decided"), ("fits", "does not fit"), ("fits", "fits")


def stated(*verdicts: str) -> StatedView:
    rows = [SimpleNamespace(measurement=f"m{n}", verdict=verdict) for n, verdict in enumerate(verdicts)]
    return cast(StatedView, SimpleNamespace(statements=rows))


def played(verdicts: list[tuple[str, ...]], seconds: float = 100.0) -> tuple[list[str], Remedies | None]:
    """Return what was done, in order, where the statement has these verdicts one after the other."""
    done, left = list[str](), iter(verdicts[1:])

    def state(limit: TimeLimit, enough: Callable[[StatedView], bool]) -> StatedView:
        decisive = enough(stated(*GOOD)) and not enough(stated(*OPEN))
        missing = decisive and enough(stated("does not fit", "not decided"))
        until = "until missed" if missing else "until decided" if decisive else "on"
        done.append(f"state {until}, {limit.left:.0f} s")
        return stated(*next(left))

    def mend(now: Any, before: Remedies | None, limit: TimeLimit, sensors: bool) -> Remedies | None:
        done.append(f"changes{' and sensors' * sensors}, {limit.left:.0f} s")
        return before or Remedies({one.measurement: one for one in now.statements if one.verdict == "does not fit"})

    return done, in_turn(stated(*verdicts[0]), state, mend, TimeLimit(seconds))[1]


def test_a_verdict_comes_before_other_sensors_and_after_changes_in_half_of_the_time() -> None:
    done, remedies = played([("does not fit", "not decided"), ("does not fit", "fits"), ("does not fit", "fits")])
    assert done == ["changes, 50 s", "state until decided, 100 s", "changes and sensors, 100 s", "state on, 100 s"]
    assert remedies is not None and list(remedies.missed) == ["m0"]


def test_decided_verdicts_leave_their_time_to_changes_of_all_kinds() -> None:
    assert played([MISSED, MISSED])[0] == ["changes and sensors, 100 s", "state on, 100 s"]


def test_a_measurement_that_fits_after_all_needs_no_change() -> None:
    done, remedies = played([("fits", "not decided", "does not fit"), GOOD, GOOD])
    assert [one.split(",")[0] for one in done] == ["changes", "state until decided", "state on"]
    assert remedies is None


def test_a_statement_that_misses_nothing_yet_leaves_time_to_changes() -> None:
    """Of a bare bracket it took all time: all were open after the first trials, and no change was tried."""
    done, remedies = played([OPEN, ("does not fit", "not decided"), MISSED, MISSED])
    assert done[:3] == ["state until missed, 50 s", "changes, 50 s", "state until decided, 100 s"]
    assert remedies is not None and list(remedies.missed) == ["m1"]


def test_what_was_not_tried_for_lack_of_time_is_named() -> None:
    done, remedies = played([("does not fit", "not decided"), ("does not fit", "does not fit")], seconds=0.0)
    assert [one.split(",")[0] for one in done] == ["changes", "state until decided"]
    assert remedies is not None
    assert [(one.words, one.measurements) for one in remedies.untried] == [
        ("any change", ["m1"]),
        ("with another sensor", ["m0", "m1"]),
    ]


def test_the_time_of_a_trial_is_told_without_that_of_preparing_the_view(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a large sensor, 5 trials took 150 s, 35 more 140 s: changes were refused as if one trial took 7 s."""
    asked = list[float]()
    taken = iter([("does not fit", 40, 140.0)] + 2 * [("does not fit", 60, 90.0)])
    clock = SimpleNamespace(steps={"state": 150.0}, lap=lambda _: None)

    def trials(verdict: str, made: int) -> StatedView:
        rows = [SimpleNamespace(measurement=name, verdict=verdict, trials=made) for name in ("a", "b")]
        rows[0].verdict = "not decided"
        return cast(StatedView, SimpleNamespace(statements=rows, view=None))

    def state(*_: object) -> StatedView:
        verdict, made, seconds = next(taken)
        clock.steps["state"] += seconds
        return trials(verdict, made)

    def find(missed: object, proposed: object, trials: object, within: object, before: object, trial_s: float) -> None:
        asked.append(trial_s)

    for name, value in {
        "write_json": lambda *_: None,
        "statement_document": lambda *_: {},
        "changes": lambda *_: iter(()),
        "all_changes": lambda *_: iter(()),
        "find_remedies": find,
        "seeks_remedies": lambda _: True,
    }.items():
        monkeypatch.setattr(module, name, value)
    table = SimpleNamespace(remedies=SimpleNamespace(trials=40, minutes=5.0))
    session = SimpleNamespace(study=SimpleNamespace(file=table), folder=Path("run"), state=state)
    stated_view = trials("not decided", 5)
    now = Shortfall(cast(Any, session), stated_view, cast(Any, None), cast(Any, None), cast(Any, None))
    state_and_mend(cast(Any, session), now, TimeLimit(1000.0), cast(Any, clock))
    assert asked[0] == pytest.approx(4.0)
