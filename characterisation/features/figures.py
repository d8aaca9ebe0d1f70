"""Describe figures in a face: the circle of a hole, the point where a line leaves the face; and derived points.

A figure lies in a plane that is a feature of its own. The parameters of the figure move it within that plane only;
:meth:`carried` moves it along with the plane. The uncertainty of the plane therefore enters once, also where a
measurement names both the plane and the figure.

An edge in a cloud lies between the last pixel that shows the face and the next, which does not. Its position is uniform
within a pixel pitch d, with variance d^2 / 12 along the row or column (JCGM 100:2008, 4.3.7). Let psi be the angle of
the edge to the normal of the pixels, at most 45 deg for the better of row and column. Its error perpendicular to itself
is smaller by cos(psi). The mean square over all directions, each weighted by its crossings, is 5/6.

If a share 1 - F of the points is lost at random, some of the last pixels are lost as well. Their number is geometric
with variance (1 - F) / F^2. Together, each crossing has the variance

    s^2 = 5/6 d^2 (1/12 + (1 - F) / F^2)
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from characterisation.features.surfaces import Plane
from characterisation.features.vectors import moved_rigidly, tangents, unit

Array = NDArray[np.float64]

#: mean square of cos(psi) over crossings of edges in all directions: integral of cos^3 over that of cos, to 45 deg
ACROSS_THE_EDGE = 5 / 6

#: crossings per pixel pitch of an edge's length: mean of the larger of |cos| and |sin|, 2 sqrt(2) / pi
CROSSINGS_PER_PITCH = 2 * np.sqrt(2) / np.pi


@dataclass(frozen=True)
class Point:
    """A place (3,) [mm] derived from other features."""

    place: Array

    kind: ClassVar[str] = "point"


@dataclass(frozen=True)
class Circle:
    """Circle about ``centre`` (3,) [mm] in the plane of unit ``normal`` (3,), ``radius`` [mm].

    ``ray`` (3,) is the unit direction in which the circle slides when its plane moves. It is the view ray of its
    centre, or the normal while the viewpoint is unknown.

    Parameters of a small change: shifts [mm] of the centre along e1 and e2 of the normal's
    :func:`~characterisation.features.vectors.tangents`, change of radius [mm].
    """

    centre: Array
    normal: Array
    radius: float
    ray: Array

    parameter_count: ClassVar[int] = 3
    kind: ClassVar[str] = "circle"

    def moved(self, parameters: Array) -> Circle:
        """Change the circle by the three parameters."""
        centre = self.centre + parameters[:2] @ tangents(self.normal)
        return Circle(centre, self.normal, self.radius + float(parameters[2]), self.ray)

    def placed(self, motion: ArrayLike) -> Circle:
        """Move the circle rigidly by a (4, 4) matrix."""
        centre, normal, ray = moved_rigidly(motion, self.centre, self.normal, self.ray)
        return Circle(centre, normal, self.radius, ray)

    def seen_from(self, viewpoint: ArrayLike) -> Circle:
        """Return the same circle, seen from a viewpoint (3,) [mm]."""
        return Circle(self.centre, self.normal, self.radius, unit(self.centre - np.asarray(viewpoint, float)))

    def on_moved_plane(self, plane: Plane) -> Circle:
        """Return the circle carried along with its moved plane, neglecting the effect of the tilt on the radius."""
        normal = _facing(plane.normal, self.normal)
        return Circle(_slid(self.centre, self.ray, plane), normal, self.radius, self.ray)

    def linearised(self, parameters: Array, points: Array, rays: Array | None = None) -> tuple[Array, Array, Array]:
        """Linearise the distances of points (n, 3) in its plane from the circle.

        Returns the distances (n,) [mm], positive outside, their derivatives (n, 3), and ones (n,).
        """
        moved = self.moved(parameters)
        local = (points - moved.centre) @ tangents(self.normal).T
        reach = np.maximum(np.linalg.norm(local, axis=1), 1e-12)
        ones = np.ones(len(points))
        return reach - moved.radius, -np.column_stack([local / reach[:, None], ones]), ones


@dataclass(frozen=True)
class EdgePoint:
    """Point (3,) [mm] where a line along unit ``direction`` (3,) in the face of unit ``normal`` (3,) leaves it.

    ``slope`` is the tangent of the angle by which the edge deviates from the right angle to the line, toward normal x
    direction. ``ray`` is as for :class:`Circle`.

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
        """Change the point by the two parameters."""
        point = self.point + parameters[0] * self.direction
        return EdgePoint(point, self.direction, self.normal, self.slope + float(parameters[1]), self.ray)

    def placed(self, motion: ArrayLike) -> EdgePoint:
        """Move the point rigidly by a (4, 4) matrix."""
        point, direction, normal, ray = moved_rigidly(motion, self.point, self.direction, self.normal, self.ray)
        return EdgePoint(point, direction, normal, self.slope, ray)

    def seen_from(self, viewpoint: ArrayLike) -> EdgePoint:
        """Return the same point, seen from a viewpoint (3,) [mm]."""
        ray = unit(self.point - np.asarray(viewpoint, float))
        return EdgePoint(self.point, self.direction, self.normal, self.slope, ray)

    def on_moved_plane(self, plane: Plane) -> EdgePoint:
        """Return the point carried along with its moved plane, with the line turned into the plane."""
        normal = _facing(plane.normal, self.normal)
        direction = unit(self.direction - (self.direction @ normal) * normal)
        return EdgePoint(_slid(self.point, self.ray, plane), direction, normal, self.slope, self.ray)

    def linearised(self, parameters: Array, points: Array, rays: Array | None = None) -> tuple[Array, Array, Array]:
        """Linearise the distances of points (n, 3) in its plane from the edge.

        Returns the distances (n,) [mm] along the line, positive beyond the edge, their derivatives (n, 2), and ones
        (n,).
        """
        moved = self.moved(parameters)
        local = points - moved.point
        sideways = local @ np.cross(self.normal, self.direction)
        ones = np.ones(len(points))
        return local @ self.direction - moved.slope * sideways, -np.column_stack([ones, sideways]), ones


def crossings(length: float, pitch: float) -> float:
    """Return the expected number of rows or columns of pixels that an edge crosses.

    ``length`` [mm] is that of the edge, ``pitch`` [mm] that of the pixels.
    """
    return float(CROSSINGS_PER_PITCH * length / pitch)


def edge_covariance(
    figure: Circle | EdgePoint, pitch: float, count: float, fraction: float = 1.0, reach: float = np.nan
) -> Array:
    """Return the covariance (p, p) of a figure's own parameters due to sampling by pixels alone.

    It is s^2 times the inverse of J^T J of ``count`` crossings, with the variance s^2 above:

    - diag(2, 2, 1) s^2 / count for a whole circle;
    - diag(1, 3 / reach^2) s^2 / count for an edge visible up to ``reach`` [mm] on both sides of the point.

    Raises ValueError if the reach of an edge is not given.

    Parameters
    ----------
    figure
        Circle or point of an edge.
    pitch
        Of the pixels on the face [mm]; on a tilted face the root mean square of both directions.
    count
        Number of crossings with independent errors. An edge along a row of pixels has the same error in all of them.
        Then give the number of rows that it crosses, at least 1, instead of :func:`crossings`.
    fraction
        F near the edge, above 0 and up to 1.
    reach
        Visible length of the edge on each side of the point [mm]; not used for a circle.
    """
    variance = ACROSS_THE_EDGE * pitch**2 * (1 / 12 + (1 - fraction) / fraction**2) / count
    if isinstance(figure, Circle):
        return variance * np.diag([2.0, 2.0, 1.0])
    if not reach > 0:
        raise ValueError(f"reach is {reach}; an edge point requires a reach greater than 0 mm")
    return variance * np.diag([1.0, 3.0 / reach**2])


def _slid(point: Array, ray: Array, plane: Plane) -> Array:
    """Return the point where the line through another along a ray meets a plane."""
    slid: Array = point + (plane.point - point) @ plane.normal / (ray @ plane.normal) * ray
    return slid


def _facing(normal: Array, former: Array) -> Array:
    return normal if normal @ former >= 0 else -normal
