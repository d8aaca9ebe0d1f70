"""Describe one measured number: its value with unit, uncertainty and nominal value, or the reason why there is none."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

#: source of a standard uncertainty: the covariance of a fit, a statement, or none
Origin = Literal["fit", "statement", "none"]


@dataclass(frozen=True)
class Result:
    """One measured number of one cloud.

    - ``name`` of the measurement, and ``value`` in ``unit``; NaN if the measurement was not possible.
    - ``reason`` for a missing value, "" otherwise.
    - ``uncertainty``: standard uncertainty in ``unit``, NaN if unknown; ``origin``: its source.
    - ``points``: number of points used, of ``points_given`` in the window; 0 where no points were counted.
    - ``nominal``: nominal value in ``unit``, NaN if there is none.
    - ``bias`` that was subtracted, in ``unit``.
    """

    name: str
    unit: str
    value: float
    uncertainty: float = math.nan
    origin: Origin = "none"
    points: int = 0
    points_given: int = 0
    nominal: float = math.nan
    bias: float = 0.0
    reason: str = ""

    @property
    def possible(self) -> bool:
        """Whether the measurement has a value."""
        return math.isfinite(self.value)

    @property
    def error(self) -> float:
        """Value minus nominal, in ``unit``; NaN without either."""
        return self.value - self.nominal


def failed(name: str, unit: str, reason: str, points: int = 0, points_given: int = 0) -> Result:
    """Return the result of a measurement that was not possible, with its reason."""
    return Result(name, unit, math.nan, points=points, points_given=points_given, reason=reason)
