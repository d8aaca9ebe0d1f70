"""Trials of a case, of four kinds, each in its own worlds.

- *tool*: the trials of statements, and beside them those of the *race*;
- *truth*: trials of every candidate, for the risks, in the worlds of the race;
- *choice*: trials of the candidates of a race, for the regret of its choices, in other worlds;
- *apart*: trials of the stated views, for the coverage. Nothing is shared: every world renders all of its light at its
  own pose.

All kinds but *tool* may include light paths over more surfaces than the tool, and have other worlds in every case. With
the same 45 decoders in all cases of a matcher, 13 of 45 correlated blocks of 7 px where a statement had 14 %, and the
misses of one case were those of all.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mitsim.running.executor import Executor
from mitsim.study import Study
from mitsim.study.session import Session
from mitsim.study.virtual.race import Job, complete
from mitsim.study.virtual.trials import TrialFolder
from mitsim.study.virtual.world import JUDGING_DAYS, Trial
from mitsim.views import View
from tests.proofs.kept_trials import take_up_trials, write_trials
from tests.proofs.part_cases import PartCase

#: kinds of trials, with the offset of the seed of their unknowns from the study's
KINDS = {"tool": 0, "truth": 1 << 20, "apart": 1 << 21, "choice": 3 << 20}


def trials_by_kind(case: PartCase, study: Study, folder: Path, workers: Executor | None = None) -> dict[str, Session]:
    """Return a session for each kind of trials, with the trials in the folder and in the cases file."""
    found = {
        kind: Session(_study_of_kind(case, study, kind), folder / case.name / kind, workers, kind == "apart")
        for kind in KINDS
    }
    if case.measured is not None:
        take_up_trials(case.measured / f"{case.name}.nc", _folders(found))
    return found


def _study_of_kind(case: PartCase, study: Study, kind: str) -> Study:
    """Return the study with the worlds of a kind, and with its light paths."""
    own = 0 if kind == "tool" else zlib.crc32(case.name.encode()) % (1 << 19)
    file = study.file.model_copy(update={"seed": study.file.seed + KINDS[kind] + own})
    if kind != "tool" and case.table.surfaces is not None:
        measured_with = file.measure.model_copy(update={"light_path_depth": case.table.surfaces})
        file = file.model_copy(update={"measure": measured_with})
    return replace(study, file=file)


def measure_worlds(
    case: PartCase, kind: str, session: Session, views: Iterable[View], worlds: dict[int, Sequence[Trial]]
) -> None:
    """Measure views in the ``worlds`` of each, by its number, and reuse existing trials."""
    jobs = [Job(view, trial) for view in views for trial in worlds[view.number]]
    if any(job.trial not in session.trials.known(job.view.number) for job in jobs):  # else nothing is prepared
        complete(session.trials, session.runner, jobs, f"{case.name}: {kind}")


def keep_trials(case: PartCase, folder: Path, found: dict[str, Session]) -> None:
    """Write all trials of a case to one file in the folder."""
    views = [view.number for view in found["truth"].study.views]
    write_trials(folder / f"{case.name}.nc", _folders(found), views)


def _folders(found: dict[str, Session]) -> dict[str, TrialFolder]:
    """Return the folders of all trials by kind."""
    return {kind: one.trials for kind, one in found.items()} | {"race": found["tool"].race_trials}


def measured_truth(case: PartCase, session: Session) -> NDArray[np.float64]:
    """Measure every candidate in the worlds of the truth.

    Returns errors (measurement, view, world): NaN where a world gave no value, infinite where the view was not measured
    in a world. Raced views are measured in more worlds.
    """
    file, study = case.file, session.study
    views = study.views
    worlds = {
        view.number: file.raced_worlds if case.table.raced and place < file.raced_candidates else file.worlds
        for place, view in enumerate(views)
    }
    measure_worlds(case, "truth", session, views, {number: days(count) for number, count in worlds.items()})
    truth = np.full((len(study.task.measurements), len(views), max(worlds.values())), np.inf)
    for v, view in enumerate(views):
        truth[:, v, : worlds[view.number]] = session.trials.errors(view.number, days(worlds[view.number]))
    return truth


def measured_choice(case: PartCase, session: Session) -> NDArray[np.float64]:
    """Measure the candidates of a race in other worlds than those of the race.

    Returns errors (measurement, candidate, world), NaN where a world gave no value.
    """
    views, worlds = session.study.views[: case.file.raced_candidates], days(case.file.raced_worlds, JUDGING_DAYS)
    measure_worlds(case, "choice", session, views, {view.number: worlds for view in views})
    return np.stack([session.trials.errors(view.number, worlds) for view in views], axis=1)


def days(count: int, first: int = 0) -> list[Trial]:
    """Return ``count`` worlds, each on its own day."""
    return [Trial(first + day) for day in range(count)]
