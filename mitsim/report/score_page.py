"""The pages of a score validation: tables and figures of how right the view scores are, in Markdown.

Signal chain: true errors beside every score, by sensor -> rows, contests, calibrations
(:mod:`characterisation.scores.score_validation`) -> ``scores.csv``, ``calibration.csv``, figures -> ``index.md``, and
a page for each sensor with every measurement.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from characterisation.scores.score_table import (
    calibrations,
    contests,
    overall,
    write_calibrations,
    write_score_rows,
)
from characterisation.scores.score_validation import UNCERTAINTY, V_M, CheckedViews, ScoreRow, score_rows
from characterisation.whole_files import written_whole
from mitsim.report.numbers import percent, rounded
from mitsim.report.score_figures import (
    calibration_figure,
    decile_figure,
    mean_rank_figure,
    roc_figure,
    spearman_figure,
)
from mitsim.report.score_grids import calibration_grid, decile_grid, roc_grid
from mitsim.report.score_tables import (
    calibration_table,
    contest_table,
    mean_rank_table,
    measurement_table,
    overall_table,
    sample_table,
)
from mitsim.report.style import write_png

#: what the predicted uncertainty is asked to reach over all measurements, samples and sensors
AIMS = {"decile_spearman": 0.95, "roc_area": 0.95}

#: between these the share of the true errors inside two standard uncertainties is asked to lie
COVERAGE = (0.90, 0.98)

#: on so many measurements, of all, it is asked to be ahead of V_m
AHEAD = 5 / 7

_DPI = 70


def write_score_page(
    found: Mapping[str, Sequence[CheckedViews]], folder: str | Path, preamble: str
) -> tuple[Path, str]:
    """Write ``index.md``, a page for each sensor, their figures and CSV files into a folder; ``found`` is by sensor.

    Returns its path, and the table of what was asked and reached, in Markdown.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    rows = {sensor: score_rows(every) for sensor, every in found.items()}
    together = [replace(row, sample=f"{sensor}, {row.sample}") for sensor, own in rows.items() for row in own]
    pooled = [replace(one, sample=f"{sensor}, {one.sample}") for sensor, every in found.items() for one in every]
    write_score_rows(folder / "scores.csv", together)
    write_calibrations(folder / "calibration.csv", calibrations(pooled))
    write_png(mean_rank_figure(together), folder / "mean_ranks.png", dpi=_DPI)
    aims = aims_table(together, pooled)
    text = [
        "# How right the view scores are\n", preamble, "\n## What was asked, and what came out\n\n",
        aims, "\n## Sample by sample\n\nMeans over the measurements, of the predicted uncertainty, and of V_m in "
        "brackets.\n\n", sample_table(together, pooled),
        "\n## All sensors, samples and measurements\n\n", overall_table(together),
        "\n![Mean rank of each decile by true error](mean_ranks.png)\n\n", mean_rank_table(together),
        "\nThe predicted uncertainty against V_m, by measurement:\n\n", contest_table(contests(together)),
    ]  # fmt: skip
    for sensor, every in found.items():
        text += _of_sensor(sensor, every, rows[sensor], folder)
        _write(folder / f"{sensor}.md", _measurements(sensor, every, rows[sensor], folder))
    page = folder / "index.md"
    _write(page, text)
    return page, aims


def _write(page: Path, text: Sequence[str]) -> None:
    with written_whole(page) as file:
        file.write_text("".join(text), encoding="utf-8")


def aims_table(rows: Sequence[ScoreRow], every: Sequence[CheckedViews]) -> str:
    """What the predicted uncertainty should reach, what it reaches, and what V_m does."""
    means = {total.score: total.mean for total in overall(rows)}
    mine, theirs = means[UNCERTAINTY], means.get(V_M, {})
    coverage = calibrations(every)[-1][2].coverage
    decided = contests(rows)
    ahead = sum(contest.winner == UNCERTAINTY for contest in decided)
    least = math.ceil(AHEAD * len(decided) - 1e-9)
    names = {"decile_spearman": "mean Spearman correlation of the deciles", "roc_area": "area under the ROC curve"}
    lines = ["| aim of the predicted uncertainty | asked | reached | V_m |", "| --- | --- | --- | --- |"]
    for figure, aim in AIMS.items():
        reached = f"{rounded(mine[figure], 3)}, {_verdict(mine[figure] >= aim)}"
        lines.append(f"| {names[figure]} | {aim} | {reached} | {rounded(theirs.get(figure, np.nan), 3)} |")
    inside = f"{percent(coverage)}, {_verdict(COVERAGE[0] <= coverage <= COVERAGE[1])}"
    lines.append(f"| true errors inside 2 u | {percent(COVERAGE[0])} to {percent(COVERAGE[1])} | {inside} | |")
    beaten = f"{ahead} of {len(decided)}, {_verdict(ahead >= least)}"
    lines.append(f"| measurements on which it is ahead of V_m | {least} of {len(decided)} | {beaten} | |")
    return "\n".join(lines) + "\n"


def _verdict(reached: bool) -> str:
    return "reached" if reached else "**missed**"


def _of_sensor(sensor: str, every: Sequence[CheckedViews], rows: Sequence[ScoreRow], folder: Path) -> list[str]:
    write_png(spearman_figure(rows), folder / f"{sensor}_spearman.png", dpi=_DPI)
    write_png(decile_grid(every), folder / f"{sensor}_means.png", dpi=_DPI)
    write_png(decile_grid(every, "std"), folder / f"{sensor}_deviations.png", dpi=_DPI)
    write_png(roc_grid(every), folder / f"{sensor}_roc.png", dpi=_DPI)
    write_png(calibration_grid(every), folder / f"{sensor}_calibration.png", dpi=_DPI)
    return [
        f"\n## {sensor}\n\n", overall_table(rows), "\nThe predicted uncertainty against V_m:\n\n",
        contest_table(contests(rows)),
        f"\n![Rank correlation of the deciles with the true error]({sensor}_spearman.png)\n",
        f"\n![Mean true error by decile of each score]({sensor}_means.png)\n",
        f"\n![Standard deviation of the true error by decile of each score]({sensor}_deviations.png)\n",
        f"\n![Which views can be measured]({sensor}_roc.png)\n",
        f"\n![True error over predicted uncertainty]({sensor}_calibration.png)\n",
        "\nHow often the true error lies inside two predicted standard uncertainties:\n\n",
        calibration_table(calibrations(every)),
        f"\nMeasurement by measurement: `{sensor}.md`, which the command writes beside this page.\n",
    ]  # fmt: skip


def _measurements(
    sensor: str, every: Sequence[CheckedViews], rows: Sequence[ScoreRow], folder: Path
) -> list[str]:  # fmt: skip
    text = [f"# {sensor}, measurement by measurement\n\nAll together: [index.md](index.md).\n"]
    for measurement in dict.fromkeys(one.measurement for one in every):
        here = [one for one in every if one.measurement == measurement]
        stem = f"{sensor}_{measurement}"
        write_png(decile_figure(here), folder / f"{stem}_deciles.png", dpi=_DPI)
        write_png(roc_figure(here), folder / f"{stem}_roc.png", dpi=_DPI)
        write_png(calibration_figure(here), folder / f"{stem}_calibration.png", dpi=_DPI)
        text += [
            f"\n## {measurement}\n\n",
            f"![True error by decile of each score]({stem}_deciles.png)\n\n",
            f"![Which views can be measured]({stem}_roc.png)\n\n",
            f"![True error against predicted uncertainty]({stem}_calibration.png)\n\n",
            measurement_table(rows, measurement),
        ]  # fmt: skip
    return text
