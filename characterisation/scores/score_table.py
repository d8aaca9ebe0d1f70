"""All rows of :mod:`.score_validation` together: means over measurements and samples, who wins, files.

Signal chain: rows -> mean of every figure by score, over the rows in which it is defined; mean rank of every decile,
the talk's last slide; on how many measurements one score beats another -> CSV. And the calibrations of the predicted
uncertainty, one by one and pooled.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from characterisation.scores.rank_agreement import DECILES
from characterisation.scores.score_validation import UNCERTAINTY, V_M, CheckedViews, ScoreRow
from characterisation.scores.uncertainty_calibration import Calibration, calibrate
from characterisation.whole_files import written_whole

Floats = NDArray[np.float64]

#: figures of a :class:`ScoreRow` that are averaged
FIGURES = (
    "decile_spearman", "view_spearman", "measurable_spearman", "regret", "lost", "within", "roc_area", "top_spearman",
    "top_ratio",
)  # fmt: skip

#: of these the mean is the geometric one: 2 and 1/2 cancel
RATIOS = frozenset({"regret", "top_ratio"})

#: what stands for the measurement and the sample in rows over all of them
ALL = "all"

#: figures by which one score beats another, the first that tells them apart, and 1 where more is better
DECIDING = {"decile_spearman": 1, "regret": -1}

#: figures nearer than this, relative, are equal
_SAME = 1e-9


@dataclass(frozen=True)
class Overall:
    """One score over all its rows: ``mean`` of each of :data:`FIGURES`, and in how many ``rows`` it is ``defined``."""

    score: str
    rows: int
    mean: Mapping[str, float]
    defined: Mapping[str, int]


@dataclass(frozen=True)
class Contest:
    """One measurement between two scores: ``winner`` and the figure it won by; both "" where nothing tells them apart.

    ``sample`` is :data:`ALL` where the figures are means over the samples.
    """

    measurement: str
    sample: str
    winner: str
    by: str


def overall(rows: Sequence[ScoreRow]) -> list[Overall]:
    """Mean of every figure, a row for each score; undefined figures are left out and counted."""
    found = []
    for score in dict.fromkeys(row.score for row in rows):
        here = [row for row in rows if row.score == score]
        values = {name: np.array([getattr(row, name) for row in here], float) for name in FIGURES}
        means = {name: _mean(name, column) for name, column in values.items()}
        defined = {name: int((~np.isnan(column)).sum()) for name, column in values.items()}
        found.append(Overall(score, len(here), means, defined))
    return found


def mean_ranks(rows: Sequence[ScoreRow]) -> dict[str, tuple[Floats, int]]:
    """Mean rank (10,) of each decile by true error, and over how many rows, for each score.

    A perfect score has 1, 2, ... 10, a random one 5.5 throughout. Rows whose deciles have no rank are left out.
    """
    found = {}
    for score in dict.fromkeys(row.score for row in rows):
        ranks = [row.decile_ranks for row in rows if row.score == score and np.isfinite(row.decile_ranks).all()]
        found[score] = (np.mean(ranks, axis=0) if ranks else np.full(DECILES, np.nan), len(ranks))
    return found


def contests(
    rows: Sequence[ScoreRow],
    challenger: str = UNCERTAINTY,
    reference: str = V_M,
    by: Literal["measurement", "sample"] = "measurement",
) -> list[Contest]:
    """Who wins each measurement: the greater decile Spearman; where that is the same or undefined, the lesser regret.

    By measurement the figures are means over the samples in which both scores have them; by sample each measurement of
    each sample is a contest of its own.
    """  # fmt: skip
    of = {(row.measurement, row.sample, row.score): row for row in rows}
    pairs: dict[tuple[str, str], list[tuple[ScoreRow, ScoreRow]]] = {}
    for (measurement, sample, score), row in of.items():
        if score == challenger and (measurement, sample, reference) in of:
            place = (measurement, sample if by == "sample" else ALL)
            pairs.setdefault(place, []).append((row, of[measurement, sample, reference]))
    return [Contest(*place, *_winner(both)) for place, both in pairs.items()]


def calibrations(every: Sequence[CheckedViews]) -> list[tuple[str, str, Calibration]]:
    """Calibration of each measurement and sample, and at the end of all together if there are several.

    The pool takes the views of every measurement and sample as independent of one another. Measurements that use the
    same images are not, and its interval is then too narrow.
    """
    z = [checked.error / checked.predicted_uncertainty[:, None] for checked in every]
    rows = [(one.measurement, one.sample, calibrate(values)) for one, values in zip(every, z, strict=True)]
    if len(every) > 1:
        repeats = max(values.shape[1] for values in z)
        padded = [np.pad(v, ((0, 0), (0, repeats - v.shape[1])), constant_values=np.nan) for v in z]
        rows.append((ALL, ALL, calibrate(np.concatenate(padded))))
    return rows


def write_score_rows(path: str | Path, rows: Sequence[ScoreRow]) -> None:
    """Write the rows as CSV, whole or not at all, and after them a row over all for each score.

    In the rows over all ``views``, ``possible`` and ``measurable`` are sums, figures are means, intervals are empty.
    """
    table = [_columns(row) for row in rows]
    ranks = mean_ranks(rows)
    for total in overall(rows):
        here = [row for row in rows if row.score == total.score]
        counts = {name: sum(getattr(row, name) for row in here) for name in ("views", "possible", "measurable")}
        names = {"measurement": ALL, "sample": ALL, "score": total.score}
        table.append(names | counts | dict(total.mean) | _rank_columns(ranks[total.score][0]))
    _write(path, table, ["measurement", "sample", "score"])


def write_calibrations(path: str | Path, rows: Sequence[tuple[str, str, Calibration]]) -> None:
    """Write :func:`calibrations` as CSV, whole or not at all."""
    table = [{"measurement": m, "sample": s, **asdict(calibration)} for m, s, calibration in rows]
    _write(path, table, ["measurement", "sample"])


def _winner(pairs: Sequence[tuple[ScoreRow, ScoreRow]]) -> tuple[str, str]:
    for figure, sign in DECIDING.items():
        values = np.array([[getattr(row, figure) for row in pair] for pair in pairs], float)
        values = values[~np.isnan(values).any(axis=1)]
        if not len(values):
            continue
        mine, theirs = (_mean(figure, column) for column in values.T)
        if not math.isclose(mine, theirs, rel_tol=_SAME, abs_tol=_SAME):
            return pairs[0][int(sign * mine < sign * theirs)].score, figure
    return "", ""


def _mean(figure: str, values: Floats) -> float:
    """Mean of what is defined; of ratios the geometric one, inf if one of them is."""
    values = values[~np.isnan(values)]
    if not len(values):
        return math.nan
    return float(np.exp(np.log(values).mean()) if figure in RATIOS else values.mean())


def _columns(row: ScoreRow) -> dict[str, Any]:
    plain = {name: value for name, value in vars(row).items() if name != "decile_ranks"}
    return plain | _rank_columns(row.decile_ranks)


def _rank_columns(ranks: Floats) -> dict[str, float]:
    return {f"rank_of_decile_{number}": float(rank) for number, rank in enumerate(ranks, 1)}


def _write(path: str | Path, table: Sequence[Mapping[str, Any]], least: list[str]) -> None:
    with written_whole(path) as whole, whole.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, list(table[0]) if table else least)
        writer.writeheader()
        writer.writerows(table)
