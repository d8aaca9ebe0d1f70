"""The ``[views]`` table of a study: candidate views, the stage that shows them, and the body of the sensor."""

from __future__ import annotations

import itertools
import math
from typing import Annotated

import numpy as np
from pydantic import Field, model_validator

from characterisation.files.documents import Document
from characterisation.stage.angles import StageAxis
from mitsim.sensor.transforms import Transform, is_rotation

#: margin around the eyes of a sensor whose body is unknown [mm]; *assumed*
MARGIN_MM = 30.0

#: largest deviation of a written rotation from a rotation: six digits, or a rounded hand-eye result
ROUNDED = 1e-3

Standoff = Annotated[float, Field(ge=50, le=20000)]
Place = Annotated[float, Field(ge=-1e5, le=1e5)]
Side = Annotated[float, Field(ge=10, le=5000)]
Point = tuple[Place, Place, Place]
Row = tuple[float, float, float, float]


class PartAxis(StageAxis):
    """One axis of a stage that carries a part; ``point_mm`` is a point on it in the stage frame, at zero angles."""

    point_mm: Point = (0.0, 0.0, 0.0)


class PartStage(Document):
    """The ``[views.stage]`` table: a stage rotates the part in front of a fixed sensor.

    Everything is given in the stage frame, which is the view frame of a campaign's ``[stage]``. Its origin is the point
    that the reference camera looks at; z points from there to the camera, x along the baseline, y = z cross x (up in
    the image). The first axis is fixed to the ground; the last carries the part. With all axes at zero, the part is
    rotated by ``part_rotation_deg`` about fixed x, then y, then z, and its origin is at ``part_position_mm``. The
    default position puts the target at the origin of the stage frame.
    """

    axes: Annotated[list[PartAxis], Field(min_length=2, max_length=3)]
    part_rotation_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    part_position_mm: Point | None = None

    @model_validator(mode="after")
    def _named(self) -> PartStage:
        names = [axis.name for axis in self.axes]
        if len(set(names)) < len(names) or not all(name.strip() for name in names):
            raise ValueError("axes with different names, since stage.csv has a column for each")
        return self


class SensorBody(Document):
    """The ``[views.sensor_body]`` table: a box around the sensor, parallel to the axes of the sensor frame.

    It has either its ``size_mm`` along x, y, z and its ``centre_mm`` (default: the middle of the eyes), or the
    ``margin_mm`` by which it extends beyond the apertures of all cameras and the projector on every side.
    """

    size_mm: tuple[Side, Side, Side] | None = None
    centre_mm: Point | None = None
    margin_mm: Annotated[float, Field(ge=5, le=1000)] | None = None

    @model_validator(mode="after")
    def _one(self) -> SensorBody:
        if self.size_mm is not None and self.margin_mm is not None:
            raise ValueError("either size_mm or margin_mm, not both")
        if self.size_mm is None and self.centre_mm is not None:
            raise ValueError("size_mm together with centre_mm")
        return self


class FlangeFromSensor(Document):
    """The ``[views.flange_from_sensor]`` table: pose of the sensor on a robot's flange, from hand-eye calibration.

    It takes coordinates in the sensor frame to coordinates in the flange frame. It is either ``matrix``, four rows of
    four, or ``position_mm`` of the sensor frame's origin with ``quaternion_xyzw``.
    """

    matrix: tuple[Row, Row, Row, Row] | None = None
    position_mm: Point | None = None
    quaternion_xyzw: Row | None = None

    @model_validator(mode="after")
    def _rigid(self) -> FlangeFromSensor:
        if (self.matrix is None) == (self.position_mm is None or self.quaternion_xyzw is None) or (
            self.matrix is not None and (self.position_mm, self.quaternion_xyzw) != (None, None)
        ):
            raise ValueError("either matrix, or position_mm and quaternion_xyzw")
        if self.quaternion_xyzw is not None and abs(math.hypot(*self.quaternion_xyzw) - 1) > ROUNDED:
            raise ValueError("a quaternion of length 1, in the order x, y, z, w")
        if self.matrix is not None:
            if not is_rotation(np.array(self.matrix)[:3, :3], ROUNDED):
                raise ValueError("a rigid motion, whose first three rows and columns are a right-handed rotation")
            if self.matrix[3] != (0, 0, 0, 1):
                raise ValueError("rows of a homogeneous matrix, with the last row [0, 0, 0, 1]")
        return self

    def transform(self) -> Transform:
        """Return the motion, with the nearest exact rotation."""
        from scipy.spatial.transform import Rotation

        if self.matrix is not None:
            matrix = np.array(self.matrix)
            u, _, v = np.linalg.svd(matrix[:3, :3])  # the nearest rotation
            return Transform(u @ v, matrix[:3, 3].copy())
        assert self.position_mm is not None and self.quaternion_xyzw is not None  # as validated above
        return Transform(Rotation.from_quat(self.quaternion_xyzw).as_matrix(), np.array(self.position_mm))


class ViewsTable(Document):
    """The ``[views]`` table of a study: directions, standoffs and rolls of the candidate views.

    The directions are the vertices of a subdivided icosahedron above the horizon. The sensor looks at ``target_mm``
    (default: the middle of the scene) from ``standoff_mm``, |V| along the axis of its reference camera, or from each of
    ``standoffs_mm``. The default standoff is the nearest at which the whole part can be measured. A roll rotates the
    sensor, and so its baseline, about that axis. On a ``stage`` of two axes the direction determines the roll, so
    ``rolls_deg`` needs three axes or no stage. The part stays at least ``clearance_mm`` away from the ``sensor_body``.
    """

    subdivisions: int = Field(default=2, ge=0, le=4)
    standoff_mm: Standoff | None = None
    standoffs_mm: Annotated[list[Standoff], Field(min_length=1)] | None = None
    rolls_deg: list[Annotated[float, Field(ge=-360, le=360)]] = Field(min_length=1, default_factory=lambda: [0.0])
    lowest_elevation_deg: Annotated[float, Field(ge=-90, lt=90)] = 10.0
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    target_mm: tuple[float, float, float] | None = None
    stage: PartStage | None = None
    sensor_body: SensorBody = SensorBody()
    clearance_mm: Annotated[float, Field(ge=0, le=1000)] = 20.0
    flange_from_sensor: FlangeFromSensor | None = None

    @model_validator(mode="after")
    def _possible(self) -> ViewsTable:
        if self.standoff_mm is not None and self.standoffs_mm is not None:
            raise ValueError("either standoff_mm or standoffs_mm, not both")
        if any(b <= a for a, b in itertools.pairwise(self.standoffs_mm or [])):
            raise ValueError("standoffs_mm in ascending order")
        if len({round(roll % 360, 6) % 360 for roll in self.rolls_deg}) < len(self.rolls_deg):
            raise ValueError("rolls_deg that differ, and not by whole turns: each would be the same view again")
        if np.linalg.norm(self.up) < 1e-9:
            raise ValueError("a direction up that is not zero")
        if self.stage is not None and len(self.stage.axes) == 2 and "rolls_deg" in self.model_fields_set:
            raise ValueError("no rolls_deg with a stage of two axes, where the direction determines the roll")
        return self

    @property
    def standoffs(self) -> list[float]:
        """Return the standoffs in the table [mm], nearest first; empty for the sensor's default."""
        return list(self.standoffs_mm or ([] if self.standoff_mm is None else [self.standoff_mm]))
