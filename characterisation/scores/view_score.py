"""Compute the view score V_m of Kinnell and Justham (2018) from the expected points and noise of every view.

Signal chain: n, mean sigma per view and feature (from the performance map of the actual material, and of matt white) ->
n^ and sigma^ -> feature score S_f -> S^_f; matt white with and without the rest of the part -> occlusion ratio R_f ->
S_m, R_m -> V_m -> rank.

The equations are those of the slides "The View Score" (Kinnell and Justham, "Task Specific Viewpoint Optimisation",
Hamburg 2018), unchanged. What the slides do not define is filled as docs/explanation/view-score.md lists: for example,
a view with fewer than ``minimum_points`` on a needed feature has V_m = 0.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from characterisation.files.atomic_io import atomic_write
from characterisation.tasks.task_file import Task

#: Inputs of the score, each (view, feature): long name and unit.
INPUTS = {
    "n": ("expected points on the feature", "1"),
    "mean_sigma": ("mean standard deviation of the feature's points along the view ray", "mm"),
    "n_white": ("expected points on the feature in matt white", "1"),
    "mean_sigma_white": ("mean standard deviation along the view ray in matt white", "mm"),
    "n_only_white": ("expected points on the feature in matt white, alone without the rest of the part", "1"),
}


def view_statistics(
    features: Sequence[str],
    n: ArrayLike,
    mean_sigma: ArrayLike,
    n_white: ArrayLike,
    mean_sigma_white: ArrayLike,
    n_only_white: ArrayLike,
) -> xr.Dataset:
    """Return the inputs of the score, arrays (views, features), as a dataset; see :data:`INPUTS`.

    Raises ValueError if shapes differ, a number of points is negative or NaN, or points come without a positive sigma.

    Parameters
    ----------
    features, n, n_white, n_only_white
        Names; expected numbers of points, which may be fractional.
    mean_sigma, mean_sigma_white
        [mm], NaN where a view has no point on a feature.
    """
    arrays = [np.asarray(values, float) for values in (n, mean_sigma, n_white, mean_sigma_white, n_only_white)]
    shape = (len(arrays[0]), len(features))
    views = xr.Dataset(coords={"view": np.arange(shape[0]), "feature": list(features)})
    for (name, (long_name, units)), array in zip(INPUTS.items(), arrays, strict=True):
        if array.shape != shape:
            raise ValueError(f"{name} is {array.shape}, expected (views, features) = {shape}")
        views[name] = _variable(array, ("view", "feature"), long_name, units)
    _check(views)
    return views


def score_views(views: xr.Dataset, task: Task, minimum_points: float = 100) -> xr.Dataset:
    """Score and rank every view for every measurement of a task.

    ``views`` holds the variables of :data:`INPUTS` over (view, feature), from :func:`view_statistics`, with every
    feature of the task. A measurement is impossible from a view with fewer than ``minimum_points`` expected points on
    one of its features. Raises ValueError if a feature or variable is absent, or numbers are invalid.

    The result has ``S_f``, ``S_f_hat``, ``R_f`` (view, feature); ``S_m``, ``R_m``, ``V_m``, ``possible``, ``rank`` and
    ``limited_by`` (measurement, view); and ``n``. Where a measurement is impossible, V_m is 0 regardless of S_m R_m.
    ``limited_by`` then names the feature with the fewest points; elsewhere it is "". Rank 1 is best. Impossible views
    rank after all possible ones; of equal views the lower index ranks first.
    """
    _check(views)
    names = list(task.shapes)
    absent = sorted(set(names) - set(views["feature"].values.tolist()))
    if absent:
        raise ValueError(f"no statistics for the features {', '.join(absent)}")
    views = views.sel(feature=names).transpose("view", "feature", ...)
    n, sigma, n_white, sigma_white, n_only = (views[name].values.astype(float) for name in INPUTS)

    # n^_f = n_f / max(n_f)_MattWhite, sigma^_f = mean sigma_f / max(mean sigma_f)_MattWhite, maxima over the views
    n_hat = _ratio(n, n_white.max(axis=0, initial=0.0))
    sigma_hat = _ratio(sigma, np.where(n_white > 0, sigma_white, 0.0).max(axis=0, initial=0.0))
    S_f = np.where(n > 0, _ratio(n_hat, sigma_hat), 0.0)
    S_f_hat = _ratio(S_f, S_f.max(axis=0, initial=0.0))
    R_f = _ratio(n_white, n_only)

    shape = (len(task.measurements), len(n))
    S_m, R_m, limited_by = np.zeros(shape), np.zeros(shape), np.full(shape, "", dtype=object)
    possible = np.zeros(shape, bool)
    for m, measurement in enumerate(task.measurements):
        shapes = task.shapes_for(measurement)
        needed = [names.index(shape) for shape in shapes]
        S_m[m] = S_f_hat[:, needed].sum(axis=1)
        R_m[m] = R_f[:, needed].prod(axis=1)
        possible[m] = (n[:, needed] >= minimum_points).all(axis=1)
        weakest = np.asarray(shapes, object)[n[:, needed].argmin(axis=1)]
        limited_by[m] = np.where(possible[m], "", weakest)
    V_m = np.where(possible, S_m * R_m, 0.0)

    by_feature, by_measurement = ("view", "feature"), ("measurement", "view")
    scores = {
        "n": _variable(n, by_feature, *INPUTS["n"]),
        "S_f": _variable(S_f, by_feature, "feature score", "1"),
        "S_f_hat": _variable(S_f_hat, by_feature, "feature score over its maximum over the views", "1"),
        "R_f": _variable(R_f, by_feature, "feature occlusion ratio", "1"),
        "S_m": _variable(S_m, by_measurement, "measurement score", "1"),
        "R_m": _variable(R_m, by_measurement, "product of the feature occlusion ratios", "1"),
        "V_m": _variable(V_m, by_measurement, "view score", "1"),
        "possible": _variable(possible, by_measurement, "whether the measurement can be made", "1"),
        "rank": _variable(rank_views(V_m, possible), by_measurement, "rank of the view, 1 is best", "1"),
        "limited_by": _variable(limited_by.astype(str), by_measurement, "feature that makes it impossible", "1"),
    }
    coordinates = {"view": views["view"].values, "feature": names, "measurement": list(task.measurements)}
    return xr.Dataset(scores, coordinates, {"minimum_points": minimum_points})


def rank_views(score: NDArray[np.floating], possible: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return ranks 1, 2, ... along the last axis (..., view): possible first, then higher score, then lower index."""
    order = np.lexsort((-score, ~possible), axis=-1)  # lexsort is stable: ties stay in view order
    rank = np.empty(score.shape, np.int64)
    np.put_along_axis(rank, order, np.broadcast_to(np.arange(1, score.shape[-1] + 1), score.shape), axis=-1)
    return rank


def score_table(
    scores: xr.Dataset, extra: Mapping[str, ArrayLike] | None = None, order: str = "rank"
) -> list[dict[str, Any]]:
    """Return the rows of ``scores.csv``: one per measurement and view, measurements in task order, best view first.

    ``extra`` maps further column names (a pose, a predicted uncertainty) to arrays (views,), or (measurements, views).
    ``order`` is the variable whose rank orders the views. Raises ValueError if an extra column has another length, or
    the name of a column of this table.
    """
    columns = {name: np.asarray(values) for name, values in (extra or {}).items()}
    shape = scores["V_m"].shape
    for name, values in columns.items():
        if values.shape not in (shape, shape[1:]):
            raise ValueError(f"column {name!r} is {values.shape}, expected {shape[1:]} or {shape}")
    points = {f"n_{feature}": scores["n"].sel(feature=feature).values for feature in scores["feature"].values}
    rows = []
    for m, measurement in enumerate(scores["measurement"].values):
        at = {name: scores[name].values[m] for name in ("rank", "V_m", "possible", "limited_by", "S_m", "R_m")}
        for v in np.argsort(scores[order].values[m]):
            row: dict[str, Any] = {"measurement": str(measurement), "view": scores["view"].values[v].item()}
            row |= {"view_score" if name == "V_m" else name: values[v].item() for name, values in at.items()}
            row |= {name: values[v].item() for name, values in points.items()}
            if taken := sorted(row.keys() & columns.keys()):
                raise ValueError(f"extra columns {', '.join(taken)}: these names are taken")
            row |= {name: (values[m] if values.ndim == 2 else values)[v].item() for name, values in columns.items()}
            rows.append(row)
    return rows


def write_scores(
    path: str | Path, scores: xr.Dataset, extra: Mapping[str, ArrayLike] | None = None, order: str = "rank"
) -> None:
    """Write :func:`score_table` as CSV, atomically.

    Parameters
    ----------
    path, scores, extra, order
        The file, and as in :func:`score_table`.
    """
    rows = score_table(scores, extra, order)
    with atomic_write(path) as whole, whole.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]) if rows else ["measurement", "view"])
        writer.writeheader()
        writer.writerows(rows)


def _ratio(numerator: NDArray[np.floating], denominator: NDArray[np.floating]) -> NDArray[np.floating[Any]]:
    """Return the quotient, 0 where the denominator is 0 or either is NaN, which means no visible points."""
    numerator, denominator = np.broadcast_arrays(numerator, denominator)
    defined = (denominator > 0) & np.isfinite(numerator)
    return np.asarray(np.divide(numerator, denominator, out=np.zeros(numerator.shape), where=defined))


def _variable(values: ArrayLike, dims: tuple[str, ...], long_name: str, units: str) -> xr.Variable:
    return xr.Variable(dims, values, {"long_name": long_name, "units": units})


def _check(views: xr.Dataset) -> None:
    if absent := sorted(set(INPUTS) - set(views.data_vars)):
        raise ValueError(f"view statistics without {', '.join(map(str, absent))}")
    for name in ("n", "n_white", "n_only_white"):
        if not (np.isfinite(views[name].values) & (views[name].values >= 0)).all():
            raise ValueError(f"{name}: numbers of points must be finite and not negative")
    for points, noise in (("n", "mean_sigma"), ("n_white", "mean_sigma_white")):
        with_points = views[noise].values[views[points].transpose(*views[noise].dims).values > 0]
        if not (np.isfinite(with_points) & (with_points > 0)).all():
            raise ValueError(f"{noise}: must be finite and greater than 0 wherever {points} is")
