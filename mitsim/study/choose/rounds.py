"""Measure a sensor virtually in a round of a comparison, and say which sensors more trials may show to be the best.

Signal chain: view that is best by screening -> statement of few trials -> in later rounds, a short race of views -> a
statement from the view that is best for all measurements -> a statement from a measurement's own best view, where the
common view does not suffice.
"""

from __future__ import annotations

import gc
import math
from collections.abc import Sequence

import numpy as np

from characterisation.files.atomic_io import write_json
from characterisation.statements.selection import EXCESS
from mitsim.running.time_limit import TimeLimit
from mitsim.study import StatementTable
from mitsim.study.choose.ranking import rank_keys
from mitsim.study.choose.sensor_result import SensorResult, ordered, stated_demand
from mitsim.study.statement_document import statement_document
from mitsim.study.virtual.race import ALL, Raced, standings
from mitsim.study.virtual.risks import shortlist

#: largest number of views raced for each measurement; chosen
SHORTLIST = 3

#: largest number of trials of each of them; chosen
RACE_TRIALS = 8

#: a sensor can still win if its demand divided by this many standard errors of a factor is below the least
_STANDARD_ERRORS = 2.0

#: largest factor by which a race is expected to improve on the view that is best by screening: the largest finite mean
#: regret of the predicted u by sensor, of four (docs/explanation/statement.md: python -m tests.proofs statements)
_RACE_GAIN = 2.65

#: a measurement's own best view is stated if its risk in the race is below this fraction of the common view's risk
_WORTH_STATING = 0.8

#: fewest trials that make a statement worth showing
_FEWEST = 4

#: fraction of a sensor's time that its race may take
_RACE_SHARE = 0.4

#: trials of the leader that are added at once
_MORE = 40


def state_by_screening(result: SensorResult, count: int, limit: TimeLimit, whole: TimeLimit) -> None:
    """State a sensor from ``count`` trials of the view that screening finds best for all measurements.

    - ``result``, ``count``: results of the sensor so far, which get the statement, and number of trials.
    - ``limit``, ``whole``: time of the sensor, and of the comparison. If that of the sensor ends before there are a few
      trials, it gets these within ``whole``: the light paths of its view are traced by then.
    """
    for view in shortlist(result.scores, 1):
        _state(result, view, count, limit)
        if view not in result.stated:
            _state(result, view, min(_FEWEST, count), whole)
        if view in result.stated:
            _finish(result, view)


def race_and_state(result: SensorResult, count: int, limit: TimeLimit) -> None:
    """Race the views of a sensor, unless they were raced, and state it from ``count`` trials of the best view.

    A race that had little time may name a poor view. The view of an earlier statement stays the best one, unless the
    statement of the view that won the race is better.
    """
    before = next(iter(result.stated), None)
    if result.raced is None:
        table = result.session.study.file.race
        fewer = {"shortlist": min(SHORTLIST, table.shortlist), "trials": min(RACE_TRIALS, table.trials)}
        rules = table.model_copy(update={**fewer, "each": True})
        result.raced = result.session.race(result.scores, rules, limit.part(_RACE_SHARE))
        view = result.raced.leader(ALL) if len(result.raced.views) else before
    else:
        view = before
    if view is None:  # no view can measure
        return
    _state(result, view, count, limit)
    stated_views = [number for number in dict.fromkeys((before, view)) if number in result.stated]
    if not stated_views:  # time was over
        return
    view = _better(result, stated_views)
    extra_views = _own_views(result, view)
    for number in extra_views:
        if limit.over():
            break
        _state(result, number, count, limit)
    result.stated = {number: result.stated[number] for number in (view, *extra_views) if number in result.stated}
    _finish(result, view)


def refine_leader(leader: SensorResult, limit: TimeLimit) -> None:
    """Add trials of the leader up to the number in the study, as long as there is time."""
    most = leader.session.study.file.statement.trials
    used = {row[0] for row in leader.best() if row is not None}

    def trials(view: int) -> int:
        return leader.stated[view].statements[0].trials

    while not limit.over():
        behind = [view for view in used if leader.stated[view].statements and trials(view) < most]
        if not behind:
            break
        view = min(behind, key=trials)
        _state(leader, view, trials(view) + _MORE, limit)
    _finish(leader, next(iter(leader.stated)))


def able_to_win(results: Sequence[SensorResult], rivals: Sequence[SensorResult]) -> list[SensorResult]:
    """Return the rivals that more trials or a race may show to be the best.

    At least one of ``results`` is measured. A raced sensor that lacks more measurements than the best cannot win.
    Another one can if its worst demand may be as small as that of the best may be large: of n trials the demand has a
    relative standard error of about sqrt((k - 1) / (4 n)), as a standard deviation has, with the usual kurtosis k of
    errors. Raced sensors that have all of their trials get no more.

    A sensor that was not raced may have a better view. It can win if it lacks a measurement, or with a demand that is
    larger by the factor that a race is expected to gain.
    """
    stated = [result for result in ordered(results) if result.stated]
    keys = rank_keys([result.demands() for result in stated], stated[0].has_tolerance)
    first = keys[0]
    highest = max(first[1], default=math.inf) * math.exp(_STANDARD_ERRORS * _relative_error(stated[0]))
    out = []
    for result, key in zip(stated, keys, strict=True):
        if not any(result is rival for rival in rivals):
            continue
        lowest = max(key[1], default=math.inf) * math.exp(-_STANDARD_ERRORS * _relative_error(result))
        if result.raced is None:
            able = key[0] > first[0] or lowest <= _RACE_GAIN * highest
        else:
            able = (
                key[0] <= first[0] and lowest <= highest and result.trials < result.session.study.file.statement.trials
            )
        if able:
            out.append(result)
    return out


def race_as_stated(result: SensorResult) -> Raced:
    """Return the race of a sensor, or of its stated views alone if there was no time for one."""
    if result.raced is not None:
        return result.raced
    rules, numbers = result.session.study.file.race.model_copy(update={"each": False}), list(result.stated)
    trials = dict.fromkeys(numbers, 0)
    return standings(result.scores.sel(view=numbers), numbers, result.session.race_trials, trials, rules)


def _relative_error(result: SensorResult) -> float:
    """Return the relative standard error of a demand from the sensor's trials."""
    return math.sqrt(EXCESS / (4 * max(result.trials, 1)))


def _state(result: SensorResult, view: int, count: int, limit: TimeLimit) -> None:
    """State a view from ``count`` trials, at most those of the study, or from those within the limit."""
    study = result.session.study
    count = min(count, study.file.statement.trials)
    stated = result.session.state(study.view(view), StatementTable(trials=count), limit)
    if stated.statements and stated.statements[0].trials >= min(_FEWEST, count):
        result.stated[view] = stated


def _finish(result: SensorResult, view: int) -> None:
    """Write the statement of a view, and free the memory of the sensor."""
    write_json(result.session.folder / "statement.json", statement_document(result.session, result.stated[view]))
    result.session.release()
    gc.collect()


def _better(result: SensorResult, views: Sequence[int]) -> int:
    """Return the stated view that makes more measurements, or else has the less demanding ones."""
    demands = [[stated_demand(statement) for statement in result.stated[view].statements] for view in views]
    keys = rank_keys(demands, result.has_tolerance)
    return views[min(range(len(views)), key=keys.__getitem__)]


def _own_views(result: SensorResult, view: int) -> list[int]:
    """Return best views of measurements that do not fit, or have no value, from the common view and may elsewhere."""
    assert result.raced is not None
    out = list[int]()
    index = int(np.flatnonzero(result.raced.views == view)[0])
    for name, statement in zip(result.session.study.task.measurements, result.stated[view].statements, strict=True):
        standing = result.raced.standings[name]
        better = standing.risk[standing.leader] < _WORTH_STATING * standing.risk[index]
        lost = not math.isfinite(stated_demand(statement)) and standing.leader != index
        if lost or (statement.verdict not in ("fits", "no tolerance") and better):
            out.append(result.raced.leader(name))
    return [number for number in dict.fromkeys(out) if number != view]
