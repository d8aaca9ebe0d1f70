"""Score the candidate views of the artefact, and read the errors of their virtual measurements.

Slides *Viewpoint Scoring*, *The View Score*, *Example Result* and *View Score Accuracy*.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import xarray as xr

from mitsim.study import StudyFile, open_study
from mitsim.study.session import Session
from mitsim.study.virtual.trials import TrialFolder
from mitsim.study.virtual.world import Trial

#: variables of scores that the page shows
SHOWN = "n S_f R_f S_m R_m V_m possible predicted_uncertainty chance azimuth_deg elevation_deg"


def scores_of(folder: str, file: StudyFile) -> xr.Dataset:
    """Return the scores that are shown of all candidate views of the artefact in one finish; nothing is rendered.

    ``left_out`` are the directions of impossible views, with their reasons.
    """
    study = open_study(Path(folder) / "talk.toml", file)
    scores, _ = Session(study).screen()
    kept = scores[SHOWN.split()].assign_attrs({})
    kept["unit"] = ("measurement", scores["unit"].values.astype(str))
    for name in kept.data_vars:
        if kept[name].dtype == np.float64:
            kept[name] = kept[name].astype(np.float32)
    kept["possible"] = kept["possible"].astype(np.int8)
    outside = study.candidates.left_out
    directions = np.array([out.direction for out in outside], float).reshape(-1, 3)
    kept["left_out"] = (("outside", "xyz"), directions)
    kept["reason"] = ("outside", np.array([out.reason for out in outside] or [""], dtype=str)[: len(outside)])
    for name in ("measurement", "feature", "unit", "reason"):
        kept[name] = kept[name].astype(object)
    return kept.assign_attrs(standoff_mm=study.views[0].standoff, moved_out=study.candidates.moved_out)


def errors_of(trials: TrialFolder, views: Sequence[int], count: int) -> xr.Dataset:
    """Return the errors (measurement, view, trial) of virtual measurements, and the number ``tried`` (view,)."""
    errors = np.full((len(trials.measurements), len(views), count), np.nan, np.float32)
    tried = np.zeros(len(views), np.int64)
    for number, view in enumerate(views):
        done = [Trial(day) for day in range(count) if Trial(day) in trials.known(view)]
        tried[number] = len(done)
        if done:
            errors[:, number, : len(done)] = trials.errors(view, done)
    return xr.Dataset(
        {"error": (("measurement", "view", "trial"), errors, {"units": "mm or deg"}), "tried": ("view", tried)},
        {"measurement": np.array(trials.measurements, dtype=object), "view": list(views)},
        {"source": "virtual measurements"},
    )
