"""Compare scores of views with the errors of their measurements: deciles of every measurement of every sample.

Three scores are compared: the talk's V_m, the predicted risk u / sqrt(chance) with its sign changed, and the number of
points on the features of the measurement. Each has its own impossible views.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import xarray as xr

from characterisation.files.arrays import Floats
from characterisation.scores.deciles import deciles, mean_ranks
from characterisation.tasks.task_file import Task

#: scores that are compared, in words
SCORES = {"V_m": "view score V_m", "risk": "predicted risk", "points": "number of points"}

#: quantities of a bin that are ranked, in words
QUANTITIES = {"error": "mean error", "deviation": "standard deviation", "share": "share of trials with a value"}

#: least number of points on a feature; as of the view score
_LEAST_POINTS = 100


@dataclass(frozen=True)
class JudgedViews:
    """Scores of a sample's views, and errors (measurement, view, trial) of their measurements, by sample."""

    task: Task
    scores: Mapping[str, xr.Dataset]
    errors: Mapping[str, xr.Dataset]

    def score(self, sample: str, measurement: str, kind: str) -> Floats:
        """Return one score (view,), a key of :data:`SCORES`; larger is better, NaN for an impossible view."""
        scores = self.scores[sample].sel(measurement=measurement)
        if kind == "V_m":
            return np.where(scores["possible"].values > 0, scores["V_m"].values, np.nan)
        if kind == "risk":
            u, chance = scores["predicted_uncertainty"].values.astype(float), scores["chance"].values.astype(float)
            able = np.isfinite(u) & (u > 0) & (chance > 0)
            return np.where(able, 0.5 * np.log(np.where(able, chance, 1)) - np.log(np.where(able, u, 1)), np.nan)
        points = scores["n"].sel(feature=list(self.task.shapes_for(measurement))).values
        return np.where((points >= _LEAST_POINTS).all(axis=1), points.sum(axis=1), np.nan)

    def cell(self, sample: str, measurement: str, kind: str) -> xr.Dataset:
        """Return the deciles of one measurement of one sample."""
        score, errors = self.score(sample, measurement, kind), self.errors[sample]
        count = errors["tried"].values
        tried = count > 0
        return deciles(score[tried], errors["error"].sel(measurement=measurement).values[tried], count[tried])

    def ranks(self, kind: str) -> dict[str, xr.Dataset]:
        """Return the mean ranks of the bins over all measurements and samples with errors, by :data:`QUANTITIES`."""
        cells = [self.cell(sample, name, kind) for sample in self.errors for name in self.task.measurements]
        return {quantity: mean_ranks(cells, quantity) for quantity in QUANTITIES}


def true_error(errors: xr.Dataset, measurement: str) -> Floats:
    """Return the mean absolute error (view,) over the trials with a value, NaN without any."""
    values = np.abs(errors["error"].sel(measurement=measurement).values.astype(float))
    valid = np.isfinite(values)
    count = valid.sum(axis=1)
    total = np.where(valid, values, 0).sum(axis=1)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)
