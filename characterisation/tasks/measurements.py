"""What can be measured on features: distances, angles, sizes, and the zones of ISO 1101.

Every measurement is a function of features in one frame; it returns mm or rad. Some ask for more than the features as
they were found: ``nominal``, the same features where the drawing has them, in the same frame, and ``outline`` (k, 3)
[mm], places that span the first feature there (the corners of a face, the ends of an axis). :data:`DEFINITIONS` says
which kinds of feature, in which order, and what else.

Zones (ISO 1101) are those of the fitted feature, not of its points: the width or diameter of the zone that
would just hold the plane or the axis over its extent. What the surface's form adds is measured by itself (flatness,
cylindricity). Datums are the fitted planes and axes, where ISO 5459 asks for the surfaces that touch the material from
outside: they differ by the form of the datum.

Measurements of near-parallel features are taken at a stated place, so that they stay well-conditioned: the shortest
distance between skew lines, the usual definition, is taken where the lines pass nearest, and for near-parallel axes
that place, and so the distance, hangs on the noise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from characterisation.features.figures import Circle, EdgePoint, Point
from characterisation.features.form import zone
from characterisation.features.pose_fit import Pose
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


def intersection_distance(plane: Plane, first: Axis, second: Axis) -> float:
    """Distance [mm] between the points where two axes meet a plane; NaN for an axis within 0.1 mrad of the plane."""
    return float(np.linalg.norm(_on_axis(plane, first) - _on_axis(plane, second)))


def _on_axis(plane: Plane, axis: Axis) -> Array:
    """Where an axis meets a plane (3,) [mm]."""
    climb = float(axis.axis @ plane.normal)
    if abs(climb) < PARALLEL:
        return np.full(3, np.nan)
    met: Array = axis.point + ((plane.point - axis.point) @ plane.normal / climb) * axis.axis
    return met


def axis_distance(first: Axis, second: Axis) -> float:
    """Distance [mm] between two axes where they were measured.

    It is taken in the plane perpendicular to the mean axis through the middle of the two axis points (for fits, the
    points abreast of the measured points).
    """
    other = second.axis if first.axis @ second.axis >= 0 else -second.axis
    mean = first.axis + other
    plane = Plane((first.point + second.point) / 2, mean / np.linalg.norm(mean))
    return intersection_distance(plane, first, second)


def point_distance(first: PointLike, second: PointLike) -> float:
    """Distance [mm] between two points."""
    return float(np.linalg.norm(place(first) - place(second)))


def point_plane_distance(point: PointLike, plane: Plane) -> float:
    """Distance [mm] of a point from a plane, on whichever side."""
    return abs(float((place(point) - plane.point) @ plane.normal))


def plane_distance(first: Plane, second: Plane, *, nominal: Sequence[Geometry]) -> float:
    """Distance [mm] between two planes along their mean normal, through the middle of their nominal points.

    Planes that are not parallel have no distance as a whole; a stated place makes one, the same from every view.
    """
    near, far = (one.point for one in nominal if isinstance(one, Plane))
    other = second.normal if first.normal @ second.normal >= 0 else -second.normal
    mean, middle = unit(first.normal + other), (near + far) / 2
    heights = [(one.point - middle) @ one.normal / (mean @ one.normal) for one in (first, second)]
    return abs(float(heights[0] - heights[1]))


def plane_axis_angle(plane: Plane, axis: Axis) -> float:
    """Angle [rad], 0 to pi/2, between a plane's normal and an axis: 0 where the axis is normal to the plane."""
    return _line_angle(plane.normal, axis.axis)


def axis_angle(first: Axis, second: Axis) -> float:
    """Angle [rad], 0 to pi/2, between two axes, whichever way they run."""
    return _line_angle(first.axis, second.axis)


def plane_angle(first: Plane, second: Plane) -> float:
    """Angle [rad], 0 to pi/2, between two planes, whichever way their normals point: 60 deg is also 120 deg."""
    return _line_angle(first.normal, second.normal)


def _line_angle(first: Array, second: Array) -> float:
    # the arc cosine would lose half the digits at the small angles that matter most
    return float(np.arctan2(np.linalg.norm(np.cross(first, second)), abs(first @ second)))


def cone_angle(cone: Cone) -> float:
    """Full angle [rad] of a cone, twice the half-angle (ISO 3040)."""
    return 2 * cone.half_angle


def radius(feature: Cylinder | Sphere | Circle) -> float:
    """Radius [mm]: the least-squares size, not the two-point size of ISO 14405-1."""
    return feature.radius


def diameter(feature: Cylinder | Sphere | Circle) -> float:
    """Diameter [mm], twice the :func:`radius`."""
    return 2 * feature.radius


def position(feature: Axis | PointLike, *datums: Plane, nominal: Sequence[Geometry], outline: Array) -> float:
    """Position [mm] in the sense of ISO 1101: size of the zone, which is *twice the offset* from nominal.

    The zone is a sphere about the nominal point for a sphere or an intersection; a cylinder across the face for a
    circle, so that the offset counts within the face; two planes across the line for a point of an edge; a cylinder
    about the nominal axis for an axis, whose offset is the largest over its outline.

    With three datum planes the nominal place is taken in the frame that they make, primary, secondary and tertiary in
    this order (ISO 5459). Without datums it is taken as the pose of the part has it, and an error of the pose counts.
    """
    target, *planes = nominal
    motion = np.eye(4)
    if datums:
        motion = datum_motion(datums, [one for one in planes if isinstance(one, Plane)])
    turn, shift = motion[:3, :3], motion[:3, 3]
    if isinstance(feature, Cylinder | Cone):
        assert isinstance(target, Cylinder | Cone)
        along = turn @ target.axis
        offsets = [
            float(np.linalg.norm(_on_axis(Plane(spot, along), feature) - spot))
            for spot in _on(target, outline) @ turn.T + shift
        ]
        return 2 * float(np.max(offsets))
    assert not isinstance(target, Plane | Cylinder | Cone)
    offset = place(feature) - (turn @ place(target) + shift)
    if isinstance(target, Circle):
        offset = offset - (offset @ turn @ target.normal) * (turn @ target.normal)
    if isinstance(target, EdgePoint):
        return 2 * abs(float(offset @ turn @ target.direction))
    return 2 * float(np.linalg.norm(offset))


def datum_motion(measured: Sequence[Plane], nominal: Sequence[Plane]) -> Array:
    """Rigid motion (4, 4) that takes the frame of three nominal datum planes to that of the measured ones.

    The frame's first axis is the primary plane's normal, the second the secondary's made perpendicular to it, and its
    origin the point of all three.
    """
    frames = []
    for planes in (measured, nominal):
        normals = [
            one.normal * (1.0 if one.normal @ meant.normal >= 0 else -1.0)
            for one, meant in zip(planes, nominal, strict=True)
        ]
        first = normals[0]
        second = unit(normals[1] - (normals[1] @ first) * first)
        frame = np.eye(4)
        frame[:3, :3] = np.column_stack([first, second, np.cross(first, second)])
        frame[:3, 3] = intersection(planes).place
        frames.append(frame)
    motion: Array = frames[0] @ np.linalg.inv(frames[1])
    return motion


def parallelism(feature: Plane | Axis, datum: Plane | Axis, *, outline: Array) -> float:
    """Parallelism [mm] (ISO 1101): width or diameter of the zone parallel to the datum that holds the feature.

    Two planes parallel to a datum plane; two planes parallel to a datum axis, turned about it as is best, for a plane;
    a cylinder along a datum axis for an axis.
    """
    places, along = _on(feature, outline), direction(datum)
    if isinstance(datum, Plane):
        return float(np.ptp(places @ along))
    across = places - np.outer(places @ along, along)
    return least_width(across, along) if isinstance(feature, Plane) else largest_distance(across)


def perpendicularity(feature: Plane | Axis, datum: Plane | Axis, *, outline: Array) -> float:
    """Perpendicularity [mm] (ISO 1101): width or diameter of the zone at right angles to the datum.

    Two planes across a datum axis; two planes upright on a datum plane, turned as is best, for a plane; a cylinder
    upright on a datum plane for an axis.
    """
    places, along = _on(feature, outline), direction(datum)
    if not isinstance(datum, Plane):
        return float(np.ptp(places @ along))
    across = places - np.outer(places @ along, along)
    return least_width(across, along) if isinstance(feature, Plane) else largest_distance(across)


def _on(feature: Plane | Axis, outline: Array) -> Array:
    """Feet (k, 3) on a plane or an axis of the places that span it."""
    along = direction(feature)
    from_point = np.asarray(outline, float) - feature.point
    part = np.outer(from_point @ along, along)
    feet: Array = feature.point + (from_point - part if isinstance(feature, Plane) else part)
    return feet


def least_width(places: Array, normal: Array) -> float:
    """Smallest distance [mm] of two parallel lines that hold all places (k, 3) in a plane of unit ``normal`` (3,).

    One of the lines passes through two of the places (Houle and Toussaint, IEEE Trans. Pattern Anal. Mach. Intell. 10
    (1988) 761-765); with the few corners of a face all pairs are tried.
    """
    first, second = np.triu_indices(len(places), 1)
    edges = places[second] - places[first]
    across = np.cross(edges, normal)
    length = np.linalg.norm(across, axis=1)
    across = across[length > 1e-9] / length[length > 1e-9, None]
    return float(np.ptp(places @ across.T, axis=0).min()) if len(across) else 0.0


def largest_distance(places: Array) -> float:
    """Largest distance [mm] between two of the places (k, 3): the diameter of the zone that holds a line's feet."""
    return float(np.linalg.norm(places[:, None] - places[None], axis=-1).max())


def pose_position(pose: Pose, *, sensor_from_part: ArrayLike, point: ArrayLike) -> float:
    """Distance [mm] between where a point (3,) of the part is by the fitted pose, and by the one that is meant."""
    difference = pose.sensor_from_part - np.asarray(sensor_from_part, float)
    return float(np.linalg.norm(difference[:3, :3] @ np.asarray(point, float) + difference[:3, 3]))


def pose_rotation(pose: Pose, *, sensor_from_part: ArrayLike, point: ArrayLike) -> float:
    """Angle [rad], 0 to pi, of the rotation between the fitted pose and the one that is meant; no point matters."""
    turn = pose.sensor_from_part[:3, :3] @ np.asarray(sensor_from_part, float)[:3, :3].T
    skew = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    return float(np.arctan2(np.linalg.norm(skew), np.trace(turn) - 1.0))


PLANE, AXIS, POINT = ("plane",), ("cylinder", "cone"), ("sphere", "circle", "edge_point", "intersection")
SURFACE = ("plane", "cylinder", "sphere", "cone")

MeasurementKind = Literal[
    "intersection_distance", "axis_distance", "point_distance", "point_plane_distance", "plane_distance",
    "plane_axis_angle", "axis_angle", "plane_angle", "cone_angle", "radius", "diameter", "position", "parallelism",
    "perpendicularity", "flatness", "cylindricity", "pose_position", "pose_rotation",
]  # fmt: skip


@dataclass(frozen=True)
class Definition:
    """What a kind of measurement computes, on which kinds of feature in which order, and the unit in files.

    ``of`` says what the value is a function of: the features, the form of the one feature, or the pose by all of them.
    ``datums`` kinds of feature may follow, all or none; with ``many`` any number of features of the one kind. ``zone``
    values are 0 for a perfect part, and their tolerance is the largest that is allowed.
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
        position, (AXIS + POINT,), "mm", needs=("nominal", "outline"), datums=(PLANE, PLANE, PLANE), zone=True
    ),
    "parallelism": Definition(parallelism, (PLANE + AXIS, PLANE + AXIS), "mm", needs=("outline",), zone=True),
    "perpendicularity": Definition(perpendicularity, (PLANE + AXIS, PLANE + AXIS), "mm", needs=("outline",), zone=True),
    "flatness": Definition(zone, (PLANE,), "mm", of="form", zone=True),
    "cylindricity": Definition(zone, (("cylinder",),), "mm", of="form", zone=True),
    "pose_position": Definition(pose_position, (SURFACE,), "mm", of="pose", many=True, zone=True),
    "pose_rotation": Definition(pose_rotation, (SURFACE,), "deg", of="pose", many=True, zone=True),
}
