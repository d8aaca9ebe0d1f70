"""Make a text table of the best views of a measurement: pose, predicted uncertainty, and limit."""

from __future__ import annotations

import math
from collections.abc import Sequence

import xarray as xr

from characterisation.words.numbers import percent, two_digits
from mitsim.report.findings import ranked_views
from mitsim.report.pose_texts import limit_words
from mitsim.views.no_view import why_no_view

_POSE = {"azimuth": "azimuth_deg", "elevation": "elevation_deg", "roll": "roll_deg", "standoff": "standoff_mm"}
_HEAD = ("rank", "view", *_POSE, "u", "u/tolerance", "chance", "V_m rank", "limited by")


def best_views(scores: xr.Dataset, measurement: str, count: int, shapes: Sequence[str]) -> str:
    """Return the ``count`` best views by predicted risk as text; angles in deg, lengths in mm.

    If no view can make the measurement, the text says why. It ends with an empty line.

    Parameters
    ----------
    scores, measurement, count, shapes
        Scores of all views; largest number of views in the text; shapes that the measurement depends on.
    """
    measured = scores.sel(measurement=measurement)
    unit, tolerance = str(measured["unit"].values), float(measured["tolerance"].values)
    ranked = ranked_views(scores, measurement)
    title = f"{measurement} [{unit}]: {len(ranked)} of {scores.sizes['view']} views can make it"
    if not math.isnan(tolerance):
        title += f"; tolerance {tolerance:g} {unit}"
    if not len(ranked):
        return f"{title}\n  {why_no_view(scores, measurement, shapes)}\n"
    rows = [_HEAD, *(_row(measured, int(v), tolerance) for v in ranked[:count])]
    *columns, limits = zip(*rows, strict=True)
    padded = [[text.rjust(max(map(len, column))) for text in column] for column in columns]
    return "\n".join([title, *map("  ".join, zip(*padded, limits, strict=True)), ""])


def _row(measured: xr.Dataset, view: int, tolerance: float) -> tuple[str, ...]:
    here = measured.isel(view=view)
    u = float(here["predicted_uncertainty"])
    pose = [f"{float(here[name]):.0f}" for name in _POSE.values()]
    share = "" if math.isnan(tolerance) else two_digits(u / tolerance)
    rank, score_rank = (str(int(here[name])) for name in ("uncertainty_rank", "rank"))
    chance = percent(float(here["chance"]))
    return rank, str(view), *pose, two_digits(u), share, chance, score_rank, limit_words(here)
