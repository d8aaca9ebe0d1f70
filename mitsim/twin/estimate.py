"""A number of a sensor file as captures tell it, and several of them put together.

Several captures tell one number n times. They may differ by more than each says of itself, as sheets and their places
do; that scatter tau^2 is estimated by the moments of Q = sum w_i (x_i - x)^2 and added to every variance (DerSimonian &
Laird, Controlled Clinical Trials 7 (1986) 177).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Estimate:
    """A fitted number: ``key`` in the sensor file, ``value``, standard ``uncertainty``, ``unit``.

    ``captures`` that told it, and ``how``.
    """

    key: str
    value: float
    uncertainty: float
    unit: str
    captures: tuple[str, ...]
    how: str

    def interval(self, coverage: float = 1.959964) -> tuple[float, float]:
        """Ends of the interval of so many standard uncertainties: 95 % of a normal."""
        return self.value - coverage * self.uncertainty, self.value + coverage * self.uncertainty


@dataclass(frozen=True)
class Untold:
    """A number that no capture tells: it keeps the file's ``value``; ``without`` is the capture that would tell it."""

    key: str
    value: float
    without: str


def combined(values: Sequence[float], uncertainties: Sequence[float]) -> tuple[float, float]:
    """Weighted mean of values and its standard uncertainty, with what they scatter beyond their own uncertainties."""
    x, variance = np.asarray(values, float), np.asarray(uncertainties, float) ** 2
    if len(x) == 1:
        return float(x[0]), float(np.sqrt(variance[0]))
    weight = 1 / variance
    mean = float((weight * x).sum() / weight.sum())
    excess = float((weight * (x - mean) ** 2).sum()) - (len(x) - 1)
    scale = float(weight.sum() - (weight**2).sum() / weight.sum())
    weight = 1 / (variance + max(excess / scale, 0.0))
    return float((weight * x).sum() / weight.sum()), float(weight.sum() ** -0.5)
