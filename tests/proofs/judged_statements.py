"""Judge the statements and chosen views of cases: coverage of the intervals, false accepts, regrets.

Signal chain: judged cases (:mod:`tests.proofs.statement_run`) -> shares of errors inside the stated intervals,
shares of worlds that falsely accept a part, and regrets of chosen views (:mod:`tests.proofs.judgement`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from characterisation.statements.coverage import Share, share
from mitsim.views.view_scores import screening_risk
from tests.proofs.judgement import Regret, falsely_accepted, pooled_share, regret, within
from tests.proofs.screening_figures import LEAST_MEASURABLE
from tests.proofs.statement_run import JudgedCase, JudgedView

Floats = NDArray[np.float64]

#: who chose a view: the race, the map's predicted uncertainty, the talk's V_m
RACE, PREDICTED, TALK = "race", "predicted u", "V_m"


@dataclass(frozen=True)
class Choice:
    """The view that somebody chose for a measurement of a case, and its regret.

    ``regret`` is judged in other worlds than those of the race. ``judged``: the best view gives a value in half of the
    worlds; where it does not, risks are those of a few worlds, and the regret is listed but in no mean.
    """

    case: JudgedCase
    measurement: str
    by: str
    view: int
    best: int
    regret: Regret
    judged: bool = True


def coverage_of(stated: JudgedView) -> list[Share]:
    """Share of errors inside the stated interval, of every measurement; of none where nothing could be stated."""
    return [share(known[np.isfinite(known)] > 0) for known in _inside(stated)]


def pooled_coverage(cases: Sequence[JudgedCase]) -> Share:
    """Share over all measurements and stated views of some cases; its interval is that over worlds."""
    return pooled([_inside(stated) for case in cases for stated in case.stated])


def false_accepts(stated: JudgedView, corrected: bool) -> Floats:
    """Whether worlds accept a part at an edge of its tolerance (measurement, world); NaN without a value or interval.

    By the rule of ISO 14253-1 as the tool applies it, to readings as they are or with the stated bias subtracted.
    """
    rows = []
    for one, errors in zip(stated.statements, stated.errors, strict=True):
        low, high = one.interval_corrected if corrected else one.interval
        guards = (max(high, 0.0), max(-low, 0.0)) if corrected else (max(abs(low), abs(high)),) * 2
        known = math.isfinite(low)
        rows.append(falsely_accepted(errors - one.bias * corrected, guards) if known else np.full(len(errors), np.nan))
    return np.array(rows)


def pooled(columns: Sequence[Floats]) -> Share:
    """Return the share over all measurements (measurement, world) of several stated views, NaN where unknown."""
    rows = max((len(one) for one in columns), default=0)
    if not rows:
        return share([])
    padded = [np.pad(one, ((0, rows - len(one)), (0, 0)), constant_values=np.nan) for one in columns]
    return pooled_share(np.concatenate(padded, axis=1))


def choices_of(case: JudgedCase) -> list[Choice]:
    """Views that the race, the map's u and V_m chose for every measurement of a raced case, with their regrets."""
    if case.raced is None or case.choice is None:
        return []
    few = case.case.file.raced_candidates
    numbers = case.views[:few].tolist()
    errors = case.choice
    scores = case.scores.sel(view=numbers)
    risk = screening_risk(scores)
    talk = scores["V_m"].transpose("measurement", "view").values
    out = []
    for m, name in enumerate(case.measurements):
        if np.isfinite(errors[m]).sum(axis=1).max() < 3:
            continue  # no view can measure it
        picks = {
            RACE: numbers.index(case.raced.leader(name)) if name in case.raced.standings else 0,
            PREDICTED: int(np.argmin(risk[m])),
            TALK: int(np.nanargmax(np.where(np.isfinite(talk[m]), talk[m], -1.0))),
        }
        for by, place in picks.items():
            found = regret(errors[m], place)
            judged = bool(np.isfinite(errors[m, found.best]).mean() >= LEAST_MEASURABLE)
            out.append(Choice(case, name, by, numbers[place], numbers[found.best], found, judged))
    return out


def _inside(stated: JudgedView) -> Floats:
    rows = []
    for one, errors in zip(stated.statements, stated.errors, strict=True):
        known = all(math.isfinite(end) for end in one.interval)
        rows.append(within(errors, one.interval) if known else np.full(len(errors), np.nan))
    return np.array(rows)
