"""Draw the figures of the talk's slides on views: spheres of scores and errors, deciles, and mean ranks."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure

from characterisation.files.arrays import Floats
from characterisation.plots.discs import disc
from characterisation.plots.style import BLUE, INK, MUTED, SEQUENTIAL, VERMILION, drawing, figure_of
from characterisation.words.numbers import unit_symbol
from mitsim.report.style import colour_scale, plain_log
from mitsim.report.view_figures import sphere_of_views, view_places
from mitsim.talk.judged_views import QUANTITIES, SCORES, JudgedViews, true_error


def sphere(axes: Axes, scores: xr.Dataset, values: Floats, title: str, label: str, error: bool = False) -> None:
    """Draw a value (view,) of every candidate view on the sphere of views from above; a cross where it is NaN.

    Parameters
    ----------
    axes, scores, values, error
        Where to draw; scores with the directions of the views and those left out; values (view,), of an ``error`` the
        small ones bright, on a logarithmic scale.
    title, label
        Title of the picture, and label of the colour bar with the unit.
    """
    positions = view_places(scores)
    outside = scores["left_out"].values
    reach = 1.06 * float(np.linalg.norm(positions, axis=1).max())
    disc(axes, reach)
    sphere_of_views(axes, reach)
    valid = np.isfinite(values)
    size = 4200 / max(len(positions), 20)
    if len(outside):
        zenith = np.arccos(np.clip(outside[:, 2], -1, 1))
        around = np.arctan2(outside[:, 1], outside[:, 0])
        there = (2 * np.sin(zenith / 2))[:, None] * np.stack([np.cos(around), np.sin(around)], axis=-1)
        axes.plot(*there[np.linalg.norm(there, axis=1) < reach].T, "s", ms=4, mfc="none", mec=MUTED, zorder=3)
    x, y = positions.T
    axes.scatter(x[~valid], y[~valid], marker="x", s=0.4 * size, c=MUTED, lw=0.9, zorder=3)
    if valid.any():
        low, high = float(values[valid].min()), float(np.percentile(values[valid], 95 if error else 100))
        norm: Normalize = Normalize(0 if low >= 0 else low, max(high, 1e-9))
        if error and low > 0:
            norm = LogNorm(low, max(high, 1.05 * low))
        colours, extend = (f"{SEQUENTIAL}_r", "max") if error else (SEQUENTIAL, "neither")
        dots: dict[str, Any] = {"s": size, "norm": norm, "cmap": colours, "lw": 0.3, "ec": MUTED, "zorder": 4}
        shown = axes.scatter(x[valid], y[valid], c=values[valid], **dots)
        bar = colour_scale(figure_of(axes), shown, axes, label, extend=extend, location="bottom", shrink=0.8)
        if isinstance(norm, LogNorm):
            plain_log(bar.ax.xaxis)
    axes.set_title(title, pad=11, fontsize=9)


def reach_figure(scores: xr.Dataset, feature: str) -> Figure:
    """Draw the candidate views that the stage reaches, and the number of points on a feature over them."""
    with drawing():
        figure = Figure((4.4, 4.4), layout="constrained")
        points = scores["n"].sel(feature=feature).values.astype(float)
        sphere(figure.subplots(), scores, points, f"points on {feature}; □ the stage does not reach", "points [1]")
    return figure


def scores_figure(scores: xr.Dataset, measurement: str, shapes: Sequence[str]) -> Figure:
    """Draw S_f and R_f of every feature of a measurement, and S_m, R_m and V_m, over the views."""
    here = scores.sel(measurement=measurement)
    with drawing():
        figure = Figure((2.75 * max(len(shapes), 3), 10.0), layout="constrained")
        grid = np.asarray(figure.subplots(3, max(len(shapes), 3), squeeze=False))
        for axes in grid.ravel():
            axes.set_visible(False)
        for row, name in enumerate(("S_f", "R_f")):
            for axes, shape in zip(grid[row], shapes, strict=False):
                axes.set_visible(True)
                sphere(axes, scores, scores[name].sel(feature=shape).values.astype(float), f"{name}, {shape}", "[1]")
        possible = here["possible"].values > 0
        for axes, name in zip(grid[2], ("S_m", "R_m", "V_m"), strict=False):
            axes.set_visible(True)
            values = here[name].values.astype(float)
            sphere(axes, scores, np.where(possible | (name != "V_m"), values, np.nan), name, "[1]")
    return figure


def example_figure(judged: JudgedViews, sample: str, measurement: str) -> Figure:
    """Draw deciles of V_m against mean error and standard deviation, and spheres of V_m and of the true error."""
    cell, errors = judged.cell(sample, measurement, "V_m"), judged.errors[sample]
    unit = unit_symbol(str(judged.scores[sample]["unit"].sel(measurement=measurement).item()))
    with drawing():
        figure = Figure((11.2, 3.9), layout="constrained")
        panels = figure.subplots(1, 4, width_ratios=(1, 1, 0.95, 0.95))
        for axes, name, label in zip(
            panels, ("error", "deviation"), ("mean |error|", "standard deviation"), strict=False
        ):
            bars(axes, cell, name)
            axes.set_ylabel(f"{label} [{unit}]")
        score = judged.score(sample, measurement, "V_m")
        sphere(panels[2], judged.scores[sample], score, "view score V_m", "V_m [1]")
        error = true_error(errors, measurement)
        sphere(panels[3], judged.scores[sample], error, "true error", f"mean |error| [{unit}]", error=True)
    return figure


def bars(axes: Axes, cell: xr.Dataset, name: str) -> None:
    """Draw the bins of a decile data set as bars with intervals: x where no view of a bin has a value.

    The second line of a label is the share of trials with a value [%].
    """
    values = cell[name].values
    low, high = cell[f"{name}_low"].values, cell[f"{name}_high"].values
    valid = np.isfinite(values)
    colours = [MUTED if number == 0 else BLUE for number in cell["bin"].values]
    axes.bar(cell["bin"].values[valid], values[valid], 0.8, color=np.array(colours)[valid])
    ends = valid & np.isfinite(low)
    spread = np.abs(np.stack([values - low, high - values])[:, ends])
    axes.errorbar(cell["bin"].values[ends], values[ends], spread, fmt="none", ecolor=INK, elinewidth=0.8, capsize=1.8)
    top = 1.15 * float(values[valid].max()) if valid.any() else 1.0
    if valid.any():
        axes.set_ylim(0, min(max(top, 1.03 * float(np.where(ends, high, 0).max())), 2.2 * top))
    empty = (cell["views"].values > 0) & ~valid
    axes.plot(cell["bin"].values[empty], np.full(empty.sum(), 0.03 * axes.get_ylim()[1]), "x", color=VERMILION, ms=6)
    shares = ["–" if math.isnan(share) else f"{100 * share:.0f}" for share in cell["share"].values]
    names = ["imp.", *map(str, range(1, 11))]
    axes.set_xticks(range(11), [f"{name}\n{share}" for name, share in zip(names, shares, strict=True)], fontsize=6.5)
    axes.set_xlabel("decile of V_m, 10 is best, imp. is impossible\n% of trials with a value", fontsize=8)


def ranks_figure(ranks: Mapping[str, Mapping[str, xr.Dataset]]) -> Figure:
    """Draw the mean rank of the bins by error, standard deviation and share of trials with a value, for each score.

    ``ranks`` are those of :meth:`~mitsim.talk.judged_views.JudgedViews.ranks`, by the score.
    """
    with drawing():
        figure = Figure((11.2, 3.9), layout="constrained")
        panels = figure.subplots(1, len(QUANTITIES), sharey=True)
        for axes, (quantity, words) in zip(panels, QUANTITIES.items(), strict=True):
            axes.plot([1, 10], [10, 1], color=MUTED, lw=0.8, label="perfect")
            for number, (kind, name) in enumerate(SCORES.items()):
                mean_ranks = ranks[kind][quantity]
                rank = mean_ranks["rank"].values
                spread = np.stack([rank - mean_ranks["rank_low"].values, mean_ranks["rank_high"].values - rank])
                spread = np.where(np.isfinite(spread), np.maximum(spread, 0), 0)
                position = mean_ranks["bin"].values + 0.13 * (number - 1)
                correlation = mean_ranks.attrs["correlation"]
                ends = f"({mean_ranks.attrs['correlation_low']:+.2f} to {mean_ranks.attrs['correlation_high']:+.2f})"
                label = name if math.isnan(correlation) else f"{name}: {correlation:+.2f} {ends}".replace("-", "−")
                colour, line = (BLUE, VERMILION, "#009e73")[number], ("o-", "s-", "D-")[number]
                axes.errorbar(position, rank, spread, fmt=line, ms=4, lw=0.9, capsize=2, color=colour, label=label)
            axes.set(xlabel="decile of the score, 10 is best", title=f"by {words}", xticks=range(1, 11))
            axes.set(yticks=range(2, 11, 2), ylim=(0.5, 12.5))  # the legend is above
            axes.legend(fontsize=6.5, title="mean rank correlation, 95 % interval", title_fontsize=6.5)
        panels[0].set_ylabel("mean rank of the bin, 1 is best")
    return figure
