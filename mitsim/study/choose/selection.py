"""Compare sensors: screen all of them, and measure the promising ones until every verdict is clear or time is over.

Signal chain: sensors -> scores of all views of each sensor (kept in its folder) -> order by impossible measurements,
then by the worst of the others (:mod:`mitsim.study.choose.ranking`) -> exclusion of sensors that can make fewer
measurements, or whose demand is far too large -> rounds of those that can still win, each with more trials than the
round before: a short race -> a statement from the view that is best for all measurements -> a statement from a
measurement's own best view, where the common view does not suffice -> more trials for the leader -> its folder, as of a
run (:mod:`mitsim.study.run_record`), and ``choice.json``.

Screening takes at most half of the time: within its share, a sensor scores views that lie far apart. The first round
gives every sensor the same share of the time. Each later one keeps the sensors whose demand may still
be the least, and gives each a share of half of the time that is left (successive halving: Karnin et al., ICML 2013).

Screening includes noise and calibration, but not finish, interreflections at edges and false points. It is therefore
more often too small than too large, and a sensor is excluded if even the screened demand of its best view exceeds
:data:`mitsim.study.choose.ranking.LARGEST_DEMAND`. A measurement that screening excludes for every sensor excludes none
of them.

Finished work is on the disk, so an interrupted command continues. In a round the sensors are measured one after the
other, and the memory of each is released before the next.
"""

from __future__ import annotations

import gc
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from characterisation.files.atomic_io import write_json
from characterisation.files.datasets import Schema, Variable, read_dataset
from characterisation.files.errors import InputError
from characterisation.statements.decision import demand, tolerance_of
from characterisation.statements.selection import EXCESS
from characterisation.statements.statement import Statement
from characterisation.tasks.task_file import Task
from mitsim.maps.campaign.run import write_netcdf
from mitsim.running.executor import Executor
from mitsim.running.progress import say
from mitsim.running.time_limit import TimeLimit
from mitsim.study import StatementTable
from mitsim.study.choose.candidates import CandidateSensor
from mitsim.study.choose.ranking import rank_keys, unpromising
from mitsim.study.run_record import complete_winner
from mitsim.study.screened_errors import screened_errors, stated_shares
from mitsim.study.session import Session
from mitsim.study.statement_document import statement_document
from mitsim.study.virtual.plan import map_digest, trial_digest
from mitsim.study.virtual.race import ALL, Raced, RaceRules
from mitsim.study.virtual.stated import StatedView
from mitsim.views.view_scores import not_scored_in_words, screening_risk

Floats = NDArray[np.float64]

#: number of views raced for each measurement, and of trials of each of them
SHORTLIST, RACE_TRIALS = 3, 8

#: trials of a statement in the first round, and their factor from round to round
FIRST_TRIALS, GROWTH = 24, 2

#: largest share of the time for screening
_SCREENING_SHARE = 0.5

#: a sensor with views left out is screened again if its share of the time is longer than before by this factor
_LONGER = 1.5

#: share of the time for the rounds after the first, and largest number of rounds
_LATER_SHARE, _ROUNDS = 0.5, 6

#: a sensor can still win if its demand divided by this many standard errors of a factor is below the least
_STANDARD_ERRORS = 2.0

#: a measurement's own best view is stated if its risk in the race is below this fraction of the common view's risk
_WORTH_STATING = 0.8

#: fewest trials that make a statement worth showing
_FEWEST = 4

#: fraction of a sensor's time that its race may take
_RACE_SHARE = 0.4


@dataclass
class SensorResult:
    """Results of a sensor so far.

    ``screened`` (measurement,) is the demand of the best view by screening, ``screened_u`` its uncertainty,
    ``screened_view`` its number. ``unpromising`` is the reason why the sensor is not measured. ``stated`` holds
    statements by view number; the view that is best for all measurements comes first. A demand is infinite if no view
    can make the measurement.
    """

    candidate: CandidateSensor
    session: Session
    scores: xr.Dataset
    screened: Floats
    screened_u: Floats
    screened_view: NDArray[np.int64]
    unpromising: str = ""
    stated: dict[int, StatedView] = field(default_factory=dict)
    raced: Raced | None = None

    @property
    def ratio(self) -> float:
        """Return the largest demand of the possible measurements that have a limit; NaN if there is none."""
        limited = self.has_tolerance
        compared = limited if any(limited) else [True] * len(limited)
        demands = [one for one, kept in zip(self.demands(), compared, strict=True) if kept and math.isfinite(one)]
        return max(demands, default=math.nan)

    @property
    def has_tolerance(self) -> list[bool]:
        """Return whether each measurement of the task has a tolerance."""
        return [one.tolerance is not None for one in self.session.study.task.measurements.values()]

    def demands(self) -> list[float]:
        """Return the demand of every measurement, each from its best view; infinite for an impossible one."""
        if not self.stated:
            return list(self.screened.tolist())
        return [math.inf if row is None else row[1] for row in self.best()]

    def best(self) -> list[tuple[int, float, Statement] | None]:
        """Return view, demand and statement of least demand for each measurement; None without a value."""
        out = list[tuple[int, float, Statement] | None]()
        for m in range(len(self.screened)):
            statements = {view: one.statements[m] for view, one in self.stated.items()}
            rows = [(view, _demand(one), one) for view, one in statements.items()]
            rows = [row for row in rows if math.isfinite(row[1])]
            out.append(min(rows, key=lambda row: row[1]) if rows else None)
        return out


def _demand(one: Statement) -> float:
    """Return the demand of the decision rule; without a tolerance the root mean square error."""
    value = one.root_mean_square if one.decided is None else one.decided.demand
    return value if math.isfinite(value) else math.inf


def choose_sensor(
    candidates: list[CandidateSensor],
    folder: Path,
    limit: TimeLimit,
    report_results: Callable[[list[SensorResult], bool], None],
    workers: Executor | None = None,
) -> list[SensorResult]:
    """Screen, race and state sensors; return them, best first.

    Parameters
    ----------
    candidates
        Sensors, each with the study for it.
    folder
        Finished work is kept in a folder of it for each sensor.
    limit
        Time of the whole, shared among the sensors.
    report_results
        Receives the results so far, and whether they are final, after each sensor.
    workers
        Processes or cluster that make the trials; by default this process makes them.
    """
    found = list[SensorResult]()
    screening = limit.part(_SCREENING_SHARE)
    equal = screening.left / len(candidates)
    for number, candidate in enumerate(candidates, 1):
        share = screening.part(1 / (len(candidates) - number + 1))
        found.append(_screened(candidate, Session(candidate.study, folder / candidate.name, workers), share, equal))
        _say(found, f"{number} of {len(candidates)} screened", limit)
    rivals, count = _promising(found), FIRST_TRIALS
    report_results(_ordered(found), False)
    for turn in range(_ROUNDS):
        work = limit.part(_LATER_SHARE if turn or len(rivals) > 1 else 1.0, _reserve(limit))
        for place, one in enumerate(rivals):
            if limit.over() and (place or turn):
                unmeasured = sum(not each.stated for each in rivals)
                if unmeasured:
                    say(f"choose: time is over; {unmeasured} sensors are judged by screening alone")
                break
            _measure_sensor(one, count, work.part(1 / (len(rivals) - place)))
            _say(found, f"round {turn + 1}: {place + 1} of {len(rivals)} sensors measured", limit)
            report_results(_ordered(found), False)
        if any(one.stated for one in found):
            rivals, count = _able_to_win(found, rivals), GROWTH * count
            if len(rivals) < 2:
                break
        else:  # every share was too short for a statement: the first rival, best by screening, gets what is left
            rivals = rivals[:1]
        if limit.over() or not rivals:
            break
    leader = _ordered(found)[0]
    if leader.stated and not limit.over():
        _refine_leader(leader, limit.part(1.0, _reserve(limit)))
    _complete(_ordered(found)[0])
    report_results(_ordered(found), True)
    return _ordered(found)


def _reserve(limit: TimeLimit) -> float:
    """Return the time [s] that the pages and the winner's folder need; nothing without a limit."""
    return 0.0 if limit.end is None else min(10.0, 0.1 * (limit.end - limit.began))


def _able_to_win(found: list[SensorResult], rivals: list[SensorResult]) -> list[SensorResult]:
    """Return the measured sensors that more trials may show to be the best, and that have not all of theirs.

    At least one of the sensors found is measured. A sensor that lacks more measurements than the best cannot win. Of
    the others, one can if its worst demand may be as small as that of the best may be large: of n trials the demand has
    a relative standard error of about sqrt((k - 1) / (4 n)), as a standard deviation has, with the usual kurtosis k of
    errors.
    """
    stated = [one for one in _ordered(found) if one.stated]
    keys = rank_keys([one.demands() for one in stated], stated[0].has_tolerance, [True] * len(stated))
    first = keys[0]
    highest = max(first[1], default=math.inf) * math.exp(_STANDARD_ERRORS * _relative_error(stated[0]))
    out = []
    for one, key in zip(stated, keys, strict=True):
        lowest = max(key[1], default=math.inf) * math.exp(-_STANDARD_ERRORS * _relative_error(one))
        most = one.session.study.file.statement.trials
        if any(one is rival for rival in rivals) and key[0] <= first[0] and lowest <= highest and _trials(one) < most:
            out.append(one)
    return out


def _trials(one: SensorResult) -> int:
    """Return the least number of trials of the sensor's statements."""
    return min((stated.statements[0].trials for stated in one.stated.values() if stated.statements), default=0)


def _relative_error(one: SensorResult) -> float:
    """Return the relative standard error of a demand from the sensor's trials."""
    return math.sqrt(EXCESS / (4 * max(_trials(one), 1)))


def _complete(winner: SensorResult) -> None:
    """Complete the folder of the best sensor, if it was measured."""
    if not winner.stated or winner.raced is None:
        return
    session = winner.session
    own = zip(session.study.task.measurements, winner.best(), strict=True)
    leaders = {ALL: next(iter(winner.stated))} | {name: row[0] for name, row in own if row is not None}
    complete_winner(session, winner.scores, winner.raced, leaders)
    session.release()


def _promising(found: list[SensorResult]) -> list[SensorResult]:
    """Return the sensors worth a virtual measurement, best first: at least one if any sensor can measure at all."""
    keys = rank_keys([one.screened for one in found], found[0].has_tolerance, [True] * len(found))
    for one, reason in zip(found, unpromising(keys, any(found[0].has_tolerance)), strict=True):
        one.unpromising = reason
    order = sorted(range(len(found)), key=keys.__getitem__)
    return [found[i] for i in order if not found[i].unpromising]


def _ordered(found: list[SensorResult]) -> list[SensorResult]:
    """Return measured sensors before screened ones, each by their impossible and then their worst measurements."""
    stated = [bool(one.stated) for one in found]
    known = stated if any(stated) else [True] * len(found)
    keys = rank_keys([one.demands() for one in found], found[0].has_tolerance, known)
    order = sorted(range(len(found)), key=lambda i: (not stated[i], keys[i]))
    return [found[i] for i in order]


def _screened(candidate: CandidateSensor, session: Session, limit: TimeLimit, equal: float) -> SensorResult:
    """Return the scores of all views, from the folder if they are there, or of those that the limit allows.

    ``equal`` is the sensor's share [s] of the time for screening, before sensors leave some of theirs.
    """
    study, path = session.study, session.folder / "scores.nc"
    session.folder.mkdir(parents=True, exist_ok=True)
    screening = f"screening {study.file.score.light_path_depth} {map_digest(study)}"
    digest = trial_digest(study, session.unknowns, screening)
    scores = _kept(path, digest, equal)
    if scores is None:
        say(f"choose: {candidate.name}, {len(study.views)} views")
        scores, _ = session.screen(limit=limit)
        if not_scored_in_words(scores):
            say(f"choose: {candidate.name}: {not_scored_in_words(scores)}")
            scores.attrs["within_s"] = limit.elapsed
        scores.attrs["digest"] = digest
        write_netcdf(scores, path)
        session.release()
        gc.collect()
    u = scores["predicted_uncertainty"].transpose("measurement", "view").values
    able = scores["uncertainty_possible"].transpose("measurement", "view").values.astype(bool) & (u > 0)
    best = np.where(able, screening_risk(scores), np.inf).argmin(axis=1)
    least = np.take_along_axis(np.where(able, u, np.inf), best[:, None], axis=1)[:, 0]
    least = least * stated_shares(study.task)
    demands = [_screened_demand(study.task, *row) for row in zip(study.task.measurements, least.tolist(), strict=True)]
    screened_view = scores["view"].values[best].astype(np.int64)
    return SensorResult(candidate, session, scores, np.array(demands), least, screened_view)


_OF_A_VIEW = ("measurement", "view")
_SCORES = Schema(
    "scores of all views of a sensor",
    {
        "view": Variable(("view",), "whole", 0, 1e9),
        "measurement": Variable(("measurement",), "text"),
        "predicted_uncertainty": Variable(_OF_A_VIEW, gaps=True),
        "chance": Variable(_OF_A_VIEW, "number", 0, 1),
        "uncertainty_possible": Variable(_OF_A_VIEW, "truth"),
        "tolerance": Variable(("measurement",), gaps=True),
    },
    names=("view", "measurement"),
)


def _kept(path: Path, digest: str, seconds: float) -> xr.Dataset | None:
    """Return the scores of a file, if they are of the study, and of hardly fewer views than some seconds allow."""
    try:
        scores = read_dataset(path, _SCORES)
    except InputError:
        return None
    if scores.attrs.get("digest") != digest:
        return None
    return scores if seconds <= _LONGER * float(scores.attrs.get("within_s", math.inf)) + 1.0 else None


def _screened_demand(task: Task, name: str, u: float) -> float:
    tolerance = tolerance_of(task, name)
    if not math.isfinite(u):
        return math.inf
    return u if tolerance is None else demand(screened_errors(u), tolerance)


def _measure_sensor(one: SensorResult, count: int, limit: TimeLimit) -> None:
    """Race a sensor at its first turn, and state it from ``count`` trials, within a limit."""
    session, study = one.session, one.session.study
    if one.raced is None:
        table = study.file.race
        rules = RaceRules(
            min(SHORTLIST, table.shortlist), min(RACE_TRIALS, table.trials), table.margin, table.loss, each=True
        )
        one.raced = session.race(one.scores, rules, limit.part(_RACE_SHARE))
    if not len(one.raced.views):
        return
    view, count = one.raced.leader(ALL), min(count, study.file.statement.trials)
    _state(one, view, count, limit)
    for number in _own_views(one, list(study.task.measurements), view) if view in one.stated else ():
        if limit.over():
            break
        _state(one, number, count, limit)
    if view in one.stated:
        _finish(one, view)


def _state(one: SensorResult, view: int, count: int, limit: TimeLimit) -> None:
    """State a view from ``count`` trials, or those within the limit."""
    stated = one.session.state(one.session.study.view(view), StatementTable(trials=count), limit)
    if stated.statements and stated.statements[0].trials >= min(_FEWEST, count):
        one.stated[view] = stated


def _finish(one: SensorResult, view: int) -> None:
    """Write the statement of a view, and free the memory of the sensor."""
    write_json(one.session.folder / "statement.json", statement_document(one.session, one.stated[view]))
    one.session.release()
    gc.collect()


def _say(found: list[SensorResult], done: str, limit: TimeLimit) -> None:
    """Print the progress and the leading sensor."""
    first = _ordered(found)[0]
    names = list(first.candidate.study.task.measurements)
    rows = first.demands()
    by = "measured" if first.stated else "by the screening"
    left = limit.left
    possible = [m for m, value in enumerate(rows) if math.isfinite(value)]
    if not possible:
        say(f"choose: {done}; no sensor can make a measurement {by}; {left:.0f} s left")
        return
    limited = [m for m in possible if first.has_tolerance[m]]
    worst = max(limited or possible, key=rows.__getitem__)
    measurement = first.candidate.study.task.measurements[names[worst]]
    unit = "times the limit" if first.has_tolerance[worst] else measurement.unit
    demand_in_words = f"{rows[worst]:.2g} {unit} ({names[worst]})"
    if len(possible) < len(rows):
        demand_in_words += f", {len(possible)} of {len(rows)} measurements possible"
    say(f"choose: {done}; {first.candidate.name} leads {by}, at worst {demand_in_words}; {left:.0f} s left")


def _own_views(one: SensorResult, names: list[str], view: int) -> list[int]:
    """Return best views of measurements that do not fit, or have no value, from the common view and may elsewhere."""
    assert one.raced is not None
    out = list[int]()
    place = int(np.flatnonzero(one.raced.views == view)[0])
    for name, known in zip(names, one.stated[view].statements, strict=True):
        standing = one.raced.standings[name]
        better = standing.risk[standing.leader] < _WORTH_STATING * standing.risk[place]
        lost = not math.isfinite(_demand(known)) and standing.leader != place
        if lost or (known.verdict not in ("fits", "no tolerance") and better):
            out.append(one.raced.leader(name))
    return list(dict.fromkeys(out))


def _refine_leader(leader: SensorResult, limit: TimeLimit) -> None:
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
        _state(leader, view, min(trials(view) + 40, most), limit)
    _finish(leader, next(iter(leader.stated)))
