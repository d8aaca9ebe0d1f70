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
from mitsim.study.virtual.race import ALL, Raced, RaceRules, shortlist, standings

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


def state_by_screening(one: SensorResult, count: int, limit: TimeLimit, whole: TimeLimit) -> None:
    """State a sensor from ``count`` trials of the view that screening finds best for all measurements.

    Parameters
    ----------
    one
        Results of the sensor so far, which get the statement.
    count
        Number of trials.
    limit
        Time of the sensor. If it ends before there are a few trials, the sensor gets these within ``whole``: the light
        paths of its view are traced by then.
    whole
        Time of the comparison.

    See Also
    --------
    race_and_state : from the best view by a race
    """
    for view in shortlist(one.scores, 1):
        _state(one, view, count, limit)
        if view not in one.stated:
            _state(one, view, min(_FEWEST, count), whole)
        if view in one.stated:
            _finish(one, view)


def race_and_state(one: SensorResult, count: int, limit: TimeLimit) -> None:
    """Race the views of a sensor, unless they were raced, and state it from ``count`` trials of the best view.

    A race that had little time may name a poor view. The view of an earlier statement stays the best one, unless the
    statement of the view that won the race is better.
    """
    before = next(iter(one.stated), None)
    if one.raced is None:
        table = one.session.study.file.race
        most = min(RACE_TRIALS, table.trials)
        rules = RaceRules(min(SHORTLIST, table.shortlist), most, table.margin, table.loss, each=True)
        one.raced = one.session.race(one.scores, rules, limit.part(_RACE_SHARE))
        view = one.raced.leader(ALL) if len(one.raced.views) else before
    else:
        view = before
    if view is None:  # no view can measure
        return
    _state(one, view, count, limit)
    known = [number for number in dict.fromkeys((before, view)) if number in one.stated]
    if not known:  # time was over
        return
    view = _better(one, known)
    own = _own_views(one, view)
    for number in own:
        if limit.over():
            break
        _state(one, number, count, limit)
    one.stated = {number: one.stated[number] for number in (view, *own) if number in one.stated}
    _finish(one, view)


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


def able_to_win(found: Sequence[SensorResult], rivals: Sequence[SensorResult]) -> list[SensorResult]:
    """Return the rivals that more trials or a race may show to be the best.

    At least one of the sensors found is measured. A raced sensor that lacks more measurements than the best cannot win.
    Another one can if its worst demand may be as small as that of the best may be large: of n trials the demand has a
    relative standard error of about sqrt((k - 1) / (4 n)), as a standard deviation has, with the usual kurtosis k of
    errors. Raced sensors that have all of their trials get no more.

    A sensor that was not raced may have a better view. It can win if it lacks a measurement, or with a demand that is
    larger by the factor that a race is expected to gain.
    """
    stated = [one for one in ordered(found) if one.stated]
    keys = rank_keys([one.demands() for one in stated], stated[0].has_tolerance, [True] * len(stated))
    first = keys[0]
    highest = max(first[1], default=math.inf) * math.exp(_STANDARD_ERRORS * _relative_error(stated[0]))
    out = []
    for one, key in zip(stated, keys, strict=True):
        if not any(one is rival for rival in rivals):
            continue
        lowest = max(key[1], default=math.inf) * math.exp(-_STANDARD_ERRORS * _relative_error(one))
        if one.raced is None:
            able = key[0] > first[0] or lowest <= _RACE_GAIN * highest
        else:
            able = key[0] <= first[0] and lowest <= highest and one.trials < one.session.study.file.statement.trials
        if able:
            out.append(one)
    return out


def race_as_stated(one: SensorResult) -> Raced:
    """Return the race of a sensor, or of its stated views alone if there was no time for one."""
    if one.raced is not None:
        return one.raced
    table, numbers = one.session.study.file.race, list(one.stated)
    rules = RaceRules(len(numbers), 0, table.margin, table.loss)
    trials = dict.fromkeys(numbers, 0)
    return standings(one.scores.sel(view=numbers), numbers, one.session.race_trials, trials, rules)


def _relative_error(one: SensorResult) -> float:
    """Return the relative standard error of a demand from the sensor's trials."""
    return math.sqrt(EXCESS / (4 * max(one.trials, 1)))


def _state(one: SensorResult, view: int, count: int, limit: TimeLimit) -> None:
    """State a view from ``count`` trials, at most those of the study, or from those within the limit."""
    study = one.session.study
    count = min(count, study.file.statement.trials)
    stated = one.session.state(study.view(view), StatementTable(trials=count), limit)
    if stated.statements and stated.statements[0].trials >= min(_FEWEST, count):
        one.stated[view] = stated


def _finish(one: SensorResult, view: int) -> None:
    """Write the statement of a view, and free the memory of the sensor."""
    write_json(one.session.folder / "statement.json", statement_document(one.session, one.stated[view]))
    one.session.release()
    gc.collect()


def _better(one: SensorResult, views: Sequence[int]) -> int:
    """Return the stated view that makes more measurements, or else has the less demanding ones."""
    demands = [[stated_demand(each) for each in one.stated[view].statements] for view in views]
    keys = rank_keys(demands, one.has_tolerance, [True] * len(views))
    return views[min(range(len(views)), key=keys.__getitem__)]


def _own_views(one: SensorResult, view: int) -> list[int]:
    """Return best views of measurements that do not fit, or have no value, from the common view and may elsewhere."""
    assert one.raced is not None
    out = list[int]()
    place = int(np.flatnonzero(one.raced.views == view)[0])
    for name, known in zip(one.session.study.task.measurements, one.stated[view].statements, strict=True):
        standing = one.raced.standings[name]
        better = standing.risk[standing.leader] < _WORTH_STATING * standing.risk[place]
        lost = not math.isfinite(stated_demand(known)) and standing.leader != place
        if lost or (known.verdict not in ("fits", "no tolerance") and better):
            out.append(one.raced.leader(name))
    return [number for number in dict.fromkeys(out) if number != view]
