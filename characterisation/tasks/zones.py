"""Compute zones of ISO 1101: the width of the smallest zone that contains a fitted plane, axis or point.

They are zones of the fitted feature, not of its points; the form of the surface is measured separately (flatness,
cylindricity). Datums are the fitted planes and axes, whereas ISO 5459 uses the surfaces that touch the material from
outside. The two differ by the form of the datum.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from characterisation.features.figures import Circle, EdgePoint
from characterisation.features.surfaces import Cone, Cylinder, Plane
from characterisation.features.vectors import cross, unit
from characterisation.tasks.places import PARALLEL, Axis, Geometry, PointLike, direction, intersection, on_axis, place

Array = NDArray[np.float64]
Datum = Plane | Axis

#: sine of the angle within which normals and axes count as parallel. It applies to an axis perpendicular to a datum
#: plane, and to two planes about a middle plane
ASKEW = 0.1

#: least distance of two datum axes [mm]
APART_MM = 1.0


def position(feature: Plane | Axis | PointLike, *datums: Datum, nominal: Sequence[Geometry], outline: Array) -> float:
    """Return the position [mm] in the sense of ISO 1101: the size of the zone, *twice the offset* from nominal.

    The zone depends on the feature:

    - Sphere or intersection: a sphere about the nominal point.
    - Circle: a cylinder across the face, so that only the offset within the face counts.
    - Point of an edge: two planes across the line.
    - Axis: a cylinder about the nominal axis.
    - Plane: two planes about the nominal plane; the offset is the largest over the outline.

    Parameters
    ----------
    feature
        Fitted feature.
    *datums
        Fitted datums. With three, the nominal place is given in their frame (:func:`datum_motion`). Without datums, it
        is given by the pose of the part, so an error of the pose counts.
    nominal
        Nominal feature, then the nominal datums.
    outline
        (k, 3) [mm], places that span the feature.

    See Also
    --------
    angularity : the zone of a plane at an angle
    """
    target, *nominal_datums = nominal
    motion = np.eye(4)
    if datums:
        motion = datum_motion(datums, [datum for datum in nominal_datums if isinstance(datum, Plane | Cylinder | Cone)])
    turn, shift = motion[:3, :3], motion[:3, 3]
    if isinstance(feature, Plane | Cylinder | Cone):
        assert isinstance(target, Plane | Cylinder | Cone)
        along = turn @ direction(target)
        spots = feet_on(target, outline) @ turn.T + shift
        if isinstance(feature, Plane):
            offsets = (spots - feature.point) @ feature.normal / (along @ feature.normal)
            return 2 * float(np.abs(offsets).max())
        return 2 * max(float(np.linalg.norm(on_axis(Plane(spot, along), feature) - spot)) for spot in spots)
    assert not isinstance(target, Plane | Cylinder | Cone)
    offset = place(feature) - (turn @ place(target) + shift)
    if isinstance(target, Circle):
        offset = offset - (offset @ turn @ target.normal) * (turn @ target.normal)
    if isinstance(target, EdgePoint):
        return 2 * abs(float(offset @ turn @ target.direction))
    return 2 * float(np.linalg.norm(offset))


def datum_motion(measured: Sequence[Datum], nominal: Sequence[Datum]) -> Array:
    """Return the rigid motion (4, 4) from the frame of three nominal datums to that of the measured ones (ISO 5459).

    The primary datum is a plane, and its normal is the first axis of the frame. There are two cases:

    - Two more planes: the second axis is the normal of the secondary, made perpendicular. Both planes keep their
      nominal angles to the frame, and pass through the middle of their points.
    - An axis perpendicular to the primary: it passes through the middle of its points. A second such axis, or a plane,
      determines the rotation about it.
    """
    frames = []
    for datums in (measured, nominal):
        first, *others = (
            direction(datum) * (1.0 if direction(datum) @ direction(ideal) >= 0 else -1.0)
            for datum, ideal in zip(datums, nominal, strict=True)
        )
        _, secondary, tertiary = datums
        if isinstance(secondary, Plane):
            second = others[0]
        else:
            second = others[1] if isinstance(tertiary, Plane) else tertiary.point - secondary.point
        second = unit(second - (second @ first) * first)
        frames.append(np.column_stack([first, second, cross(first, second)]))
    motion = np.eye(4)
    motion[:3, :3] = frames[0] @ frames[1].T
    # the primary places the origin along its normal; the others, in two more directions
    places, ways = [0, 1, 2], np.array([direction(datum) for datum in nominal])
    if not isinstance(nominal[1], Plane):
        places, ways = [0, 1, 1], frames[1].T
    ways = ways @ motion[:3, :3].T
    moves = [measured[place].point - motion[:3, :3] @ nominal[place].point for place in places]
    motion[:3, 3] = np.linalg.solve(ways, np.einsum("ij,ij->i", ways, np.array(moves)))
    return motion


def parallelism(feature: Plane | Axis, datum: Plane | Axis, *, outline: Array) -> float:
    """Return the parallelism [mm] (ISO 1101): width or diameter of the zone that is parallel to the datum.

    The zone depends on the datum and the feature:

    - Datum plane: two planes parallel to it.
    - Datum axis, plane: two planes parallel to the axis, at the angle about it with the least width.
    - Datum axis, axis: a cylinder along the datum axis.
    """
    return _along(feature, datum, outline) if isinstance(datum, Plane) else _across(feature, datum, outline)


def perpendicularity(feature: Plane | Axis, datum: Plane | Axis, *, outline: Array) -> float:
    """Return the perpendicularity [mm] (ISO 1101): width or diameter of the zone at right angles to the datum.

    The zone depends on the datum and the feature:

    - Datum axis: two planes perpendicular to it.
    - Datum plane, plane: two planes perpendicular to the datum, at the angle with the least width.
    - Datum plane, axis: a cylinder perpendicular to the datum.
    """
    return _across(feature, datum, outline) if isinstance(datum, Plane) else _along(feature, datum, outline)


def _along(feature: Plane | Axis, datum: Datum, outline: Array) -> float:
    """Return the range of a feature along the direction of a datum."""
    return float(np.ptp(feet_on(feature, outline) @ direction(datum)))


def _across(feature: Plane | Axis, datum: Datum, outline: Array) -> float:
    """Return the extent of a feature across the direction of a datum."""
    points, along = feet_on(feature, outline), direction(datum)
    across = points - np.outer(points @ along, along)
    return least_width(across, along) if isinstance(feature, Plane) else float(largest_distance(across))


def frame_fault(datums: Sequence[Datum]) -> str:
    """Return the allowed datums where three datums define no frame (:func:`datum_motion`); empty where they do."""
    primary, secondary, tertiary = datums
    if not isinstance(primary, Plane):
        return "a plane as the primary datum"
    if isinstance(secondary, Plane) and isinstance(tertiary, Plane):
        meet = np.isfinite(intersection([primary, secondary, tertiary]).place).all()
        return "" if meet else "three datum planes that meet in one point"
    if isinstance(secondary, Plane):
        return "datums: plane, axis, axis; plane, axis, plane; or three planes"
    for surface in (secondary, tertiary):
        sine = float(np.linalg.norm(np.cross(direction(surface), primary.normal)))
        if sine < ASKEW if isinstance(surface, Plane) else sine > ASKEW:
            return "datum axes perpendicular to the primary plane, and datum planes that cross it"
    if not isinstance(tertiary, Plane):
        apart = tertiary.point - secondary.point
        if np.linalg.norm(apart - (apart @ primary.normal) * primary.normal) < APART_MM:
            return f"two datum axes {APART_MM:g} mm apart or more"
    return ""


def angularity(feature: Plane, datum: Datum, *, nominal: Sequence[Geometry], outline: Array) -> float:
    """Return the angularity [mm] (ISO 1101) of a plane: width of the zone at the nominal angle to the datum.

    The zone is rotated about the direction of the datum to the least width. For small rotations from the fitted plane,
    the width is piecewise linear in the angle, and least where two of the places change order.

    ``feature``, ``datum``: fitted plane and datum. ``nominal``: nominal feature and datum. ``outline``: (k, 3) [mm],
    places that span the feature.
    """
    target, nominal_datum = (direction(surface) for surface in nominal if isinstance(surface, Plane | Cylinder | Cone))
    along = direction(datum) * (1.0 if direction(datum) @ nominal_datum >= 0 else -1.0)
    cosine = float(target @ nominal_datum)
    sine = float(np.linalg.norm(np.cross(target, nominal_datum)))
    normal = feature.normal * (1.0 if feature.normal @ target >= 0 else -1.0)
    away = unit(normal - (normal @ along) * along) if sine > PARALLEL else np.zeros(3)
    points = feet_on(feature, outline)
    across, turned = points @ (cosine * along + sine * away), sine * (points @ np.cross(along, away))
    first, second = np.triu_indices(len(points), 1)
    change, by_turn = across[second] - across[first], turned[second] - turned[first]
    distinct = np.abs(by_turn) > 1e-9
    turns = np.append(-change[distinct] / by_turn[distinct], 0.0)
    return float(np.ptp(across[:, None] + turns * turned[:, None], axis=0).min())


def coaxiality(feature: Axis, datum: Axis, *, outline: Array) -> float:
    """Return the coaxiality [mm] (ISO 1101): diameter of the cylinder about the datum axis that contains the axis."""
    from_datum = feet_on(feature, outline) - datum.point
    across = from_datum - np.outer(from_datum @ datum.axis, datum.axis)
    return 2 * float(np.linalg.norm(across, axis=1).max())


def symmetry(feature: Plane | Axis, datum: Plane, *, outline: Array) -> float:
    """Return the symmetry [mm] (ISO 1101): distance of two planes about the datum plane.

    The planes contain the median plane or axis.
    """
    return 2 * float(np.abs((feet_on(feature, outline) - datum.point) @ datum.normal).max())


def feet_on(feature: Plane | Axis, outline: Array) -> Array:
    """Return the feet (k, 3), on a plane or an axis, of the places that span it."""
    along = direction(feature)
    from_point = np.asarray(outline, float) - feature.point
    part = np.outer(from_point @ along, along)
    feet: Array = feature.point + (from_point - part if isinstance(feature, Plane) else part)
    return feet


def least_width(points: Array, normal: Array) -> float:
    """Return the smallest distance [mm] of two parallel lines with all points (k, 3) between them.

    The points lie in a plane of unit ``normal`` (3,). One of the lines passes through two of the points (Houle and
    Toussaint, IEEE Trans. Pattern Anal. Mach. Intell. 10 (1988) 761-765). A face has few corners, so all pairs are
    tried.
    """
    first, second = np.triu_indices(len(points), 1)
    edges = points[second] - points[first]
    across = np.cross(edges, normal)
    length = np.linalg.norm(across, axis=1)
    across = across[length > 1e-9] / length[length > 1e-9, None]
    return float(np.ptp(points @ across.T, axis=0).min()) if len(across) else 0.0


def largest_distance(points: Array) -> Array:
    """Return the largest distance (...) [mm] between points (..., k, m), the diameter of their zone."""
    apart = points[..., :, None, :] - points[..., None, :, :]
    return np.asarray(np.sqrt((apart**2).sum(axis=-1)).max(axis=(-2, -1)))
