"""Results of a sensor in a comparison: what screening predicts, what was stated, and its place among the others."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from characterisation.files.arrays import Floats
from characterisation.statements.statement import Statement
from mitsim.study.choose.candidates import CandidateSensor
from mitsim.study.choose.ranking import rank_keys
from mitsim.study.session import Session
from mitsim.study.virtual.race import Raced
from mitsim.study.virtual.stated import StatedView


@dataclass
class SensorResult:
    """Results of a sensor so far.

    ``screened`` (measurement,) is the demand of the best view by screening, ``screened_u`` its uncertainty,
    ``screened_view`` its number. ``unpromising`` is the reason why the sensor is not measured. ``stated`` holds
    statements by view number; the view that is best for all measurements comes first. ``raced`` is None until the
    views of the sensor were raced. A demand is infinite if no view can make the measurement.
    """

    candidate: CandidateSensor
    session: Session
    scores: xr.Dataset
    screened: Floats
    screened_u: Floats
    screened_view: NDArray[np.int64]
    unpromising: str = ""
    stated: dict[int, StatedView] = field(default_factory=dict)
    raced: Raced | None = None

    @property
    def ratio(self) -> float:
        """Return the largest demand of the possible measurements that have a limit; NaN if there is none."""
        limited = self.has_tolerance
        compared = limited if any(limited) else [True] * len(limited)
        demands = [value for value, kept in zip(self.demands(), compared, strict=True) if kept and math.isfinite(value)]
        return max(demands, default=math.nan)

    @property
    def has_tolerance(self) -> list[bool]:
        """Return whether each measurement of the task has a tolerance."""
        return [measurement.tolerance is not None for measurement in self.session.study.task.measurements.values()]

    @property
    def trials(self) -> int:
        """Return the least number of trials of the statements; 0 without one."""
        return min((stated.statements[0].trials for stated in self.stated.values() if stated.statements), default=0)

    def demands(self) -> list[float]:
        """Return the demand of every measurement, each from its best view; infinite for an impossible one."""
        if not self.stated:
            return list(self.screened.tolist())
        return [math.inf if row is None else row[1] for row in self.best()]

    def best(self) -> list[tuple[int, float, Statement] | None]:
        """Return view, demand and statement of least demand for each measurement; None without a value."""
        out = list[tuple[int, float, Statement] | None]()
        for m in range(len(self.screened)):
            statements = {view: stated_view.statements[m] for view, stated_view in self.stated.items()}
            rows = [(view, stated_demand(statement), statement) for view, statement in statements.items()]
            rows = [row for row in rows if math.isfinite(row[1])]
            out.append(min(rows, key=lambda row: row[1]) if rows else None)
        return out


def stated_demand(statement: Statement) -> float:
    """Return the demand of the decision rule; without a tolerance the root mean square error."""
    value = statement.root_mean_square if statement.decided is None else statement.decided.demand
    return value if math.isfinite(value) else math.inf


def ordered(results: Sequence[SensorResult]) -> list[SensorResult]:
    """Return measured sensors before screened ones, each by their impossible and then their worst measurements."""
    stated = [bool(result.stated) for result in results]
    keys = rank_keys([result.demands() for result in results], results[0].has_tolerance, stated)
    order = sorted(range(len(results)), key=lambda i: (not stated[i], keys[i]))
    return [results[i] for i in order]
