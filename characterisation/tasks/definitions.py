"""Define the measurements on features: distances, angles, sizes, and the zones of ISO 1101.

Every measurement is a function of features in one frame that returns mm or rad. Some need two more arguments:

- ``nominal``: the same features at their nominal places, in the same frame.
- ``outline`` (k, 3) [mm]: nominal places that span the first feature (the corners of a face, the ends of an axis).

:data:`DEFINITIONS` gives the kinds of feature, their order, and these needs.

The functions of zones are in :mod:`characterisation.tasks.zones`.

Measurements of nearly parallel features are evaluated at a stated place, so that they are well-conditioned. The usual
definition of the distance between skew lines uses the place where they are nearest. For nearly parallel axes this
place, and thus the distance, depends on the noise.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from characterisation.features.figures import Circle
from characterisation.features.form import zone
from characterisation.features.pose_fit import Pose
from characterisation.features.surfaces import Cone, Cylinder, Plane, Sphere
from characterisation.features.vectors import cross
from characterisation.tasks.places import Axis, Geometry, PointLike, between_axes, between_planes, on_axis, place
from characterisation.tasks.zones import (
    angularity,
    coaxiality,
    parallelism,
    perpendicularity,
    position,
    symmetry,
)

Array = NDArray[np.float64]


def intersection_distance(plane: Plane, first: Axis, second: Axis) -> float:
    """Return the distance [mm] between the points where two axes meet a plane.

    It is NaN for an axis within 0.1 mrad of the plane.
    """
    return _length(on_axis(plane, first) - on_axis(plane, second))


def axis_distance(first: Axis, second: Axis) -> float:
    """Return the distance [mm] between two axes where they were measured (:func:`between_axes`)."""
    return _length(between_axes(first, second))


def point_distance(first: PointLike, second: PointLike) -> float:
    """Return the distance [mm] between two points."""
    return _length(place(first) - place(second))


def point_plane_distance(point: PointLike, plane: Plane) -> float:
    """Return the distance [mm] of a point from a plane, never negative."""
    return abs(float((place(point) - plane.point) @ plane.normal))


def plane_distance(first: Plane, second: Plane, *, nominal: Sequence[Geometry]) -> float:
    """Return the distance [mm] between two planes along their mean normal, through the middle of their nominal points.

    Planes that are not parallel have no single distance. The nominal points define a place that is the same from every
    view.
    """
    near, far = (plane.point for plane in nominal if isinstance(plane, Plane))
    return abs(between_planes(first, second, (near + far) / 2)[0])


def plane_axis_angle(plane: Plane, axis: Axis) -> float:
    """Return the angle [rad], 0 to pi/2, between a plane's normal and an axis: 0 for an axis normal to the plane."""
    return _line_angle(plane.normal, axis.axis)


def axis_angle(first: Axis, second: Axis) -> float:
    """Return the angle [rad], 0 to pi/2, between two axes, regardless of their senses."""
    return _line_angle(first.axis, second.axis)


def plane_angle(first: Plane, second: Plane) -> float:
    """Return the angle [rad], 0 to pi/2, between two planes, regardless of their normals: 60 deg is also 120 deg."""
    return _line_angle(first.normal, second.normal)


def _line_angle(first: Array, second: Array) -> float:
    # the arc cosine would lose half the digits at small angles, which matter most
    return float(np.arctan2(_length(cross(first, second)), abs(first @ second)))


def _length(vector: Array) -> float:
    return math.sqrt(vector.dot(vector))  # np.linalg.norm takes three times as long


def cone_angle(cone: Cone) -> float:
    """Return the full angle [rad] of a cone, twice the half-angle (ISO 3040)."""
    return 2 * cone.half_angle


def radius(feature: Cylinder | Sphere | Circle) -> float:
    """Return the radius [mm]: the least-squares size, not the two-point size of ISO 14405-1."""
    return feature.radius


def diameter(feature: Cylinder | Sphere | Circle) -> float:
    """Return the diameter [mm], twice the :func:`radius`."""
    return 2 * feature.radius


def pose_position(pose: Pose, *, sensor_from_part: ArrayLike, point: ArrayLike) -> float:
    """Return the distance [mm] between the positions of a point (3,) of the part by the fitted and the nominal pose."""
    difference = pose.sensor_from_part - np.asarray(sensor_from_part, float)
    return float(np.linalg.norm(difference[:3, :3] @ np.asarray(point, float) + difference[:3, 3]))


def pose_rotation(pose: Pose, *, sensor_from_part: ArrayLike, point: ArrayLike) -> float:
    """Return the angle [rad], 0 to pi, of the rotation between the fitted and the nominal pose.

    ``point`` has no effect.
    """
    turn = pose.sensor_from_part[:3, :3] @ np.asarray(sensor_from_part, float)[:3, :3].T
    skew = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    return float(np.arctan2(np.linalg.norm(skew), np.trace(turn) - 1.0))


#: kinds of features that are a plane
PLANE = ("plane",)

#: kinds of features that have an axis
AXIS = ("cylinder", "cone")

#: kinds of features that have a point
POINT = ("sphere", "circle", "edge_point", "intersection")

#: kinds of features that have a plane, also one between two others
FLAT = ("plane", "mid_plane")

#: kinds of features that are a surface
SURFACE = ("plane", "cylinder", "sphere", "cone")

MeasurementKind = Literal[
    "intersection_distance",
    "axis_distance",
    "point_distance",
    "point_plane_distance",
    "plane_distance",
    "plane_axis_angle",
    "axis_angle",
    "plane_angle",
    "cone_angle",
    "radius",
    "diameter",
    "position",
    "parallelism",
    "perpendicularity",
    "angularity",
    "coaxiality",
    "symmetry",
    "flatness",
    "cylindricity",
    "pose_position",
    "pose_rotation",
]


@dataclass(frozen=True)
class Definition:
    """Function of a kind of measurement, the kinds of feature that it takes, in order, and its unit in files.

    ``of`` is the argument of the function: the features, the form of the one feature, or the pose fitted to all of
    them. Features of the kinds in ``datums`` may follow, all or none. With ``many``, any number of features of the one
    kind is allowed. ``zone`` values are 0 for a perfect part, and their tolerance is the largest allowed value.
    """

    value: Callable[..., float]
    kinds: tuple[tuple[str, ...], ...]
    unit: Literal["mm", "deg"]
    of: Literal["features", "form", "pose"] = "features"
    needs: tuple[Literal["nominal", "outline"], ...] = ()
    datums: tuple[tuple[str, ...], ...] = ()
    many: bool = False
    zone: bool = False


DEFINITIONS: dict[MeasurementKind, Definition] = {
    "intersection_distance": Definition(intersection_distance, (PLANE, AXIS, AXIS), "mm"),
    "axis_distance": Definition(axis_distance, (AXIS, AXIS), "mm"),
    "point_distance": Definition(point_distance, (POINT, POINT), "mm"),
    "point_plane_distance": Definition(point_plane_distance, (POINT, PLANE), "mm"),
    "plane_distance": Definition(plane_distance, (PLANE, PLANE), "mm", needs=("nominal",)),
    "plane_axis_angle": Definition(plane_axis_angle, (PLANE, AXIS), "deg"),
    "axis_angle": Definition(axis_angle, (AXIS, AXIS), "deg"),
    "plane_angle": Definition(plane_angle, (PLANE, PLANE), "deg"),
    "cone_angle": Definition(cone_angle, (("cone",),), "deg"),
    "radius": Definition(radius, (("cylinder", "sphere", "circle"),), "mm"),
    "diameter": Definition(diameter, (("cylinder", "sphere", "circle"),), "mm"),
    "position": Definition(
        position,
        (FLAT + AXIS + POINT,),
        "mm",
        needs=("nominal", "outline"),
        datums=(FLAT, FLAT + AXIS, FLAT + AXIS),
        zone=True,
    ),
    "parallelism": Definition(parallelism, (FLAT + AXIS, FLAT + AXIS), "mm", needs=("outline",), zone=True),
    "perpendicularity": Definition(perpendicularity, (FLAT + AXIS, FLAT + AXIS), "mm", needs=("outline",), zone=True),
    "angularity": Definition(angularity, (FLAT, FLAT + AXIS), "mm", needs=("nominal", "outline"), zone=True),
    "coaxiality": Definition(coaxiality, (AXIS, AXIS), "mm", needs=("outline",), zone=True),
    "symmetry": Definition(symmetry, (("mid_plane", *AXIS), FLAT), "mm", needs=("outline",), zone=True),
    "flatness": Definition(zone, (PLANE,), "mm", of="form", zone=True),
    "cylindricity": Definition(zone, (("cylinder",),), "mm", of="form", zone=True),
    "pose_position": Definition(pose_position, (SURFACE,), "mm", of="pose", many=True, zone=True),
    "pose_rotation": Definition(pose_rotation, (SURFACE,), "deg", of="pose", many=True, zone=True),
}
