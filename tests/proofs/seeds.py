"""Compare the statements of one study made with different seeds.

Signal chain: study -> the same study with the seeds 1 to n -> statement of a view with each -> u and interval of every
measurement, and how far they lie apart.

A statement is a property of part and sensor. Its seed may change it by no more than its number of trials explains.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from characterisation.statements.statement import Statement
from mitsim.running.executor import Executor
from mitsim.study import StatementTable, Study
from mitsim.study.session import Session
from mitsim.study.virtual.world import SET_DAYS, STATEMENT_DAYS
from mitsim.views import View
from tests.proofs.tables import markdown, number

#: u of all seeds shall lie within this of one another, and widths of intervals within the second [1]
SAME_U, SAME_INTERVAL = 0.15, 0.20


def statements_of_seeds(
    study: Study, view: View, seeds: Sequence[int], trials: int | None, folder: Path, workers: Executor | None = None
) -> dict[int, list[Statement]]:
    """Return the statements of a view by seed; trials in the folder are reused.

    ``trials`` is the number of each statement; None for as many as the study makes by its own rule.
    """
    out = {}
    for seed in seeds:
        one = replace(study, file=study.file.model_copy(update={"seed": seed}))
        session = Session(one, folder / f"seed_{seed}", workers)
        out[seed] = session.state(view, None if trials is None else StatementTable(trials=trials)).statements
    return out


def tails(study: Study, view: View, seeds: Sequence[int], folder: Path) -> list[float]:
    """Return kurtosis less 1 of the errors of each measurement, over the statement's trials of all seeds."""
    parts = []
    for seed in seeds:
        one = replace(study, file=study.file.model_copy(update={"seed": seed}))
        trials = Session(one, folder / f"seed_{seed}").trials
        made = [trial for trial in trials.known(view.number) if STATEMENT_DAYS <= trial.day < SET_DAYS]
        parts.append(trials.errors(view.number, made))
    apart = np.hstack(parts)
    apart = apart - np.nanmean(apart, axis=1, keepdims=True)
    return list(np.nanmean(apart**4, axis=1) / np.nanmean(apart**2, axis=1) ** 2 - 1)


def spread(values: Sequence[float]) -> float:
    """Return the largest of some positive values over the least, less 1; NaN if one is missing."""
    found = np.asarray(values, float)
    return float(found.max() / found.min() - 1) if np.isfinite(found).all() and found.min() > 0 else float("nan")


def seeds_table(stated: Mapping[int, Sequence[Statement]]) -> str:
    """Return u of every measurement by seed, the spread of u and of the widths of the intervals, and the trials.

    The table is Markdown.
    """
    body = []
    for same in zip(*stated.values(), strict=True):
        u = [one.standard_uncertainty for one in same]
        widths = [one.interval[1] - one.interval[0] for one in same]
        ends = (f"{100 * spread(values):.0f} %" for values in (u, widths))
        body.append([same[0].measurement, same[0].unit, *map(number, u), *ends])
    made = [str(max(one.trials for one in same)) for same in stated.values()]
    body.append(["trials", "", *made, "", ""])
    head = ["measurement", "unit", *(f"u, seed {seed}" for seed in stated), "largest u over least", "of the widths"]
    return markdown(head, body)
