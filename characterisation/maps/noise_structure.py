"""What a performance map says of noise that does not average out: noise area A and persistent p, point by point.

Signal chain: queries -> nearest node of the normals, for both vary slowly -> ln A and p / sigma linear in ln |V| and ln
Ra between the knots that know them -> A [px^2], p / sigma [1].
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from characterisation.equal_area import equal_area
from characterisation.maps.performance_map import PerformanceMap

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class NoiseStructure:
    """One element per query: ``area`` A [px^2] and ``persistent_share`` p / sigma [1], of the map's sigma.

    NaN where no knot about a query knows them, and throughout for a map that was made before they were measured.
    """

    area: Floats
    persistent_share: Floats


def noise_structure(
    performance_map: PerformanceMap, finish: str, roughness: float, distance: ArrayLike, normals: Floats
) -> NoiseStructure:
    """Look up A and p / sigma; arguments and errors of :meth:`PerformanceMap.query`.

    Outside the characterised normals or distances the nearest ones answer: whether there is an answer at all is for
    F and sigma to say.
    """
    rough = performance_map.require(finish, roughness)
    data, members = performance_map.data, performance_map.members(finish)
    normals = np.asarray(normals, float)
    distance = np.broadcast_to(np.asarray(distance, float), normals.shape[:-1])
    if "noise_area" not in data:
        return NoiseStructure(np.full(distance.shape, np.nan), np.full(distance.shape, np.nan))
    axis = data["a"].values
    place = np.rint((equal_area(normals) - axis[0]) / (axis[1] - axis[0])).astype(int)
    column, row = np.moveaxis(np.clip(place, 0, len(axis) - 1), -1, 0)
    near, way = _between(np.log(data["distance"].values.astype(float)), np.log(distance))
    known = data["roughness"].values[members].astype(float)
    low, part = (np.array(0), np.array(0.0)) if np.isnan(rough) else _between(np.log(known), np.log(np.array(rough)))
    area, share = (data[name].values[members].astype(float) for name in ("noise_area", "persistent_share"))
    total, log_area, persistent = np.zeros((3, *distance.shape))
    for i, sample_weight in ((int(low), 1 - float(part)), (min(int(low) + 1, len(members) - 1), float(part))):
        for step in (0, 1):
            j = np.minimum(near + step, area.shape[1] - 1)
            weight = sample_weight * np.where(step, way, 1 - way) + 1e-9  # a knot alone answers, however far
            a, p = area[i, j, row, column], share[i, j, row, column]
            weight = np.where(np.isfinite(a) & np.isfinite(p), weight, 0.0)
            total += weight
            log_area += weight * np.log(np.where(weight > 0, a, 1.0))
            persistent += weight * np.where(weight > 0, p, 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        return NoiseStructure(np.where(total > 0, np.exp(log_area / total), np.nan), persistent / total)


def _between(knots: Floats, at: Floats) -> tuple[NDArray[np.int64], Floats]:
    """Number of the knot below, and the way to the next, 0 to 1; held at the ends."""
    if len(knots) == 1:
        return np.zeros(at.shape, np.int64), np.zeros(at.shape)
    below = np.clip(np.searchsorted(knots, at) - 1, 0, len(knots) - 2)
    return below, np.clip((at - knots[below]) / (knots[below + 1] - knots[below]), 0.0, 1.0)
