"""Judge statements of uncertainty and choices of views: worlds are drawn, measured, and compared with what was stated.

Signal chain: case (:mod:`mitsim.validation.part_cases`) -> screening, race and statement by the functions of
`mitsim run`, with its defaults -> errors in other worlds -> share of them inside the stated 95 % intervals; risk of the
chosen view over that of the best.

Three kinds of trials, each with unknowns of another seed:

- *tool*: those that the race and the statement make;
- *truth*: of every candidate, for the risks. They share light of other surfaces as the tool's do;
- *apart*: of the views that are stated, for the coverage. Nothing is shared or pooled: every world renders all of its
  light from its own pose, with a finish of its own.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from characterisation.statements.statement import Statement
from mitsim.predict import Predictor
from mitsim.predict.interreflection import Interreflections
from mitsim.progress import say, track
from mitsim.scene.self_view import sees_itself
from mitsim.score import score_candidates
from mitsim.study import MINIMUM_POINTS, StatementTable, Study
from mitsim.validation.kept_trials import take_up_trials, write_trials
from mitsim.validation.part_cases import PartCase
from mitsim.views import View
from mitsim.virtual.plan import measured_by, measurements_of, race_rules, study_unknowns, trial_digest
from mitsim.virtual.race import ALL, Job, Maker, Raced, run_race, screening_risk
from mitsim.virtual.stated import state_view
from mitsim.virtual.trials import TrialFolder
from mitsim.virtual.world import Trial, Unknowns

Floats = NDArray[np.float64]

#: kinds of trials, and by how much the seed of their unknowns differs from the study's
KINDS = {"tool": 0, "truth": 1 << 20, "apart": 1 << 21}


@dataclass(frozen=True)
class StatedView:
    """A view's statements, by measurement, and the ``errors`` (measurement, world) of worlds that they are judged by.

    ``why`` the view was stated.
    """

    view: int
    why: str
    statements: tuple[Statement, ...]
    errors: Floats


@dataclass(frozen=True)
class JudgedCase:
    """What was found of a case.

    ``views`` (v,) numbers of all candidates; ``truth`` (measurement, v, world) errors, infinite where a view was not
    measured in a world; ``scores`` of the screening; ``raced`` the race, None if the case is not raced.
    """

    case: PartCase
    measurements: tuple[str, ...]
    units: tuple[str, ...]
    views: NDArray[np.int64]
    truth: Floats
    scores: xr.Dataset
    raced: Raced | None
    stated: tuple[StatedView, ...]


def run_cases(cases: Sequence[PartCase], folder: str | Path) -> list[JudgedCase]:
    """Measure and judge all cases; what the folder, or the file of cases, holds of them is not measured again."""
    return [run_case(case, Path(folder)) for case in cases]


def run_case(case: PartCase, folder: Path) -> JudgedCase:
    """Measure and judge one case."""
    say(f"case: {case.name}")
    file, study = case.file, case.study
    names = list(study.task.measurements)
    bench = {kind: _Bench(case, folder, kind) for kind in KINDS}
    folders = {kind: one.trials for kind, one in bench.items()}
    if case.measured is not None:
        take_up_trials(case.measured / f"{case.name}.nc", folders)
    scores = _screened(study, bench["tool"].maker)
    raced_study = case.among(file.raced_candidates)
    raced = None
    if case.table.raced:
        told = scores.sel(view=[view.number for view in raced_study.views])
        raced = run_race(raced_study.views, told, bench["tool"].maker, folders["tool"], race_rules(study.file.race))
    wanted = {
        view.number: file.raced_worlds if case.table.raced and place < file.raced_candidates else file.worlds
        for place, view in enumerate(study.views)
    }
    bench["truth"].measure(study.views, wanted)
    stated = [_stated(case, bench, view, why) for view, why in _to_state(case, scores, raced)]
    numbers = [view.number for view in study.views]
    write_trials(folder / f"{case.name}.nc", folders, numbers)
    truth = np.full((len(names), len(numbers), max(wanted.values())), np.inf)
    for v, number in enumerate(numbers):
        truth[:, v, : wanted[number]] = folders["truth"].errors(number, _days(wanted[number]))
    units = tuple(one.unit for one in study.task.measurements.values())
    return JudgedCase(case, tuple(names), units, np.array(numbers), truth, scores, raced, tuple(stated))


class _Bench:
    """What makes the trials of one kind of a case, and where they are kept."""

    def __init__(self, case: PartCase, folder: Path, kind: str) -> None:
        self.name, self.study, self.kind = case.name, case.study, kind
        apart = kind == "apart"
        unknowns = study_unknowns(case.study)
        self.unknowns: Unknowns = replace(unknowns, seed=unknowns.seed + KINDS[kind], pooled=not apart)
        self._maker: Maker | None = None
        digest = trial_digest(case.study, self.unknowns, measured_by(case.study), apart)
        self.trials = TrialFolder(folder / case.name / kind, digest, list(case.study.task.measurements))

    @property
    def maker(self) -> Maker:
        """Made when it is first needed: a case whose trials are all known renders nothing."""
        if self._maker is None:
            self._maker = measurements_of(self.study, self.unknowns, self.kind == "apart")
        return self._maker

    def measure(self, views: Iterable[View], worlds: dict[int, int]) -> None:
        """Measure views in so many worlds each; trials that are known are not made again."""
        jobs = [
            Job(view, trial)
            for view in views
            for trial in _days(worlds[view.number])
            if trial not in self.trials.known(view.number)
        ]
        if jobs:
            for job, errors in track(self.maker.run(self.maker.in_order(jobs)), f"{self.name}: {self.kind}", len(jobs)):
                self.trials.add(job.view.number, job.trial, errors)


def _screened(study: Study, maker: Maker) -> xr.Dataset:
    """Scores of all candidates, as `mitsim run` screens them."""
    assert study.performance_map is not None
    depth = study.file.score.light_path_depth
    predictor: Predictor = maker.predictor  # type: ignore[attr-defined]
    reflected = Interreflections(study.sensor, depth) if depth > 1 and sees_itself(study.scene) else None
    return score_candidates(
        study.scene, study.task, study.views, predictor, study.performance_map, MINIMUM_POINTS, reflected
    )[0]


def _to_state(case: PartCase, scores: xr.Dataset, raced: Raced | None) -> list[tuple[View, str]]:
    """Views whose statements are judged: the chosen one, and others that the map thinks possible, at random."""
    risk = screening_risk(scores)
    by_number = {view.number: view for view in case.study.views}
    numbers = [int(number) for number in scores["view"].values]
    possible = [numbers[i] for i in np.flatnonzero(np.isfinite(risk).all(axis=0))]
    if not possible:
        finite = np.isfinite(risk).sum(axis=0)
        possible = [numbers[i] for i in np.flatnonzero(finite == finite.max())] if finite.max() else numbers
    total = np.where(np.isfinite(risk), risk, 0.0).sum(axis=0)
    by_screening = [numbers[i] for i in np.argsort(total, kind="stable") if numbers[i] in possible]
    first = None if raced is None else raced.leaders().get(ALL)
    chosen = [(by_screening[0] if first is None else first, "chosen")]
    others = [number for number in possible if number != chosen[0][0]]
    drawn = np.random.default_rng([case.file.seed, len(numbers)]).permutation(len(others))[: case.file.stated - 1]
    return [(by_number[number], why) for number, why in [*chosen, *((others[i], "at random") for i in drawn)]]


def _stated(case: PartCase, bench: dict[str, _Bench], view: View, why: str) -> StatedView:
    tool, apart, count = bench["tool"], bench["apart"], case.file.stated_worlds
    table = StatementTable(trials=case.study.file.statement.trials, pairs=0)
    statements = state_view(case.study, view, tool.maker, tool.trials, tool.unknowns, table)
    apart.measure([view], {view.number: count})
    return StatedView(view.number, why, tuple(statements), apart.trials.errors(view.number, _days(count)))


def _days(count: int) -> list[Trial]:
    return [Trial(day) for day in range(count)]
