"""Represent estimates of a sensor file's numbers, and combine those of several captures.

Signal chain: estimates of one number from n captures, each with its uncertainty -> scatter between captures -> weighted
mean and its uncertainty.

The estimates may differ by more than their own uncertainties, as sheets and their poses do. This variance tau^2 is
estimated by the moments of Q = sum w_i (x_i - x)^2 and added to every variance (DerSimonian & Laird, Controlled
Clinical Trials 7 (1986) 177). Few captures determine tau^2 poorly, so the uncertainty is that of a normal distribution
with the 95 % interval of Student's, whose degrees of freedom follow from the share of tau^2 (GUM, G.4).

Captures of one projector show the same random dots: over units, features of two such captures correlate by 0.91 to 1.00
(24 simulated units before a sheet at 450 and 480 mm). Their errors are common, and more captures do not reduce them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.stats import norm
from scipy.stats import t as student

#: scale on which an estimate is approximately normal: the number, its logarithm or its inverse
Scale = Literal["linear", "logarithm", "inverse"]

#: probability up to the upper end of a 95 % interval
_SIDE = 0.975

#: least share of tau^2 in the variance, below which Student's distribution is normal; chosen
_LEAST_SHARE = 1e-3


def scaled(value: float, scale: Scale) -> float:
    """Return a number on the scale on which it is approximately normal; must be positive unless linear."""
    if scale == "linear":
        return value
    return math.log(max(value, 1e-300)) if scale == "logarithm" else 1 / max(value, 1e-300)


def unscaled(value: float, scale: Scale) -> float:
    """Return the number at a value of its scale; infinite beyond the end of the inverse scale."""
    if scale == "linear":
        return value
    if scale == "logarithm":
        return math.exp(value)
    return 1 / value if value > 0 else math.inf


@dataclass(frozen=True)
class FittedKey:
    """A fitted number: ``key`` in the sensor file, ``value``, standard ``uncertainty`` on its ``scale``, ``unit``.

    ``captures`` that determine it, and the method ``method``. Noise determines the inverse of the full well, so that
    inverse is approximately normal. A number that is not ``determined`` is part of the fit, and near its assumed value.
    """

    key: str
    value: float
    uncertainty: float
    unit: str
    captures: tuple[str, ...]
    method: str
    scale: Scale = "linear"
    determined: bool = True

    def interval_in_words(self) -> str:
        """Return the 95 % interval, or that the number is not determined: its interval would be the assumed one."""
        return "{:.4g} to {:.4g}".format(*self.interval()) if self.determined else "not determined"

    def interval(self) -> tuple[float, float]:
        """Return the 95 % interval about the value, of 1.96 standard uncertainties on its scale."""
        middle = scaled(self.value, self.scale)
        ends = [unscaled(middle + sign * 1.959964 * self.uncertainty, self.scale) for sign in (-1, 1)]
        return min(ends), max(ends)


@dataclass(frozen=True)
class Undetermined:
    """A number that no capture determines, with one that would; ``contained`` in fitted ones, it is 0 in their file."""

    key: str
    value: float
    determined_by: str
    contained: bool = False


def combined(values: Sequence[float], uncertainties: Sequence[float], *, common: bool = False) -> tuple[float, float]:
    """Return the weighted mean of values and its standard uncertainty, including their excess scatter.

    ``common``: the errors of the values are the same error, not independent ones.
    """
    x, variance = np.asarray(values, float), np.asarray(uncertainties, float) ** 2
    if len(x) == 1:
        return float(x[0]), float(np.sqrt(variance[0]))
    weight = 1 / variance
    mean = float((weight * x).sum() / weight.sum())
    excess = float((weight * (x - mean) ** 2).sum()) - (len(x) - 1)
    scale = float(weight.sum() - (weight**2).sum() / weight.sum())
    scatter = max(excess / scale, 0.0)
    share = scatter / (scatter + len(x) / float(weight.sum()))
    weight = 1 / (variance + scatter)
    factor = student.ppf(_SIDE, (len(x) - 1) / max(share, _LEAST_SHARE) ** 2) / norm.ppf(_SIDE)
    total = float(factor**2 / weight.sum())
    if common:
        precision = 1 / variance
        total += float((precision * np.sqrt(variance)).sum() / precision.sum()) ** 2 - 1 / float(precision.sum())
    return float((weight * x).sum() / weight.sum()), math.sqrt(total)


def pooled(estimates: Sequence[FittedKey], *, common: bool = False) -> list[FittedKey]:
    """Combine estimates of the same key, in the order in which the keys first occur; ``common`` as for each key."""
    out = []
    for key in dict.fromkeys(estimate.key for estimate in estimates):
        group = [estimate for estimate in estimates if estimate.key == key]
        # one that is not determined is its assumed value again, which many captures would make a measurement
        group = [estimate for estimate in group if estimate.determined] or group
        first = group[0]
        if len(group) > 1 and all(fitted_key.uncertainty > 0 for fitted_key in group):
            middle, spread = combined(
                [scaled(fitted_key.value, first.scale) for fitted_key in group],
                [fitted_key.uncertainty for fitted_key in group],
                common=common,
            )
            names = tuple(name for fitted_key in group for name in fitted_key.captures)
            first = replace(first, value=unscaled(middle, first.scale), uncertainty=spread, captures=names)
        out.append(first)
    return out
