"""The contest: sensors screened, those worth it raced and stated, until every verdict is clear or time is over.

Signal chain: entrants -> scores of all views of each (kept in its folder) -> order by the worst of its measurements ->
those out by far are judged by the screening alone -> for the others a short race, a statement from the best view of all
with as many trials as its verdicts need, and one from a measurement's own view where the view for all does not serve it
-> more trials for the leader -> ``choice.json``.

The screening sees noise and calibration, not finish, light by way of edges and false points, so it is too small more
often than too large: a sensor whose best view is out by a factor of :data:`FAR` there is out.

Everything finished is on the disk: a second start goes on. Sensors are worked on one after the other, each in memory of
its own.
"""

from __future__ import annotations

import gc
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.stats import norm

from characterisation.datasets import Schema, Variable, read_dataset
from characterisation.errors import InputError
from characterisation.statements.decision import demand, tolerance_of
from characterisation.statements.statement import Statement
from characterisation.tasks.task_file import Task
from mitsim.campaign.executor import Executor
from mitsim.campaign.run import write_netcdf
from mitsim.choose.entrants import Entrant
from mitsim.exposures.planned import exposed_for
from mitsim.progress import say
from mitsim.sensor.exposure import PlannedExposure
from mitsim.study import StatementTable
from mitsim.virtual.mapped import MappedMeasurements
from mitsim.virtual.plan import map_digest, measurements_of, trial_digest
from mitsim.virtual.race import ALL, Maker, Raced, RaceRules, run_race
from mitsim.virtual.rendered import RenderedMeasurements
from mitsim.virtual.screening import screen
from mitsim.virtual.spread_out import spread_over
from mitsim.virtual.stated import state_view, statement_document, write_statement
from mitsim.virtual.study_unknowns import study_unknowns
from mitsim.virtual.trials import TrialFolder
from mitsim.virtual.world import Unknowns

Floats = NDArray[np.float64]

#: a sensor whose best view asks for so many times what the rule allows, by the screening, is not measured
FAR = 3.0

#: views of each measurement that are raced, and trials of one; and the trials that a statement begins with
SHORTLIST, RACE_TRIALS, FIRST_TRIALS = 3, 8, 24

#: trials from which the 95 % interval rests on order statistics, whatever the distribution
SURE_TRIALS = 80

#: a view of a measurement's own is stated where its risk in the race is below this share of that of the view for all
_WORTH = 0.8

#: share of a sensor's time that its race may take
_RACE_SHARE = 0.4

#: evenly likely values of a standard normal distribution, for a screened u
_NORMAL = norm.ppf((np.arange(400) + 0.5) / 400)


@dataclass
class Found:
    """What is known of an entrant so far.

    ``screened`` (measurement,) demand of the best view by the screening and ``screened_view`` its number, ``able``
    whether any view can make it; ``stated`` statements by number of the view, the view for all first; ``planned``
    exposures of these views, where the study asks for them.
    """

    entrant: Entrant
    scores: xr.Dataset
    screened: Floats
    screened_u: Floats
    screened_view: NDArray[np.int64]
    far: bool = False
    stated: dict[int, list[Statement]] = field(default_factory=dict)
    raced: Raced | None = None
    planned: dict[int, PlannedExposure] = field(default_factory=dict)

    @property
    def ratio(self) -> float:
        """Worst demand of the measurements, each from its best view; infinite where one cannot be made."""
        best = [math.inf if row is None else row[1] for row in self.best()] if self.stated else self.screened.tolist()
        return max(best, default=math.inf)

    def best(self) -> list[tuple[int, float, Statement] | None]:
        """Of every measurement the stated view of least demand, with both; None where none gave a value."""
        out = list[tuple[int, float, Statement] | None]()
        for m in range(len(self.screened)):
            rows = [(view, _demand(some[m]), some[m]) for view, some in self.stated.items()]
            rows = [row for row in rows if math.isfinite(row[1])]
            out.append(min(rows, key=lambda row: row[1]) if rows else None)
        return out


def _demand(one: Statement) -> float:
    """The rule's demand; without a tolerance the root mean square error."""
    value = one.root_mean_square if one.decided is None else one.decided.demand
    return value if math.isfinite(value) else math.inf


def choose_sensor(
    entrants: list[Entrant],
    folder: Path,
    minutes: float,
    tell: Callable[[list[Found], bool], None],
    workers: Executor | None = None,
) -> list[Found]:
    """Screen, race and state; ``tell`` is given what is known, and whether that is all, whenever a sensor is done.

    Returns the entrants, best first.
    """
    end = time.monotonic() + 60 * minutes
    found = list[Found]()
    for number, entrant in enumerate(entrants, 1):
        found.append(_screened(entrant, folder / entrant.name))
        _say(found, f"{number} of {len(entrants)} screened", end)
    open_ones = _in_the_race(found)
    tell(_ordered(found), False)
    for place, one in enumerate(open_ones):
        left = end - time.monotonic()
        if left <= 0 and place:
            say(f"choose: time is over; {len(open_ones) - place} sensors are judged by the screening alone")
            break
        _measured(one, folder / one.entrant.name, max(left, 1.0) / (len(open_ones) - place), workers)
        _say(found, f"{place + 1} of {len(open_ones)} sensors measured", end)
        tell(_ordered(found), False)
    leader = _ordered(found)[0]
    if leader.stated and time.monotonic() < end:
        _surer(leader, folder / leader.entrant.name, end, workers)
    tell(_ordered(found), True)
    return _ordered(found)


def _in_the_race(found: list[Found]) -> list[Found]:
    """Those worth a virtual measurement, best first; at least one, if any can measure at all."""
    tolerances = any(one.tolerance is not None for one in found[0].entrant.study.task.measurements.values())
    order = sorted(found, key=lambda one: one.ratio if tolerances else _together(one))
    least = 1.0 if tolerances else _together(order[0])
    for place, one in enumerate(order):
        worst = one.ratio if tolerances else _together(one)
        one.far = not math.isfinite(worst) or (place > 0 and worst > FAR * least)
    return [one for one in order if not one.far]


def _together(one: Found) -> float:
    """Geometric mean of the screened demands: without tolerances measurements have no other scale in common."""
    return float(np.exp(np.mean(np.log(one.screened)))) if np.isfinite(one.screened).all() else math.inf


def _ordered(found: list[Found]) -> list[Found]:
    return sorted(found, key=sort_key)


def sort_key(one: Found) -> tuple[bool, float]:
    """Those that were measured first, by their worst measurement; then those that were screened."""
    tolerances = any(asked.tolerance is not None for asked in one.entrant.study.task.measurements.values())
    if tolerances:
        return not one.stated, one.ratio
    rows = [math.inf if row is None else row[1] for row in one.best()] if one.stated else one.screened.tolist()
    return not one.stated, float(np.mean(np.log(rows)))


def _screened(entrant: Entrant, folder: Path) -> Found:
    """Scores of all views, from the folder if they are there."""
    study, path = entrant.study, folder / "scores.nc"
    folder.mkdir(parents=True, exist_ok=True)
    unknowns = study_unknowns(study)
    digest = trial_digest(study, unknowns, f"screening {study.file.score.light_path_depth} {map_digest(study)}")
    scores = _kept(path, digest)
    if scores is None:
        from mitsim.prediction import Predictor
        from mitsim.reconstruction.cloud import sensor_geometry

        assert study.performance_map is not None
        predictor = Predictor.of_sensor(study.sensor, sensor_geometry(study.sensor))
        say(f"choose: {entrant.name}, {len(study.views)} views")
        scores, _ = screen(study, predictor, study.performance_map)
        scores.attrs["digest"] = digest
        write_netcdf(scores, path)
        gc.collect()
    u = scores["predicted_uncertainty"].transpose("measurement", "view").values
    able = scores["uncertainty_possible"].transpose("measurement", "view").values.astype(bool) & (u > 0)
    worth = np.where(able, u, np.inf)
    best = worth.argmin(axis=1)
    least = np.take_along_axis(worth, best[:, None], axis=1)[:, 0]
    asked = [
        _screened_demand(study.task, name, float(size))
        for name, size in zip(study.task.measurements, least, strict=True)
    ]
    return Found(entrant, scores, np.array(asked), least, scores["view"].values[best].astype(np.int64))


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


def screened_errors(u: float) -> Floats:
    """Errors that stand for a screened uncertainty: normal, without bias."""
    return np.asarray(u * _NORMAL)


def _screened_demand(task: Task, name: str, u: float) -> float:
    tolerance = tolerance_of(task, name)
    if not math.isfinite(u):
        return math.inf
    return u if tolerance is None else demand(screened_errors(u), tolerance)


@dataclass
class _Worked:
    """All that virtual measurements of an entrant need, laid out."""

    entrant: Entrant
    unknowns: Unknowns
    here: RenderedMeasurements | MappedMeasurements
    maker: Maker
    trials: TrialFolder
    digest: str
    folder: Path
    planned: dict[int, PlannedExposure] = field(default_factory=dict)

    def state(self, view: int, count: int) -> list[Statement]:
        study = self.entrant.study
        chosen = next(one for one in study.views if one.number == view)
        exposed = exposed_for(study, chosen, self.here, self.maker, self.digest, self.folder)
        if exposed.planned is not None:
            self.planned[view] = exposed.planned
        trials = exposed.trials(study, self.folder, self.trials)
        return state_view(study, chosen, exposed.maker, trials, self.unknowns, StatementTable(trials=count, pairs=0))


def _laid_out(entrant: Entrant, folder: Path, workers: Executor | None) -> _Worked:
    study, unknowns = entrant.study, study_unknowns(entrant.study)
    here = measurements_of(study, unknowns)
    maker = spread_over(workers, study, unknowns, here)
    digest = trial_digest(study, unknowns, maker.source)
    trials = TrialFolder(folder / "trials", digest, list(study.task.measurements))
    return _Worked(entrant, unknowns, here, maker, trials, digest, folder)


def _measured(one: Found, folder: Path, seconds: float, workers: Executor | None) -> None:
    """Race and state one sensor in about so many seconds."""
    began = time.monotonic()
    study, worked = one.entrant.study, _laid_out(one.entrant, folder, workers)
    table = study.file.race
    rules = RaceRules(
        min(SHORTLIST, table.shortlist), min(RACE_TRIALS, table.trials), table.margin, 0.9, _RACE_SHARE * seconds
    )
    one.raced = run_race(study.views, one.scores, worked.maker, worked.trials, rules)
    if not len(one.raced.views):
        return
    view, most = one.raced.leader(ALL), study.file.statement.trials
    count = min(FIRST_TRIALS, most)
    while True:
        one.stated[view] = worked.state(view, count)
        for number in _own_views(one, list(study.task.measurements), view):
            if time.monotonic() - began > seconds:
                break
            one.stated[number] = worked.state(number, count)
        if time.monotonic() - began > seconds or count >= most or not _open(one):
            break
        count = min(2 * count, most)
    _write(one, worked, folder, view)
    del worked
    gc.collect()


def _say(found: list[Found], done: str, end: float) -> None:
    """How far along, and who leads."""
    first = _ordered(found)[0]
    names = list(first.entrant.study.task.measurements)
    stated = [math.inf if row is None else row[1] for row in first.best()]
    rows: list[float] = stated if first.stated else first.screened.tolist()
    worst = int(np.argmax(rows))
    by = "measured" if first.stated else "by the screening"
    asked = first.entrant.study.task.measurements[names[worst]]
    size = f"{rows[worst]:.2g}"
    told = f"{size} times what may be ({names[worst]})" if asked.tolerance else f"{size} {asked.unit} ({names[worst]})"
    left = max(0.0, end - time.monotonic())
    say(f"choose: {done}; {first.entrant.name} leads {by}, at worst {told}; {left:.0f} s left")


def _open(one: Found) -> bool:
    """Whether more trials could change a verdict."""
    return any(row is not None and row[2].verdict == "not decided" for row in one.best())


def _own_views(one: Found, names: list[str], view: int) -> list[int]:
    """Leaders of measurements that do not fit from the view for all, and would be better off, by the race."""
    assert one.raced is not None
    out = list[int]()
    place = int(np.flatnonzero(one.raced.views == view)[0])
    for name, known in zip(names, one.stated[view], strict=True):
        standing = one.raced.standings[name]
        better = standing.risk[standing.leader] < _WORTH * standing.risk[place]
        if known.verdict not in ("fits", "no tolerance") and better:
            out.append(one.raced.leader(name))
    return list(dict.fromkeys(out))


def _surer(leader: Found, folder: Path, end: float, workers: Executor | None) -> None:
    """More trials of the leader, to the full number of the study, as long as there is time."""
    worked = _laid_out(leader.entrant, folder, workers)
    most = leader.entrant.study.file.statement.trials
    used = {row[0] for row in leader.best() if row is not None}
    while time.monotonic() < end:
        behind = [view for view in used if leader.stated[view] and leader.stated[view][0].trials < most]
        if not behind:
            break
        view = min(behind, key=lambda number: leader.stated[number][0].trials)
        leader.stated[view] = worked.state(view, min(leader.stated[view][0].trials + 40, most))
    _write(leader, worked, folder, next(iter(leader.stated)))


def _write(one: Found, worked: _Worked, folder: Path, view: int) -> None:
    study = one.entrant.study
    one.planned.update(worked.planned)
    chosen = next(known for known in study.views if known.number == view)
    document: dict[str, Any] = statement_document(
        study, chosen, one.stated[view], worked.unknowns, worked.maker.source, one.planned.get(view)
    )
    write_statement(folder / "statement.json", document)
