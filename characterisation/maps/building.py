"""Build a performance map from the patches of coupons.

Signal chain: tables of patches (:mod:`characterisation.coupon.patches`) -> pooled at the nodes of a grid
(:mod:`characterisation.maps.pooling`) -> map with standard errors (:mod:`characterisation.maps.performance_map`).

A sample may have *variants*, in which one unknown quantity q was changed by one standard deviation, down or up. Half
the difference between the two in F or sigma, as root sum of squares over all unknown quantities, is the *spread*:

    u^2(F) = sum over q of [(F(q high) - F(q low)) / 2]^2

(GUM 5.1.3, note 2: sensitivities by finite differences; the q are assumed independent).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import xarray as xr

from characterisation.files.arrays import Floats
from characterisation.maps.light import Light, light_variables
from characterisation.maps.map_file import SCHEMA_VERSION
from characterisation.maps.performance_map import PerformanceMap
from characterisation.maps.pooled_offsets import pool_offsets
from characterisation.maps.pooling import pool

#: unknown quantity, and whether it was changed by one standard deviation down (low) or up (high)
Variant = tuple[str, Literal["low", "high"]]

#: nodes of the grid along each axis: 1.2 deg apart for 60 deg of incidence, about as wide as a patch
NODES = 97

_DESCRIBED = {
    "recovered_fraction": ("1", "fraction of points recovered, F"),
    "ray_noise_std": ("mm", "standard deviation along the view ray, sigma, without outliers"),
    "recovered_fraction_error": ("1", "standard error of F in the map"),
    "ray_noise_std_error": ("mm", "standard error of sigma in the map"),
    "recovered_fraction_spread": ("1", "standard uncertainty of F due to unknown properties of the sample"),
    "ray_noise_std_spread": ("mm", "standard uncertainty of sigma due to unknown properties of the sample"),
    "false_fraction": ("1", "false points, over possible ones"),
    "patches": ("1", "effective number of patches in the mean"),
    "noise_area": ("px2", "noise area A: the mean of n neighbouring points has the variance sigma^2 A / n"),
    "persistent_share": ("1", "persistent standard deviation, which does not average out, without bias, over sigma"),
    "bias_share": ("1", "bias away from the sensor that faces of equal orientation have in common, over sigma"),
}


@dataclass(frozen=True)
class SampleTable:
    """Patches of one sample (finish, Ra [um] or NaN), or of a variant of it, at one nominal distance [mm].

    ``light`` holds the optical properties of the sample; None if they are unknown.
    """

    finish: str
    roughness: float
    distance: float
    patches: xr.Dataset
    variant: Variant | None = None
    light: Light | None = None


def build_map(
    tables: Sequence[SampleTable], attributes: dict[str, Any], largest_incidence: float, nodes: int = NODES
) -> PerformanceMap:
    """Pool tables of patches into a map.

    Parameters
    ----------
    tables, attributes
        Patches of each sample; written into the map: ``sensor``, ``source``, ``exposure_rule`` and everything else that
        makes it reproducible.
    largest_incidence, nodes
        Largest incidence [rad] of the campaign, beyond which nodes are NaN, as outside the hull of the patches; number
        of nodes along each axis of the equal-area grid.
    """
    keys = [(t.finish, t.roughness if not math.isnan(t.roughness) else -1.0) for t in tables]
    samples = sorted(set(keys))
    distances = sorted({t.distance for t in tables})
    reach = 2 * math.sin(largest_incidence / 2)
    axis = np.linspace(-reach, reach, nodes)
    shape = (len(samples), len(distances), nodes, nodes)
    fields = {name: np.full(shape, np.nan) for name in _DESCRIBED}
    lights: list[Light | None] = [None] * len(samples)
    ends: dict[tuple[int, int], dict[Variant, dict[str, Floats]]] = {}
    for table, key in zip(tables, keys, strict=True):
        i, j = samples.index(key), distances.index(table.distance)
        pooled = _at_nodes(table, axis, reach)
        if table.variant is not None:
            ends.setdefault((i, j), {})[table.variant] = pooled
            continue
        lights[i] = table.light
        for name, values in pooled.items():
            fields[name][i, j] = values
    for index, variants in ends.items():
        for name in ("recovered_fraction", "ray_noise_std"):
            fields[f"{name}_spread"][index] = _spread({variant: pooled[name] for variant, pooled in variants.items()})

    def variable(over: str | tuple[str, ...], values: Any, units: str, long_name: str) -> tuple[Any, ...]:
        return over, values, {"units": units, "long_name": long_name}

    dims = ("sample", "distance", "b", "a")
    roughness = [ra if ra >= 0 else np.nan for _, ra in samples]
    data = xr.Dataset(
        {name: variable(dims, values.astype(np.float32), *_DESCRIBED[name]) for name, values in fields.items()},
        coords={
            "finish": ("sample", np.array([finish for finish, _ in samples], dtype=str)),
            "roughness": variable("sample", roughness, "um", "roughness average Ra"),
            "distance": variable("distance", distances, "mm", "|V|"),
            "a": variable("a", axis, "1", "equal-area place along the baseline"),
            "b": variable("b", axis, "1", "equal-area place across the baseline"),
        },
        attrs={"title": "performance map", "schema_version": SCHEMA_VERSION, **attributes},
    )
    if any(lights):
        data = data.assign(light_variables(lights))
    return PerformanceMap(data)


def _spread(ends: dict[Variant, Floats]) -> Floats:
    """Return half the difference between the high and the low end of each quantity, root sum of squares."""
    moved = sorted({quantity for quantity, _ in ends})
    return np.asarray(np.sqrt(sum(((ends[q, "high"] - ends[q, "low"]) / 2) ** 2 for q in moved)))


def _at_nodes(table: SampleTable, axis: Floats, reach: float) -> dict[str, Floats]:
    """Return the fields (b, a) of one sample at one distance."""
    b, a = np.meshgrid(axis, axis, indexing="ij")
    within = np.hypot(a, b) <= reach * (1 + 1e-9)
    positions = np.column_stack([a[within], b[within]])
    pooled = pool(table.patches, table.distance, positions)
    offsets = pool_offsets(table.patches, positions)
    finite = np.isfinite(pooled.sigma)
    node_fields = {
        "recovered_fraction": pooled.fraction,
        "ray_noise_std": pooled.sigma,
        "recovered_fraction_error": pooled.fraction_error,
        "ray_noise_std_error": pooled.sigma_error,
        "false_fraction": pooled.false_fraction,
        "patches": pooled.patches,
        "noise_area": np.where(finite, offsets.area, np.nan),
        "persistent_share": np.where(finite, offsets.persistent, np.nan),
        "bias_share": np.where(finite, offsets.bias, np.nan),
    }
    out = {name: np.full(a.shape, np.nan) for name in node_fields}
    for name, values in node_fields.items():
        out[name][within] = values
    return out
