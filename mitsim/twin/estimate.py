"""A number of a sensor file as captures tell it, and several of them put together.

Several captures tell one number n times. They may differ by more than each says of itself, as sheets and their places
do; that scatter tau^2 is estimated by the moments of Q = sum w_i (x_i - x)^2 and added to every variance (DerSimonian &
Laird, Controlled Clinical Trials 7 (1986) 177).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

#: how a number is near a normal: as it is, by its logarithm, by its inverse
Scale = Literal["linear", "logarithm", "inverse"]


def scaled(value: float, scale: Scale) -> float:
    """A number on the scale on which it is near a normal; positive, but on the linear one."""
    if scale == "linear":
        return value
    return math.log(max(value, 1e-300)) if scale == "logarithm" else 1 / max(value, 1e-300)


def unscaled(value: float, scale: Scale) -> float:
    """The number that stands at a place of its scale; infinite beyond the end of the inverse one."""
    if scale == "linear":
        return value
    if scale == "logarithm":
        return math.exp(value)
    return 1 / value if value > 0 else math.inf


@dataclass(frozen=True)
class Estimate:
    """A fitted number: ``key`` in the sensor file, ``value``, standard ``uncertainty`` on its ``scale``, ``unit``.

    ``captures`` that told it, and ``how``. A full well is one over what noise tells, and its inverse is near a normal.
    """

    key: str
    value: float
    uncertainty: float
    unit: str
    captures: tuple[str, ...]
    how: str
    scale: Scale = "linear"

    def interval(self, coverage: float = 1.959964) -> tuple[float, float]:
        """Ends of the interval of so many standard uncertainties on its scale: 95 % of a normal."""
        middle = scaled(self.value, self.scale)
        ends = [unscaled(middle + sign * coverage * self.uncertainty, self.scale) for sign in (-1, 1)]
        return min(ends), max(ends)


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


def pooled(estimates: Sequence[Estimate]) -> list[Estimate]:
    """Estimates of the same key put together, in the order in which the keys first come."""
    out = []
    for key in dict.fromkeys(one.key for one in estimates):
        own = [one for one in estimates if one.key == key]
        first = own[0]
        if len(own) > 1 and all(one.uncertainty > 0 for one in own):
            middle, spread = combined([scaled(one.value, first.scale) for one in own], [one.uncertainty for one in own])
            names = tuple(name for one in own for name in one.captures)
            first = replace(first, value=unscaled(middle, first.scale), uncertainty=spread, captures=names)
        out.append(first)
    return out
