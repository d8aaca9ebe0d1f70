"""Describe values that cannot fall below 0, or exceed 90 deg, by the signed deviations whose size they are.

Signal chain: fitted and nominal features -> deviations (k, m), zero for a nominal part -> size of the deviations, the
value of the measurement.

The value of a zone is the size of a vector: a position is twice the length of an offset. The errors of two captures of
one part add to that vector, not to its size. On a nominal part every error makes the value larger. On a part whose
deviation is much larger than the error, the value is as often too small as too large. So the errors of such a
measurement depend on the deviation of the part, and only their vectors can be carried over from part to part
(:mod:`characterisation.statements.one_sided`).

Deviations are rows of 3-vectors, or of signed distances or angles:

| kind | deviations | size |
|---|---|---|
| position, coaxiality, symmetry | offsets at the places of the outline, or of the point | twice the largest |
| parallelism, perpendicularity to one direction | distances along it | range |
| the same of an axis to a line or a plane | offsets across it | largest distance of two |
| the same of a plane, angularity | distances from the nominal angle | least range over turns about the datum |
| flatness, cylindricity | heights of the form at nodes, and its noise | range, shortened for the noise |
| pose; distances and angles of nominally 0 | the vector, or the signed distance or angle | length |
| angles of nominally 90 deg | signed deviation from 90 deg | 90 deg minus the length |

They are first-order in the angles between the measured and the nominal directions.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from characterisation.features.figures import Circle, EdgePoint
from characterisation.features.form import NODE_SHARES, node_heights, node_modes
from characterisation.features.pose_fit import Pose
from characterisation.features.surfaces import Cone, Cylinder, Plane
from characterisation.features.vectors import unit
from characterisation.tasks.definitions import DEFINITIONS
from characterisation.tasks.places import between_axes, between_planes, direction, on_axis, place
from characterisation.tasks.task_file import AT_FOLD, LINE_ANGLES, Measurement
from characterisation.tasks.zones import datum_motion, feet_on, largest_distance

Array = NDArray[np.float64]
Size = Callable[[Array], Array]

#: distances and angles that are the length of a vector, where their nominal value is 0
LENGTHS = (
    "intersection_distance",
    "axis_distance",
    "point_distance",
    "point_plane_distance",
    "plane_distance",
    *LINE_ANGLES,
)


@dataclass(frozen=True)
class Deviations:
    """Deviations behind a measurement."""

    #: the deviations (k, m) in mm or rad, of the measured features (or form, or pose) and the nominal ones, in one
    #: frame
    of: Callable[[Sequence[Any], Sequence[Any]], Array]
    size: Size  # size (...) of deviations (..., k, m)


def fold_of(asked: Measurement) -> float | None:
    """Return the value at which the values of a measurement fold: 0, 90 (deg), or None for values that do not.

    Zones fold at 0. Distances and angles fold at 0 if they are nominally 0 or their tolerance includes 0, within
    :data:`~characterisation.tasks.task_file.AT_FOLD`. Angles of lines fold at 90 deg likewise.
    """
    if asked.zone or (asked.kind in LENGTHS and (asked.nominal <= AT_FOLD or asked.one_sided)):
        return 0.0
    if asked.folds_at_90 or (asked.kind in LINE_ANGLES and asked.nominal >= 90 - AT_FOLD):
        return 90.0
    return None


def deviations(asked: Measurement, outline: Array, nominal: Sequence[Any], point: Array) -> Deviations:
    """Return the deviations of a measurement that folds (:func:`fold_of`).

    Parameters
    ----------
    asked
        The measurement, from the task file.
    outline
        (k, 3) [mm], part frame.
    nominal
        Nominal features, part frame.
    point
        (3,) [mm] of a pose.
    """
    kind = asked.kind
    if DEFINITIONS[kind].of == "form":
        return Deviations(lambda form, _: node_heights(form[0]), form_size)
    if kind == "pose_position":
        return Deviations(lambda pose, ideal: _pose_shift(pose[0], ideal[0], point), largest)
    if kind == "pose_rotation":
        return Deviations(lambda pose, ideal: _pose_turn(pose[0], ideal[0]), largest)
    if fold_of(asked) == 90.0:
        return Deviations(_from_right_angle, largest)
    if kind in _POINTWISE:
        return Deviations(_POINTWISE[kind], largest)
    if kind in ("position", "coaxiality", "symmetry"):
        return Deviations(lambda fits, ideal: _offsets(kind, fits, ideal, outline), twice_largest)
    if kind == "angularity":
        along, across, sine = _angled(*nominal[:2])
        points = feet_on(nominal[0], outline)
        return Deviations(
            lambda fits, ideal: _angular_heights(fits, ideal, outline),
            least_range(sine * points @ np.cross(along, across)),
        )
    feature, datum = nominal[:2]
    by_height = isinstance(datum, Plane) == (kind == "parallelism")
    if by_height:
        return Deviations(lambda fits, ideal: _heights(fits, ideal, outline), value_range)
    if isinstance(feature, Plane):
        normal = _across(feature.normal, direction(datum))
        sideways = feet_on(feature, outline) @ np.cross(direction(datum), normal)
        return Deviations(lambda fits, ideal: _wall_heights(fits, ideal, outline), least_range(sideways))
    return Deviations(lambda fits, ideal: _offsets_across(fits, ideal, outline), largest_distance)


def largest(rows: Array) -> Array:
    """Return the largest length (...) of the rows of deviations (..., k, m)."""
    return np.asarray(np.sqrt((rows**2).sum(axis=-1)).max(axis=-1))


def twice_largest(rows: Array) -> Array:
    """Return twice the largest length (...) of the rows of deviations (..., k, m)."""
    return 2 * largest(rows)


def value_range(rows: Array) -> Array:
    """Return the range (...) of deviations (..., k, 1)."""
    return np.asarray(np.ptp(rows[..., 0], axis=-1))


def least_range(sideways: Array) -> Size:
    """Return the size of heights (..., k, 1) at places (k,): their least range over all turns of a line through them.

    The range of h + t s is piecewise linear in t, and least where two of the places change order.
    """
    first, second = np.triu_indices(len(sideways), 1)
    apart = sideways[second] - sideways[first]
    distinct = np.abs(apart) > 1e-9

    def size(rows: Array) -> Array:
        heights = rows[..., 0]
        turns = -(heights[..., second] - heights[..., first])[..., distinct] / apart[distinct]
        turned = heights[..., None, :] + turns[..., None] * sideways
        return np.asarray(np.ptp(turned, axis=-1).min(axis=-1) if distinct.any() else np.ptp(heights, axis=-1))

    return size


def form_size(rows: Array) -> Array:
    """Return the zone (...) of heights at nodes (..., k, 1), the last of which is the noise of the form.

    Nodes without points are NaN. The form is shortened so that its mean square is unbiased
    (:mod:`characterisation.features.form`).
    """
    heights, noise = rows[..., :-1, 0], rows[..., -1, 0]
    seen = np.isfinite(heights)
    share = seen * NODE_SHARES
    square = (share * np.where(seen, heights, 0.0) ** 2).sum(axis=-1) / np.maximum(share.sum(axis=-1), 1e-12)
    shortened = np.sqrt(np.maximum(0.0, 1 - noise**2 / np.maximum(square, np.finfo(float).tiny)))
    high = np.where(seen, heights, -np.inf).max(axis=-1)
    low = np.where(seen, heights, np.inf).min(axis=-1)
    return np.asarray(np.where(seen.any(axis=-1), shortened * np.where(seen.any(axis=-1), high - low, 0.0), np.nan))


def form_basis(kind: str) -> Array:
    """Return orthonormal forms (D, k, 1) of a plane or cylinder at the nodes, and 0 for its noise."""
    modes = node_modes(kind)
    return np.concatenate([modes, np.zeros((1, modes.shape[1]))]).T[:, :, None]


def _alike(feature: Any, ideal: Any) -> Any:
    """Return a plane or axis in the sense of its nominal."""
    if not isinstance(feature, Plane | Cylinder | Cone) or direction(feature) @ direction(ideal) >= 0:
        return feature
    return (
        replace(feature, normal=-feature.normal) if isinstance(feature, Plane) else replace(feature, axis=-feature.axis)
    )


def _across(vector: Array, along: Array) -> Array:
    return unit(vector - (vector @ along) * along)


def _offsets(kind: str, fits: Sequence[Any], ideal: Sequence[Any], outline: Array) -> Array:
    """Return offsets (k, 3) of a feature from its nominal place in the frame of the datums, or from a datum."""
    feature, target = fits[0], ideal[0]
    if kind != "position":
        datum = fits[1]
        from_datum = feet_on(feature, outline) - datum.point
        along = direction(datum)
        part = np.outer(from_datum @ along, along)
        return np.asarray(part if isinstance(datum, Plane) else from_datum - part)
    motion = np.eye(4)
    if len(fits) > 1:
        motion = datum_motion(fits[1:], ideal[1:])
    turn, shift = motion[:3, :3], motion[:3, 3]
    if not isinstance(feature, Plane | Cylinder | Cone):
        offset = place(feature) - (turn @ place(target) + shift)
        if isinstance(target, Circle):
            normal = turn @ target.normal
            offset = offset - (offset @ normal) * normal
        if isinstance(target, EdgePoint):
            line = turn @ target.direction
            offset = (offset @ line) * line
        return np.asarray(offset)[None]
    along = turn @ direction(target)
    spots = feet_on(target, outline) @ turn.T + shift
    if isinstance(feature, Plane):
        reach = (spots - feature.point) @ feature.normal / (along @ feature.normal)
        return np.asarray(-reach[:, None] * along)
    return np.array([on_axis(Plane(spot, along), feature) - spot for spot in spots])


def _heights(fits: Sequence[Any], ideal: Sequence[Any], outline: Array) -> Array:
    along = direction(_alike(fits[1], ideal[1]))
    heights = feet_on(fits[0], outline) @ along
    return np.asarray(heights - heights.mean())[:, None]


def _offsets_across(fits: Sequence[Any], ideal: Sequence[Any], outline: Array) -> Array:
    points, along = feet_on(fits[0], outline), direction(fits[1])
    across = points - np.outer(points @ along, along)
    return np.asarray(across - across.mean(axis=0))


def _wall_heights(fits: Sequence[Any], ideal: Sequence[Any], outline: Array) -> Array:
    """Return the heights (k, 1) of a plane over the plane through the datum's direction nearest to it."""
    along, nominal = direction(fits[1]), direction(ideal[1])
    heights = feet_on(fits[0], outline) @ _across(ideal[0].normal, along)
    sideways = feet_on(ideal[0], outline) @ np.cross(nominal, _across(ideal[0].normal, nominal))
    return _without_turn(heights, sideways)


def _angled(feature: Any, datum: Any) -> tuple[Array, Array, float]:
    """Return the direction of a datum, the nominal normal across it, and the sine of the angle of both."""
    along = direction(datum)
    sine = float(np.linalg.norm(np.cross(direction(feature), along)))
    across = _across(direction(feature), along) if sine > 1e-4 else np.zeros(3)
    return along, across, sine


def _angular_heights(fits: Sequence[Any], ideal: Sequence[Any], outline: Array) -> Array:
    along = direction(_alike(fits[1], ideal[1]))
    sine = _angled(*ideal[:2])[2]
    cosine = float(direction(ideal[0]) @ direction(ideal[1]))
    across = _across(direction(ideal[0]), along) if sine > 1e-4 else np.zeros(3)
    heights = feet_on(fits[0], outline) @ (cosine * along + sine * across)
    return _without_turn(heights, feet_on(ideal[0], outline) @ np.cross(*_angled(*ideal[:2])[:2]))


def _without_turn(heights: Array, sideways: Array) -> Array:
    """Return heights (k, 1) at places (k,) less the straight line of least squares through them."""
    line = np.column_stack([np.ones(len(sideways)), sideways])
    return np.asarray(heights - line @ np.linalg.lstsq(line, heights, rcond=None)[0])[:, None]


def _pose_shift(pose: Pose, ideal: Pose, point: Array) -> Array:
    difference = pose.sensor_from_part - ideal.sensor_from_part
    return np.asarray(difference[:3, :3] @ point + difference[:3, 3])[None]


def _pose_turn(pose: Pose, ideal: Pose) -> Array:
    turn = pose.sensor_from_part[:3, :3] @ ideal.sensor_from_part[:3, :3].T
    return np.asarray(Rotation.from_matrix(turn).as_rotvec())[None]


def _from_right_angle(fits: Sequence[Any], ideal: Sequence[Any]) -> Array:
    first, second = (direction(_alike(fit, wanted)) for fit, wanted in zip(fits, ideal, strict=True))
    return np.array([[np.arcsin(np.clip(first @ second, -1.0, 1.0))]])


def _tilt(fits: Sequence[Any], ideal: Sequence[Any]) -> Array:
    """Return the angle (1, 3) [rad] of two lines as a vector across the second."""
    first, second = (direction(_alike(fit, wanted)) for fit, wanted in zip(fits, ideal, strict=True))
    if direction(ideal[0]) @ direction(ideal[1]) < 0:
        second = -second
    across = first - (first @ second) * second
    sine = float(np.linalg.norm(across))
    return np.asarray(across * (np.arctan2(sine, first @ second) / sine if sine > 0 else 1.0))[None]


def _between_planes(fits: Sequence[Any], ideal: Sequence[Any]) -> Array:
    distance, mean = between_planes(fits[0], fits[1], (ideal[0].point + ideal[1].point) / 2)
    return np.array([[distance * (1.0 if mean @ ideal[0].normal >= 0 else -1.0)]])


#: deviations of measurements whose value is the length of one vector
_POINTWISE: dict[str, Callable[[Sequence[Any], Sequence[Any]], Array]] = {
    "intersection_distance": lambda fits, _: (on_axis(fits[0], fits[1]) - on_axis(fits[0], fits[2]))[None],
    "axis_distance": lambda fits, _: between_axes(*fits)[None],
    "point_distance": lambda fits, _: (place(fits[0]) - place(fits[1]))[None],
    "point_plane_distance": lambda fits, ideal: np.array(
        [[(place(fits[0]) - fits[1].point) @ _alike(fits[1], ideal[1]).normal]]
    ),
    "plane_distance": _between_planes,
    "plane_axis_angle": _tilt,
    "axis_angle": _tilt,
    "plane_angle": _tilt,
}
