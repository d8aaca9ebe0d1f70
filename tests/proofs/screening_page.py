"""Write the page on how well screening orders views: recall, rank correlation and probability of a value, in Markdown.

Signal chain: judged cases (:mod:`tests.proofs.screening_run`) -> values of every measurement and score
(:mod:`tests.proofs.screening_figures`) -> ``scores.csv``, ``reliability.png``, ``order.png`` -> ``scores.md``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from characterisation.plots.style import BLUE, INK, MUTED, VERMILION, drawing
from mitsim.report.style import write_png
from tests.proofs.part_cases import PartCase
from tests.proofs.screening_figures import (
    Screened,
    attainable_recall,
    ceiling,
    interval,
    measurable_area,
    rank_correlation,
    recall,
    reliability,
)
from tests.proofs.screening_run import ALONE, COSINE, POINTS, PREDICTED, TALK, JudgedScreening
from tests.proofs.tables import markdown, number, write_csv

#: file name of the page
PAGE = "scores.md"

#: number of first views of an order among which recall looks for a good one
FIRST = 12

#: aims for the mean recall, for the recall of every sensor on sealed parts, for the rank correlation over its ceiling,
#: and for the area under the ROC curve
RECALL, LEAST_RECALL, OF_CEILING, AREA = 0.95, 0.85, 0.9, 0.95


@dataclass(frozen=True)
class Cell:
    """Values of one measurement of a case by one score; NaN if there is none."""

    recall: float
    attainable: float
    correlation: float
    ceiling: float
    area: float
    measurable: int
    wrongly_impossible: int


def cells_of(case: JudgedScreening, score: str, measured: bool = False) -> list[Cell]:
    """Return the values of every measurement, by a score alone or combined with one virtual measurement."""
    out = []
    known = zip(case.cells(score, measured), case.areas(score, measured), _limits(case), strict=True)
    for one, area, (attainable, limit) in known:
        able = one.measurable
        out.append(
            Cell(
                recall(one, FIRST),
                attainable,
                rank_correlation(one),
                limit,
                measurable_area(area),
                int(able.sum()),
                int((able & ~np.isfinite(one.cost)).sum()),
            )
        )
    return out


@cache
def _limits(case: JudgedScreening) -> list[tuple[float, float]]:
    """Return attainable recall and ceiling of every measurement, which depend on the truth alone and take long."""
    return [(attainable_recall(one, FIRST), ceiling(one.errors)) for one in case.cells(PREDICTED)]


def write_screening_page(cases: Sequence[JudgedScreening], folder: str | Path, preamble: str) -> tuple[Path, str]:
    """Write ``scores.md``, its figures and ``scores.csv``; return its path, and the summary tables."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    write_csv(folder / "scores.csv", _HEAD, [row for case in cases for row in _rows(case)])
    write_png(order_figure(cases), folder / "order.png", dpi=110)
    write_png(reliability_figure(cases), folder / "reliability.png", dpi=110)
    summary = []
    for kind, sealed in (("sealed", True), ("open", False)):
        mine = [case for case in cases if case.case.sealed == sealed]
        if mine:
            summary.append(f"\n### {kind.capitalize()} parts\n\n" + sensor_table(mine))
    text = [
        "# How right the screening is\n",
        preamble,
        "\n## Sensor by sensor\n",
        "\nTwo orders are judged. *map*: the predicted risk alone. *once*: the order after the race's first round, in "
        "which every view on the shortlist is measured virtually once. The race continues from this order.\n"
        "\n*recall*: share of measurements for which a view within 10 % of the least risk is among the first "
        f"{FIRST} of the order; the aim is {RECALL} for the mean and {LEAST_RECALL} for every sensor on sealed parts. "
        "*attainable*: recall of an order by half of the truth. *rank*: Spearman's correlation of order and "
        f"risk over measurable views; the aim is {OF_CEILING} of the *ceiling*, which follows from the noise of the "
        f"truth. *ROC*: area under the ROC curve of the predicted chance of a value; the aim is {AREA}. Brackets: "
        "95 % intervals from a bootstrap over views.\n",
        *summary,
        "\n## Score by score\n\nThe same values for simpler scores, with the same treatment of impossible views and "
        "combined with the same virtual measurements. *best*: number of measurements in which a score has the best "
        "rank correlation; ties count for all. *measurement alone* uses only one virtual measurement of each view.\n\n",
        score_table(cases),
        "\n## Case by case\n\n![Rank correlation and its ceiling](order.png)\n\n",
        case_table(cases),
        "\n## Chance of being measurable\n\n![Share of worlds with a value, by predicted chance](reliability.png)\n",
    ]
    (folder / PAGE).write_text("".join(text), encoding="utf-8")
    return folder / PAGE, "".join(summary)


def described_screening(path: str | Path, cases: Sequence[PartCase]) -> str:
    """Return the introduction of the page, in Markdown."""
    file = cases[0].file
    parts = {sealed: sorted({case.table.part for case in cases if case.sealed == sealed}) for sealed in (False, True)}
    return (
        f"\nMade by `python -m tests.proofs scores {path} -o FOLDER`, which writes this page, its figures "
        "and `scores.csv`.\n"
        f"\nOpen parts: {', '.join(parts[False]) or 'none'}. Sealed parts, which are used only for "
        f"validation: {', '.join(parts[True]) or 'none'}.\n\nEvery case has {file.candidates} candidate views, drawn "
        "at random from those of a study. The function that `mitsim run` uses screens them, with its defaults. "
        "The race then measures each view on its shortlist once, as `mitsim run` does. "
        f"For the truth, each view is measured in {file.worlds} other random worlds, each with another calibration, "
        "finish, room light, temperature and pose ([unknowns](../../reference/unknowns.md)). The risk of a view is its "
        "root mean square error over the square root of the share of worlds with a value.\n"
    )


def sensor_table(cases: Sequence[JudgedScreening]) -> str:
    """Return the values of the tool's own orders, for every sensor and for all."""
    names = list(dict.fromkeys(case.sensor for case in cases))
    body = []
    for name in [*names, "all"]:
        mine = [case for case in cases if name in (case.sensor, "all")]
        known = [cell for case in mine for cell in cells_of(case, PREDICTED)]
        body.append(
            [
                name,
                str(len({case.case.table.part for case in mine})),
                str(len(known)),
                *(_with_interval(mine, lambda one: recall(one, FIRST), measured) for measured in (False, True)),
                number(_mean(known, "attainable")),
                *(_with_interval(mine, rank_correlation, measured) for measured in (False, True)),
                number(_mean(known, "ceiling")),
                *(_with_interval(mine, measurable_area, measured, areas=True) for measured in (False, True)),
                f"{sum(cell.wrongly_impossible for cell in known)} of {sum(cell.measurable for cell in known)}",
            ]
        )
    return markdown(
        [
            "sensor",
            "parts",
            "measurements",
            "recall: map",
            "once",
            "attainable",
            "rank: map",
            "once",
            "ceiling",
            "ROC: map",
            "once",
            "measurable views rated impossible",
        ],
        body,
    )


def score_table(cases: Sequence[JudgedScreening]) -> str:
    """Return mean values of every score over all measurements, alone and combined with one virtual measurement."""
    names = list(cases[0].costs)
    found = {
        (name, measured): [cell for case in cases for cell in cells_of(case, name, measured)]
        for name in names
        for measured in (False, True)
    }
    best = {
        measured: np.nanmax([[_rank(cell) for cell in found[name, measured]] for name in names], axis=0)
        for measured in (False, True)
    }
    body = []
    for name in names:
        row = [name]
        for measured in (False, True):
            mine = found[name, measured]
            if name == ALONE and not measured:
                row += ["-"] * 4
                continue
            row += [number(_mean(mine, key)) for key in ("recall", "correlation", "area")]
            row.append(str(int(np.sum(np.array([_rank(cell) for cell in mine]) >= best[measured]))))
        body.append(row)
    return markdown(["score", "map: recall", "rank", "ROC", "best", "once: recall", "rank", "ROC", "best"], body)


def case_table(cases: Sequence[JudgedScreening]) -> str:
    """Return means over the measurements of every case, and its worst measurement."""
    body = []
    for case in cases:
        table, known, once = case.case.table, cells_of(case, PREDICTED), cells_of(case, PREDICTED, measured=True)
        ranks = [cell.correlation for cell in once]
        worst = "-"
        if np.isfinite(ranks).any():
            place = int(np.nanargmin(ranks))
            worst = f"{case.measurements[place]}: {number(ranks[place])} ({number(once[place].ceiling)})"
        body.append(
            [
                f"{table.part}{' (sealed)' if case.case.sealed else ''}",
                case.sensor,
                table.finish,
                number(_mean(known, "recall")),
                number(_mean(once, "recall")),
                number(_mean(known, "attainable")),
                number(_mean(known, "correlation")),
                number(_mean(once, "correlation")),
                number(_mean(known, "ceiling")),
                worst,
                number(_mean(known, "area")),
                number(_mean(once, "area")),
            ]
        )
    return markdown(
        [
            "part",
            "sensor",
            "finish",
            "recall: map",
            "once",
            "attainable",
            "rank: map",
            "once",
            "ceiling",
            "least rank once (ceiling)",
            "ROC: map",
            "once",
        ],
        body,
    )


def order_figure(cases: Sequence[JudgedScreening]) -> Figure:
    """Draw the rank correlation of every score, case by case, with its ceiling."""
    ordered = sorted(cases, key=lambda case: case.sensor)
    marks = [
        (PREDICTED, True, "o", "measured once"),
        (PREDICTED, False, "o", PREDICTED),
        (TALK, False, "x", TALK),
        (POINTS, False, "+", POINTS),
        (COSINE, False, "|", COSINE),
    ]
    with drawing():
        figure = Figure(figsize=(7.5, 1.5 + 0.24 * len(ordered)), layout="constrained")
        axes = figure.add_subplot()
        for place, case in enumerate(ordered):
            for name, measured, mark, label in marks:
                value = _mean(cells_of(case, name, measured), "correlation")
                colour = (VERMILION if case.case.sealed else BLUE) if name == PREDICTED else MUTED
                axes.plot(
                    value,
                    place,
                    mark,
                    color=colour,
                    markersize=5,
                    fillstyle="full" if measured else "none",
                    label=label if place == 0 else None,
                )
            limit = _mean(cells_of(case, PREDICTED), "ceiling")
            axes.plot(
                [limit, limit],
                [place - 0.35, place + 0.35],
                color=INK,
                linewidth=1.2,
                label="ceiling" if place == 0 else None,
            )
        labels = [f"{case.case.table.part}, {case.sensor}, {case.case.table.finish}" for case in ordered]
        axes.set_yticks(range(len(ordered)), labels)
        axes.set_xlim(-1, 1.02)
        axes.invert_yaxis()
        axes.set_xlabel("rank correlation with the true risk (vermilion: sealed parts)")
        figure.legend(loc="outside lower center", ncols=3)
    return figure


def reliability_figure(cases: Sequence[JudgedScreening]) -> Figure:
    """Draw the share of worlds with a value over the predicted chance, for sealed and open parts."""
    with drawing():
        figure = Figure(figsize=(4.2, 3.6), layout="constrained")
        axes = figure.add_subplot()
        axes.plot([0, 1], [0, 1], color=MUTED, linewidth=0.7)
        for sealed, colour in ((False, BLUE), (True, VERMILION)):
            mine = [case for case in cases if case.case.sealed == sealed]
            if not mine:
                continue
            worlds = min(case.errors.shape[2] for case in mine)
            chance = np.concatenate([case.chance.ravel() for case in mine])
            errors = np.concatenate([case.errors[..., :worlds].reshape(-1, worlds) for case in mine])
            found = reliability(chance, errors)
            axes.plot(
                found.predicted, found.found, "o-", color=colour, label="sealed parts" if sealed else "open parts"
            )
            for x, y, count in zip(found.predicted, found.found, found.views, strict=True):
                if count:
                    axes.annotate(
                        str(count), (x, y), xytext=(4, -9), textcoords="offset points", color=colour, fontsize=7
                    )
        axes.set_xlabel("predicted chance of a value")
        axes.set_ylabel("share of worlds with a value")
        axes.legend(loc="upper left")
    return figure


def _with_interval(
    cases: Sequence[JudgedScreening], figure: Callable[[Screened], float], measured: bool, areas: bool = False
) -> str:
    groups = [(case.areas if areas else case.cells)(PREDICTED, measured) for case in cases]
    values = [figure(one) for cells in groups for one in cells]
    if not np.isfinite(values).any():
        return "-"
    low, high = interval(groups, figure)
    return f"{np.nanmean(values):.2f} ({low:.2f} to {high:.2f})"


def _rank(cell: Cell) -> float:
    return -math.inf if math.isnan(cell.correlation) else cell.correlation


def _mean(cells: Sequence[Cell], key: str) -> float:
    values = [getattr(cell, key) for cell in cells]
    return float(np.nanmean(values)) if np.isfinite(values).any() else math.nan


_HEAD = (
    "part",
    "sealed",
    "sensor",
    "finish",
    "measurement",
    "score",
    "order",
    "measurable",
    "wrongly_impossible",
    "recall",
    "attainable",
    "rank_correlation",
    "ceiling",
    "roc_area",
)


def _rows(case: JudgedScreening) -> list[tuple[object, ...]]:
    table = case.case.table
    return [
        (
            table.part,
            int(case.case.sealed),
            case.sensor,
            table.finish,
            measurement,
            score,
            "once" if measured else "map",
            cell.measurable,
            cell.wrongly_impossible,
            cell.recall,
            cell.attainable,
            cell.correlation,
            cell.ceiling,
            cell.area,
        )
        for score in case.costs
        for measured in (False, True)
        if measured or score != ALONE
        for measurement, cell in zip(case.measurements, cells_of(case, score, measured), strict=True)
    ]
