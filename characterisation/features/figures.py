"""Figures in a face: the circle of a hole, the point where a line leaves the face; and points that follow from others.

A figure lies in a plane that is a feature of its own. Its parameters move it within that plane only; :meth:`carried`
takes it along when the plane moves. So the plane's uncertainty enters once, also where a measurement names the plane
and the figure both.

An edge in a cloud is known from the last pixel that still shows the face and the next that does not: uniform within a
pixel pitch d, variance d^2 / 12 along the row or column (JCGM 100:2008, 4.3.7). An edge at an angle psi to the pixels'
normal, at most 45 deg for the better of the two, errs at right angles to itself by cos(psi) of that; the mean square
over all directions, each weighed by its crossings, is 5/6. A share 1 - F of points lost at random also hides some of
the last pixels; their number is geometric with variance (1 - F) / F^2. Together, for each crossing,

    s^2 = 5/6 d^2 (1/12 + (1 - F) / F^2)
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from characterisation.features.surfaces import Plane, moved_rigidly, tangents, unit

Array = NDArray[np.float64]

#: mean square of cos(psi) over crossings of edges in all directions: integral of cos^3 over that of cos, to 45 deg
ACROSS_THE_EDGE = 5 / 6

#: crossings for each pixel pitch of an edge's length: mean of the larger of |cos| and |sin|, 2 sqrt(2) / pi
CROSSINGS_PER_PITCH = 2 * np.sqrt(2) / np.pi


@dataclass(frozen=True)
class Point:
    """A place (3,) [mm] that follows from other features."""

    place: Array

    kind: ClassVar[str] = "point"


@dataclass(frozen=True)
class Circle:
    """Circle about ``centre`` (3,) [mm] in the plane of unit ``normal`` (3,), ``radius`` [mm].

    ``ray`` (3,) is the unit direction in which it slides when its plane moves: the view ray of its centre, since it
    was seen there; the normal where nobody has looked yet.

    Parameters of a small change: shifts [mm] of the centre along e1 and e2 of the normal's
    :func:`~characterisation.features.surfaces.tangents`, change of radius [mm].
    """

    centre: Array
    normal: Array
    radius: float
    ray: Array

    parameter_count: ClassVar[int] = 3
    kind: ClassVar[str] = "circle"

    def moved(self, parameters: Array) -> Circle:
        """Change by the three parameters."""
        centre = self.centre + parameters[:2] @ tangents(self.normal)
        return Circle(centre, self.normal, self.radius + float(parameters[2]), self.ray)

    def placed(self, motion: ArrayLike) -> Circle:
        """Move rigidly by a (4, 4) matrix."""
        centre, normal, ray = moved_rigidly(motion, self.centre, self.normal, self.ray)
        return Circle(centre, normal, self.radius, ray)

    def seen_from(self, viewpoint: ArrayLike) -> Circle:
        """The same circle, seen from a viewpoint (3,) [mm]."""
        return Circle(self.centre, self.normal, self.radius, unit(self.centre - np.asarray(viewpoint, float)))

    def carried(self, plane: Plane) -> Circle:
        """The circle in its plane as that is now; a change of its radius by the plane's tilt is neglected."""
        normal = _facing(plane.normal, self.normal)
        return Circle(_slid(self.centre, self.ray, plane), normal, self.radius, self.ray)

    def linearised(self, parameters: Array, points: Array, rays: Array | None = None) -> tuple[Array, Array, Array]:
        """Distances (n,) [mm] from the circle, positive outside, of points (n, 3) in its plane; slopes (n, 3); 1."""
        moved = self.moved(parameters)
        local = (points - moved.centre) @ tangents(self.normal).T
        reach = np.maximum(np.linalg.norm(local, axis=1), 1e-12)
        ones = np.ones(len(points))
        return reach - moved.radius, -np.column_stack([local / reach[:, None], ones]), ones


@dataclass(frozen=True)
class EdgePoint:
    """Point (3,) [mm] where a line along unit ``direction`` (3,) in the face of unit ``normal`` (3,) leaves it.

    ``slope`` is the tangent of the angle by which the edge deviates from the right angle to the line, toward
    normal x direction; ``ray`` as of :class:`Circle`.

    Parameters of a small change: shift of the point along the direction [mm], change of the slope.
    """

    point: Array
    direction: Array
    normal: Array
    slope: float
    ray: Array

    parameter_count: ClassVar[int] = 2
    kind: ClassVar[str] = "edge_point"

    def moved(self, parameters: Array) -> EdgePoint:
        """Change by the two parameters."""
        point = self.point + parameters[0] * self.direction
        return EdgePoint(point, self.direction, self.normal, self.slope + float(parameters[1]), self.ray)

    def placed(self, motion: ArrayLike) -> EdgePoint:
        """Move rigidly by a (4, 4) matrix."""
        point, direction, normal, ray = moved_rigidly(motion, self.point, self.direction, self.normal, self.ray)
        return EdgePoint(point, direction, normal, self.slope, ray)

    def seen_from(self, viewpoint: ArrayLike) -> EdgePoint:
        """The same point, seen from a viewpoint (3,) [mm]."""
        ray = unit(self.point - np.asarray(viewpoint, float))
        return EdgePoint(self.point, self.direction, self.normal, self.slope, ray)

    def carried(self, plane: Plane) -> EdgePoint:
        """The point in its plane as that is now, the line turned into it."""
        normal = _facing(plane.normal, self.normal)
        direction = unit(self.direction - (self.direction @ normal) * normal)
        return EdgePoint(_slid(self.point, self.ray, plane), direction, normal, self.slope, self.ray)

    def linearised(self, parameters: Array, points: Array, rays: Array | None = None) -> tuple[Array, Array, Array]:
        """Distances (n,) [mm] along the line, beyond the edge, of points (n, 3) in its plane; slopes (n, 2); 1."""
        moved = self.moved(parameters)
        local = points - moved.point
        sideways = local @ np.cross(self.normal, self.direction)
        ones = np.ones(len(points))
        return local @ self.direction - moved.slope * sideways, -np.column_stack([ones, sideways]), ones


def crossings(length: float, pitch: float) -> float:
    """How often an edge of some length [mm] is expected to cross the pixels' rows or columns, at a pitch [mm]."""
    return float(CROSSINGS_PER_PITCH * length / pitch)


def edge_covariance(
    figure: Circle | EdgePoint, pitch: float, count: float, fraction: float = 1.0, reach: float = np.nan
) -> Array:
    """Covariance (p, p) of a figure's own parameters that sampling by pixels alone would give.

    J^T J of ``count`` crossings with the variance s^2 above: for a whole circle diag(2, 2, 1) s^2 / count, for an edge
    seen as far as ``reach`` [mm] to both sides of the point diag(1, 3 / reach^2) s^2 / count.

    Parameters
    ----------
    pitch
        Of the pixels on the face [mm]; on a tilted face the root mean square of both directions.
    count
        Crossings that err independently. An edge that follows a row of pixels errs in all of them alike: then the
        number of rows that it crosses, at least 1, and not :func:`crossings`.
    fraction
        F near the edge, over 0 to 1.

    Raises
    ------
    ValueError
        If the reach of an edge is not given.
    """
    variance = ACROSS_THE_EDGE * pitch**2 * (1 / 12 + (1 - fraction) / fraction**2) / count
    if isinstance(figure, Circle):
        return variance * np.diag([2.0, 2.0, 1.0])
    if not reach > 0:
        raise ValueError(f"reach is {reach}, an edge point needs one above 0")
    return variance * np.diag([1.0, 3.0 / reach**2])


def _slid(place: Array, ray: Array, plane: Plane) -> Array:
    """Where the line through a place along a ray meets a plane."""
    slid: Array = place + (plane.point - place) @ plane.normal / (ray @ plane.normal) * ray
    return slid


def _facing(normal: Array, former: Array) -> Array:
    return normal if normal @ former >= 0 else -normal
