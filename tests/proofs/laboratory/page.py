"""Write how many errors in the laboratory lie inside the stated 95 % intervals, as Markdown and CSV.

Worlds are independent, the measurements of one world are not. The interval of one measurement's share is Wilson's (JASA
22, 1927). For a share over all measurements of some rows, each world counts as the number of independent trials that
has the variance of its own share: Wilson's interval of n p (1 - p) / s^2 trials, s^2 the variance of the mean over
worlds (Kish's design effect), at least one and at most one for each measurement of a world.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import norm

from characterisation.files.atomic_io import write_text
from characterisation.statements.coverage import Share
from tests.proofs.judgement import within
from tests.proofs.laboratory.run import Found
from tests.proofs.tables import markdown, number, write_csv

Floats = NDArray[np.float64]

#: between these the share inside is asked to lie in every family
ASKED = (0.90, 0.98)

_Z = float(norm.ppf(0.975))


def wilson(share: float, trials: float) -> tuple[float, float]:
    """Return Wilson's 95 % interval of a share of independent trials; their number need not be whole."""
    if trials <= 0:
        return 0.0, 1.0
    centre = share + _Z**2 / (2 * trials)
    half = _Z * math.sqrt(share * (1 - share) / trials + _Z**2 / (4 * trials**2))
    scale = 1 + _Z**2 / trials
    return max((centre - half) / scale, 0.0), min((centre + half) / scale, 1.0)


def share_inside(inside: ArrayLike) -> Share:
    """Return the share of true over measurements and worlds (m, w), NaN for missing values, and its interval."""
    each = np.atleast_2d(np.asarray(inside, float))
    known = np.isfinite(each)
    count, total = int(np.nansum(each)), int(known.sum())
    if total == 0:
        return Share(0, 0, 0.0, 1.0)
    share, worlds = count / total, int(known.any(axis=0).sum())
    trials = float(worlds)
    if len(each) > 1 and 0 < count < total and worlds > 1:
        # of the ratio of two sums over worlds, to first order
        residual = np.nansum(each, axis=0) - share * known.sum(axis=0)
        variance = float((residual**2).sum()) / total**2 * worlds / (worlds - 1)
        trials = min(max(share * (1 - share) / variance, worlds), total) if variance > 0 else float(total)
    low, high = wilson(share, trials)
    return Share(count, total, low, high)


def inside_of(found: Found) -> Floats:
    """Return whether errors (measurement, world) lie in the stated intervals, NaN without a value or an interval."""
    rows = []
    for one, errors in zip(found.statements, found.errors, strict=True):
        known = all(math.isfinite(end) for end in one.interval)
        rows.append(within(errors, one.interval) if known else np.full(len(errors), np.nan))
    return np.array(rows)


def share_table(found: Sequence[Found]) -> str:
    """Return the share of every family, mask and decoder (rows) in every case and view (columns), in Markdown."""
    columns = list(dict.fromkeys((one.row.case.name, one.row.view) for one in found))
    rows = list(dict.fromkeys((one.row.family, one.row.mask, one.decoder) for one in found))
    by_place = {(one.row.case.name, one.row.view, one.row.family, one.row.mask, one.decoder): one for one in found}
    body = []
    for row in rows:
        cells = [by_place.get((*column, *row)) for column in columns]
        body.append([*row, *("" if one is None else _percent(share_inside(inside_of(one))) for one in cells)])
    return markdown(["family", "mask", "decoder", *(f"{case}, view {view}" for case, view in columns)], body)


def measurement_table(found: Sequence[Found]) -> str:
    """Return the share of every measurement of every row, in Markdown."""
    body = []
    for one in found:
        for stated, inside, errors in zip(one.statements, inside_of(one), one.errors, strict=True):
            known = errors[np.isfinite(errors)]
            body.append(
                [
                    *_place(one),
                    stated.measurement,
                    _percent(share_inside(inside)),
                    number(stated.standard_uncertainty),
                    number(float(np.sqrt(np.mean(known**2)))) if len(known) else "-",
                    stated.unit,
                    str(int(len(errors) - len(known))),
                ]
            )
    head = [*_HEAD, "measurement", "inside", "stated u", "rms error", "unit", "worlds without a value"]
    return markdown(head, body)


def write_laboratory_page(found: Sequence[Found], folder: Path, source: Path) -> tuple[Path, str]:
    """Write ``laboratory.md`` and ``laboratory.csv``; return the page's path, and its first table."""
    table = share_table(found)
    file = found[0].row.file
    of_trials = "of as many trials as a study makes" if file.trials is None else f"of {file.trials} trials"
    text = (
        "# Statements in worlds of an independent laboratory\n\n"
        f"Made by `python -m tests.proofs laboratory {source} -o FOLDER`. Every cell has {file.worlds} worlds, judged "
        f"by a statement {of_trials} at seed {file.seed}. Asked is that {100 * ASKED[0]:.0f} to "
        f"{100 * ASKED[1]:.0f} % of the errors lie inside the stated 95 % intervals in every row. Brackets are 95 % "
        "intervals over independent worlds (Wilson).\n\n"
        f"{table}\n## Measurement by measurement\n\n{measurement_table(found)}"
    )
    path = folder / "laboratory.md"
    write_text(path, text)
    rows = []
    for one in found:
        for stated, inside, errors in zip(one.statements, inside_of(one), one.errors, strict=True):
            share = share_inside(inside)
            ends = [share.count, share.of, share.low, share.high]
            rows.append([*_place(one), stated.measurement, *ends, stated.standard_uncertainty, *stated.interval])
            rows[-1].append(int((~np.isfinite(errors)).sum()))
    head = [*_HEAD, "measurement", "inside", "worlds", "low", "high", "u", "interval_low", "interval_high", "no_value"]
    write_csv(folder / "laboratory.csv", head, rows)
    return path, table


_HEAD = ("case", "view", "family", "mask", "decoder")


def _place(found: Found) -> list[str]:
    row = found.row
    return [row.case.name, str(row.view), row.family, row.mask, found.decoder]


def _percent(share: Share) -> str:
    if share.of == 0:
        return "no value"
    return f"{100 * share.value:.0f} % [{100 * share.low:.0f}, {100 * share.high:.0f}]"
