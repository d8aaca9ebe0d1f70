"""Compare a map's predictions with captures that were not used to make it.

Signal chain: captures of coupons, each with the predicted cloud of the same pose -> F and sigma of both, over the
patches of a capture -> residuals by sample and distance; and the distributions of the points about the planes of their
patches -> distance between the distributions.

The talk of Kinnell and Justham (2018; slide *Simulation Validation*) reports a mean absolute residual below 10 %
for all surfaces except the shiniest. It does not name the quantity. Here F and sigma have separate residuals. That of
sigma is a mean over points: a pose is weighted by its F, as in a cloud. The unweighted residual is given as well.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.stats import wasserstein_distance

from characterisation.coupon.patch_table import Overall
from characterisation.files.arrays import Floats
from characterisation.files.errors import InputError

#: limit of the mean absolute residual of F [1], per sample and distance
FRACTION_LIMIT = 0.05

#: limit of the mean absolute residual of sigma, relative to it, per sample and distance
SIGMA_LIMIT = 0.05

#: mean of |x| of a normal variable with a standard deviation of 1
_MEAN_ABSOLUTE = math.sqrt(2 / math.pi)


@dataclass(frozen=True)
class Pair:
    """One capture and its prediction.

    - ``finish``, ``roughness`` [um] or NaN, ``distance`` nominal |V| [mm], ``incidence`` [rad].
    - ``measured`` and ``predicted`` F and sigma over the patches.
    - ``measured_residuals`` and ``predicted_residuals`` [mm]: residuals along V of the points from the planes of their
      patches.
    """

    finish: str
    roughness: float
    distance: float
    incidence: float
    measured: Overall
    predicted: Overall
    measured_residuals: Floats = field(repr=False)
    predicted_residuals: Floats = field(repr=False)


def residual_table(pairs: Sequence[Pair]) -> xr.Dataset:
    """Return the residuals by sample and distance, in the order of the pairs.

    Returns
    -------
    xarray.Dataset
        One ``row`` for each sample and distance: ``finish``, ``roughness``, ``distance``, ``captures``.

        F: ``fraction_residual``, mean of |F predicted - F measured|; ``fraction_bias``, mean of the difference;
        ``fraction_floor``, the expected residual from the standard errors of the capture and of the draw from the map
        alone.

        Sigma, relative to the measured one and weighted by F: ``sigma_residual``, ``sigma_bias``, ``sigma_floor``, over
        the ``sigma_captures`` with both values; ``sigma_residual_captures``, the residual of these without weights;
        ``one_sided``, captures with only one of both values.

        ``wasserstein``, distance between the distributions of the residuals along V, in units of the measured sigma;
        ``unknown``, captures without a value in the map.
    """
    if not pairs:
        raise InputError("residual_table", "pairs", "none", "at least one")
    keys = list(dict.fromkeys((pair.finish, str(pair.roughness), pair.distance) for pair in pairs))
    rows = []
    for key in keys:
        here = [pair for pair in pairs if (pair.finish, str(pair.roughness), pair.distance) == key]
        rows.append({"finish": key[0], "roughness": float(key[1]), "distance": key[2], **_row(here)})
    columns = {name: ("row", np.array([row[name] for row in rows])) for name in rows[0]}
    return xr.Dataset(columns, attrs={"fraction_limit": FRACTION_LIMIT, "sigma_limit": SIGMA_LIMIT})


def within_limits(table: xr.Dataset) -> NDArray[np.bool_]:
    """Return which rows of a residual table are within both limits; a row without sigma is within that of sigma."""
    fraction, sigma = (table[name].values for name in ("fraction_residual", "sigma_residual"))
    return np.asarray((fraction <= FRACTION_LIMIT) & ~(sigma > SIGMA_LIMIT))


def _row(pairs: Sequence[Pair]) -> dict[str, float]:
    valued_pairs = [p for p in pairs if math.isfinite(p.predicted.fraction) and math.isfinite(p.measured.fraction)]
    fraction = np.array([p.predicted.fraction - p.measured.fraction for p in valued_pairs])
    fraction_error = np.array([math.hypot(p.measured.fraction_error, p.predicted.fraction_error) for p in valued_pairs])
    both = [p for p in valued_pairs if _has_sigma(p.predicted) and _has_sigma(p.measured)]
    sigma = np.array([p.predicted.sigma / p.measured.sigma - 1 for p in both])
    sigma_error = np.array(
        [math.hypot(*(overall.sigma_error / overall.sigma for overall in (p.measured, p.predicted))) for p in both]
    )
    points = np.array([p.measured.fraction for p in both])
    one_sided = [p for p in valued_pairs if _has_sigma(p.predicted) != _has_sigma(p.measured)]
    return {
        "captures": len(valued_pairs),
        "fraction_residual": _mean(np.abs(fraction)),
        "fraction_bias": _mean(fraction),
        "fraction_floor": _mean(_MEAN_ABSOLUTE * fraction_error),
        "sigma_captures": len(both),
        "sigma_residual": _mean(np.abs(sigma), points),
        "sigma_bias": _mean(sigma, points),
        "sigma_floor": _mean(_MEAN_ABSOLUTE * sigma_error, points),
        "sigma_residual_captures": _mean(np.abs(sigma)),
        "one_sided": len(one_sided),
        "wasserstein": _wasserstein(both),
        "unknown": len(pairs) - len(valued_pairs),
    }


def _has_sigma(overall: Overall) -> bool:
    """Return whether sigma is known; 0, of points of one depth in steps, says nothing."""
    return math.isfinite(overall.sigma) and overall.sigma > 0


def _mean(values: Floats, weights: Floats | None = None) -> float:
    if not len(values) or (weights is not None and not weights.sum()):
        return math.nan
    return float(np.average(values, weights=weights))


def _wasserstein(pairs: Sequence[Pair]) -> float:
    """Return the distance between the residuals of all captures, in units of the measured sigma of each capture."""
    if not pairs:
        return math.nan
    measured = np.concatenate([pair.measured_residuals / pair.measured.sigma for pair in pairs])
    predicted = np.concatenate([pair.predicted_residuals / pair.measured.sigma for pair in pairs])
    if not len(measured) or not len(predicted):
        return math.nan
    return float(wasserstein_distance(measured, predicted))
