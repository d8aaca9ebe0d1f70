"""Derive points, directions and planes from features: intersections, and the plane midway between two planes.

Signal chain: features in one frame -> the point that represents a feature, its direction, derived points and planes.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from characterisation.features.figures import Circle, EdgePoint, Point
from characterisation.features.surfaces import Cone, Cylinder, Plane, Sphere
from characterisation.features.vectors import unit

Array = NDArray[np.float64]
Axis = Cylinder | Cone
PointLike = Sphere | Circle | EdgePoint | Point
Geometry = Plane | Axis | PointLike

#: lines and planes within about this angle [rad] of parallel have no intersection
PARALLEL = 1e-4

#: largest angle [deg] between two planes or axes that have one distance
MOST_ASKEW_DEG = 6.0


def place(feature: PointLike) -> Array:
    """Return the point (3,) [mm] that represents a feature: its centre, point of an edge, or intersection."""
    if isinstance(feature, Sphere | Circle):
        return feature.centre
    return feature.point if isinstance(feature, EdgePoint) else feature.place


def direction(feature: Plane | Axis) -> Array:
    """Return the unit normal (3,) of a plane, or the axis (3,)."""
    return feature.normal if isinstance(feature, Plane) else feature.axis


def askew_deg(features: Sequence[object]) -> float:
    """Return the angle [deg], 0 to 90, between the lines of two planes or axes; 0 of anything else."""
    lines = [direction(feature) for feature in features if isinstance(feature, Plane | Cylinder | Cone)]
    if len(lines) != 2:
        return 0.0
    return float(np.degrees(np.arcsin(min(float(np.linalg.norm(np.cross(lines[0], lines[1]))), 1.0))))


def intersection(features: Sequence[Plane | Axis]) -> Point:
    """Return the point where an axis meets a plane, where three planes meet, or midway between two axes.

    The last is the middle of the common perpendicular. All are least-squares common points. The point is NaN where the
    features are within :data:`PARALLEL` of being parallel. Raises ValueError if the features are none of the three.
    """
    kinds = sorted("plane" if isinstance(feature, Plane) else "axis" for feature in features)
    if kinds not in (["axis", "plane"], ["plane", "plane", "plane"], ["axis", "axis"]):
        raise ValueError(f"no point follows from {' and '.join(kinds)}")
    middle = np.mean([feature.point for feature in features], axis=0)
    rows, values = [], []
    for feature in features:
        along = direction(feature)
        # distances are along the normal of a plane, and perpendicular to an axis
        across = np.outer(along, along) if isinstance(feature, Plane) else np.eye(3) - np.outer(along, along)
        rows.append(across)
        values.append(across @ (feature.point - middle))
    matrix = np.concatenate(rows)
    solution, _, _, singular = np.linalg.lstsq(matrix, np.concatenate(values), rcond=None)
    if singular[-1] < PARALLEL:
        return Point(np.full(3, np.nan))
    return Point(middle + solution)


def on_axis(plane: Plane, axis: Axis) -> Array:
    """Return the point (3,) [mm] where an axis meets a plane."""
    climb = float(axis.axis @ plane.normal)
    if abs(climb) < PARALLEL:
        return np.full(3, np.nan)
    met: Array = axis.point + ((plane.point - axis.point) @ plane.normal / climb) * axis.axis
    return met


def between_axes(first: Axis, second: Axis) -> Array:
    """Return the vector (3,) [mm] from the second of two axes to the first, where they were measured.

    It lies in the plane perpendicular to the mean axis, through the middle of the two axis points (for fits, the axis
    points nearest the measured points).
    """
    other = second.axis if first.axis @ second.axis >= 0 else -second.axis
    plane = Plane((first.point + second.point) / 2, unit(first.axis + other))
    return np.asarray(on_axis(plane, first) - on_axis(plane, second))


def between_planes(first: Plane, second: Plane, middle: Array) -> tuple[float, Array]:
    """Return the signed distance [mm] from the second of two planes to the first, along their mean normal (3,).

    It is that through the place ``middle`` (3,) [mm].
    """
    other = second.normal if first.normal @ second.normal >= 0 else -second.normal
    mean = unit(first.normal + other)
    high, low = ((plane.point - middle) @ plane.normal / (mean @ plane.normal) for plane in (first, second))
    return float(high - low), mean


def mid_plane(first: Plane, second: Plane) -> Plane:
    """Return the plane midway between two planes, with the normal in the sense of the first.

    It bisects the angle between them. For the fitted sides of a slot or a web it is the median plane (ISO 5460). Let N1
    and N2 be the normals in the same sense. The points q of the middle plane are at equal distances from both: (q -
    p1).N1 + (q - p2).N2 = 0. Its reference point is the one nearest to the middle of p1 and p2.
    """
    other = second.normal if first.normal @ second.normal >= 0 else -second.normal
    total, middle = first.normal + other, (first.point + second.point) / 2
    length = float(np.linalg.norm(total))
    off = (middle - first.point) @ first.normal + (middle - second.point) @ other
    return Plane(middle - off / length**2 * total, unit(total))
