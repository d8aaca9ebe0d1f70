"""One measured number with its unit and uncertainty, and how many clouds repeat it.

Uncertainties come from the covariance of the least-squares fit unless a statement replaced them. Such an uncertainty
takes the noise of the points as independent from pixel to pixel, and leaves out what :data:`LEAVES_OUT` names.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

#: what the standard uncertainty of a fit does not know of
LEAVES_OUT = (
    "noise that neighbouring points share",
    "calibration and scale of the sensor",
    "systematic error of the surface (reflections, penetration, blur at edges)",
    "form of the surface, but for flatness and cylindricity",
)

#: where a standard uncertainty comes from: covariance of a fit, a statement, or nowhere
Origin = Literal["fit", "statement", "none"]


@dataclass(frozen=True)
class Result:
    """One number of one cloud.

    ``name`` of the measurement, ``value`` in ``unit``, NaN if it was not possible, and then ``reason`` says why;
    ``points`` that it rests on, of ``points_given`` that were in its window (0 where no points were counted);
    ``uncertainty`` standard uncertainty in the same unit by ``origin``, NaN if none is known; ``nominal`` value, NaN if
    nobody said one; ``bias`` that was subtracted.
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
        """Whether there is a value."""
        return math.isfinite(self.value)

    @property
    def error(self) -> float:
        """Value minus nominal, NaN without either."""
        return self.value - self.nominal


@dataclass(frozen=True)
class Repeated:
    """One measurement over several clouds.

    ``count`` clouds that gave a value, of ``asked``; ``mean``, and ``deviation``, the standard deviation with count - 1
    degrees of freedom (NaN for fewer than two); ``uncertainty``, root mean square of the uncertainties of the fits.
    """

    name: str
    unit: str
    count: int
    asked: int
    mean: float
    deviation: float
    uncertainty: float
    nominal: float


def failed(name: str, unit: str, reason: str, points: int = 0, points_given: int = 0) -> Result:
    """A measurement that was not possible."""
    return Result(name, unit, math.nan, points=points, points_given=points_given, reason=reason)


def repeated(clouds: Sequence[Sequence[Result]]) -> list[Repeated]:
    """Each measurement over all clouds, in the order of the first cloud that names it."""
    by_name: dict[str, list[Result]] = {}
    for results in clouds:
        for one in results:
            by_name.setdefault(one.name, []).append(one)
    out = []
    for name, results in by_name.items():
        values = np.array([one.value for one in results if one.possible])
        known = np.array([one.uncertainty for one in results if math.isfinite(one.uncertainty)])
        out.append(
            Repeated(
                name,
                results[0].unit,
                len(values),
                len(clouds),
                float(values.mean()) if len(values) else math.nan,
                float(values.std(ddof=1)) if len(values) > 1 else math.nan,
                float(np.sqrt(np.mean(known**2))) if len(known) else math.nan,
                results[0].nominal,
            )
        )
    return out
