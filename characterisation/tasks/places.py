"""Places and directions that follow from features: points, where features meet, the plane midway between two.

Signal chain: features in one frame -> the point that a feature stands for, its direction, derived points and planes.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from characterisation.features.figures import Circle, EdgePoint, Point
from characterisation.features.surfaces import Cone, Cylinder, Plane, Sphere, unit

Array = NDArray[np.float64]
Axis = Cylinder | Cone
PointLike = Sphere | Circle | EdgePoint | Point
Geometry = Plane | Axis | PointLike

#: lines and planes that are nearer to parallel than about this [rad] have no intersection
PARALLEL = 1e-4


def place(feature: PointLike) -> Array:
    """The point (3,) [mm] that a feature stands for: centre, point of an edge, intersection."""
    if isinstance(feature, Sphere | Circle):
        return feature.centre
    return feature.point if isinstance(feature, EdgePoint) else feature.place


def direction(feature: Plane | Axis) -> Array:
    """Unit normal of a plane, or axis (3,)."""
    return feature.normal if isinstance(feature, Plane) else feature.axis


def intersection(features: Sequence[Plane | Axis]) -> Point:
    """Point where an axis meets a plane, where three planes meet, or in the middle between two axes.

    The last is the middle of the common perpendicular. NaN where the features are within :data:`PARALLEL` of being
    parallel. Solved as the least-squares common point, which these are.

    Raises
    ------
    ValueError
        If the features are none of the three.
    """
    kinds = sorted("plane" if isinstance(one, Plane) else "axis" for one in features)
    if kinds not in (["axis", "plane"], ["plane", "plane", "plane"], ["axis", "axis"]):
        raise ValueError(f"no point follows from {' and '.join(kinds)}")
    middle = np.mean([one.point for one in features], axis=0)
    rows, values = [], []
    for one in features:
        along = direction(one)
        # distances from a plane count along its normal, from an axis across it
        across = np.outer(along, along) if isinstance(one, Plane) else np.eye(3) - np.outer(along, along)
        rows.append(across)
        values.append(across @ (one.point - middle))
    matrix = np.concatenate(rows)
    solution, _, _, singular = np.linalg.lstsq(matrix, np.concatenate(values), rcond=None)
    if singular[-1] < PARALLEL:
        return Point(np.full(3, np.nan))
    return Point(middle + solution)


def on_axis(plane: Plane, axis: Axis) -> Array:
    """Where an axis meets a plane (3,) [mm]."""
    climb = float(axis.axis @ plane.normal)
    if abs(climb) < PARALLEL:
        return np.full(3, np.nan)
    met: Array = axis.point + ((plane.point - axis.point) @ plane.normal / climb) * axis.axis
    return met


def mid_plane(first: Plane, second: Plane) -> Plane:
    """Plane midway between two: it halves the angle between them, and its normal is turned as that of the first.

    The median plane of a slot or a web (ISO 5460), by its fitted sides. With both normals turned alike, N1 and N2, its
    points q are as far from the one as from the other: (q - p1).N1 + (q - p2).N2 = 0. It is described by its point
    nearest to the middle of p1 and p2.
    """
    other = second.normal if first.normal @ second.normal >= 0 else -second.normal
    total, middle = first.normal + other, (first.point + second.point) / 2
    length = float(np.linalg.norm(total))
    off = (middle - first.point) @ first.normal + (middle - second.point) @ other
    return Plane(middle - off / length**2 * total, unit(total))
