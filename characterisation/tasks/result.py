"""Describe one measured number: its value with unit, uncertainty and nominal value, or the reason why there is none.

Signal chain: measurements of several clouds -> grouped by name -> mean, standard deviation, and root mean square of the
uncertainties.

Uncertainties come from the covariance of a least-squares fit, unless a statement of uncertainty replaces them. The fit
treats the noise of the points as independent from pixel to pixel. Its uncertainty does not include
:data:`NOT_INCLUDED`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

#: effects that the standard uncertainty of a fit does not include
NOT_INCLUDED = (
    "noise that neighbouring points share",
    "calibration and scale of the sensor",
    "systematic error of the surface (reflections, penetration, blur at edges)",
    "form of the surface, except in flatness and cylindricity (there: of the margin at edges)",
    "what noise alone adds to values near 0, up to 1.5 u",
)

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
    - ``deviations`` (k, m) from nominal of a value that folds, in ``unit``, part frame
      (:mod:`characterisation.tasks.deviations`); None for any other.
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
    deviations: NDArray[np.float64] | None = None

    @property
    def possible(self) -> bool:
        """Whether the measurement has a value."""
        return math.isfinite(self.value)

    @property
    def error(self) -> float:
        """Value minus nominal, in ``unit``; NaN without either."""
        return self.value - self.nominal


def failed(name: str, unit: str, reason: str, points: int = 0, points_given: int = 0) -> Result:
    """Return the result of a measurement that was not possible, with its reason.

    Parameters
    ----------
    name
        Name of the result.
    unit
        Its unit.
    reason
        Why the measurement was not possible.
    points
        Number of points that were used.
    points_given
        Number of points with the labels of the measurement's shapes, or in its window.
    """
    return Result(name, unit, math.nan, points=points, points_given=points_given, reason=reason)


@dataclass(frozen=True)
class Repeatability:
    """One measurement over several clouds, in ``unit``.

    - ``count``: number of clouds with a value, of ``cloud_count`` clouds.
    - ``mean`` of the values, NaN without one; ``nominal`` value.
    - ``deviation``: standard deviation with count - 1 degrees of freedom, NaN for fewer than two values.
    - ``uncertainty``: root mean square of the known standard uncertainties, NaN without one.
    """

    name: str
    unit: str
    count: int
    cloud_count: int
    mean: float
    deviation: float
    uncertainty: float
    nominal: float


def repeatability(clouds: Sequence[Sequence[Result]]) -> list[Repeatability]:
    """Return the repeatability of each measurement over all clouds, in the order in which the names first occur."""
    by_name: dict[str, list[Result]] = {}
    for results in clouds:
        for result in results:
            by_name.setdefault(result.name, []).append(result)
    out = []
    for name, results in by_name.items():
        values = np.array([result.value for result in results if result.possible])
        uncertainties = np.array([result.uncertainty for result in results if math.isfinite(result.uncertainty)])
        out.append(
            Repeatability(
                name,
                results[0].unit,
                len(values),
                len(clouds),
                float(values.mean()) if len(values) else math.nan,
                float(values.std(ddof=1)) if len(values) > 1 else math.nan,
                float(np.sqrt(np.mean(uncertainties**2))) if len(uncertainties) else math.nan,
                results[0].nominal,
            )
        )
    return out
