"""Define the table of a coupon's patches, and pool the patches of one capture to F and sigma.

One row is one patch, as :func:`characterisation.coupon.patches.measure_patches` measures it. Each column carries its
unit. :data:`PATCHES` checks a stored table when it is read.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from characterisation.coupon.metrics import LEAST_DEGREES
from characterisation.files.datasets import Schema, Variable


@dataclass(frozen=True)
class Overall:
    """F and sigma [mm] of one capture over its patches, with standard errors from their scatter; NaN where unknown."""

    fraction: float
    fraction_error: float
    sigma: float
    sigma_error: float


def overall(patches: xr.Dataset) -> Overall:
    """Pool the patches of one capture: F weighted by points, sigma^2 by degrees of freedom.

    Parameters
    ----------
    patches
        Table of :func:`characterisation.measure_coupon`. Discs with fewer than 10 degrees of freedom are excluded from
        sigma.

    Returns
    -------
    Overall
        ``fraction`` F [1] and ``sigma`` [mm] with their standard errors ``fraction_error`` and ``sigma_error``.

    Examples
    --------
    >>> import characterisation
    >>> cloud = characterisation.read_cloud("coupon.ply")
    >>> pooled = characterisation.overall(characterisation.measure_coupon(cloud, window=(90, 50, 140, 140)))
    >>> pooled.sigma_error < pooled.sigma
    True
    """
    count, possible = patches["points"].values.astype(float), patches["points_possible"].values.astype(float)
    if not possible.sum():
        return Overall(math.nan, math.nan, math.nan, math.nan)
    fraction = min(count.sum() / possible.sum(), 1.0)
    some = possible > 0
    scatter = float(np.std(count[some] / possible[some])) / math.sqrt(some.sum())
    fraction_error = max(scatter, math.sqrt(fraction * (1 - fraction) / possible.sum()))
    sigma = patches["ray_noise_inliers"].values
    degrees = np.where((count - 3 >= LEAST_DEGREES) & np.isfinite(sigma), count - 3, 0.0)
    if not degrees.sum():
        return Overall(fraction, fraction_error, math.nan, math.nan)
    variance = np.nan_to_num(sigma) ** 2
    pooled = float((degrees * variance).sum() / degrees.sum())
    spread = math.sqrt(float((degrees * (variance - pooled) ** 2).sum() / degrees.sum()) / np.count_nonzero(degrees))
    error = max(spread, pooled * math.sqrt(2 / degrees.sum())) / (2 * math.sqrt(pooled)) if pooled > 0 else 0.0
    return Overall(fraction, fraction_error, math.sqrt(pooled), error)


_COLUMNS_BY_UNIT = {
    "mm": "ray_noise_std standard_error ray_noise_robust ray_noise_inliers distance semi_major semi_minor ray_offset",
    "mm2": "offset_product_touching offset_product_apart",
    "rad": "incidence off_axis included_angle",
    "px": "row column",
}

_UNITS = {name: unit for unit, names in _COLUMNS_BY_UNIT.items() for name in names.split()}

_PATCH = ("patch",)

#: schema of a stored table of patches from which a map can be made
PATCHES = Schema(
    "a table of patches from mitsim map make",
    {
        **{name: Variable(_PATCH, "number", 0, 1) for name in ("recovered_fraction", "false_fraction")},
        **{name: Variable(_PATCH, "number", 0, 1e9) for name in ("points", "points_possible")},
        **{name: Variable(_PATCH, "number", 0, 1e6, gaps=True) for name in ("ray_noise_std", "ray_noise_inliers")},
        "ray_offset": Variable(_PATCH, "number", -1e6, 1e6, gaps=True),
        "offset_product_touching": Variable(_PATCH, "number", -1e12, 1e12, gaps=True),
        "offset_product_apart": Variable(_PATCH, "number", -1e12, 1e12, gaps=True),
        **{name: Variable(_PATCH, "number", -1, 1) for name in ("normal_x", "normal_y")},
        "distance": Variable(_PATCH, "number", 1, 1e6),
        "independent_share": Variable(_PATCH, "number", 0, 1),
    },
    {"patch": (0, 10_000_000)},
)


def patch_table(**columns: NDArray[np.generic]) -> xr.Dataset:
    """Assemble the table of patches, each column with its unit."""
    return xr.Dataset({name: ("patch", values, {"units": _UNITS.get(name, "1")}) for name, values in columns.items()})
