"""Generate candidate views, within the reach of a stage and clear of the part.

Signal chain: vertices of a subdivided icosahedron above the horizon x rolls -> angles of the stage, if there is one ->
pose of the sensor at each standoff -> shift outward along its axis, if its body is too near to the part -> views, and
excluded views with the reason.

The talk of Kinnell and Justham (2018; slide *Viewpoint Scoring*, step 1) generates its candidates in the same way: a
sub-divided icosahedron, and reachability by the tilt table.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from characterisation.coupon.orientations import sphere_directions
from characterisation.features.vectors import unit
from characterisation.files.arrays import Floats
from characterisation.files.errors import InputError
from characterisation.words.progress import track_if_long
from mitsim.sensor.sensor import Sensor
from mitsim.sensor.transforms import Transform, look_at
from mitsim.sensor.working_volume import in_image
from mitsim.views.collision import BodyBox, Obstacle, is_inside, is_near, obstacle, sensor_box
from mitsim.views.reach import reach_directions, reach_rotations, stage_from_part, stage_from_sensor
from mitsim.views.table import PartStage, ViewsTable

#: step by which a sensor that is too near is moved out [mm]
STEP_MM = 10.0

#: largest distance between a target on the view axis and the axis [mm]
_ON_AXIS_MM = 1e-6


@dataclass(frozen=True)
class View:
    """One candidate: a pose of the sensor that looks at the part.

    ``direction`` (3,) is a unit vector in the part frame, from the target back along the axis of the reference camera;
    ``roll_deg`` is the rotation about it. ``standoff`` is the distance of the target along that axis [mm].
    ``world_from_sensor`` is the pose; the world is the part frame.

    On a stage there are also ``stage_angles`` (axes,) [rad], and ``stage_distance`` [mm] of the reference camera from
    the origin of the stage frame. This is the standoff if the stage rotates the part about the target. Without a stage
    both are None.
    """

    number: int
    direction: Floats
    roll_deg: float
    standoff: float
    world_from_sensor: Transform
    stage_angles: Floats | None = None
    stage_distance: float | None = None

    @property
    def elevation_deg(self) -> float:
        """Return the angle above the plane z = 0 of the part [deg]."""
        return math.degrees(math.asin(float(np.clip(self.direction[2], -1, 1))))

    @property
    def azimuth_deg(self) -> float:
        """Return the angle about the part's z axis from x [deg]."""
        return math.degrees(math.atan2(self.direction[1], self.direction[0]))


@dataclass(frozen=True)
class LeftOut:
    """An impossible view: ``direction`` (3,), ``roll_deg`` (NaN if not determined by stage angles), and the reason.

    ``standoff`` [mm] is the requested one; on a stage it is the distance of the reference camera from the stage's
    origin.
    """

    direction: Floats
    roll_deg: float
    standoff: float
    reason: str


@dataclass(frozen=True)
class Candidates:
    """The views, numbered from 0, the excluded views, the number ``moved_out``, and the ``target`` (3,) [mm]."""

    views: list[View]
    left_out: list[LeftOut]
    moved_out: int
    target: Floats


@dataclass(frozen=True)
class _Sight:
    """A direction and a roll without a standoff; ``pose`` for a distance [mm], or the ``reason`` for none."""

    direction: Floats
    roll_deg: float
    pose: Callable[[float], Transform]
    angles: Floats | None = None
    reason: str = ""


def candidate_views(
    table: ViewsTable,
    sensor: Sensor,
    standoffs: Sequence[float],
    centre: NDArray[np.floating],
    triangles: NDArray[np.floating],
    range_mm: tuple[float, float] | None = None,
    where: str | Path = "views",
) -> Candidates:
    """Return all views of a table: directions from the zenith down, for each all rolls, for each roll all standoffs.

    If the body of the sensor is too near to the part, the sensor is moved out in steps of :data:`STEP_MM` until it is
    free. Raises InputError if no view is possible.

    Parameters
    ----------
    table, where, sensor
        Table ``[views]``, and its file, for error messages; sensor with its working range and its body.
    standoffs
        [mm], ascending: distance of the target, on a stage of its origin, from the reference camera along its axis.
    centre, triangles
        (3,) [mm] target if the table has none; (n, 3, 3) [mm], part frame: surfaces that the sensor's body must not
        touch (:func:`mitsim.scene.ray_casting.triangles.triangles`).
    range_mm
        Range in which the target must lie; default the sensor's working range. A view is moved out neither beyond it
        nor as far as the next standoff, which is a separate view.
    """
    target = np.asarray(table.target_mm if table.target_mm is not None else centre, float)
    near, far = range_mm or sensor.working_range_mm
    part, box = obstacle(np.asarray(triangles, float)), sensor_box(sensor, table.sensor_body)

    def placed(sight: _Sight, standoff: float, end: float) -> View | str:
        """Return the view, without a number yet, or the reason why it is impossible."""
        if sight.reason:
            return sight.reason
        steps = np.concatenate([[standoff], np.arange(standoff + STEP_MM, end, STEP_MM)])
        pose = sight.pose(standoff)
        distance = _first_free(part, box, table.clearance_mm, sensor, pose, steps)
        if math.isnan(distance):
            position = f"within {table.clearance_mm:g} mm of the part or inside it, as far out as {steps[-1]:g} mm"
            return f"collision: the body of the sensor is {position}"
        if distance != standoff:
            pose = sight.pose(distance)
        if sight.angles is None:
            return View(-1, sight.direction, sight.roll_deg, distance, pose)
        depth, reason = _depth(sensor, pose.inverse().points(target), distance, (near, far))
        return reason or View(-1, sight.direction, sight.roll_deg, depth, pose, sight.angles, distance)

    views: list[View] = []
    left_out: list[LeftOut] = []
    moved_out = 0
    ends = [*standoffs[1:], math.nextafter(far, math.inf)]
    for sight in track_if_long(_sights(table, sensor, target), "candidate views"):
        for standoff, end in zip(standoffs, ends, strict=True):
            outcome = placed(sight, standoff, end)
            if isinstance(outcome, str):
                left_out.append(LeftOut(sight.direction, sight.roll_deg, standoff, outcome))
                continue
            views.append(replace(outcome, number=len(views)))
            moved_out += (outcome.standoff if outcome.stage_distance is None else outcome.stage_distance) > standoff
    if not views:
        raise _no_views_error(where, left_out)
    return Candidates(views, left_out, moved_out, target)


def _no_views_error(where: str | Path, left_out: list[LeftOut]) -> InputError:
    """Return the error for a table without possible views: their number, and the reason of the first."""
    if not left_out:
        hint = "a finer icosahedron has more directions near the zenith"
        return InputError(where, "views.lowest_elevation_deg", "no direction above it", "at least one", hint)
    views = f"{len(left_out)} views, all of them impossible"
    return InputError(where, "views", views, "at least one", f"the first: {left_out[0].reason}")


def directions_above(table: ViewsTable) -> Floats:
    """Return the unit directions (n, 3) of a table, part frame, above its lowest elevation, from the zenith down."""
    directions = sphere_directions(table.subdivisions)
    height = directions @ unit(table.up)
    keep = height >= math.sin(math.radians(table.lowest_elevation_deg)) - 1e-9
    directions, height = directions[keep], height[keep]
    order = np.lexsort((np.arctan2(directions[:, 1], directions[:, 0]), -np.round(height, 9)))
    return np.asarray(directions[order])


def _free_pose(
    table: ViewsTable, sensor: Sensor, target: Floats, direction: Floats, roll_deg: float, distance: float
) -> Transform:
    """Return the pose of a sensor without a stage."""
    up = unit(table.up)
    # a roll of 0 at the zenith has the baseline along x
    forward = np.array([0.0, 1.0, 0.0]) if abs(up[1]) < 0.9 else np.array([0.0, 0.0, 1.0])
    reference = forward if direction @ up > 1 - 1e-6 else up
    camera = sensor.rig.reference.sensor_from_camera
    return look_at(target + distance * direction, target, reference, roll_deg) @ camera.inverse()


def _stage_pose(stage: PartStage, sensor: Sensor, target: Floats, angles: Floats, distance: float) -> Transform:
    """Return the pose of the sensor relative to a part that a stage has rotated."""
    return stage_from_part(stage, target, angles).inverse() @ stage_from_sensor(sensor, distance)


def _sights(table: ViewsTable, sensor: Sensor, target: Floats) -> list[_Sight]:
    """Return directions and rolls of a table, with stage angles if it has a stage."""
    directions, stage = directions_above(table), table.stage
    if stage is not None and len(stage.axes) == 2:
        reach = reach_directions(stage, directions)
        sights = []
        for direction, angles, reason in zip(directions, reach.angles, reach.reasons, strict=True):
            pose = partial(_stage_pose, stage, sensor, target, angles)
            upright = _free_pose(table, sensor, target, direction, 0.0, 1.0)
            roll = math.nan if reason else _roll_deg(sensor, upright, pose(1.0))
            sights.append(_Sight(direction, roll, pose, angles, reason))
        return sights
    asked = [(direction, roll) for direction in directions for roll in table.rolls_deg]
    free = [_Sight(*pair, partial(_free_pose, table, sensor, target, *pair)) for pair in asked]
    if stage is None or not free:
        return free
    turns = stage_from_sensor(sensor, 1.0).rotation @ np.stack([sight.pose(1.0).rotation.T for sight in free])
    reach = reach_rotations(stage, turns)
    return [
        replace(sight, pose=partial(_stage_pose, stage, sensor, target, angles), angles=angles, reason=reason)
        for sight, angles, reason in zip(free, reach.angles, reach.reasons, strict=True)
    ]


def _roll_deg(sensor: Sensor, upright: Transform, turned: Transform) -> float:
    """Return the rotation of a pose from another about the axis of the reference camera, within -180 to 180 [deg]."""
    camera = sensor.rig.reference.sensor_from_camera
    turn = (upright @ camera).rotation.T @ (turned @ camera).rotation
    roll = round(math.degrees(math.atan2(turn[1, 0], turn[0, 0])), 6) + 0.0  # so that equal rolls compare equal
    return 180.0 if roll == -180 else roll


def _depth(sensor: Sensor, target: Floats, distance: float, range_mm: tuple[float, float]) -> tuple[float, str]:
    """Return the depth [mm] of a target (3,), sensor frame, on the axis of the reference camera, and any fault."""
    camera = sensor.rig.reference
    across, down, depth = (float(value) for value in camera.sensor_from_camera.inverse().points(target))
    beside = math.hypot(across, down)
    if beside < _ON_AXIS_MM and abs(depth - distance) < _ON_AXIS_MM:
        return distance, ""
    if range_mm[0] <= depth <= range_mm[1] and bool(in_image(camera, target)):
        return depth, ""
    position = f"{depth:.0f} mm deep and {beside:.0f} mm off the axis"
    return depth, f"stage: the target is {position}, outside the image or the range"


def _first_free(
    part: Obstacle, box: BodyBox, clearance: float, sensor: Sensor, nearest: Transform, distances: Floats
) -> float:
    """Return the first of ascending distances [mm] with a free body, NaN if none; ``nearest`` is the first pose."""
    outward = -(nearest @ sensor.rig.reference.sensor_from_camera).rotation[:, 2]
    inside: bool | None = None  # None: unknown. Between two free steps the body does not cross the surface
    for distance in distances.tolist():
        pose = Transform(nearest.rotation, nearest.translation + (distance - distances[0]) * outward)
        if is_near(part, box, pose, clearance):
            inside = None
            continue
        if inside is None:
            inside = is_inside(part, pose.points(box.centre))
        if not inside:
            return float(distance)
    return math.nan
