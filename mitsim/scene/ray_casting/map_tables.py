r"""F and sigma of the faces of a scene on the device: a performance map that rides along with the rays.

Signal chain: fields of each surface (:class:`characterisation.maps.tables.Surface`) -> one flat table, a row of four
for each interval of distances and node: probit of F at both its ends, ln sigma at both -> |V|, N and number of the
surface -> rows of the four nodes about N, gathered at once -> along ln |V|, then bilinear over the normal -> F, sigma.

The rule of what is known is that of :mod:`characterisation.maps.tables`, which stays the reference and alone knows of
errors: F must be known at both distances, and at nodes that hold half of the weight; where sigma is unknown on one
side, the other's is taken. Here all is single precision: F agrees to 1e-5, sigma to 1e-5 of itself, 4e-5 where it
changes most from node to node (see the tests).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from characterisation.maps.tables import AT_KNOT, PROBIT_MARGIN, ROUNDED, Surface
from mitsim.scene.backend import dr, mi

#: the outermost nodes lie on the limit itself, which a rounding may miss [nodes]
_BEYOND = 1e-4


class MapTables:
    """Look-up of F and sigma of numbered surfaces of one map.

    ``surfaces`` share their distances and nodes, as those of one map do; there is at least one.
    """

    def __init__(self, surfaces: Sequence[Surface]) -> None:
        first = surfaces[0]
        self.count, self.step = first.count, float(first.step)
        self.origin = float(first.first / first.step)
        knots = first.knots
        self.intervals = max(len(knots) - 1, 1)
        self.ends = _singles_between(knots)
        self.inner = [float(np.float32(math.exp(knot))) for knot in knots[1:-1]]
        width = np.diff(knots) if len(knots) > 1 else np.ones(1)
        low, high = (np.exp(knots[i : i + self.intervals]) for i in (0, min(1, len(knots) - 1)))
        self.knots = mi.Float(np.stack([low, high, 1 / width], axis=-1).astype(np.float32).ravel())
        rows = np.concatenate([_rows(surface, self.intervals) for surface in surfaces])
        self.table = mi.Float(rows.ravel())
        dr.eval(self.knots, self.table)

    def look_up(self, number: Any, distance: Any, normal: Any, active: Any) -> tuple[Any, Any]:
        """F and sigma [mm] at |V| [mm] and N in the view frame, of surfaces by number; NaN where unknown."""
        scale = dr.sqrt(2 / (1 + normal.z)) / self.step
        column, row = normal.x * scale - self.origin, normal.y * scale - self.origin
        last = float(self.count - 1)
        within = active & (distance >= self.ends[0]) & (distance <= self.ends[1]) & (normal.z > 0)
        within &= (dr.minimum(column, row) >= -_BEYOND) & (dr.maximum(column, row) <= last + _BEYOND)
        interval, t = self._along(distance, within)
        left, u = self._cell(column)
        low, v = self._cell(row)
        base = ((number * self.intervals + interval) * self.count + low) * self.count + left
        near, far = t < AT_KNOT, t > 1 - AT_KNOT
        probit, probit_weight, log_sigma, sigma_weight = (mi.Float(0) for _ in range(4))
        corners = ((0, (1 - u) * (1 - v)), (1, u * (1 - v)), (self.count, (1 - u) * v), (self.count + 1, u * v))
        for step, share in corners:
            z0, z1, s0, s1 = dr.gather(mi.Vector4f, self.table, base + step, within)
            z = dr.select(near, z0, dr.select(far, z1, z0 + t * (z1 - z0)))
            between = dr.select(dr.isnan(s0), s1, dr.select(dr.isnan(s1), s0, s0 + t * (s1 - s0)))
            s = dr.select(near, s0, dr.select(far, s1, between))
            told, weighted = dr.isfinite(z) & (share > 0), dr.isfinite(s) & (share > 0)
            probit += dr.select(told, share * z, 0)
            probit_weight += dr.select(told, share, 0)
            log_sigma += dr.select(weighted, share * s, 0)
            sigma_weight += dr.select(weighted, share, 0)
        answered = within & (probit_weight >= 0.5)
        fraction = dr.select(answered, _from_probit(probit / probit_weight), dr.nan)
        sigma = dr.select(answered & (sigma_weight > 0), dr.exp(log_sigma / sigma_weight), dr.nan)
        return fraction, sigma

    def _along(self, distance: Any, within: Any) -> tuple[Any, Any]:
        """Interval of distances, and the way between its knots."""
        interval = mi.UInt32(0)
        for knot in self.inner:
            interval += dr.select(distance > knot, mi.UInt32(1), mi.UInt32(0))
        low, high, per_width = dr.gather(mi.Vector3f, self.knots, interval, within)
        t = dr.clip(dr.log(distance / low) * per_width, 0, 1)
        # a logarithm is not exact, and at a knot the other one must not speak
        return interval, dr.select(distance == low, 0, dr.select(distance == high, 1, t))

    def _cell(self, place: Any) -> tuple[Any, Any]:
        """Node below, and the way to the next."""
        place = dr.clip(place, 0, float(self.count - 1))
        below = dr.minimum(mi.UInt32(place), self.count - 2)
        return below, place - mi.Float(below)


def _rows(surface: Surface, intervals: int) -> NDArray[np.float32]:
    """(interval, node, 4): probit of F at the near and far distance, ln sigma at both; one distance is both."""
    far = min(1, len(surface.knots) - 1)
    probit, log_sigma = surface.fields[:2]
    ends = [field[i : i + intervals] for field in (probit, log_sigma) for i in (0, far)]
    return np.stack(ends, axis=-1).astype(np.float32).reshape(-1, 4)


def _singles_between(knots: NDArray[np.float64]) -> tuple[float, float]:
    """Least and largest distance [mm] in single precision that the map answers, by its rule of 1e-9 of an interval."""
    slack = 1e-9 * (np.diff(knots) if len(knots) > 1 else np.ones(1))
    low, high = math.exp(knots[0] - slack[0]), math.exp(knots[-1] + slack[-1])
    least, largest = np.float32(low), np.float32(high)
    if float(least) < low:
        least = np.nextafter(least, np.float32(np.inf))
    if float(largest) > high:
        largest = np.nextafter(largest, np.float32(0))
    return float(least), float(largest)


def _from_probit(z: Any) -> Any:
    """F of a probit, as :func:`characterisation.maps.tables.from_probit`."""
    share = 0.5 + 0.5 * dr.erf(z * math.sqrt(0.5))
    fraction = (share - PROBIT_MARGIN) / (1 - 2 * PROBIT_MARGIN)
    return dr.select(fraction < ROUNDED, 0, dr.select(fraction > 1 - ROUNDED, 1, fraction))
