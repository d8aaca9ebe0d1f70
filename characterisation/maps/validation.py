"""Does a map predict captures that were not used to make it?

Signal chain: captures of coupons, each with the cloud that its map predicts of the same pose -> F and sigma of both,
over the patches of a capture -> their residuals by sample and distance; and the distributions of the points about their
patches' planes -> how far they are apart.

The talk (slide *Validation of the Simulation*) reports that the mean absolute residual is under 10 % for all but the
shiniest surface, and does not say of what; here F and sigma each have their own. That of sigma is a mean over points: a
pose counts by its F, as it does in a cloud. Without these weights it is given beside it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.stats import wasserstein_distance

from characterisation.coupon.patches import Overall

Floats = NDArray[np.float64]

#: mean absolute residuals that a map must keep under, per sample and distance: of F [1], and of sigma relative to it
FRACTION_LIMIT, SIGMA_LIMIT = 0.05, 0.05

#: |x| of a normal variable of one standard deviation, in the mean
_MEAN_ABSOLUTE = math.sqrt(2 / math.pi)


@dataclass(frozen=True)
class Pair:
    """One capture and its prediction.

    ``finish``, ``roughness`` [um] or NaN, ``distance`` nominal |V| [mm], ``incidence`` [rad]; ``measured`` and
    ``predicted`` over the patches; the residuals along V [mm] of both clouds' points to their patches' planes.
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
    """Residuals by sample and distance, in the order in which they come.

    Returns
    -------
    xarray.Dataset
        One ``row`` for each: ``finish``, ``roughness``, ``distance``, ``captures``; ``fraction_residual``, mean of
        |F predicted - F measured|, and ``fraction_bias``, mean of the difference; ``fraction_floor``, what the
        standard errors of what was captured, and of what was drawn from the map, would make of the residual alone; the
        same of sigma, relative to the measured one and weighted by F: ``sigma_residual``, ``sigma_bias``,
        ``sigma_floor``, over ``sigma_captures`` that have one on both sides; ``sigma_residual_captures`` of these
        without weights;
        ``one_sided``, captures with a sigma on one side only; ``wasserstein``, distance between the distributions of
        the residuals along V, in units of the measured sigma; ``unknown``, captures of which the map says nothing.
    """
    keys = list(dict.fromkeys((pair.finish, str(pair.roughness), pair.distance) for pair in pairs))
    rows = []
    for key in keys:
        here = [pair for pair in pairs if (pair.finish, str(pair.roughness), pair.distance) == key]
        rows.append({"finish": key[0], "roughness": float(key[1]), "distance": key[2], **_row(here)})
    columns = {name: ("row", np.array([row[name] for row in rows])) for name in rows[0]}
    return xr.Dataset(columns, attrs={"fraction_limit": FRACTION_LIMIT, "sigma_limit": SIGMA_LIMIT})


def holds(table: xr.Dataset) -> NDArray[np.bool_]:
    """Which rows of a residual table keep to both limits; a sigma that nobody has breaks none."""
    sigma = table["sigma_residual"].values
    return np.asarray(
        (table["fraction_residual"].values <= FRACTION_LIMIT) & (np.isnan(sigma) | (sigma <= SIGMA_LIMIT))
    )


def _row(pairs: Sequence[Pair]) -> dict[str, float]:
    known = [pair for pair in pairs if math.isfinite(pair.predicted.fraction) and math.isfinite(pair.measured.fraction)]
    fraction = np.array([pair.predicted.fraction - pair.measured.fraction for pair in known])
    fraction_error = np.array(
        [math.hypot(pair.measured.fraction_error, pair.predicted.fraction_error) for pair in known]
    )
    both = [p for p in known if math.isfinite(p.predicted.sigma) and math.isfinite(p.measured.sigma)]
    sigma = np.array([p.predicted.sigma / p.measured.sigma - 1 for p in both])
    sigma_error = np.array(
        [math.hypot(*(one.sigma_error / one.sigma for one in (p.measured, p.predicted))) for p in both]
    )
    points = np.array([p.measured.fraction for p in both])
    one_sided = [p for p in known if math.isfinite(p.predicted.sigma) != math.isfinite(p.measured.sigma)]
    return {
        "captures": len(known),
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
        "unknown": len(pairs) - len(known),
    }


def _mean(values: Floats, weights: Floats | None = None) -> float:
    if not len(values) or (weights is not None and not weights.sum()):
        return math.nan
    return float(np.average(values, weights=weights))


def _wasserstein(pairs: Sequence[Pair]) -> float:
    """Between residuals in units of the measured sigma of their own captures, all captures together."""
    if not pairs:
        return math.nan
    measured = np.concatenate([pair.measured_residuals / pair.measured.sigma for pair in pairs])
    predicted = np.concatenate([pair.predicted_residuals / pair.measured.sigma for pair in pairs])
    if not len(measured) or not len(predicted):
        return math.nan
    return float(wasserstein_distance(measured, predicted))
