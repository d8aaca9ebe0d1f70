"""Zones of ISO 1101: how wide the zone is that just holds a fitted plane, axis or point.

They are zones of the fitted feature, not of its points. What the surface's form adds is measured by itself (flatness,
cylindricity). Datums are the fitted planes and axes, where ISO 5459 asks for the surfaces that touch the material from
outside: they differ by the form of the datum.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from characterisation.features.figures import Circle, EdgePoint
from characterisation.features.surfaces import Cone, Cylinder, Plane, unit
from characterisation.tasks.places import PARALLEL, Axis, Geometry, PointLike, direction, intersection, on_axis, place

Array = NDArray[np.float64]
Datum = Plane | Axis

#: sine of the angle within which normals and axes count as parallel: an axis upright on a datum plane, two
#: planes about a middle plane; and least distance of two datum axes [mm]
ASKEW, APART_MM = 0.1, 1.0


def position(feature: Plane | Axis | PointLike, *datums: Datum, nominal: Sequence[Geometry], outline: Array) -> float:
    """Position [mm] in the sense of ISO 1101: size of the zone, which is *twice the offset* from nominal.

    The zone is a sphere about the nominal point for a sphere or an intersection; a cylinder across the face for a
    circle, so that the offset counts within the face; two planes across the line for a point of an edge; a cylinder
    about the nominal axis for an axis, two planes about the nominal plane for a plane, whose offset is the largest over
    its outline.

    With three datums the nominal place is taken in the frame that they make (:func:`datum_motion`). Without datums it
    is taken as the pose of the part has it, and an error of the pose counts.
    """
    target, *others = nominal
    motion = np.eye(4)
    if datums:
        motion = datum_motion(datums, [one for one in others if isinstance(one, Plane | Cylinder | Cone)])
    turn, shift = motion[:3, :3], motion[:3, 3]
    if isinstance(feature, Plane | Cylinder | Cone):
        assert isinstance(target, Plane | Cylinder | Cone)
        along = turn @ direction(target)
        spots = _on(target, outline) @ turn.T + shift
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
    """Rigid motion (4, 4) that takes the frame of three nominal datums to that of the measured ones (ISO 5459).

    The primary is a plane, whose normal is the frame's first axis. Then either two planes: the secondary's normal made
    perpendicular is the second axis, and the origin is the point of all three. Or an axis upright on the primary, which
    stands for its foot there, as that of a cylinder that is held upright, and is the origin; a second such axis, or a
    plane, says how the part is turned about it.
    """
    frames = []
    for datums in (measured, nominal):
        ways = [
            direction(one) * (1.0 if direction(one) @ direction(meant) >= 0 else -1.0)
            for one, meant in zip(datums, nominal, strict=True)
        ]
        primary, secondary, tertiary = datums
        first = ways[0]
        if isinstance(secondary, Plane):
            second, origin = ways[1], intersection([primary, secondary, tertiary]).place
        else:
            origin = secondary.point - ((secondary.point - primary.point) @ first) * first
            second = ways[2] if isinstance(tertiary, Plane) else tertiary.point - origin
        second = unit(second - (second @ first) * first)
        frame = np.eye(4)
        frame[:3, :3] = np.column_stack([first, second, np.cross(first, second)])
        frame[:3, 3] = origin
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


def frame_fault(datums: Sequence[Datum]) -> str:
    """Which three datums are allowed, where these make no frame (:func:`datum_motion`); empty where they do."""
    primary, secondary, tertiary = datums
    if not isinstance(primary, Plane):
        return "a plane as the primary datum"
    if isinstance(secondary, Plane) and isinstance(tertiary, Plane):
        meet = np.isfinite(intersection([primary, secondary, tertiary]).place).all()
        return "" if meet else "three datum planes that meet in one point"
    if isinstance(secondary, Plane):
        return "datums: plane, axis, axis; plane, axis, plane; or three planes"
    for one in (secondary, tertiary):
        sine = float(np.linalg.norm(np.cross(direction(one), primary.normal)))
        if sine < ASKEW if isinstance(one, Plane) else sine > ASKEW:
            return "datum axes that stand upright on the primary plane, and planes that cross it"
    if not isinstance(tertiary, Plane):
        apart = tertiary.point - secondary.point
        if np.linalg.norm(apart - (apart @ primary.normal) * primary.normal) < APART_MM:
            return f"two datum axes that stand {APART_MM:g} mm apart or more"
    return ""


def angularity(feature: Plane, datum: Datum, *, nominal: Sequence[Geometry], outline: Array) -> float:
    """Angularity [mm] (ISO 1101) of a plane: width of the zone at the nominal angle to the datum that holds it.

    The zone is turned about the datum's direction as is best. For the small turn from the fitted plane the width is
    piecewise linear in its angle, and least where two of the places change order.
    """
    target, meant = (direction(one) for one in nominal if isinstance(one, Plane | Cylinder | Cone))
    along = direction(datum) * (1.0 if direction(datum) @ meant >= 0 else -1.0)
    cosine = float(target @ meant)
    sine = float(np.linalg.norm(np.cross(target, meant)))
    normal = feature.normal * (1.0 if feature.normal @ target >= 0 else -1.0)
    away = unit(normal - (normal @ along) * along) if sine > PARALLEL else np.zeros(3)
    places = _on(feature, outline)
    across, turned = places @ (cosine * along + sine * away), sine * (places @ np.cross(along, away))
    first, second = np.triu_indices(len(places), 1)
    change, by_turn = across[second] - across[first], turned[second] - turned[first]
    known = np.abs(by_turn) > 1e-9
    turns = np.append(-change[known] / by_turn[known], 0.0)
    return float(np.ptp(across[:, None] + turns * turned[:, None], axis=0).min())


def coaxiality(feature: Axis, datum: Axis, *, outline: Array) -> float:
    """Coaxiality [mm] (ISO 1101): diameter of the cylinder about the datum axis that holds the axis."""
    from_datum = _on(feature, outline) - datum.point
    across = from_datum - np.outer(from_datum @ datum.axis, datum.axis)
    return 2 * float(np.linalg.norm(across, axis=1).max())


def symmetry(feature: Plane | Axis, datum: Plane, *, outline: Array) -> float:
    """Symmetry [mm] (ISO 1101): distance of the two planes about the datum plane that hold the median plane or axis."""
    return 2 * float(np.abs((_on(feature, outline) - datum.point) @ datum.normal).max())


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
