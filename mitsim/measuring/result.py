"""Compute the repeatability of measured numbers over several clouds.

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

import numpy as np

from characterisation.tasks.result import Result

#: effects that the standard uncertainty of a fit does not include
NOT_INCLUDED = (
    "noise that neighbouring points share",
    "calibration and scale of the sensor",
    "systematic error of the surface (reflections, penetration, blur at edges)",
    "form of the surface, except in flatness and cylindricity",
)


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
        for one in results:
            by_name.setdefault(one.name, []).append(one)
    out = []
    for name, results in by_name.items():
        values = np.array([one.value for one in results if one.possible])
        known = np.array([one.uncertainty for one in results if math.isfinite(one.uncertainty)])
        out.append(
            Repeatability(
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
