"""Draw the candidate views: u over the sphere of views, and the errors measured in the checked views.

The sphere is seen from above: the zenith of the part at the centre, azimuth counter-clockwise from the part's x axis,
rings of elevation. The projection is equal-area, so that evenly spread views look evenly spread.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from characterisation.files.arrays import Floats
from characterisation.plots.discs import disc
from characterisation.plots.style import BLUE, FIELD, INK, MUTED, PAPER, SEQUENTIAL, VERMILION, drawing
from characterisation.words.numbers import rounded, signed, unit_symbol
from mitsim.report.agreement import Agreement
from mitsim.report.figures import colour_bar
from mitsim.report.style import plain_log

_RINGS_DEG = (60, 30, 0, -30, -60)

#: largest number of rolls with a disc each; on a stage every view has another roll, and all share one disc
_MOST_ROLLS = 4


def view_places(scores: xr.Dataset) -> NDArray[np.float64]:
    """Return positions (view, 2) of the views on the disc: 2 sin(zenith angle / 2), at their azimuth."""
    zenith, azimuth = np.radians(90 - scores["elevation_deg"].values), np.radians(scores["azimuth_deg"].values)
    return np.asarray((2 * np.sin(zenith / 2))[:, None] * np.stack([np.cos(azimuth), np.sin(azimuth)], axis=-1))


def uncertainty_limits(uncertainty: Floats) -> tuple[float, float]:
    """Return the ends of the colour scale of u (views,): the least, and the 90th percentile against hopeless views."""
    values = np.sort(uncertainty[uncertainty > 0])
    if not len(values):
        return 0.1, 1.0
    low, high = float(values[0]), float(values[math.ceil(0.9 * (len(values) - 1))])
    return (low, high) if high > low else (low / 1.2, low * 1.2)


def uncertainty_figure(scores: xr.Dataset, measurement: str, unit: str, checked: list[int], best: int | None) -> Figure:
    """Draw the predicted u of every view for one measurement, a disc for each roll, on a logarithmic scale.

    Bright is a small u. If views share a position, the best is on top. ``checked`` views were rendered.
    """
    worst_first = np.argsort(-scores["uncertainty_rank"].sel(measurement=measurement).values, kind="stable")
    scores = scores.isel(view=worst_first)
    here = scores.sel(measurement=measurement)
    positions, rolls, numbers = view_places(scores), scores["roll_deg"].values, scores["view"].values
    if one_disc := len(np.unique(rolls)) > _MOST_ROLLS:
        rolls = np.zeros_like(rolls)
    u, possible = here["predicted_uncertainty"].values, here["uncertainty_possible"].values
    reach = 1.06 * max(float(np.linalg.norm(positions, axis=1).max()), 0.5)
    norm, colours = LogNorm(*uncertainty_limits(u[possible])), f"{SEQUENTIAL}_r"
    every = np.unique(rolls)
    size = 5200 / max(len(positions) / len(every), 20)  # so that neighbours do not touch
    with drawing():
        figure = Figure((max(2.75 * len(every), 4.6), 3.75), layout="constrained")
        grid = np.asarray(figure.subplots(1, len(every), squeeze=False))
        for axes, roll in zip(grid[0], every, strict=True):
            disc(axes, reach)
            sphere_of_views(axes, reach)
            at, no = (rolls == roll) & possible, (rolls == roll) & ~possible
            axes.scatter(*positions[no].T, marker="x", s=size * 0.3, c=MUTED, lw=0.8, zorder=3)
            axes.scatter(*positions[at].T, c=u[at], norm=norm, cmap=colours, s=size, lw=0.4, ec=MUTED, zorder=4)
            dots = (rolls == roll) & np.isin(numbers, checked)
            axes.scatter(*positions[dots].T, marker="D", s=size * 1.15, fc="none", ec=INK, lw=0.9, zorder=5)
            if best is not None and roll == rolls[numbers == best][0]:
                ring = positions[numbers == best]
                axes.scatter(*ring.T, s=size * 3.2, fc="none", ec=VERMILION, lw=2.0, zorder=6)
            axes.set_title("all rolls" if one_disc else f"roll {signed(f'{roll:g}')}°", pad=12)
        extend = "max" if (u[possible] > norm.vmax).any() else "neither"
        colour_bar(figure, grid, norm, colours, f"predicted standard uncertainty u [{unit_symbol(unit)}]", extend)
        legend = [
            _mark("best", "o", 10, mec=VERMILION, mfc="none", mew=2),
            _mark("rendered to check", "D", 6, mec=INK, mfc="none"),
            _mark("not possible", "x", 5, mec=MUTED),
        ]
        figure.legend(handles=legend, loc="outside lower center", ncols=3, handletextpad=0.2, columnspacing=1.2)
    return figure


def sphere_of_views(axes: Axes, reach: float) -> None:
    """Draw rings of elevation and directions of azimuth into the disc of a sphere of views, as far as ``reach``."""
    angle = np.linspace(0, 2 * math.pi, 181)
    for elevation in _RINGS_DEG:
        radius = 2 * math.sin(math.radians(90 - elevation) / 2)
        if radius > 1.02 * reach:
            continue
        axes.plot(radius * np.cos(angle), radius * np.sin(angle), color=MUTED, lw=0.5, zorder=1)
        text = axes.text(0, radius, f"{signed(str(elevation))}°", fontsize=6.5, ha="center", va="center", zorder=7)
        text.set_bbox({"facecolor": FIELD, "alpha": 0.85, "edgecolor": "none", "pad": 0.8})
    for azimuth, name in ((0, "x, 0°"), (90, "y, 90°"), (180, "180°"), (-90, "−90°")):
        c, s = math.cos(math.radians(azimuth)), math.sin(math.radians(azimuth))
        axes.plot([0, reach * c], [0, reach * s], color=MUTED, lw=0.4, zorder=1)
        across, up = {1: "left", -1: "right", 0: "center"}[round(c)], {1: "bottom", -1: "top", 0: "center"}[round(s)]
        axes.text(1.03 * reach * c, 1.03 * reach * s, name, fontsize=6.5, color=INK, ha=across, va=up)


def agreement_figure(agreement: Agreement, unit: str) -> Figure:
    """Draw the true error of the checked views over the predicted standard uncertainty, and over the view score."""
    with drawing():
        figure = Figure((5.6, 3.5), layout="constrained")
        left, right = figure.subplots(1, 2, sharey=True)
        band = _error_axis(left, agreement, unit)
        failed_at = math.sqrt(band[0] * band[1])
        has_uncertainty = np.isfinite(agreement.uncertainty) & (agreement.uncertainty > 0)
        scale = agreement.uncertainty[has_uncertainty] if has_uncertainty.any() else np.array([0.1, 1.0])
        ends = np.array([scale.min() / 1.5, scale.max() * 1.5])
        left.set_xscale("log")
        left.set_xlim(*ends)
        lines = [
            left.plot(ends, k * ends, color=MUTED, lw=1.0, ls=style, label=name, zorder=1)[0]
            for k, style, name in ((1, "-", "error = u"), (2, "--", "error = 2 u"))
        ]
        _errors(left, np.where(has_uncertainty, agreement.uncertainty, np.nan), agreement, failed_at)
        left.set_xlabel(f"predicted standard uncertainty u [{unit}]")
        for axis in (left.xaxis, left.yaxis):
            plain_log(axis)
        missing, unknown = len(agreement.views) - agreement.count, int((~has_uncertainty).sum())
        notes = [f"{missing} without a value"] * bool(missing) + [f"{unknown} without u"] * bool(unknown)
        left.set_title("\n".join([f"{_rank(agreement.spearman)}, n = {agreement.count}", *notes]))

        right.axhspan(*band, color=FIELD, lw=0, zorder=0)
        _errors(right, agreement.score, agreement, failed_at)
        right.set_xlabel("view score Vₘ [1]")
        highest = max(float(agreement.score.max(initial=0.0)), 0.1)
        right.set_xlim(1.06 * highest, -0.04 * highest)  # as on the left, better views are on the left
        right.set_title(_rank(agreement.score_spearman))
        handles = [_mark("mean of repeats; bar: min to max", "o", 5, color=BLUE)]
        if (np.isfinite(agreement.error) & (agreement.failed > 0)).any():
            handles.append(_mark("some repeats failed", "o", 5, mec=BLUE, mfc="none"))
        if missing:
            handles.append(_mark("not measurable", "X", 6, color=VERMILION))
        handles += lines
        figure.legend(handles=handles, loc="outside lower center", ncols=2, handletextpad=0.4, columnspacing=1.2)
    return figure


def _mark(label: str, marker: str, size: float, **style: Any) -> Line2D:
    return Line2D([], [], ls="none", marker=marker, ms=size, label=label, **style)


def _rank(spearman: float) -> str:
    return f"Spearman {rounded(spearman, 2)}" if math.isfinite(spearman) else "no rank correlation"


def _error_axis(axes: Axes, agreement: Agreement, unit: str) -> tuple[float, float]:
    """Format the logarithmic axis of |error|; return the band at the top that holds failed measurements."""
    errors = np.concatenate([agreement.least, agreement.most])
    errors = errors[np.isfinite(errors) & (errors > 0)]
    low, high = (errors.min() / 1.5, errors.max() * 1.5) if len(errors) else (0.1, 1.0)
    axes.set_yscale("log")
    decades = math.log10(high / low)
    top = float(high * 10 ** (0.12 * decades))
    axes.set_ylim(low, top)
    axes.axhspan(high, top, color=FIELD, lw=0, zorder=1.5)  # grid lines end below the band of failed measurements
    axes.set_ylabel(f"|true error| [{unit}]")
    for axis in (axes.xaxis, axes.yaxis):
        plain_log(axis)
    return float(high), top


def _errors(axes: Axes, x: NDArray[np.float64], agreement: Agreement, failed_at: float) -> None:
    at = np.isfinite(x)
    measured, failed = at & np.isfinite(agreement.error), at & ~np.isfinite(agreement.error)
    axes.vlines(x[measured], agreement.least[measured], agreement.most[measured], color=BLUE, lw=1.0, zorder=2)
    whole, part = measured & (agreement.failed == 0), measured & (agreement.failed > 0)
    axes.plot(x[whole], agreement.error[whole], "o", color=BLUE, ms=5, zorder=3)
    axes.plot(x[part], agreement.error[part], "o", mec=BLUE, mfc=PAPER, ms=5, zorder=3)
    axes.plot(x[failed], np.full(failed.sum(), failed_at), "X", color=VERMILION, mec="none", ms=6, zorder=3)
