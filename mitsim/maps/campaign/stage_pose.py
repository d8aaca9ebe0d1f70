"""Pose of a coupon on a live stage: calibration of the stage as a file, and pose at the angles that were read back.

Signal chain: axes as lines in the sensor's frame and the coupon's pose at zero
(:mod:`characterisation.stage.calibration`) -> ``stage_calibration.json`` -> motion of the axes by the angles read back,
applied to the pose at zero -> ``sensor_from_coupon``.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, model_validator

from characterisation.coupon.view_frame import view_frame
from characterisation.files.arrays import Floats
from characterisation.files.atomic_io import write_json
from characterisation.files.checked_files import read_json_object
from characterisation.files.documents import Document, Name, validate
from characterisation.files.errors import InputError
from characterisation.stage.angles import Stage
from characterisation.stage.calibration import BoardCalibration
from characterisation.stage.turning_axes import TurningAxes
from mitsim.capture.calibration import RigidRows, Row3
from mitsim.capture.devices.stage_connection import StageConnection
from mitsim.sensor.transforms import Transform

#: largest angle between a direction in ``[stage]`` and the calibrated one [deg]; more indicates another axis, or its
#: sign
LARGEST_MISMATCH_DEG = 15.0


class StageTable(Stage):
    """The ``[stage]`` table of a campaign.

    A live stage also has its ``connection`` and its ``calibration``: a file, or one for each of its positions.
    """

    connection: StageConnection | None = None
    calibration: str | Annotated[list[str], Field(min_length=1, max_length=20)] | None = None

    @model_validator(mode="after")
    def _one_stage(self) -> StageTable:
        if self.connection is None:
            return self
        ours, theirs = [axis.name for axis in self.axes], [axis.name for axis in self.connection.axes]
        if ours != theirs:
            raise ValueError(f"connection.axes in the order of the stage's: {', '.join(ours)}, not {', '.join(theirs)}")
        for axis, live in zip(self.axes, self.connection.axes, strict=True):
            low, high = live.limits_deg
            if axis.limits_deg[0] < low or axis.limits_deg[1] > high:
                raise ValueError(f"limits_deg of {axis.name} within those of its connection, {low:g} to {high:g}")
        return self


class AxisLine(Document):
    """An axis with all angles at zero: a line in the sensor's frame."""

    name: Name
    direction: Row3
    point_mm: Row3


class StageCalibrationFile(Document):
    """Content of ``stage_calibration.json``."""

    schema_version: Literal[1]
    axes: Annotated[tuple[AxisLine, ...], Field(min_length=1, max_length=3)]
    sensor_from_coupon: RigidRows

    @model_validator(mode="after")
    def _whole(self) -> StageCalibrationFile:
        if any(np.linalg.norm(axis.direction) < 1e-9 for axis in self.axes):
            raise ValueError("axes with a non-zero direction")
        return self


@dataclass(frozen=True)
class StageCalibration:
    """A calibrated stage with a coupon: ``names`` of its ``axes`` in the sensor's frame, and ``sensor_from_zero``.

    ``sensor_from_zero`` is the coupon's pose with all angles at zero. ``where`` is the file that it was read from;
    ``checksum`` has twelve hexadecimal digits of its content.
    """

    names: tuple[str, ...]
    axes: TurningAxes
    sensor_from_zero: Transform
    where: str
    checksum: str

    def sensor_from_coupon(self, angles: ArrayLike) -> Transform:
        """Return the coupon's pose at angles (axes,) [rad]."""
        motion = self.axes.motion(np.atleast_2d(np.asarray(angles, float)))[0]
        return Transform.from_matrix(motion @ self.sensor_from_zero.matrix())

    def distance(self, eye: Floats) -> float:
        """Return the distance [mm] of the coupon at zero from the reference camera at ``eye`` (3,) [mm]."""
        return float(np.linalg.norm(self.sensor_from_zero.translation - eye))

    def stage(self, table: StageTable, eye: Floats) -> StageTable:
        """Return the ``[stage]`` table with the calibrated axes and normal, in the view frame of the coupon.

        ``eye`` (3,) is the position of the reference camera [mm]. The table's ``calibration`` becomes the checksum of
        this one. Raises InputError if the table defines other axes.
        """
        if tuple(axis.name for axis in table.axes) != self.names:
            allowed = ", ".join(axis.name for axis in table.axes)
            hint = "the axes of the campaign's [stage], in its order"
            raise InputError(self.where, "axes", ", ".join(self.names), allowed, hint)
        zero = self.sensor_from_zero
        ray = zero.translation - eye
        view = view_frame(ray / np.linalg.norm(ray), np.array([1.0, 0.0, 0.0]))
        axes = []
        for number, (axis, direction) in enumerate(zip(table.axes, self.axes.directions, strict=True)):
            direction_seen = view @ direction
            apart = math.degrees(math.acos(np.clip(axis.unit() @ direction_seen, -1, 1)))
            if apart > LARGEST_MISMATCH_DEG:
                field, far = f"axes.{number}.direction", f"{axis.name} {apart:.0f} deg from that of [stage]"
                hint = "another axis, or one that turns the other way: correct [stage], or the gear of its connection"
                raise InputError(self.where, field, far, f"up to {LARGEST_MISMATCH_DEG:g} deg", hint)
            axes.append(axis.model_copy(update={"direction": tuple(map(float, direction_seen))}))
        normal = tuple(map(float, view @ zero.rotation[:, 2]))
        return table.model_copy(update={"axes": axes, "normal": normal, "calibration": self.checksum})


def write_stage_calibration(
    path: str | Path, fit: BoardCalibration, names: Sequence[str], board_from_coupon: Transform | None = None
) -> None:
    """Write a calibration for campaigns, with the coupon's pose at zero.

    ``names`` of the axes are those in the campaign's ``[stage]``. ``board_from_coupon``: the coupon's middle and
    axes on the board, z out of the face toward the sensor; by default the coupon's frame is that of the board.
    """
    coupon = Transform.from_matrix(fit.zero_pose) @ (board_from_coupon or Transform.identity())
    lines = zip(names, fit.axes.directions, fit.axes.points, strict=True)
    table: dict[str, Any] = {
        "schema_version": 1,
        "axes": [{"name": n, "direction": d.tolist(), "point_mm": p.tolist()} for n, d, p in lines],
        "sensor_from_coupon": coupon.matrix().tolist(),
    }
    validate(path, json.loads(json.dumps(table)), StageCalibrationFile)
    write_json(path, table)


def read_stage_calibration(path: str | Path) -> StageCalibration:
    """Read a calibration of :func:`write_stage_calibration`, or one by hand; InputError with the field."""
    table = read_json_object(Path(path), "a stage calibration: see docs/how-to/first-capture.md")
    read = validate(path, table, StageCalibrationFile)
    directions = np.array([axis.direction for axis in read.axes])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    axes = TurningAxes(directions, np.array([axis.point_mm for axis in read.axes]))
    zero = Transform.from_matrix(read.sensor_from_coupon)
    checksum = hashlib.sha256(read.model_dump_json().encode()).hexdigest()[:12]
    return StageCalibration(tuple(axis.name for axis in read.axes), axes, zero, str(path), checksum)
