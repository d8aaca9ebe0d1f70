"""Write the page of how right statements of uncertainty are: coverage and regret, cell by cell, in Markdown.

Signal chain: judged cases -> their coverage, false accepts and regrets (:mod:`tests.proofs.judged_statements`) ->
``coverage.csv``, ``regret.csv`` (:mod:`tests.proofs.statement_csv`), a figure -> ``statements.md``.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from characterisation.files.atomic_io import write_text
from characterisation.plots.style import BLUE, FIELD, INK, MUTED, VERMILION, drawing
from characterisation.statements.coverage import Share, share
from mitsim.report.style import write_png
from tests.proofs.judged_statements import (
    PREDICTED,
    RACE,
    TALK,
    Choice,
    choices_of,
    coverage_of,
    false_accepts,
    pooled,
    pooled_coverage,
)
from tests.proofs.judgement import Regret
from tests.proofs.statement_csv import write_coverage_csv, write_regret_csv
from tests.proofs.statement_run import JudgedCase
from tests.proofs.tables import markdown, number

#: between these the share of errors inside the stated 95 % intervals is asked to lie
COVERAGE = (0.93, 0.97)

#: the mean regret of the chosen view is asked to be at most this
REGRET = 1.15


def write_statement_page(cases: Sequence[JudgedCase], folder: str | Path, preamble: str) -> tuple[Path, str]:
    """Write ``statements.md``, its figure and its CSV files; returns its path, and the table of what came out."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    choices = [one for case in cases for one in choices_of(case)]
    write_coverage_csv(folder / "coverage.csv", cases)
    write_regret_csv(folder / "regret.csv", choices)
    write_png(coverage_figure(cases), folder / "coverage.png", dpi=110)
    sensors = sensor_table(cases, choices)
    text = [
        "# How right the statements are\n",
        preamble,
        "\n## Sensor by sensor\n\n",
        f"Asked is that {100 * COVERAGE[0]:.0f} to {100 * COVERAGE[1]:.0f} % of the errors lie inside the stated 95 % "
        f"intervals, and that the mean regret is at most {REGRET}. A measurement that no view makes in half of the "
        "worlds is in no mean of regrets. Brackets are 95 % intervals.\n\n",
        sensors,
        "\n## Coverage\n\nOne line for each case: all measurements of its stated views.\n\n"
        "![Share of errors inside the stated intervals](coverage.png)\n\n",
        coverage_table(cases),
        "\n## Verdicts\n\nShare of worlds that accept a part whose value lies at an edge of its tolerance, at both "
        "edges together, by ISO 14253-1 with the stated expanded uncertainty. At most 5 % is right, whatever the "
        "tolerance.\n\n",
        verdict_table(cases),
        "\n## Regret\n\nRisk of the chosen view over the least of all candidates. *plain*: as estimated; the least of "
        "many estimates is too low by chance. *unbiased*: the best view is sought in half of the worlds, and both are "
        "judged in the other half; the geometric mean over random halves. *median*: their median.\n\n",
        regret_table(choices),
    ]
    write_text(folder / "statements.md", "".join(text))
    return folder / "statements.md", sensors


def sensor_table(cases: Sequence[JudgedCase], choices: Sequence[Choice]) -> str:
    """Coverage and mean regrets of every sensor, and of all."""
    names = list(dict.fromkeys(case.sensor for case in cases))
    body = []
    for name in [*names, "all"]:
        mine = [case for case in cases if name in (case.sensor, "all")]
        cells = [one for case in mine for stated in case.stated for one in coverage_of(stated) if one.of >= 10]
        honest = sum(one.low <= COVERAGE[1] and one.high >= COVERAGE[0] for one in cells)
        body.append(
            [
                name,
                str(len({case.case.table.part for case in mine})),
                _share(pooled_coverage(mine)),
                f"{honest} of {len(cells)}",
                *(
                    _mean_regret([one for one in choices if one.by == by and one.case in mine])
                    for by in (RACE, PREDICTED, TALK)
                ),
            ]
        )
    return markdown(
        [
            "sensor",
            "parts",
            "inside the 95 % interval",
            "cells that agree with 93 to 97 %",
            "mean regret: race",
            PREDICTED,
            TALK,
        ],
        body,
    )


def coverage_table(cases: Sequence[JudgedCase]) -> str:
    """Coverage of every case, and share of trials without a value as stated and as found."""
    body = []
    for case in cases:
        table, own = case.case.table, pooled_coverage([case])
        stated = np.mean([one.without_value for view in case.stated for one in view.statements])
        found = np.mean([~np.isfinite(view.errors) for view in case.stated])
        lowest = min(
            (one for view in case.stated for one in coverage_of(view) if one.of >= 10),
            key=lambda one: one.value,
            default=None,
        )
        body.append(
            [
                f"{table.part}{' (sealed)' if case.case.sealed else ''}",
                case.sensor,
                table.finish,
                _share(own),
                "-" if lowest is None else _share(lowest),
                f"{100 * stated:.0f} %",
                f"{100 * found:.0f} %",
            ]
        )
    return markdown(["part", "sensor", "finish", "inside", "least measurement", "no value, stated", "found"], body)


def verdict_table(cases: Sequence[JudgedCase]) -> str:
    """False accepts of every sensor and of all, of readings as they are and with the bias subtracted."""
    body = []
    for name in [*dict.fromkeys(case.sensor for case in cases), "all"]:
        mine = [stated for case in cases if name in (case.sensor, "all") for stated in case.stated]
        row = [name]
        for corrected in (False, True):
            found = [false_accepts(one, corrected) for one in mine]
            each = [share(row[np.isfinite(row)] > 0) for one in found for row in one if np.isfinite(row).sum() >= 10]
            row += [_share(pooled(found)), f"{sum(one.low <= 0.05 for one in each)} of {len(each)}"]
        body.append(row)
    return markdown(
        ["sensor", "false accepts", "cells that agree with 5 % or less", "bias subtracted", "cells that agree"], body
    )


def regret_table(choices: Sequence[Choice]) -> str:
    """Regret of the race's choices, and of the others beside them."""
    body = []
    by_place = {(id(one.case), one.measurement, one.by): one for one in choices}
    for one in choices:
        if one.by != RACE:
            continue
        others = [by_place[id(one.case), one.measurement, by].regret for by in (PREDICTED, TALK)]
        body.append(
            [
                f"{one.case.case.table.part}{' (sealed)' if one.case.case.sealed else ''}",
                one.case.sensor,
                one.measurement + ("" if one.judged else " (not judged)"),
                str(one.view),
                str(one.best),
                number(one.regret.risk),
                number(one.regret.least),
                number(one.regret.ratio),
                f"{number(one.regret.unbiased)} ({number(one.regret.low)} to {number(one.regret.high)})",
                number(one.regret.middle),
                *(number(other.unbiased) for other in others),
            ]
        )
    head = [
        "part",
        "sensor",
        "measurement",
        "chosen",
        "best",
        "risk",
        "least",
        "plain",
        "unbiased",
        "median",
        PREDICTED,
        TALK,
    ]
    return markdown(head, body)


def coverage_figure(cases: Sequence[JudgedCase]) -> Figure:
    """Draw the coverage of every case with its interval, sensor by sensor."""
    ordered = sorted(cases, key=lambda case: case.sensor)
    with drawing():
        figure = Figure(figsize=(7.5, 0.6 + 0.24 * len(ordered)), layout="constrained")
        axes = figure.add_subplot()
        axes.axvspan(*COVERAGE, color=FIELD)
        axes.axvline(0.95, color=MUTED, linewidth=0.7)
        for place, case in enumerate(ordered):
            found = pooled_coverage([case])
            colour = VERMILION if case.case.sealed else BLUE
            if not found.of:
                axes.text(0.95, place, "no value", color=colour, ha="center", va="center", fontsize="small")
                continue
            axes.plot([found.low, found.high], [place, place], color=colour, linewidth=1.4)
            axes.plot(found.value, place, "o", color=colour, markersize=4)
        axes.set_yticks(range(len(ordered)), [_label(one) for one in ordered])
        axes.invert_yaxis()
        axes.set_xlabel("share of errors inside the stated 95 % interval (blue: open parts, red: sealed)", color=INK)
    return figure


def _label(one: JudgedCase) -> str:
    surfaces = one.case.table.surfaces
    more = "" if surfaces is None else f", light of {surfaces} surfaces"
    return f"{one.sensor}, {one.case.table.part}{more}"


def _mean_regret(choices: Sequence[Choice], key: str = "regret") -> str:
    found: list[Regret] = [getattr(one, key) for one in choices if one.judged]
    if not found:
        return "-"
    mean = {
        key: number(float(np.mean([getattr(one, key) for one in found]))) for key in ("unbiased", "middle", "ratio")
    }
    return f"{mean['unbiased']} (median {mean['middle']}, plain {mean['ratio']})"


def _share(one: Share) -> str:
    if not one.of:
        return "-"
    return f"{100 * one.value:.1f} % ({100 * one.low:.0f} to {100 * one.high:.0f}, n = {one.of})"
