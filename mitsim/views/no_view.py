"""Say why no view can make a measurement, or all: which shape, how many points are expected of it, what takes the rest.

Signal chain: expected points of each shape from each view, in its finish and in matt white, with the part around it and
without -> the shapes that have too few from every view -> the cause that takes most of them, in words.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from characterisation.statements.verdict_words import named
from characterisation.words.numbers import listed
from mitsim.views.limiting_factor import OCCLUDED

#: share of the points in matt white below which the finish is a cause of their loss
_DULL = 0.75

#: what to do if no view can make all measurements
TOGETHER = "The table [set] of a study finds the fewest views that measure together"


def why_no_view(scores: xr.Dataset, measurement: str, shapes: Sequence[str]) -> str:
    """Return the reason why no view can make a measurement, in words; empty if a view can.

    ``scores`` are of all views (:func:`mitsim.views.view_scores.score_candidates`), ``shapes`` the names of the shapes
    of the scene that the measurement depends on.
    """
    here = scores.sel(measurement=measurement)
    if here["uncertainty_possible"].values.any():
        return ""
    shapes = list(shapes)
    needed = float(scores.attrs["minimum_points"])
    points = scores["n"].sel(feature=shapes).transpose("view", "feature").values
    most = points.max(axis=0)
    if (most < needed).any():
        short = []
        for name, at_most, from_views in zip(shapes, most, points.T, strict=True):
            if at_most < needed:
                cause = _cause(scores, name, from_views, needed)
                short.append(f"{name} has at most {at_most:.0f} points of {needed:.0f} from any view{cause}")
        return "; ".join(short)
    best = int(points.min(axis=1).argmax())
    if points[best].min() < needed:
        least = int(points[best].argmin())
        number = int(scores["view"].values[best])
        return (
            f"no view shows {listed(shapes)} together: from view {number}, the best, {shapes[least]} has "
            f"{points[best].min():.0f} points of {needed:.0f}"
        )
    if np.isfinite(here["predicted_uncertainty"].values).any():
        chance = float(np.nanmax(here["chance"].values))
        rarest = int(points[best].argmin())
        return (
            f"enough points are too rare, at most in {100 * chance:.0f} % of the captures: from the best view "
            f"{shapes[rarest]} has {points[best].min():.0f} on average by direct light alone, {needed:.0f} are needed"
        )
    return f"the points of {listed(shapes)} that a view shows do not determine it"


def _cause(scores: xr.Dataset, name: str, points: NDArray[np.float64], needed: float) -> str:
    """Return the main cause of the loss in the view with most points, with a colon; empty if none stands out."""
    best = int(points.argmax())
    white, alone = (float(scores[key].sel(feature=name).values[best]) for key in ("n_white", "n_only_white"))
    if alone < needed:
        return ": too small, or too far away, even in matt white"
    if white < needed or white < OCCLUDED * alone:
        return ": other faces hide it, or their light disturbs it"
    return ": its finish returns too little light to the sensor" if points[best] < _DULL * white else ""


def apart_in_words(scores: xr.Dataset) -> str:
    """Return which view can make the most measurements, if none can make all; empty otherwise, and for a single one."""
    possible = scores["uncertainty_possible"].values
    if len(possible) < 2 or possible.all(axis=0).any():
        return ""
    if not possible.any():
        return f"no view can make any of the {len(possible)} measurements"
    most = int(possible.sum(axis=0).argmax())
    names = scores["measurement"].values[~possible.any(axis=1)].tolist()
    never = f"; no view can make {named(names)}" if names else ""
    return (
        f"no single view can make all {len(possible)} measurements: "
        f"view {int(scores['view'][most])} can make the most, {int(possible[:, most].sum())}{never}"
    )
