"""Pictures of how right view scores are: deciles, mean ranks, rank correlations, ROC curves, predicted uncertainties.

Figures of one measurement have a column for each sample. A score keeps its colour and its mark in all of them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from characterisation.scores.rank_agreement import DECILES, roc_area, roc_curve
from characterisation.scores.score_table import mean_ranks
from characterisation.scores.score_validation import (
    LEAST_MEASURABLE,
    UNCERTAINTY,
    V_M,
    CheckedViews,
    ScoreRow,
    decile_errors,
    view_errors,
)
from characterisation.scores.uncertainty_calibration import (
    COVERAGE_FACTOR,
    NORMAL_COVERAGE,
    calibrate,
    calibrate_by_decile,
)
from mitsim.report.numbers import percent, rounded, unit_symbol
from mitsim.report.style import BLUE, FIELD, INK, MUTED, PAPER, VERMILION, drawing, plain_log

Floats = NDArray[np.float64]

#: marks and colours of all scores but the two that matter most; the colours are Okabe and Ito's
_OTHERS = (
    ("v", "#009e73"), ("^", "#cc79a7"), ("D", "#e69f00"), ("P", "#56b4e9"), ("X", MUTED), ("*", INK), ("<", "#8a6d00"),
)  # fmt: skip

#: violet to orange, white where there is no correlation: an order for every kind of colour vision; without its dark
#: ends, so that one ink can be read on all of it, which does not follow the page
_DIVERGING = ListedColormap(colormaps["PuOr_r"](np.linspace(0.18, 0.82, 256)), "light_PuOr_r")
_ON_CELL = "#1c1c1c"

#: place of the bin of the impossible on the axis of deciles
_APART = DECILES + 1.5


def decile_figure(every: Sequence[CheckedViews], scores: Sequence[str] | None = None) -> Figure:
    """One measurement, the talk's plots: by decile, mean of the true error, its standard deviation, share measurable.

    A dotted line in the first row is an order by the true errors themselves, of all views that are measurable. Open
    marks are deciles of which fewer than half of the views are measurable. Views said to be impossible stand apart.
    """
    names = list(every[0].scores) if scores is None else list(scores)
    styles = score_styles(names)
    unit = unit_symbol(every[0].unit)
    with drawing():
        figure = Figure((2.75 * len(every) + 0.9, 7.0), layout="constrained")
        grid = np.asarray(figure.subplots(3, len(every), squeeze=False, sharey="row", height_ratios=(1.35, 1.35, 0.8)))
        for checked, column in zip(every, grid.T, strict=True):
            column[0].set_title(checked.sample)
            for name in names:
                found = decile_errors(checked, name)
                few = found.measurable < LEAST_MEASURABLE
                for axes, values in zip(column, (found.mean, found.std, found.measurable), strict=True):
                    _decile_line(axes, values, few, styles[name])
            ideal = replace(checked, scores={"truth": -view_errors(checked.error)[0]})
            best = decile_errors(ideal, "truth").mean[:DECILES]
            column[0].plot(np.arange(1, DECILES + 1), best, ls=":", lw=1.1, color=INK, zorder=1)
            column[-1].set_xlabel("decile of the score, 1 is best")
            for axes in column:
                _decile_axis(axes)
        for axes, label in zip(grid[:, 0], ("mean |true error|", "standard deviation"), strict=False):
            axes.set_ylabel(f"{label} [{unit}]")
            log_if_wide(axes)
        grid[2, 0].set_ylabel("measurable [1]")
        grid[2, 0].set_ylim(-0.05, 1.08)
        handles = [*legend_handles(styles), Line2D([], [], ls=":", color=INK, label="deciles of the true error")]
        figure.legend(handles=handles, loc="outside lower center", ncols=min(4, 1 + len(every)))
        figure.suptitle(every[0].measurement, fontsize=10)
    return figure


def mean_rank_figure(rows: Sequence[ScoreRow], scores: Sequence[str] | None = None) -> Figure:
    """The talk's last slide: mean rank of every decile by true error, over all measurements and samples."""
    found = mean_ranks(rows)
    names = list(found) if scores is None else list(scores)
    styles = score_styles(names)
    ends = np.array([1.0, DECILES])
    with drawing():
        figure = Figure((5.6, 3.9), layout="constrained")
        axes = figure.subplots()
        axes.plot(ends, ends, color=MUTED, lw=1.0, zorder=1)
        axes.axhline((1 + DECILES) / 2, color=MUTED, lw=1.0, ls="--", zorder=1)
        for name in names:
            axes.plot(np.arange(1, DECILES + 1), found[name][0], **styles[name])
        axes.set_xticks(range(1, DECILES + 1))
        axes.set_yticks(range(1, DECILES + 1))
        axes.set_xlabel("decile of the score, 1 is best")
        axes.set_ylabel("mean rank by true error")
        handles = [
            *legend_handles(styles),
            Line2D([], [], color=MUTED, label="perfect"), Line2D([], [], color=MUTED, ls="--", label="chance"),
        ]  # fmt: skip
        figure.legend(handles=handles, loc="outside right upper")
    return figure


def spearman_figure(rows: Sequence[ScoreRow]) -> Figure:
    """Rank correlation of the deciles: a row for each score, a column for each sample of each measurement.

    The greatest of a column is written bold.
    """
    scores = list(dict.fromkeys(row.score for row in rows))
    places = list(dict.fromkeys((row.measurement, row.sample) for row in rows))
    values = np.full((len(scores), len(places)), np.nan)
    for row in rows:
        values[scores.index(row.score), places.index((row.measurement, row.sample))] = row.decile_spearman
    norm, colours = Normalize(-1, 1), _DIVERGING.with_extremes(bad=FIELD)
    with drawing():
        figure = Figure((0.5 * len(places) + 3.2, 0.34 * len(scores) + 2.6), layout="constrained")
        axes = figure.subplots()
        axes.imshow(np.ma.masked_invalid(values), norm=norm, cmap=colours, aspect="auto")
        greatest = np.where(np.isnan(values), -np.inf, values).max(axis=0)
        for (y, x), value in np.ndenumerate(values):
            ink, weight = INK if math.isnan(value) else _ON_CELL, "bold" if value == greatest[x] else "normal"
            axes.text(x, y, rounded(float(value), 2), ha="center", va="center", size=7, color=ink, weight=weight)
        starts = [x for x in range(1, len(places)) if places[x][0] != places[x - 1][0]]
        for x in starts:
            axes.axvline(x - 0.5, color=PAPER, lw=3)
        for first, past in zip([0, *starts], [*starts, len(places)], strict=True):
            axes.text(
                (first + past - 1) / 2, -0.62, places[first][0], ha="left" if past - first < 3 else "center",
                va="bottom", rotation=35 if past - first < 3 else 0, fontsize=8,
            )  # fmt: skip
        axes.set_xticks(range(len(places)), [sample for _, sample in places], rotation=60, ha="right")
        axes.set_yticks(range(len(scores)), scores)
        axes.tick_params(length=0)
        for spine in axes.spines.values():
            spine.set_visible(False)
        bar = figure.colorbar(ScalarMappable(norm, colours), ax=axes, fraction=0.04, pad=0.015)
        bar.set_label("Spearman, ten deciles [1]")
        bar.outline.set_visible(False)  # type: ignore[operator]
    return figure


def roc_figure(every: Sequence[CheckedViews], scores: Sequence[str] | None = None) -> Figure:
    """One measurement: ROC curves of *can be measured or not*, with their areas."""
    names = list(every[0].scores) if scores is None else list(scores)
    styles = score_styles(names)
    with drawing():
        figure = Figure((2.9 * len(every) + 0.6, 4.2), layout="constrained")
        grid = np.asarray(figure.subplots(1, len(every), squeeze=False, sharey=True))[0]
        for checked, axes in zip(every, grid, strict=True):
            _, measurable = view_errors(checked.error)
            axes.set_title(f"{checked.sample}\n{percent(float(measurable.mean()))} of {len(measurable)} measurable")
            axes.set_xlim(-0.02, 1.02)
            axes.set_ylim(-0.02, 1.02)
            axes.set_xlabel("unmeasurable views taken [1]")
            if measurable.all() or not measurable.any():
                axes.text(0.5, 0.5, "not defined", ha="center", color=MUTED)
                continue
            axes.plot([0, 1], [0, 1], color=MUTED, lw=0.8, ls="--", zorder=1)
            for name in names:
                style = {**styles[name], "marker": "", "label": rounded(roc_area(checked.scores[name], measurable), 2)}
                axes.plot(*roc_curve(checked.scores[name], measurable), **style)
            axes.legend(loc="lower right", title="area", fontsize=7, title_fontsize=7, labelspacing=0.2)
        grid[0].set_ylabel("measurable views taken [1]")
        figure.legend(
            handles=legend_handles(styles, marks=False), loc="outside lower center", ncols=min(4, 1 + len(every))
        )
        figure.suptitle(every[0].measurement, fontsize=10)
    return figure


def calibration_figure(every: Sequence[CheckedViews]) -> Figure:
    """One measurement: root mean square of the true error against the predicted standard uncertainty, and coverage.

    Small dots are views, over their repeats, and large ones deciles of u; below, for the deciles, the share of the
    errors inside 2 u with its 95 % interval.
    """
    unit = unit_symbol(every[0].unit)
    ends = _ends(np.concatenate([checked.predicted_uncertainty for checked in every]))
    with drawing():
        figure = Figure((2.9 * len(every) + 0.9, 5.9), layout="constrained")
        grid = np.asarray(figure.subplots(2, len(every), squeeze=False, sharey="row", height_ratios=(1.6, 1)))
        for checked, (upper, lower) in zip(every, grid.T, strict=True):
            u, error = checked.predicted_uncertainty, checked.error
            usable = np.isfinite(u) & np.isfinite(error).any(axis=1)
            squares = np.where(np.isfinite(error), error, 0.0)[usable] ** 2
            rms = np.sqrt(squares.sum(axis=1) / np.isfinite(error)[usable].sum(axis=1))
            bins = calibrate_by_decile(error, u, checked.seed)
            found = calibrate(error / u[:, None])
            told = f"{percent(found.coverage)} inside 2 u, rms of z {rounded(found.z_rms, 2)}"
            upper.set_title(f"{checked.sample}\n{told if found.trials else 'nothing to compare'}")
            for axes in (upper, lower):
                axes.set_xscale("log")
            upper.set_yscale("log")
            upper.plot(u[usable], rms, ".", ms=2.5, color=BLUE, alpha=0.45, mec="none")
            upper.plot(bins.uncertainty, bins.error, "o-", ms=5, lw=1.1, color=VERMILION, mec=PAPER, mew=0.6)
            upper.plot(ends, ends, color=INK, lw=1.0, zorder=1)
            upper.plot(ends, COVERAGE_FACTOR * ends, color=INK, lw=1.0, ls="--", zorder=1)
            low, high = bins.coverage - bins.low, bins.high - bins.coverage
            lower.errorbar(
                bins.uncertainty, bins.coverage, np.maximum([low, high], 0.0), fmt="o", ms=4, lw=1.0, color=VERMILION
            )
            lower.axhline(NORMAL_COVERAGE, color=INK, lw=1.0, zorder=1)
            lower.set_xlabel(f"predicted standard uncertainty u [{unit}]")
            for axes in (upper, lower):
                axes.set_xlim(*ends)
                plain_log(axes.xaxis)
        plain_log(grid[0, 0].yaxis)
        grid[0, 0].set_ylabel(f"rms of the true error [{unit}]")
        grid[1, 0].set_ylabel("inside 2 u [1]")
        grid[1, 0].set_ylim(-0.03, 1.03)
        handles = [
            Line2D([], [], marker=".", ls="none", color=BLUE, label="a view"),
            Line2D([], [], marker="o", color=VERMILION, label="decile of u"),
            Line2D([], [], color=INK, label=f"error = u; {percent(NORMAL_COVERAGE)}"),
            Line2D([], [], color=INK, ls="--", label="error = 2 u"),
        ]
        figure.legend(handles=handles, loc="outside lower center", ncols=min(4, 1 + len(every)))
        figure.suptitle(every[0].measurement, fontsize=10)
    return figure


def _ends(values: Floats) -> Floats:
    """Ends of a logarithmic axis around the numbers among positive ones."""
    known = values[np.isfinite(values)]
    return np.array([known.min() / 1.3, known.max() * 1.3]) if len(known) else np.array([0.1, 1.0])


def score_styles(names: Sequence[str]) -> dict[str, dict[str, Any]]:
    """How each score is drawn: V_m and the predicted uncertainty strongly, the others thin and in other colours."""
    styles: dict[str, dict[str, Any]] = {
        V_M: {"color": BLUE, "marker": "o", "ms": 5.0, "lw": 1.8, "zorder": 4},
        UNCERTAINTY: {"color": VERMILION, "marker": "s", "ms": 5.0, "lw": 1.8, "zorder": 5},
    }
    others = [name for name in names if name not in styles]
    for number, name in enumerate(others):
        marker, colour = _OTHERS[number % len(_OTHERS)]
        styles[name] = {"color": colour, "marker": marker, "ms": 4.0, "lw": 0.9, "zorder": 3}
    return {name: styles[name] for name in names}


def legend_handles(styles: Mapping[str, Mapping[str, Any]], marks: bool = True) -> list[Line2D]:
    """Entries of a legend."""
    plain = {} if marks else {"marker": ""}
    return [Line2D([], [], label=name, **{**style, **plain}) for name, style in styles.items()]


def _decile_line(axes: Axes, values: Floats, few: NDArray[np.bool_], style: Mapping[str, Any]) -> None:
    """One score: a line through its ten deciles, the impossible apart, open marks where few views are measurable."""
    places = np.append(np.arange(1.0, DECILES + 1), _APART)
    axes.plot(places[:-1], values[:-1], **{**style, "marker": ""})
    for which, face in ((~few, style["color"]), (few, PAPER)):
        marks = {**style, "ls": "none", "mfc": face, "mec": style["color"], "mew": 0.8}
        axes.plot(places[which], values[which], **marks)


def _decile_axis(axes: Axes) -> None:
    axes.axvspan(_APART - 0.75, _APART + 0.75, color=FIELD, lw=0, zorder=0)
    axes.set_xlim(0.4, _APART + 0.8)
    numbers = [1, 3, 5, 7, 9]
    axes.set_xticks([*numbers, _APART], [*map(str, numbers), "impossible"])
    axes.get_xticklabels()[-1].set_fontsize(6.5)


def log_if_wide(axes: Axes) -> None:
    """Logarithmic where the values of the row span a decade and more; from 0 otherwise."""
    drawn = [
        np.asarray(line.get_ydata(), float)
        for shared in axes.get_shared_y_axes().get_siblings(axes)
        for line in shared.get_lines()
    ]
    values = np.concatenate(drawn)
    values = values[np.isfinite(values)]
    if len(values) and values.min() > 0 and values.max() > 10 * values.min():
        axes.set_yscale("log")
        axes.set_ylim(values.min() / 1.2, values.max() * 1.2)
        plain_log(axes.yaxis)
    else:
        axes.set_ylim(bottom=0)
