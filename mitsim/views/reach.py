"""Angles of a stage's axes that show a direction of the part, or a direction and a roll.

Signal chain: axes of the stage, pose of the part on it (TOML) + direction or rotation of each view -> angles of the
axes, within their limits or not -> pose of the part -> pose of the sensor in the part frame.

The stage frame is that of :class:`~mitsim.views.table.PartStage`. With the angles theta_i about the axes a_i through
the points p_i, the pose of the part is

    stage_from_part(theta) = E_1(theta_1) ... E_k(theta_k) stage_from_part(0),   E_i x = R(a_i, theta_i) (x - p_i) + p_i

(product of exponentials; Murray, Li, Sastry, *A Mathematical Introduction to Robotic Manipulation*, section 3.2). The
stage shows a direction d, from the target to the sensor in the part frame, if R_1 ... R_k R_0 d = z, with R_0 the
rotation of stage_from_part(0). For two axes there are one or two such pairs of angles (Paden and Kahan's second
subproblem, same book, section 3.3.2). Three axes also show a rotation Q: R_1 R_2 a_3 = Q a_3 gives the first two
angles, and the rest of Q the third.

An angle is free if its axis is parallel to the direction it rotates, or if the first axis is parallel to the third.
Then the angle nearest to zero and the limits are tried. Of all solutions within the limits, the one of least motion is
used.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.spatial.transform import Rotation

from characterisation.coupon.view_frame import view_frame
from characterisation.files.arrays import Floats
from characterisation.stage.angles import Reach, about_one, about_two, least_motion, turned
from characterisation.stage.turning_axes import rotation_about
from mitsim.sensor.sensor import Sensor
from mitsim.sensor.transforms import Transform
from mitsim.views.table import PartStage

_Z = np.array([0.0, 0.0, 1.0])


def stage_from_sensor(sensor: Sensor, distance: float) -> Transform:
    """Return the pose of the sensor: reference camera on the stage's z axis, ``distance`` [mm] from the origin.

    A baseline along the view axis defines no direction; the x axis of the camera then replaces it.
    """
    camera = sensor.rig.reference.sensor_from_camera
    axis, baseline = camera.rotation[:, 2], sensor.rig.baseline_direction
    if np.linalg.norm(np.cross(axis, baseline)) < 1e-3:
        baseline = camera.rotation[:, 0]
    rotation = view_frame(axis, baseline)
    return Transform(rotation, distance * _Z - rotation @ camera.translation)


def resting(stage: PartStage, target: Floats) -> Transform:
    """Return ``stage_from_part`` with all axes at zero, for a part with the target ``target`` (3,) [mm]."""
    at_origin = Transform.from_degrees(stage.part_rotation_deg, (0.0, 0.0, 0.0))
    position = -at_origin.points(target) if stage.part_position_mm is None else np.array(stage.part_position_mm)
    return Transform(at_origin.rotation, position)


def stage_from_part(stage: PartStage, target: Floats, angles: Floats) -> Transform:
    """Return the pose of the part with the axes at angles (axes,) [rad]."""
    out = resting(stage, target)
    for axis, angle in reversed(list(zip(stage.axes, angles, strict=True))):
        rotation = Rotation.from_rotvec(axis.unit() * angle).as_matrix()
        point = np.array(axis.point_mm)
        out = Transform(rotation, point - rotation @ point) @ out
    return out


def reach_directions(stage: PartStage, directions: Floats) -> Reach:
    """Return angles of a two-axis stage that show unit directions (n, 3), part frame; the roll follows from them."""
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

    return least_motion(stage.axes, candidates(), error, len(start))


def reach_rotations(stage: PartStage, rotations: Floats) -> Reach:
    """Return angles of a three-axis stage that give the part the rotations (n, 3, 3) of ``stage_from_part``."""
    wanted = rotations @ resting(stage, np.zeros(3)).rotation.T
    units = [axis.unit() for axis in stage.axes]
    third = np.broadcast_to(units[2], (len(wanted), 3))

    def error(angles: Floats) -> Floats:
        first, second, third = (rotation_about(unit, angle) for unit, angle in zip(units, angles.T, strict=True))
        shown = first @ second @ third
        return np.asarray(np.abs(shown - wanted).max(axis=(1, 2)))

    def finished(first: Floats, second: Floats) -> Floats:
        remainder = rotation_about(units[1], -second) @ rotation_about(units[0], -first) @ wanted
        return np.stack([first, second, _angle(remainder, units[2])], axis=1)

    def candidates() -> Iterator[Floats]:
        for pair in about_two(third, wanted @ units[2], units[0], units[1]):
            yield finished(pair[:, 0], pair[:, 1])
        for first in _fixed(stage, 0, len(wanted)):
            left = rotation_about(units[0], -first) @ wanted
            yield finished(first, about_one(third, left @ units[2], units[1]))
        for last in _fixed(stage, 2, len(wanted)):
            left = wanted @ rotation_about(units[2], -last)  # R_1 R_2; the axis a_1 is invariant under R_1
            across = np.broadcast_to(units[0], third.shape)
            second = -about_one(across, np.einsum("nji,j->ni", left, units[0]), units[1])
            yield np.stack([_angle(left @ rotation_about(units[1], -second), units[0]), second, last], axis=1)

    return least_motion(stage.axes, candidates(), error, len(wanted))


def _fixed(stage: PartStage, number: int, count: int) -> Iterator[Floats]:
    """Yield one axis (count,) at the angle within its limits that is nearest to zero, and at the limits [rad]."""
    low, high = np.radians(stage.axes[number].limits_deg)
    for angle in dict.fromkeys((min(max(0.0, low), high), low, high)):
        yield np.full(count, angle)


def _angle(rotations: Floats, axis: Floats) -> Floats:
    """Return the angle (n,) [rad] of rotations (n, 3, 3) about their common unit axis."""
    twice_sine = np.stack([rotations[:, i, j] - rotations[:, j, i] for i, j in ((2, 1), (0, 2), (1, 0))], axis=1)
    return np.asarray(np.arctan2(twice_sine @ axis, np.trace(rotations, axis1=1, axis2=2) - 1))
