"""Draw statements of uncertainty: error, interval and budget of each measurement.

Signal chain: numbers of each measurement -> a row in the panel of its unit: 95 % interval of the error, bias, standard
uncertainty about it -> a bar beside it: the share of each group of unknowns in the variance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from characterisation.plots.style import BLUE, INK, MUTED, VERMILION, figure_of

#: colour and name of a group of unknowns (Okabe and Ito, safe for colour-blind readers)
GROUPS = {
    "calibration": ("#0072b2", "calibration and drift"),
    "finish": ("#e69f00", "finish of the part"),
    "form": ("#f0e442", "form of the part"),
    "coat": ("#6a51a3", "coat of the part"),
    "light": ("#cc79a7", "room light, power, exposure"),
    "temperature": ("#d55e00", "temperature"),
    "unit": ("#999999", "fixed patterns of the unit"),
    "decoder": ("#882255", "decoder of the maker"),
    "pose": ("#009e73", "place and pose of the part"),
    "noise": ("#56b4e9", "noise and speckle"),
    "beyond_map": ("#000000", "effects outside the map"),
    "interaction": ("#7f5539", "interaction and unexplained"),
    "model": ("#b5179e", "error of the model"),
}

#: colour of a group that is not in :data:`GROUPS`
_OTHER_GROUP = "#b9bdc4"

#: height of a row [in]
ROW_IN = 0.34

#: height of the labels and legends of a panel [in]
MARGIN_IN = 1.25


@dataclass(frozen=True)
class ErrorRow:
    """Numbers of one measurement, all in its unit.

    ``budget``: the share of each group of unknowns in the variance, by name; empty if it is not known. ``open_groups``:
    those whose share the trials are too few to tell.
    """

    name: str
    bias: float
    standard_uncertainty: float
    interval: tuple[float, float]
    budget: dict[str, float]
    verdict: str = ""
    open_groups: frozenset[str] = frozenset()


def draw_errors(axes: Axes, rows: Sequence[ErrorRow], unit: str) -> None:
    """Draw a row for each measurement: the 95 % interval of its error, its bias, and u about the bias."""
    axes.axvline(0, color=MUTED, lw=0.8, zorder=0)
    for y, row in enumerate(rows):
        low, high = row.interval
        if not math.isfinite(row.standard_uncertainty):
            axes.text(0, y, "no value", ha="center", va="center", color=MUTED)
            continue
        u = row.standard_uncertainty
        axes.plot([row.bias - u, row.bias + u], [y, y], color=BLUE, lw=6, alpha=0.45, solid_capstyle="butt", zorder=1)
        axes.plot([low, high], [y, y], color=INK, lw=1.1, marker="|", ms=7, zorder=2)
        axes.plot(row.bias, y, "o", ms=4, color=VERMILION, zorder=3)
    axes.set_yticks(range(len(rows)), [_row_label(row, unit) for row in rows])
    axes.set_ylim(len(rows) - 0.5, -0.5)
    axes.tick_params(axis="y", length=0)
    axes.set_xlabel(f"measured − true [{unit}]")
    axes.margins(x=0.06)
    legend = [
        Line2D([], [], color=INK, lw=1.1, marker="|", ms=7, label="95 % interval of the error"),
        Line2D([], [], color=BLUE, lw=6, alpha=0.45, label="bias ± u"),
        Line2D([], [], color=VERMILION, marker="o", ms=4, ls="none", label="bias"),
    ]
    axes.legend(handles=legend, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3, borderaxespad=0.2)


def draw_budget(axes: Axes, rows: Sequence[ErrorRow]) -> None:
    """Draw a bar for each measurement: shares of groups of unknowns in its variance, hatched if not well known."""
    order = {group: GROUPS.get(group, (_OTHER_GROUP, group))[0] for group in _groups(rows)}
    for y, row in enumerate(rows):
        left = 0.0
        for group, colour in order.items():
            share, hatch = row.budget.get(group, 0.0), "////" if group in row.open_groups else None
            axes.barh(y, 100 * share, 0.6, left=100 * left, color=colour, hatch=hatch, edgecolor="white", lw=0)
            left += share
    axes.set_ylim(len(rows) - 0.5, -0.5)
    axes.set_yticks([])
    axes.set_xlim(0, 100)
    hatched = "; hatched: too few trials to tell" if any(row.open_groups & set(row.budget) for row in rows) else ""
    axes.set_xlabel(f"share of the variance [%]{hatched}")


def budget_legend(axes: Axes, rows: Sequence[ErrorRow]) -> None:
    """Add the legend of the groups that occur in the budgets of all rows, below the axes."""
    shown = [GROUPS.get(group, (_OTHER_GROUP, group)) for group in _groups(rows)]
    handles = [Patch(facecolor=colour, label=name) for colour, name in shown]
    figure_of(axes).legend(handles=handles, loc="outside lower right", ncols=min(len(handles), 4), handlelength=1.1)


def _groups(rows: Sequence[ErrorRow]) -> list[str]:
    """Return the groups in the budgets of all rows, in the order of :data:`GROUPS`, then others by name."""
    used = {group for row in rows for group in row.budget}
    return [*(group for group in GROUPS if group in used), *sorted(used - set(GROUPS))]


def _row_label(row: ErrorRow, unit: str) -> str:
    u = row.standard_uncertainty
    if not (math.isfinite(u) and u > 0):
        return row.name
    digits = max(1 - math.floor(math.log10(float(np.format_float_positional(u, 2, fractional=False)))), 0)
    verdict = "" if row.verdict in ("", "no tolerance") else f", {row.verdict}"
    return f"{row.name}\nu {u:.{digits}f} {unit}{verdict}"
