"""Write the coverage of statements and the regrets of choices as CSV."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tests.proofs.judged_statements import Choice, coverage_of, false_accepts
from tests.proofs.statement_run import JudgedCase
from tests.proofs.tables import write_csv

_COVERAGE_HEAD = (
    "part",
    "sealed",
    "sensor",
    "finish",
    "view",
    "why",
    "measurement",
    "unit",
    "worlds",
    "inside",
    "share",
    "low",
    "high",
    "false_accepts",
    "false_accepts_corrected",
    "bias",
    "u",
    "interval_low",
    "interval_high",
    "true_bias",
    "true_std",
    "without_value_stated",
    "without_value_found",
)


def write_coverage_csv(path: Path, cases: Sequence[JudgedCase]) -> None:
    """Write one row for each measurement of a stated view."""
    write_csv(path, _COVERAGE_HEAD, [row for case in cases for row in _coverage_rows(case)])


def _coverage_rows(case: JudgedCase) -> list[tuple[Any, ...]]:
    table, rows = case.case.table, []
    for view in case.stated:
        accepts = [np.nansum(false_accepts(view, corrected), axis=1).astype(int) for corrected in (False, True)]
        for one, found, errors, *falsely in zip(view.statements, coverage_of(view), view.errors, *accepts, strict=True):
            known = errors[np.isfinite(errors)]
            rows.append(
                (
                    table.part,
                    int(case.case.sealed),
                    case.sensor,
                    table.finish,
                    view.view,
                    view.why,
                    one.measurement,
                    one.unit,
                    found.of,
                    found.count,
                    found.value,
                    found.low,
                    found.high,
                    *falsely,
                    one.bias,
                    one.standard_uncertainty,
                    *one.interval,
                    known.mean() if len(known) else math.nan,
                    known.std(ddof=1) if len(known) > 1 else math.nan,
                    one.without_value,
                    1 - len(known) / len(errors),
                )
            )
    return rows


_REGRET_HEAD = (
    "part",
    "sealed",
    "sensor",
    "finish",
    "measurement",
    "by",
    "view",
    "best",
    "risk",
    "least",
    "ratio",
    "unbiased",
    "low",
    "high",
    "median",
    "decided",
)


def write_regret_csv(path: Path, choices: Sequence[Choice]) -> None:
    """Write one row for each choice of a view."""
    write_csv(path, _REGRET_HEAD, [_regret_row(one) for one in choices])


def _regret_row(one: Choice) -> tuple[Any, ...]:
    table, raced, found = one.case.case.table, one.case.raced, one.regret
    assert raced is not None
    decided = raced.standings[one.measurement].confidence if one.measurement in raced.standings else math.nan
    return (
        table.part,
        int(one.case.case.sealed),
        one.case.sensor,
        table.finish,
        one.measurement,
        one.by,
        one.view,
        one.best,
        found.risk,
        found.least,
        found.ratio,
        found.unbiased,
        found.low,
        found.high,
        found.middle,
        decided,
    )
