"""Rank views by their risks: from the map before any trial, and of all measurements together."""

from __future__ import annotations

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from characterisation.files.arrays import Floats
from mitsim.views.view_scores import screening_risk


def shortlist(scores: xr.Dataset, count: int, each: bool = False) -> list[int]:
    """Return the numbers of the views worth a trial, in the order of the predicted risk u / sqrt(chance).

    These are the first ``count`` views for all measurements together, by the map, and with ``each`` also of each
    measurement. A view with zero chance counts as impossible; for all measurements together, a view that lacks one
    counts with three times the largest risk of the others. The best for all together come first.
    """
    cost = screening_risk(scores)
    together = combined_cost(cost, scores["tolerance"].values)
    chosen = first_of_each(np.concatenate([cost, together[None]]) if each else together[None], count)
    return [int(scores["view"].values[i]) for i in sorted(chosen, key=lambda i: (together[i], i))]


def combined_cost(cost: Floats, tolerances: Floats) -> Floats:
    """Return the predicted log of the combined risk (view,) from that of each measurement (measurement, view).

    A measurement that a view cannot make counts with three times the largest risk of all views. A view that can make
    none has an infinite cost. Measurements that no view can make do not count.
    """
    able = np.isfinite(cost)
    possible = able.any(axis=1)
    if not possible.any():
        return np.full(cost.shape[1], np.inf)
    worst = np.where(able, cost, -np.inf).max(axis=1, keepdims=True) + np.log(3)
    filled = np.where(able, cost, worst)[possible]
    return np.where(able.any(axis=0), combined_risk(filled[:, None], tolerances[possible])[0], np.inf)


def first_of_each(cost: Floats, count: int) -> set[int]:
    """Return the indices of the ``count`` least finite costs of each row of ``cost`` (row, view)."""
    return {int(i) for row in cost for i in np.argsort(row, kind="stable")[:count] if np.isfinite(row[i])}


def prior_risk(u: Floats) -> Floats:
    """Return the map's u (view,) of a measurement as a prior risk.

    A view without u gets three times the largest u, which counts as 1 if no view has a u.
    """
    usable = np.where(np.isfinite(u) & (u > 0), u, np.nan)
    worst = np.nanmax(usable) if np.isfinite(usable).any() else 1.0
    return np.where(np.isfinite(usable), usable, 3 * worst)


def possible_measurements(u: Floats, errors: Floats) -> NDArray[np.bool_]:
    """Return whether each measurement (m,) is possible in a view, by the map or by a trial; all if none is.

    ``u`` (m, v) is the map's, ``errors`` (m, v, trial) are those of the race. An impossible measurement cannot
    distinguish views, so it does not count for all measurements together.
    """
    predicted = (np.isfinite(u) & (u > 0)).any(axis=1)
    possible = predicted | np.isfinite(errors).any(axis=(1, 2))
    return np.asarray(possible if possible.any() else np.ones_like(possible))


def combined_risk(samples: Floats, tolerances: Floats) -> Floats:
    """Return the logarithm (s, v) of the combined risk of all measurements, from that of each, (m, s, v).

    If every measurement has a tolerance, it is the largest ratio of risk to tolerance; else the geometric mean of the
    risks.
    """
    if np.isfinite(tolerances).all():
        return np.asarray((samples - np.log(tolerances)[:, None, None]).max(axis=0))
    return np.asarray(samples.mean(axis=0))
