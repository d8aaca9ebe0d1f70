"""Tables of a race: scores of all views with its ranks, and its errors by trial.

Signal chain: scores of screening, result of a race -> data sets for ``scores.nc`` and ``checks.nc``.
"""

from __future__ import annotations

import numpy as np
import xarray as xr

from characterisation.tasks.task_file import Task
from mitsim.study.virtual.race import ALL, Raced


def with_race(scores: xr.Dataset, raced: Raced) -> xr.Dataset:
    """Add ``measured_risk``, ``trials`` and ``final_rank`` (measurement, view) from the race.

    Measured views come first, by their risk; the others follow in the order of screening.
    """
    names = [str(name) for name in scores["measurement"].values]
    indices = {int(view): index for index, view in enumerate(scores["view"].values)}
    shape = (len(names), scores.sizes["view"])
    risk, count = np.full(shape, np.nan), np.zeros(shape, int)
    columns = [indices[int(view)] for view in raced.views]
    if columns:
        risk[:, columns] = [raced.standings[name].risk for name in names]
        count[:, columns] = (~np.isinf(raced.errors)).sum(axis=2)
    screened = scores["uncertainty_rank"].transpose("measurement", "view").values
    order = np.lexsort((screened, np.where(np.isfinite(risk), risk, np.inf)), axis=1)
    rank = np.empty(shape, int)
    np.put_along_axis(rank, order, np.broadcast_to(np.arange(1, shape[1] + 1), shape), axis=1)
    by = ("measurement", "view")
    out = scores.copy()
    name = "root mean square error of virtual measurements over the square root of the share with a value"
    out["measured_risk"] = (by, risk, {"long_name": name, "units": "mm or deg"})
    out["trials"] = (by, count, {"long_name": "virtual measurements of the race", "units": "1"})
    out["final_rank"] = (by, rank, {"long_name": "rank by race, then by screening; 1 is best", "units": "1"})
    return out


def raced_errors(raced: Raced, task: Task) -> xr.Dataset:
    """Return the errors of the race (measurement, view, repeat), NaN without a value; the best view comes first.

    ``tried`` distinguishes a trial without a value from one that was not made.
    """
    order = np.argsort(raced.standings[ALL].risk, kind="stable") if len(raced.views) else np.empty(0, int)
    tried = ~np.isinf(raced.errors[:, order])
    errors = np.where(tried, raced.errors[:, order], np.nan)
    dims = ("measurement", "view", "repeat")
    nominal = np.array([measurement.nominal for measurement in task.measurements.values()])[:, None, None]
    return xr.Dataset(
        {
            "error": (dims, errors, {"units": "mm or deg"}),
            "value": (dims, errors + nominal, {"units": "mm or deg"}),
            "tried": (dims, tried.astype(np.int8), {"units": "1"}),
        },
        coords={"measurement": list(task.measurements), "view": raced.views[order]},
    )
