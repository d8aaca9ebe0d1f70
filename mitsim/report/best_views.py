"""Make a text table of the best views of a measurement: pose, predicted uncertainty, and limit."""

from __future__ import annotations

import math
from collections.abc import Sequence

import xarray as xr

from characterisation.words.numbers import percent, two_digits
from mitsim.report.findings import ranked_views
from mitsim.views.no_view import why_no_view

_HEAD = (
    "rank",
    "view",
    "azimuth",
    "elevation",
    "roll",
    "standoff",
    "u",
    "u/tolerance",
    "chance",
    "V_m rank",
    "limited by",
)


def best_views(scores: xr.Dataset, measurement: str, count: int, shapes: Sequence[str]) -> str:
    """Return the ``count`` best views by predicted risk as text; angles in deg, lengths in mm.

    If no view can make the measurement, the text says why. It ends with an empty line.

    Parameters
    ----------
    scores, measurement, count
        Scores of all views, name of the measurement, and largest number of views.
    shapes
        Names of the shapes that the measurement depends on.
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
    widths = [max(len(row[k]) for row in rows) for k in range(len(_HEAD))]
    lines = [
        "  ".join(
            text.rjust(width) if k < len(row) - 1 else text
            for k, (text, width) in enumerate(zip(row, widths, strict=True))
        )
        for row in rows
    ]
    return "\n".join([title, *lines, ""])


def _row(measured: xr.Dataset, view: int, tolerance: float) -> tuple[str, ...]:
    at = {str(name): values.values[view] for name, values in measured.data_vars.items() if values.dims == ("view",)}
    feature, limit = str(at["limiting_feature"]), str(at["limit"])
    u = float(at["predicted_uncertainty"])
    return (
        str(at["uncertainty_rank"]),
        str(view),
        f"{at['azimuth_deg']:.0f}",
        f"{at['elevation_deg']:.0f}",
        f"{at['roll_deg']:.0f}",
        f"{at['standoff_mm']:.0f}",
        two_digits(u),
        "" if math.isnan(tolerance) else two_digits(u / tolerance),
        percent(float(at["chance"])),
        str(at["rank"]),
        f"{limit} on {feature}" if feature and limit else limit,
    )
