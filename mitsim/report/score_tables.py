"""Tables, in Markdown, of how right view scores are; :mod:`mitsim.report.score_figures` draws them."""

from __future__ import annotations

import math
from collections.abc import Sequence

from characterisation.scores.rank_agreement import DECILES
from characterisation.scores.score_table import ALL, Contest, calibrations, mean_ranks, overall
from characterisation.scores.score_validation import UNCERTAINTY, V_M, CheckedViews, ScoreRow
from characterisation.scores.uncertainty_calibration import Calibration
from mitsim.report.numbers import percent, rounded

#: heading of every figure, and whether it is a share, told in per cent
HEADINGS = {
    "decile_spearman": ("Spearman, deciles", False), "view_spearman": ("Spearman, views", False),
    "measurable_spearman": ("of measurable views", False), "top_spearman": ("in the top 30 %", False),
    "top_ratio": ("error ratio in the top 30 %", False), "regret": ("regret", False), "lost": ("lost", True),
    "within": ("within tolerance", True), "roc_area": ("ROC area", False),
}  # fmt: skip

#: what is told sample by sample
BY_SAMPLE = ("decile_spearman", "view_spearman", "regret", "roc_area")


def overall_table(rows: Sequence[ScoreRow]) -> str:
    """A row for each score: mean of every figure, and in brackets in how many rows it is defined, if not in all."""
    body = []
    for total in overall(rows):
        cells = [_figure(name, total.mean[name], total.defined[name], total.rows) for name in HEADINGS]
        body.append([total.score, str(total.rows), *cells])
    return _markdown(["score", "rows", *(heading for heading, _ in HEADINGS.values())], body)


def sample_table(rows: Sequence[ScoreRow], every: Sequence[CheckedViews]) -> str:
    """A row for each sample: means over the measurements, of the predicted uncertainty and, in brackets, of V_m."""
    body = []
    for sample in dict.fromkeys(row.sample for row in rows):
        means = {total.score: total.mean for total in overall([row for row in rows if row.sample == sample])}
        mine, theirs = means[UNCERTAINTY], means.get(V_M, {})
        cells = [f"{rounded(mine[name], 2)} ({rounded(theirs.get(name, math.nan), 2)})" for name in BY_SAMPLE]
        coverage = calibrations([one for one in every if one.sample == sample])[-1][2].coverage
        body.append([sample, *cells, percent(coverage)])
    return _markdown(["sample", *(HEADINGS[name][0] for name in BY_SAMPLE), "inside 2 u"], body)


def measurement_table(rows: Sequence[ScoreRow], measurement: str) -> str:
    """One measurement: a row for each sample and score, the Spearman correlation of the views with its interval."""
    body = []
    for row in rows:
        if row.measurement != measurement:
            continue
        cells = [_figure(name, getattr(row, name)) for name in HEADINGS]
        if math.isfinite(row.view_spearman):
            cells[1] += f" ({rounded(row.view_spearman_low, 2)} to {rounded(row.view_spearman_high, 2)})"
        body.append([row.sample, row.score, f"{row.possible}, {row.measurable} of {row.views}", *cells])
    heads = ["sample", "score", "possible by the score, measurable", *(heading for heading, _ in HEADINGS.values())]
    return _markdown(heads, body)


def mean_rank_table(rows: Sequence[ScoreRow]) -> str:
    """A row for each score: mean rank of every decile by true error, the talk's last slide."""
    body = [
        [score, str(count), *(rounded(float(rank), 1) for rank in ranks)]
        for score, (ranks, count) in mean_ranks(rows).items()
    ]
    heads = [f"decile {number}" if number == 1 else str(number) for number in range(1, DECILES + 1)]
    return _markdown(["score", "rows", *heads], body)


def contest_table(found: Sequence[Contest]) -> str:
    """A row for each contest, and who won it by what."""
    body = [
        [
            contest.measurement,
            "mean of all" if contest.sample == ALL else contest.sample,
            contest.winner or "neither",
            HEADINGS[contest.by][0] if contest.by else "",
        ]
        for contest in found
    ]
    return _markdown(["measurement", "sample", "better", "by"], body)


def calibration_table(found: Sequence[tuple[str, str, Calibration]]) -> str:
    """A row for each measurement and sample: how many errors lie inside 2 u, and the distribution of z = error / u."""
    body = []
    for measurement, sample, one in found:
        share = percent(one.coverage)
        if one.trials:
            share += f" ({percent(one.low)} to {percent(one.high)})"
        shape = [rounded(value, 2) for value in (one.z_rms, one.z_mean, one.skewness, one.excess_kurtosis)]
        p = "–" if math.isnan(one.p_normal) else f"{one.p_normal:.2g}"
        body.append([measurement, sample, str(one.views), str(one.trials), share, *shape, p])
    heads = ["measurement", "sample", "views", "errors", "inside 2 u (95 % interval)", "rms of z", "mean of z"]
    return _markdown([*heads, "skewness", "excess kurtosis", "p, normal"], body)


def _figure(name: str, value: float, defined: int = 0, rows: int = 0) -> str:
    text = "∞" if value == math.inf else percent(value) if HEADINGS[name][1] else rounded(value, 2)
    return f"{text} ({defined})" if defined < rows else text


def _markdown(heads: Sequence[str], body: Sequence[Sequence[str]]) -> str:
    """Names are the user's: a bar in one would end its cell."""
    lines = [list(heads), ["---"] * len(heads), *body]
    return "".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |\n" for line in lines)
