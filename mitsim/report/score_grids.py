"""All measurements and samples of one sensor in one picture: a row for each measurement, a column for each sample.

What :mod:`mitsim.report.score_figures` draws of one measurement in full, small enough to be taken in at a glance.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from characterisation.scores.rank_agreement import DECILES, roc_area, roc_curve
from characterisation.scores.score_validation import UNCERTAINTY, V_M, CheckedViews, decile_errors, view_errors
from characterisation.scores.uncertainty_calibration import calibrate, calibrate_by_decile
from mitsim.report.numbers import percent, rounded, unit_symbol
from mitsim.report.score_figures import legend_handles, log_if_wide, score_styles
from mitsim.report.style import BLUE, INK, MUTED, drawing, plain_log

#: scores that are drawn, as far as they are there
SHOWN = (UNCERTAINTY, V_M, "points")

_SMALL = 6.5


def decile_grid(every: Sequence[CheckedViews], what: Literal["mean", "std"] = "mean") -> Figure:
    """Mean of the true error, or its standard deviation, by decile of each score.

    A dotted line is an order by the true errors themselves, of all views that are measurable.
    """
    names = _shown(every)
    styles = score_styles(names)

    def draw(axes: Axes, checked: CheckedViews) -> None:
        for name in names:
            values = getattr(decile_errors(checked, name), what)[:DECILES]
            axes.plot(np.arange(1, DECILES + 1), values, **{**styles[name], "ms": 2.5, "lw": 1.0})
        if what == "mean":
            ideal = replace(checked, scores={"truth": -view_errors(checked.error)[0]})
            best = decile_errors(ideal, "truth").mean[:DECILES]
            axes.plot(np.arange(1, DECILES + 1), best, ls=":", lw=1.0, color=INK, zorder=1)
        axes.set_xticks([1, 4, 7, 10])
        axes.set_ylabel(unit_symbol(checked.unit), fontsize=_SMALL)
        log_if_wide(axes)

    handles = legend_handles(styles)
    if what == "mean":
        handles.append(Line2D([], [], color=INK, ls=":", label="by the truth"))
    label = "mean |true error|" if what == "mean" else "standard deviation of the true error"
    return _grid(every, draw, handles, f"{label}, by decile of the score, 1 is best")


def roc_grid(every: Sequence[CheckedViews]) -> Figure:
    """ROC curves of *can be measured or not*, with the areas."""
    names = _shown(every)
    styles = score_styles(names)

    def draw(axes: Axes, checked: CheckedViews) -> None:
        _, measurable = view_errors(checked.error)
        axes.set_xlim(-0.03, 1.03)
        axes.set_ylim(-0.03, 1.03)
        axes.set_xticks([0, 1])
        axes.set_yticks([0, 1])
        if measurable.all() or not measurable.any():
            axes.text(0.5, 0.5, f"{percent(float(measurable.mean()))}\nmeasurable", ha="center", va="center",
                      color=MUTED, fontsize=_SMALL)  # fmt: skip
            return
        axes.plot([0, 1], [0, 1], color=MUTED, lw=0.8, ls="--", zorder=1)
        areas = []
        for name in names:
            score = checked.scores[name]
            axes.plot(*roc_curve(score, measurable), **{**styles[name], "marker": "", "lw": 1.2})
            areas.append(rounded(roc_area(score, measurable), 2))
        axes.text(0.98, 0.04, "\n".join(areas), ha="right", va="bottom", fontsize=_SMALL - 1)

    handles = legend_handles(styles, marks=False)
    return _grid(
        every, draw, handles, "measurable views taken, over unmeasurable ones taken; areas in the legend's order"
    )


def calibration_grid(every: Sequence[CheckedViews]) -> Figure:
    """Root mean square of the true error over the predicted standard uncertainty u, by decile of u, and coverage."""

    def draw(axes: Axes, checked: CheckedViews) -> None:
        u, error = checked.predicted_uncertainty, checked.error
        found = calibrate(error / u[:, None])
        if not found.trials:
            axes.text(0.5, 0.5, "nothing to\ncompare", ha="center", va="center", color=MUTED, fontsize=_SMALL,
                      transform=axes.transAxes)  # fmt: skip
            axes.set(xticks=[], yticks=[])
            return
        bins = calibrate_by_decile(error, u, checked.seed)
        axes.axhline(1.0, color=MUTED, lw=1.0, zorder=1)
        axes.plot(bins.uncertainty, bins.error / bins.uncertainty, "o-", color=BLUE, ms=2.5, lw=1.0)
        axes.set_xscale("log")
        plain_log(axes.xaxis, few=True)
        axes.set_yscale("log")
        axes.set_ylim(0.12, 14)
        axes.set_yticks([0.25, 1, 4], labels=["0.25", "1", "4"])
        axes.set_yticks([], minor=True)
        axes.text(0.04, 0.96, f"{percent(found.coverage)} in 2 u", ha="left", va="top", fontsize=_SMALL,
                  transform=axes.transAxes, bbox={"fc": "white", "ec": "none", "pad": 0.6}, zorder=9)  # fmt: skip

    return _grid(every, draw, [], "root mean square of true error / u, over u [unit of the measurement]")


def _shown(every: Sequence[CheckedViews]) -> list[str]:
    return [name for name in SHOWN if name in every[0].scores]


def _grid(
    every: Sequence[CheckedViews], draw: Callable[[Axes, CheckedViews], None], handles: list[Line2D], title: str
) -> Figure:  # fmt: skip
    """A small picture of each measurement (rows) and sample (columns)."""
    samples = list(dict.fromkeys(one.sample for one in every))
    measurements = list(dict.fromkeys(one.measurement for one in every))
    of = {(one.measurement, one.sample): one for one in every}
    with drawing():
        figure = Figure((max(1.6 * len(samples) + 1.1, 5.6), 1.15 * len(measurements) + 0.9), layout="constrained")
        grid = np.asarray(figure.subplots(len(measurements), len(samples), squeeze=False))
        for measurement, row in zip(measurements, grid, strict=True):
            for sample, axes in zip(samples, row, strict=True):
                axes.tick_params(labelsize=_SMALL - 0.5)
                if (measurement, sample) not in of:
                    axes.set_axis_off()
                    continue
                draw(axes, of[measurement, sample])
                if measurement == measurements[0]:
                    axes.set_title(sample, fontsize=8)
                if axes is not row[0]:
                    axes.set_ylabel("")
            row[0].annotate(
                measurement.replace("_", " "), (0, 0.5), (-0.42, 0.5), xycoords="axes fraction",
                textcoords="axes fraction", rotation=90, ha="right", va="center", fontsize=_SMALL,
            )  # fmt: skip
        if handles:
            figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), fontsize=7)
        figure.suptitle(title, fontsize=9)
    return figure
