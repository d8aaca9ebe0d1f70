"""Trials of a case, of four kinds, each in its own worlds.

- *tool*: the trials of race and statement;
- *truth*: trials of every candidate, for the risks. They share interreflections and the pool of finishes as the tool's
  trials do;
- *choice*: trials of the candidates of a race, for the regret of its choices. Every two worlds have their own finish,
  so that the finishes of a pool do not decide which view is the best;
- *apart*: trials of the stated views, for the coverage. Nothing is shared or pooled: every world renders all of its
  light at its own pose, with its own finish.

All kinds but *tool* may include light paths over more surfaces than the tool.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mitsim.running.executor import Executor
from mitsim.running.progress import track
from mitsim.study import Study
from mitsim.study.virtual.plan import measured_by, measurements_of, trial_digest
from mitsim.study.virtual.race import Job, TrialRunner
from mitsim.study.virtual.spread_out import spread_over
from mitsim.study.virtual.study_unknowns import study_unknowns
from mitsim.study.virtual.trials import TrialFolder
from mitsim.study.virtual.world import OWN_FINISH_DAYS, Trial, Unknowns
from mitsim.views import View
from tests.proofs.kept_trials import take_up_trials, write_trials
from tests.proofs.part_cases import PartCase

#: kinds of trials, with the offset of the seed of their unknowns from the study's
KINDS = {"tool": 0, "truth": 1 << 20, "apart": 1 << 21, "choice": 3 << 20}


class CaseTrials:
    """Makes the trials of one kind of a case, and keeps them."""

    def __init__(self, case: PartCase, study: Study, folder: Path, kind: str, workers: Executor | None = None) -> None:
        if kind != "tool" and case.table.surfaces is not None:
            measured_with = study.file.measure.model_copy(update={"light_path_depth": case.table.surfaces})
            study = replace(study, file=study.file.model_copy(update={"measure": measured_with}))
        self.name, self.study, self.kind, self.workers = case.name, study, kind, workers
        separate_light = kind == "apart"
        unknowns = study_unknowns(study)
        self.unknowns: Unknowns = replace(unknowns, seed=unknowns.seed + KINDS[kind], pooled=not separate_light)
        self._runner: TrialRunner | None = None
        digest = trial_digest(study, self.unknowns, measured_by(study), separate_light)
        self.trials = TrialFolder.of(folder / case.name / kind, digest, study.task)

    @property
    def runner(self) -> TrialRunner:
        """Return the runner of trials, created on first use: a case with all trials renders nothing."""
        if self._runner is None:
            virtual_measurements = measurements_of(self.study, self.unknowns, self.kind == "apart")
            self._runner = spread_over(self.workers, self.study, self.unknowns, virtual_measurements)
        return self._runner

    def measure(self, views: Iterable[View], worlds: dict[int, Sequence[Trial]]) -> None:
        """Measure views in the ``worlds`` of each, by its number, and reuse existing trials."""
        jobs = [
            Job(view, trial)
            for view in views
            for trial in worlds[view.number]
            if trial not in self.trials.known(view.number)
        ]
        if jobs:
            label = f"{self.name}: {self.kind}"
            for job, outcome in track(self.runner.run(self.runner.in_order(jobs)), label, len(jobs)):
                self.trials.add(job.view.number, job.trial, outcome)


def trials_by_kind(
    case: PartCase, study: Study, folder: Path, workers: Executor | None = None
) -> dict[str, CaseTrials]:
    """Return the trials of each kind, with those in the folder and in the cases file."""
    found = {kind: CaseTrials(case, study, folder, kind, workers) for kind in KINDS}
    if case.measured is not None:
        take_up_trials(case.measured / f"{case.name}.nc", {kind: one.trials for kind, one in found.items()})
    return found


def keep_trials(case: PartCase, folder: Path, found: dict[str, CaseTrials]) -> None:
    """Write all trials of a case to one file in the folder."""
    trials = {kind: one.trials for kind, one in found.items()}
    views = [view.number for view in found["truth"].study.views]
    write_trials(folder / f"{case.name}.nc", trials, views)


def measured_truth(case: PartCase, case_trials: CaseTrials) -> NDArray[np.float64]:
    """Measure every candidate in the worlds of the truth.

    Returns errors (measurement, view, world): NaN where a world gave no value, infinite where the view was not measured
    in a world. Raced views are measured in more worlds.
    """
    file, study = case.file, case_trials.study
    views = study.views
    worlds = {
        view.number: file.raced_worlds if case.table.raced and place < file.raced_candidates else file.worlds
        for place, view in enumerate(views)
    }
    case_trials.measure(views, {number: days(count) for number, count in worlds.items()})
    truth = np.full((len(study.task.measurements), len(views), max(worlds.values())), np.inf)
    for v, view in enumerate(views):
        truth[:, v, : worlds[view.number]] = case_trials.trials.errors(view.number, days(worlds[view.number]))
    return truth


def measured_choice(case: PartCase, case_trials: CaseTrials) -> NDArray[np.float64]:
    """Measure the candidates of a race in worlds with their own finishes.

    Returns errors (measurement, candidate, world), NaN where a world gave no value.
    """
    views, worlds = case_trials.study.views[: case.file.raced_candidates], days(case.file.raced_worlds, OWN_FINISH_DAYS)
    case_trials.measure(views, {view.number: worlds for view in views})
    return np.stack([case_trials.trials.errors(view.number, worlds) for view in views], axis=1)


def days(count: int, first: int = 0) -> list[Trial]:
    """Return ``count`` worlds, each on its own day."""
    return [Trial(first + day) for day in range(count)]
