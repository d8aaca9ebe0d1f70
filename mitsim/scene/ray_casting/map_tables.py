"""Look up F and sigma of surfaces in a performance map, on the device.

Signal chain: fields of each surface (:class:`characterisation.maps.tables.Surface`) -> one flat table -> four rows for
a query (|V|, N, number of the surface) -> interpolation along ln |V|, then bilinear over the normal -> F, sigma.

The table has a row for each interval of distances and each node: probit of F at both ends, ln sigma at both ends. The
four rows are those of the nodes around N.

The rules for unknown values are those of :mod:`characterisation.maps.tables`, which is the reference and also gives
errors. F must be known at both distances, and at nodes with half of the weight. If sigma is unknown at one distance or
node, the other values are used. All numbers here are in single precision. F agrees with the reference to 1e-5, sigma to
a relative 1e-5, or 4e-5 where it changes most between nodes (see the tests).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from characterisation.maps.tables import AT_KNOT, PROBIT_MARGIN, ROUNDED, Surface
from mitsim.scene.backend import dr, mi
from mitsim.scene.device import opaque

#: tolerance for rounding at the outermost nodes, which lie on the limit itself [nodes]
_BEYOND = 1e-4


class MapTables:
    """Tables of F and sigma of the surfaces of one map.

    ``surfaces``, at least one, share their distances and nodes. A query gives the number of a surface, from
    ``numbers``, which has one for each. The numbers after that of a surface with a lay are those of its directions.
    """

    def __init__(self, surfaces: Sequence[Surface]) -> None:
        first = surfaces[0]
        self.count, self.step = first.count, float(first.step)
        self.origin = float(first.first / first.step)
        knots = first.knots
        self.intervals = max(len(knots) - 1, 1)
        self.distance_range = _single_precision_range(knots)
        self.inner_knots = [float(np.float32(math.exp(knot))) for knot in knots[1:-1]]
        width = np.diff(knots) if len(knots) > 1 else np.ones(1)
        low, high = (np.exp(knots[i : i + self.intervals]) for i in (0, min(1, len(knots) - 1)))
        self.knots = mi.Float(np.stack([low, high, 1 / width], axis=-1).astype(np.float32).ravel())
        every = [entry for surface in surfaces for entry in (surface, *surface.directions)]
        self.numbers = np.cumsum([0] + [1 + len(surface.directions) for surface in surfaces])[:-1].tolist()
        self.directions = max(len(surface.directions) for surface in surfaces)
        directed = next((surface for surface in surfaces if surface.directions), first)
        self.mirror = [opaque(coordinate) for coordinate in directed.mirror_mm]
        self.has_lay = mi.Bool([bool(entry.directions) for entry in every])
        rows = np.concatenate([_rows(entry, self.intervals) for entry in every])
        self.table = mi.Float(rows.ravel())
        dr.eval(self.knots, self.table, self.has_lay)

    def look_up(self, number: Any, distance: Any, normal: Any, active: Any) -> tuple[Any, Any]:
        """Return F [1] and sigma [mm] of surfaces by number; NaN if unknown.

        Parameters
        ----------
        number
            Of the surface.
        distance, normal
            |V| [mm], and N in the view frame.
        active
            Mask of the lanes.

        See Also
        --------
        look_up_lay : in the direction of the marks of surfaces with a lay
        """
        scale = dr.sqrt(2 / (1 + normal.z)) / self.step
        column, row = normal.x * scale - self.origin, normal.y * scale - self.origin
        last = float(self.count - 1)
        within = active & (distance >= self.distance_range[0]) & (distance <= self.distance_range[1]) & (normal.z > 0)
        within &= (dr.minimum(column, row) >= -_BEYOND) & (dr.maximum(column, row) <= last + _BEYOND)
        interval, t = self._distance_interval(distance, within)
        left, u = self._cell(column)
        low, v = self._cell(row)
        base = ((number * self.intervals + interval) * self.count + low) * self.count + left
        near, far = t < AT_KNOT, t > 1 - AT_KNOT
        probit, probit_weight, log_sigma, sigma_weight = (mi.Float(0) for _ in range(4))
        corners = ((0, (1 - u) * (1 - v)), (1, u * (1 - v)), (self.count, (1 - u) * v), (self.count + 1, u * v))
        for offset, weight in corners:
            z0, z1, s0, s1 = dr.gather(mi.Vector4f, self.table, base + offset, within)
            z = dr.select(near, z0, dr.select(far, z1, z0 + t * (z1 - z0)))
            between = dr.select(dr.isnan(s0), s1, dr.select(dr.isnan(s1), s0, s0 + t * (s1 - s0)))
            s = dr.select(near, s0, dr.select(far, s1, between))
            fraction_known, sigma_known = dr.isfinite(z) & (weight > 0), dr.isfinite(s) & (weight > 0)
            probit += dr.select(fraction_known, weight * z, 0)
            probit_weight += dr.select(fraction_known, weight, 0)
            log_sigma += dr.select(sigma_known, weight * s, 0)
            sigma_weight += dr.select(sigma_known, weight, 0)
        determined = within & (probit_weight >= 0.5)
        fraction = dr.select(determined, _from_probit(probit / probit_weight), dr.nan)
        sigma = dr.select(determined & (sigma_weight > 0), dr.exp(log_sigma / sigma_weight), dr.nan)
        return fraction, sigma

    def look_up_lay(self, number: Any, distance: Any, normal: Any, along: Any, active: Any) -> tuple[Any, Any]:
        """Return F [1] and sigma [mm], for surfaces with a lay in its direction (:mod:`characterisation.maps.lay`).

        ``number``, ``distance``, ``normal``, ``active``: as for :meth:`look_up`. ``along``: derivative of the point by
        u, in the view frame; its length does not matter.
        """
        mean = self.look_up(number, distance, normal, active)
        directed = active & dr.gather(mi.Bool, self.has_lay, number, active)
        mirror = dr.normalize(mi.Vector3f(self.mirror[0] / distance, self.mirror[1] / distance, 1))
        z = mi.Vector3f(0, 0, 1)
        flat = _rotated_with(_rotated_with(along, mirror, z), _rotated_with(normal, mirror, z), z)
        position = dr.atan2(flat.y, flat.x) * (self.directions / math.pi)
        position -= self.directions * dr.floor(position / self.directions)
        before = dr.minimum(mi.UInt32(position), self.directions - 1)
        t = position - mi.Float(before)
        after = dr.select(before + 1 == self.directions, 0, before + 1)
        step = math.pi / self.directions
        near = self.look_up(number + 1 + before, distance, _turned(normal, -t * step, mirror), directed)
        far = self.look_up(number + 1 + after, distance, _turned(normal, (1 - t) * step, mirror), directed)
        at_near, at_far = t < AT_KNOT, t > 1 - AT_KNOT
        fraction = (1 - t) * near[0] + t * far[0]
        fraction = dr.select(at_near, near[0], dr.select(at_far, far[0], fraction))
        near_sigma, far_sigma = (dr.select(dr.isnan(a), b, a) for a, b in ((near[1], far[1]), (far[1], near[1])))
        sigma = dr.exp((1 - t) * dr.log(near_sigma) + t * dr.log(far_sigma))
        sigma = dr.select(at_near, near[1], dr.select(at_far, far[1], sigma))
        determined = directed & dr.isfinite(fraction)
        return dr.select(determined, fraction, mean[0]), dr.select(determined, sigma, mean[1])

    def _distance_interval(self, distance: Any, within: Any) -> tuple[Any, Any]:
        """Return the interval of distances, and the position between its knots, 0 to 1 in ln |V|."""
        interval = mi.UInt32(0)
        for knot in self.inner_knots:
            interval += dr.select(distance > knot, mi.UInt32(1), mi.UInt32(0))
        low, high, per_width = dr.gather(mi.Vector3f, self.knots, interval, within)
        t = dr.clip(dr.log(distance / low) * per_width, 0, 1)
        # the logarithm is not exact, but at a knot the other knot must have no weight
        return interval, dr.select(distance == low, 0, dr.select(distance == high, 1, t))

    def _cell(self, position: Any) -> tuple[Any, Any]:
        """Return the node below, and the position between it and the next, 0 to 1."""
        position = dr.clip(position, 0, float(self.count - 1))
        below = dr.minimum(mi.UInt32(position), self.count - 2)
        return below, position - mi.Float(below)


def _rows(surface: Surface, intervals: int) -> NDArray[np.float32]:
    """Return rows (interval x node, 4): probit of F at near and far distance, ln sigma; a single distance is both."""
    far = min(1, len(surface.knots) - 1)
    probit, log_sigma = surface.fields[:2]
    ends = [field[i : i + intervals] for field in (probit, log_sigma) for i in (0, far)]
    return np.stack(ends, axis=-1).astype(np.float32).reshape(-1, 4)


def _turned(vector: Any, angle: Any, axis: Any) -> Any:
    """Return a vector, turned about a unit vector by an angle [rad]."""
    sine, cosine = dr.sincos(angle)
    along = axis * dr.dot(axis, vector)
    return cosine * (vector - along) + sine * dr.cross(axis, vector) + along


def _rotated_with(vector: Any, start: Any, end: Any) -> Any:
    """Return a vector, rotated by the smallest rotation that takes one unit vector to another."""
    both = start + end
    return vector - both * (dr.dot(both, vector) / (1 + dr.dot(start, end))) + end * (2 * dr.dot(start, vector))


def _single_precision_range(knots: NDArray[np.float64]) -> tuple[float, float]:
    """Return the least and largest single-precision distance [mm] with values, within 1e-9 of an interval."""
    slack = 1e-9 * (np.diff(knots) if len(knots) > 1 else np.ones(1))
    low, high = math.exp(knots[0] - slack[0]), math.exp(knots[-1] + slack[-1])
    least, largest = np.float32(low), np.float32(high)
    if float(least) < low:
        least = np.nextafter(least, np.float32(np.inf))
    if float(largest) > high:
        largest = np.nextafter(largest, np.float32(0))
    return float(least), float(largest)


def _from_probit(z: Any) -> Any:
    """Return F of a probit, as :func:`characterisation.maps.tables.from_probit` does."""
    share = 0.5 + 0.5 * dr.erf(z * math.sqrt(0.5))
    fraction = (share - PROBIT_MARGIN) / (1 - 2 * PROBIT_MARGIN)
    return dr.select(fraction < ROUNDED, 0, dr.select(fraction > 1 - ROUNDED, 1, fraction))
