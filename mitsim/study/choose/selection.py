"""Compare sensors: screen all of them, and measure the promising ones until every verdict is clear or time is over.

Signal chain: sensors -> scores of all views of each sensor (kept in its folder) -> order by impossible measurements,
then by the worst of the others (:mod:`mitsim.study.choose.ranking`) -> exclusion of sensors that can make fewer
measurements, or whose demand is far too large -> for the others a short race -> a statement from the view that is best
for all measurements, with as many trials as its verdicts need -> a statement from a measurement's own best view, where
the common view does not suffice -> more trials for the leader -> its folder, as of a run
(:mod:`mitsim.study.choose.winner`), and ``choice.json``.

Screening includes noise and calibration, but not finish, interreflections at edges and false points. It is therefore
more often too small than too large, and a sensor is excluded if even the screened demand of its best view exceeds
:data:`mitsim.study.choose.ranking.LARGEST_DEMAND`. A measurement that screening excludes for every sensor excludes none
of them.

Finished work is on the disk, so an interrupted command continues. The sensors are measured one after the other, and the
memory of each is released before the next.
"""

from __future__ import annotations

import gc
import math
import time
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
from characterisation.statements.statement import Statement
from characterisation.tasks.task_file import Task
from mitsim.maps.campaign.run import write_netcdf
from mitsim.running.executor import Executor
from mitsim.running.progress import say
from mitsim.study import StatementTable
from mitsim.study.choose.candidates import CandidateSensor
from mitsim.study.choose.ranking import rank_keys, unpromising
from mitsim.study.choose.winner import complete_winner
from mitsim.study.screened_errors import screened_errors, stated_shares
from mitsim.study.session import Session
from mitsim.study.virtual.plan import map_digest, trial_digest
from mitsim.study.virtual.race import ALL, Raced, RaceRules
from mitsim.study.virtual.stated import StatedView, statement_document
from mitsim.views.view_scores import screening_risk

Floats = NDArray[np.float64]

#: number of views raced for each measurement, and of trials of each of them
SHORTLIST, RACE_TRIALS = 3, 8

#: trials at the start of a statement
FIRST_TRIALS = 24

#: a measurement's own best view is stated if its risk in the race is below this fraction of the common view's risk
_WORTH_STATING = 0.8

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
    minutes: float,
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
    minutes
        Total time, shared among the sensors [min].
    report_results
        Receives the results so far, and whether they are final, after each sensor.
    workers
        Processes or cluster that make the trials; by default this process makes them.
    """
    end = time.monotonic() + 60 * minutes
    found = list[SensorResult]()
    for number, candidate in enumerate(candidates, 1):
        found.append(_screened(candidate, Session(candidate.study, folder / candidate.name, workers)))
        _say(found, f"{number} of {len(candidates)} screened", end)
    promising = _promising(found)
    report_results(_ordered(found), False)
    for place, one in enumerate(promising):
        left = end - time.monotonic()
        if left <= 0 and place:
            say(f"choose: time is over; {len(promising) - place} sensors are judged by screening alone")
            break
        _measure_sensor(one, max(left, 1.0) / (len(promising) - place))
        _say(found, f"{place + 1} of {len(promising)} sensors measured", end)
        report_results(_ordered(found), False)
    leader = _ordered(found)[0]
    if leader.stated and time.monotonic() < end:
        _refine_leader(leader, end)
    _complete(_ordered(found)[0])
    report_results(_ordered(found), True)
    return _ordered(found)


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


def _screened(candidate: CandidateSensor, session: Session) -> SensorResult:
    """Return the scores of all views, from the folder if they are there."""
    study, path = session.study, session.folder / "scores.nc"
    session.folder.mkdir(parents=True, exist_ok=True)
    screening = f"screening {study.file.score.light_path_depth} {map_digest(study)}"
    digest = trial_digest(study, session.unknowns, screening)
    scores = _kept(path, digest)
    if scores is None:
        say(f"choose: {candidate.name}, {len(study.views)} views")
        scores, _ = session.screen()
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


def _kept(path: Path, digest: str) -> xr.Dataset | None:
    try:
        scores = read_dataset(path, _SCORES)
    except InputError:
        return None
    return scores if scores.attrs.get("digest") == digest else None


def _screened_demand(task: Task, name: str, u: float) -> float:
    tolerance = tolerance_of(task, name)
    if not math.isfinite(u):
        return math.inf
    return u if tolerance is None else demand(screened_errors(u), tolerance)


def _measure_sensor(one: SensorResult, seconds: float) -> None:
    """Race and state one sensor in approximately ``seconds``."""
    began = time.monotonic()
    session, study = one.session, one.session.study
    table = study.file.race
    rules = RaceRules(
        min(SHORTLIST, table.shortlist), min(RACE_TRIALS, table.trials), table.margin, 0.9, _RACE_SHARE * seconds
    )
    one.raced = session.race(one.scores, rules)
    if not len(one.raced.views):
        return
    view, most = one.raced.leader(ALL), study.file.statement.trials
    count = min(FIRST_TRIALS, most)
    while True:
        _state(one, view, count)
        for number in _own_views(one, list(study.task.measurements), view):
            if time.monotonic() - began > seconds:
                break
            _state(one, number, count)
        if time.monotonic() - began > seconds or count >= most or not _is_undecided(one):
            break
        count = min(2 * count, most)
    _finish(one, view)


def _state(one: SensorResult, view: int, count: int) -> None:
    """State a view from ``count`` trials."""
    table = StatementTable(trials=count)
    one.stated[view] = one.session.state(one.session.study.view(view), table)


def _finish(one: SensorResult, view: int) -> None:
    """Write the statement of a view, and free the memory of the sensor."""
    write_json(one.session.folder / "statement.json", statement_document(one.session, one.stated[view]))
    one.session.release()
    gc.collect()


def _say(found: list[SensorResult], done: str, end: float) -> None:
    """Print the progress and the leading sensor."""
    first = _ordered(found)[0]
    names = list(first.candidate.study.task.measurements)
    rows = first.demands()
    by = "measured" if first.stated else "by the screening"
    left = max(0.0, end - time.monotonic())
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


def _is_undecided(one: SensorResult) -> bool:
    """Return whether more trials could change a verdict."""
    return any(row is not None and row[2].verdict == "not decided" for row in one.best())


def _own_views(one: SensorResult, names: list[str], view: int) -> list[int]:
    """Return best views of measurements that do not fit from the common view and have a lower risk elsewhere.

    They include those of measurements without a value from the common view, which another view may give.
    """
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


def _refine_leader(leader: SensorResult, end: float) -> None:
    """Add trials of the leader up to the number in the study, as long as there is time."""
    most = leader.session.study.file.statement.trials
    used = {row[0] for row in leader.best() if row is not None}

    def trials(view: int) -> int:
        return leader.stated[view].statements[0].trials

    while time.monotonic() < end:
        behind = [view for view in used if leader.stated[view].statements and trials(view) < most]
        if not behind:
            break
        view = min(behind, key=trials)
        _state(leader, view, min(trials(view) + 40, most))
    _finish(leader, next(iter(leader.stated)))
