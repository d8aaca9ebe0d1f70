"""What a stage can show of a part: angles of its axes for a direction, or for a direction and a roll.

Signal chain: axes of the stage, how the part lies on it (TOML) + wanted direction or rotation of each view -> angles
of the axes, within their limits or not -> where the part then lies -> pose of the sensor in the part frame.

The stage frame is that of :class:`~mitsim.views.table.PartStage`. Turned by theta_i about the axes a_i through the
points p_i the part lies at

    stage_from_part(theta) = E_1(theta_1) ... E_k(theta_k) stage_from_part(0),   E_i x = R(a_i, theta_i) (x - p_i) + p_i

(product of exponentials; Murray, Li, Sastry, *A Mathematical Introduction to Robotic Manipulation*, section 3.2). A
direction d, from the target to the sensor in the part frame, is shown where R_1 ... R_k R_0 d = z, R_0 being the
rotation of stage_from_part(0). Two axes have one or two such pairs of angles (Paden and Kahan's second subproblem, the
same, section 3.3.2). Three axes show a rotation Q as well: R_1 R_2 a_3 = Q a_3 gives the first two, and what is left of
Q the third. Where one axis lies along what it should turn, or the first along the third, a choice is left; angles at
the ends of the limits and nearest to zero are tried. Of all solutions within the limits the one of least motion is
taken.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from characterisation.coupon.patches import view_frame
from characterisation.stage.angles import TOLERANCE, about_one, about_two, turned
from mitsim.sensor.preset import Sensor
from mitsim.sensor.transforms import Transform
from mitsim.views.table import PartStage

Floats = NDArray[np.float64]

_Z = np.array([0.0, 0.0, 1.0])

#: angles may pass a limit by this [rad]: rounding
_SLACK = 1e-9

#: angles that show a view to this [rad] go before others that are a little nearer to zero; rad^2 more than any motion
_EXACT, _ROUGH = 1e-10, 1e3


@dataclass(frozen=True)
class Reach:
    """Which of n views a stage can show: ``angles`` (n, axes) [rad], NaN where it cannot, and why not, else ""."""

    angles: Floats
    reasons: list[str]


def stage_from_sensor(sensor: Sensor, distance: float) -> Transform:
    """Where the sensor stands: its reference camera on the stage's z axis, ``distance`` [mm] from the origin.

    A baseline along the view axis gives no direction; the x axis of the camera is taken instead.
    """
    camera = sensor.rig.reference.sensor_from_camera
    axis, baseline = camera.rotation[:, 2], sensor.rig.baseline_direction
    if np.linalg.norm(np.cross(axis, baseline)) < 1e-3:
        baseline = camera.rotation[:, 0]
    rotation = view_frame(axis, baseline)
    return Transform(rotation, distance * _Z - rotation @ camera.translation)


def resting(stage: PartStage, target: Floats) -> Transform:
    """``stage_from_part`` with all axes at zero, for a part that is looked at in ``target`` (3,) [mm]."""
    at_origin = Transform.from_degrees(stage.part_rotation_deg, (0.0, 0.0, 0.0))
    place = -at_origin.points(target) if stage.part_position_mm is None else np.array(stage.part_position_mm)
    return Transform(at_origin.rotation, place)


def stage_from_part(stage: PartStage, target: Floats, angles: Floats) -> Transform:
    """Where the part lies with the axes at angles (axes,) [rad]."""
    out = resting(stage, target)
    for axis, angle in reversed(list(zip(stage.axes, angles, strict=True))):
        rotation = Rotation.from_rotvec(axis.unit() * angle).as_matrix()
        point = np.array(axis.point_mm)
        out = Transform(rotation, point - rotation @ point) @ out
    return out


def reach_directions(stage: PartStage, directions: Floats) -> Reach:
    """Angles of a stage of two axes that show directions (n, 3), unit, part frame; the roll is what it will be."""
    start = directions @ resting(stage, np.zeros(3)).rotation.T
    wanted = np.broadcast_to(_Z, start.shape)
    units = [axis.unit() for axis in stage.axes]

    def error(angles: Floats) -> Floats:
        shown = turned(turned(start, units[1], angles[:, 1]), units[0], angles[:, 0])
        return np.asarray(np.linalg.norm(shown - wanted, axis=1))

    def candidates() -> Iterator[Floats]:
        yield from about_two(start, wanted, *units)
        for first in _fixed(stage, 0, len(start)):
            second = about_one(start, turned(wanted, units[0], -first), units[1])
            yield np.stack([first, second], axis=1)
        for second in _fixed(stage, 1, len(start)):
            first = about_one(turned(start, units[1], second), wanted, units[0])
            yield np.stack([first, second], axis=1)

    return _best(stage, candidates(), error, len(start))


def reach_rotations(stage: PartStage, rotations: Floats) -> Reach:
    """Angles of a stage of three axes that give the part rotations (n, 3, 3) of ``stage_from_part``."""
    wanted = rotations @ resting(stage, np.zeros(3)).rotation.T
    units = [axis.unit() for axis in stage.axes]
    third = np.broadcast_to(units[2], (len(wanted), 3))

    def error(angles: Floats) -> Floats:
        shown = _turns(units[0], angles[:, 0]) @ _turns(units[1], angles[:, 1]) @ _turns(units[2], angles[:, 2])
        return np.asarray(np.abs(shown - wanted).max(axis=(1, 2)))

    def finished(first: Floats, second: Floats) -> Floats:
        rest = _turns(units[1], -second) @ _turns(units[0], -first) @ wanted
        return np.stack([first, second, _angle(rest, units[2])], axis=1)

    def candidates() -> Iterator[Floats]:
        for pair in about_two(third, wanted @ units[2], units[0], units[1]):
            yield finished(pair[:, 0], pair[:, 1])
        for first in _fixed(stage, 0, len(wanted)):
            left = _turns(units[0], -first) @ wanted
            yield finished(first, about_one(third, left @ units[2], units[1]))
        for last in _fixed(stage, 2, len(wanted)):
            left = wanted @ _turns(units[2], -last)  # R_1 R_2, of which the second leaves R_1 a_1 = a_1 alone
            across = np.broadcast_to(units[0], third.shape)
            second = -about_one(across, np.einsum("nji,j->ni", left, units[0]), units[1])
            yield np.stack([_angle(left @ _turns(units[1], -second), units[0]), second, last], axis=1)

    return _best(stage, candidates(), error, len(wanted))


def _fixed(stage: PartStage, number: int, count: int) -> Iterator[Floats]:
    """One axis (count,) at the angle within its limits that is nearest to zero, and at the limits [rad]."""
    low, high = np.radians(stage.axes[number].limits_deg)
    for angle in dict.fromkeys((min(max(0.0, low), high), low, high)):
        yield np.full(count, angle)


def _turns(axis: Floats, angles: Floats) -> Floats:
    """Rotations (n, 3, 3) about a unit axis."""
    return np.asarray(Rotation.from_rotvec(np.nan_to_num(angles)[:, None] * axis).as_matrix())


def _angle(rotations: Floats, axis: Floats) -> Floats:
    """Angle (n,) of rotations (n, 3, 3) about a unit axis that is theirs [rad]."""
    twice_sine = np.stack([rotations[:, i, j] - rotations[:, j, i] for i, j in ((2, 1), (0, 2), (1, 0))], axis=1)
    return np.asarray(np.arctan2(twice_sine @ axis, np.trace(rotations, axis1=1, axis2=2) - 1))


def _best(stage: PartStage, candidates: Iterator[Floats], error: Callable[[Floats], Floats], count: int) -> Reach:
    """Of angles (n, axes) that may do, those of least motion within the limits; else the least beyond, to be told."""
    best = np.full((count, len(stage.axes)), np.nan)
    least, beyond = np.full(count, np.inf), np.full(count, np.inf)
    low, high = np.radians([axis.limits_deg for axis in stage.axes]).T
    for solved in candidates:
        angles = np.stack([axis.nearest(turn) for axis, turn in zip(stage.axes, solved.T, strict=True)], axis=1)
        off = np.where(np.isfinite(angles).all(axis=1), error(np.nan_to_num(angles)), np.inf)
        there = off < TOLERANCE
        excess = np.where(there, np.maximum(low - angles, angles - high).max(axis=1), np.inf)
        excess = np.where(excess < _SLACK, 0.0, excess)
        motion = np.where(off < _EXACT, 0.0, _ROUGH) + (angles**2).sum(axis=1)
        better = there & ((excess < beyond) | ((excess == beyond) & (motion < least)))
        best[better], least[better], beyond[better] = angles[better], motion[better], excess[better]
    reasons = [_reason(stage, angles) if over > 0 else "" for angles, over in zip(best, beyond, strict=True)]
    return Reach(np.where(beyond[:, None] > 0, np.nan, best), reasons)


def _reason(stage: PartStage, angles: Floats) -> str:
    """Why angles (axes,) [rad] are out of reach; NaN where there are none."""
    if not np.isfinite(angles).all():
        return "stage: no angles of its axes show it"
    degrees = np.degrees(angles)
    over = [
        max(axis.limits_deg[0] - turn, turn - axis.limits_deg[1])
        for axis, turn in zip(stage.axes, degrees, strict=True)
    ]
    worst = int(np.argmax(over))
    low, high = stage.axes[worst].limits_deg
    return f"stage: {stage.axes[worst].name} {degrees[worst]:.1f} deg beyond {low:g} to {high:g}"
