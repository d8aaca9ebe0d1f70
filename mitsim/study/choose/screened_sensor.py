"""Screen a sensor: score its views within a limit of time, or use the scores in its folder again."""

from __future__ import annotations

import gc
import math
from pathlib import Path

import numpy as np
import xarray as xr

from characterisation.files.datasets import Schema, Variable, read_dataset
from characterisation.files.errors import InputError
from characterisation.statements.decision import demand
from characterisation.statements.tolerance import tolerance_of
from characterisation.tasks.task_file import Task
from characterisation.words.progress import say
from mitsim.maps.campaign.run import write_netcdf
from mitsim.running.time_limit import TimeLimit
from mitsim.study.choose.candidates import CandidateSensor
from mitsim.study.choose.sensor_result import SensorResult
from mitsim.study.screened_errors import screened_errors, stated_shares
from mitsim.study.session import Session
from mitsim.study.virtual.plan import map_digest, trial_digest
from mitsim.views.scoring_time import not_scored_in_words
from mitsim.views.view_scores import screening_risk

#: a sensor with views left out is screened again if its share of the time is longer than before by this factor
_LONGER = 1.5


def screen_sensor(candidate: CandidateSensor, session: Session, limit: TimeLimit, equal: float) -> SensorResult:
    """Return the scores of all views, from the folder if they are there, or of those that the limit allows.

    - ``candidate``, ``session``: the sensor, with the study for it; its session, with the folder of the sensor.
    - ``limit``, ``equal``: time of the screening of this sensor; its share [s] of the time for screening, before
      sensors leave some of theirs. Kept scores of fewer views are used again if it is hardly longer than theirs was.
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
