"""Look up the structure of the noise in a performance map: noise area, persistent noise and bias.

Signal chain: queries -> nearest node of the normals, since all three vary slowly -> ln A, p / sigma and beta / sigma,
linear in ln |V| and ln Ra between the knots with a value -> A [px^2], p / sigma and beta / sigma [1].
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from characterisation.files.arrays import Floats
from characterisation.lambert_projection import lambert_projection
from characterisation.maps.light import Light
from characterisation.maps.performance_map import PerformanceMap


@dataclass(frozen=True)
class NoiseStructure:
    """Answer with one element per query; NaN where no knot around it has a value, or if the map has no offsets.

    ``area`` is A [px^2]; ``persistent_share`` and ``bias_share`` are p / sigma and beta / sigma [1], relative to the
    sigma of the map. See :mod:`characterisation.maps.pooled_offsets`.
    """

    area: Floats
    persistent_share: Floats
    bias_share: Floats


def noise_structure(
    performance_map: PerformanceMap,
    finish: str,
    roughness: float,
    distance: ArrayLike,
    normals: Floats,
    light: Light | None = None,
) -> NoiseStructure:
    """Look up A, p / sigma and beta / sigma; arguments and errors are those of :meth:`PerformanceMap.query`.

    Outside the characterised normals or distances, the nearest ones are used: F and sigma are NaN there anyway.

    Parameters
    ----------
    performance_map, finish, roughness, distance, normals, light
        The map, and as in :meth:`~characterisation.maps.performance_map.PerformanceMap.query`.
    """
    members, rough = performance_map.known.representing(finish, roughness, light)
    data = performance_map.data
    normals = np.asarray(normals, float)
    distance = np.broadcast_to(np.asarray(distance, float), normals.shape[:-1])
    axis = data["a"].values
    node = np.rint((lambert_projection(normals) - axis[0]) / (axis[1] - axis[0])).astype(int)
    column, row = np.moveaxis(np.clip(node, 0, len(axis) - 1), -1, 0)
    near, way = _between(np.log(data["distance"].values.astype(float)), np.log(distance))
    low, part = 0, 0.0
    if not np.isnan(rough):
        roughnesses = data["roughness"].values[members].astype(float)
        below, share = _between(np.log(roughnesses), np.log(np.array(rough)))
        low, part = int(below), float(share)
    weights = {low: 1 - part}  # of the members, by number: one or two
    other = min(low + 1, len(members) - 1)
    weights[other] = weights.get(other, 0.0) + part
    least = 2e-9 / len(weights)  # a single knot with a value is used at any distance
    last = len(data["distance"]) - 1
    knots = [
        (i, np.minimum(near + step, last), weight * np.where(step, way, 1 - way) + least)
        for i, weight in weights.items()
        for step in (0, 1)
    ]

    def between(values: Floats) -> Floats:
        total, summed = np.zeros((2, *distance.shape))
        for i, j, weight in knots:
            value = values[i, j, row, column]
            finite = np.isfinite(value)
            total += np.where(finite, weight, 0.0)
            summed += np.where(finite, weight * value, 0.0)
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(summed / total)

    def field(name: str) -> Floats:
        if name not in data:
            return np.full(data["recovered_fraction"][members].shape, np.nan)
        return np.asarray(data[name].values[members], float)

    log_area = between(np.log(field("noise_area")))
    shares = (between(field(name)) for name in ("persistent_share", "bias_share"))
    return NoiseStructure(np.exp(log_area), *shares)


def _between(knots: Floats, at: Floats) -> tuple[NDArray[np.int64], Floats]:
    """Return the index of the knot below, and the way to the next from 0 to 1, limited at the ends."""
    if len(knots) == 1:
        return np.zeros(at.shape, np.int64), np.zeros(at.shape)
    below = np.clip(np.searchsorted(knots, at) - 1, 0, len(knots) - 2)
    return below, np.clip((at - knots[below]) / (knots[below + 1] - knots[below]), 0.0, 1.0)
