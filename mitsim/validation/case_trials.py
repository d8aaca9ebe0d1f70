"""Trials of a case, of three kinds, each in worlds of its own.

- *tool*: those that the race and the statement make;
- *truth*: of every candidate, for the risks. They share light of other surfaces as the tool's do;
- *apart*: of the views that are stated, for the coverage. Nothing is shared or pooled: every world renders all of its
  light from its own pose, with a finish of its own.

Truth and apart may have light of more surfaces than the tool allows for.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mitsim.campaign.executor import Executor
from mitsim.progress import track
from mitsim.study import Study
from mitsim.validation.kept_trials import take_up_trials, write_trials
from mitsim.validation.part_cases import PartCase
from mitsim.views import View
from mitsim.virtual.plan import measured_by, measurements_of, trial_digest
from mitsim.virtual.race import Job, Maker
from mitsim.virtual.spread_out import spread_over
from mitsim.virtual.study_unknowns import study_unknowns
from mitsim.virtual.trials import TrialFolder
from mitsim.virtual.world import Trial, Unknowns

#: kinds of trials, and by how much the seed of their unknowns differs from the study's
KINDS = {"tool": 0, "truth": 1 << 20, "apart": 1 << 21}


class Bench:
    """What makes the trials of one kind of a case, and where they are kept."""

    def __init__(self, case: PartCase, study: Study, folder: Path, kind: str, workers: Executor | None = None) -> None:
        if kind != "tool" and case.table.surfaces is not None:
            told = study.file.measure.model_copy(update={"light_path_depth": case.table.surfaces})
            study = replace(study, file=study.file.model_copy(update={"measure": told}))
        self.name, self.study, self.kind, self.workers = case.name, study, kind, workers
        apart = kind == "apart"
        unknowns = study_unknowns(study)
        self.unknowns: Unknowns = replace(unknowns, seed=unknowns.seed + KINDS[kind], pooled=not apart)
        self._maker: Maker | None = None
        digest = trial_digest(study, self.unknowns, measured_by(study), apart)
        self.trials = TrialFolder(folder / case.name / kind, digest, list(study.task.measurements))

    @property
    def maker(self) -> Maker:
        """Made when it is first needed: a case whose trials are all known renders nothing."""
        if self._maker is None:
            here = measurements_of(self.study, self.unknowns, self.kind == "apart")
            self._maker = spread_over(self.workers, self.study, self.unknowns, here)
        return self._maker

    def measure(self, views: Iterable[View], worlds: dict[int, int]) -> None:
        """Measure views in so many worlds each; trials that are known are not made again."""
        jobs = [
            Job(view, trial)
            for view in views
            for trial in days(worlds[view.number])
            if trial not in self.trials.known(view.number)
        ]
        if jobs:
            for job, errors in track(self.maker.run(self.maker.in_order(jobs)), f"{self.name}: {self.kind}", len(jobs)):
                self.trials.add(job.view.number, job.trial, errors)


def benches(case: PartCase, study: Study, folder: Path, workers: Executor | None = None) -> dict[str, Bench]:
    """A bench for each kind of trials, with those that the folder or the file of cases holds."""
    found = {kind: Bench(case, study, folder, kind, workers) for kind in KINDS}
    if case.measured is not None:
        take_up_trials(case.measured / f"{case.name}.nc", {kind: one.trials for kind, one in found.items()})
    return found


def keep_trials(case: PartCase, folder: Path, found: dict[str, Bench]) -> None:
    """Write all trials of a case as one file into the folder."""
    trials = {kind: one.trials for kind, one in found.items()}
    views = [view.number for view in found["truth"].study.views]
    write_trials(folder / f"{case.name}.nc", trials, views)


def measured_truth(case: PartCase, bench: Bench) -> NDArray[np.float64]:
    """Measure every candidate in the worlds of the truth.

    Returns errors (measurement, view, world): NaN where a world gave no value, infinite where the view was not measured
    in a world, as those that are raced are in more.
    """
    file, study = case.file, bench.study
    views = study.views
    worlds = {
        view.number: file.raced_worlds if case.table.raced and place < file.raced_candidates else file.worlds
        for place, view in enumerate(views)
    }
    bench.measure(views, worlds)
    truth = np.full((len(study.task.measurements), len(views), max(worlds.values())), np.inf)
    for v, view in enumerate(views):
        truth[:, v, : worlds[view.number]] = bench.trials.errors(view.number, days(worlds[view.number]))
    return truth


def days(count: int) -> list[Trial]:
    """So many worlds, each a day of its own."""
    return [Trial(day) for day in range(count)]
