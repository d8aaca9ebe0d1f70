"""Judge statements of uncertainty and choices of views by independent virtual measurements.

Signal chain: case (:mod:`tests.proofs.part_cases`) -> screening, race and statement by the functions of `mitsim
run`, with its defaults -> errors in other worlds -> share of the errors inside the stated 95 % intervals; risk of the
chosen view over that of the best.

The trials are those of :mod:`tests.proofs.case_trials`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from characterisation.statements.statement import Statement
from characterisation.words.progress import say
from mitsim.running.executor import Executor
from mitsim.study import StatementTable, Study
from mitsim.study.session import Session
from mitsim.study.virtual.race import ALL, Raced
from mitsim.views import View
from mitsim.views.view_scores import screening_risk
from tests.proofs.case_trials import (
    days,
    keep_trials,
    measure_worlds,
    measured_choice,
    trials_by_kind,
)
from tests.proofs.kept_trials import errors_of
from tests.proofs.part_cases import PartCase

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class JudgedView:
    """A view's statements, by measurement, and the ``errors`` (measurement, world) in other worlds that judge them.

    Errors of zones are those of parts at the limit of their tolerance, as in the statements.
    ``why`` is the reason why the view was stated.
    """

    view: int
    why: str
    statements: tuple[Statement, ...]
    errors: Floats


@dataclass(frozen=True)
class JudgedCase:
    """Results of a case.

    ``sensor`` is its name. ``views`` (v,) are the numbers of all candidates. ``scores`` are those of screening.
    ``raced`` is the race, None if the case is not raced. ``choice`` (measurement, candidate, world) are the errors that
    judge its choices, None if they are not judged.
    """

    case: PartCase
    sensor: str
    measurements: tuple[str, ...]
    views: NDArray[np.int64]
    scores: xr.Dataset
    raced: Raced | None
    choice: Floats | None
    stated: tuple[JudgedView, ...]


def run_cases(
    cases: Sequence[PartCase], folder: str | Path, workers: Executor | None = None, judge_choices: bool = True
) -> list[JudgedCase]:
    """Measure and judge all cases, with ``judge_choices`` their races too; reuse trials in folder or cases file."""
    return [run_case(case, Path(folder), workers, judge_choices) for case in cases]


def run_case(case: PartCase, folder: Path, workers: Executor | None = None, judge_choices: bool = True) -> JudgedCase:
    """Measure and judge one case; ``judge_choices`` also measures its candidates in other worlds than its race."""
    say(f"case: {case.name}")
    study = case.open()
    trials_of_kind = trials_by_kind(case, study, folder, workers)
    tool = trials_of_kind["tool"]
    scores, _ = tool.screen()
    raced = None
    if case.table.raced:
        raced = tool.race(scores.sel(view=[view.number for view in study.views[: case.file.raced_candidates]]))
    choice = measured_choice(case, trials_of_kind["choice"]) if judge_choices and raced is not None else None
    chosen = None if raced is None else raced.leaders().get(ALL)
    stated = [_stated(case, trials_of_kind, view, why) for view, why in _to_state(case, study, scores, chosen)]
    keep_trials(case, folder, trials_of_kind)
    numbers = np.array([view.number for view in study.views])
    return JudgedCase(
        case, study.sensor.name, tuple(study.task.measurements), numbers, scores, raced, choice, tuple(stated)
    )


def _to_state(case: PartCase, study: Study, scores: xr.Dataset, chosen: int | None) -> list[tuple[View, str]]:
    """Return the views whose statements are judged: the chosen one, and random ones that the map rates as possible."""
    risk = screening_risk(scores)
    by_number = {view.number: view for view in study.views}
    numbers = [int(number) for number in scores["view"].values]
    possible = [numbers[i] for i in np.flatnonzero(np.isfinite(risk).all(axis=0))]
    if not possible:
        finite = np.isfinite(risk).sum(axis=0)
        possible = [numbers[i] for i in np.flatnonzero(finite == finite.max())] if finite.max() else numbers
    total = np.where(np.isfinite(risk), risk, 0.0).sum(axis=0)
    by_screening = [numbers[i] for i in np.argsort(total, kind="stable") if numbers[i] in possible]
    first = by_screening[0] if chosen is None else chosen
    others = [number for number in possible if number != first]
    drawn = np.random.default_rng([case.file.seed, len(numbers)]).permutation(len(others))[: case.file.stated - 1]
    return [(by_number[number], why) for number, why in [(first, "chosen"), *((others[i], "at random") for i in drawn)]]


def _stated(case: PartCase, trials_of_kind: dict[str, Session], view: View, why: str) -> JudgedView:
    tool, apart, count = trials_of_kind["tool"], trials_of_kind["apart"], case.file.stated_worlds
    named = case.file.trials
    stated = tool.state(view, None if named is None else StatementTable(trials=named))
    measure_worlds(case, "apart", apart, [view], {view.number: days(count)})
    errors = errors_of(apart.trials, view.number, days(count))
    return JudgedView(view.number, why, tuple(stated.statements), errors)
