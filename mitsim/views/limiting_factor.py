"""Name what limits each measurement in each view: noise, few points, geometry or occlusion.

Signal chain: expected fits of all views -> noise, number of points and geometry of each contribution to u -> the one
that is farthest from its best over all views.

A contribution to u is noise / sqrt(n) times a factor of geometry.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from characterisation.tasks.measurement_model import InputQuantity
from characterisation.tasks.prediction import ExpectedInput, ExpectedMeasurement
from characterisation.tasks.task_file import Task

#: R_f below which a lack of points is attributed to occlusion
OCCLUDED = 0.75


def limiting_factors(
    task: Task,
    measured: Sequence[Sequence[ExpectedMeasurement]],
    inputs: Sequence[Mapping[InputQuantity, Any]],
    share: xr.DataArray,
    possible: NDArray[np.bool_],
) -> tuple[NDArray[np.str_], NDArray[np.str_]]:
    """Return the limiting factor of each measurement in each view, and its feature, (measurement, view) each.

    ``measured`` and ``inputs`` are the expected measurements of each view, in the order of the task, and their input
    quantities; ``share`` is R_f (view, feature), ``possible`` (measurement, view) says whether a measurement is.
    """
    shape = (len(task.measurements), len(measured))
    limit, feature = np.full(shape, "", object), np.full(shape, "", object)
    kinds = {name: definition.kind for name, definition in task.features.items()}
    for m in range(shape[0]):
        for v, row in enumerate(measured):
            predicted = row[m]
            if not predicted.uncertainty > 0:
                short = [name for name in predicted.reason.split(":")[0].split(", ") if name in kinds]
                feature[m, v] = short[0] if short else ""
        quantities = next((row[m].inputs for row in measured), ())
        parts = np.array([row[m].contributions for row in measured])
        noise, count = np.full((2, len(measured), len(quantities)), np.nan)
        for v, expected_of in enumerate(inputs):
            for i, quantity in enumerate(quantities):
                if isinstance(expected := expected_of[quantity], ExpectedInput):
                    noise[v, i], count[v, i] = expected.fit.noise, expected.fit.count
        able = possible[m]
        if not able.any():
            limit[m] = "few points"
            continue
        among = np.broadcast_to(able[:, None], noise.shape)
        with np.errstate(invalid="ignore", divide="ignore"):
            geometry = parts * np.sqrt(count) / noise
            noisier = noise / np.min(noise, axis=0, where=among & np.isfinite(noise), initial=np.inf)
            fewer = np.sqrt(np.max(count, axis=0, where=among & np.isfinite(count), initial=0.0) / count)
            flatter = geometry / np.min(geometry, axis=0, where=among & (geometry > 0), initial=np.inf)
            excess = np.stack([noisier, fewer, flatter])
        for v in range(len(measured)):
            if not np.isfinite(parts[v]).all() or not parts[v].any():
                limit[m, v] = "few points"
                continue
            worst = int(np.argmax(parts[v]))
            name = quantities[worst].features[0]
            feature[m, v] = name
            cause = int(np.nanargmax(np.where(np.isfinite(excess[:, v, worst]), excess[:, v, worst], -1)))
            limit[m, v] = ("noise", "few points", "small extent" if kinds[name] == "plane" else "short arc")[cause]
            shaped = name in share["feature"].values
            if cause == 1 and shaped and float(share.sel(feature=name).values[v]) < OCCLUDED:
                limit[m, v] = "occlusion"
            if not able[v]:
                limit[m, v] = "occlusion" if limit[m, v] == "occlusion" else "few points"
    return limit.astype(str), feature.astype(str)
