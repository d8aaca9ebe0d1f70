"""Describe the calibration and the pose of a capture as JSON documents, and convert them.

A calibration has the cameras in order; the first is the reference. It may have a projector, and the rectification of a
stereo pair. Matrices are written by rows. Lengths are in mm.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, Field, field_validator, model_validator

from characterisation.files.documents import Document
from mitsim.sensor.camera import Camera, Rectification, Rig
from mitsim.sensor.png import LONGEST_SIDE_PX
from mitsim.sensor.transforms import Transform, is_rotation

Number = Annotated[float, Field(ge=-1e9, le=1e9)]
Row3 = tuple[Number, Number, Number]
Row4 = tuple[Number, Number, Number, Number]
Side = Annotated[int, Field(ge=1, le=LONGEST_SIDE_PX)]

#: largest element of R R^T - I of a rotation in the files of mitsim; chosen: they have more than six digits
EXACT = 1e-6


def _rotation(rows: tuple[Row3, Row3, Row3]) -> tuple[Row3, Row3, Row3]:
    if not is_rotation(np.array(rows), EXACT):
        raise ValueError("a rotation matrix, by rows")
    return rows


def _rigid(rows: tuple[Row4, Row4, Row4, Row4]) -> tuple[Row4, Row4, Row4, Row4]:
    _rotation((rows[0][:3], rows[1][:3], rows[2][:3]))
    if rows[3] != (0, 0, 0, 1):
        raise ValueError("a rigid motion, 4 x 4, by rows, with the last row 0 0 0 1")
    return rows


def _intrinsic(rows: tuple[Row3, Row3, Row3]) -> tuple[Row3, Row3, Row3]:
    if rows[0][0] <= 0 or rows[1][1] <= 0 or rows[1][0] != 0 or rows[2] != (0, 0, 1):
        raise ValueError("a camera matrix by rows: fx s cx, 0 fy cy, 0 0 1, with fx and fy over 0")
    return rows


RotationRows = Annotated[tuple[Row3, Row3, Row3], AfterValidator(_rotation)]
RigidRows = Annotated[tuple[Row4, Row4, Row4, Row4], AfterValidator(_rigid)]
IntrinsicRows = Annotated[tuple[Row3, Row3, Row3], AfterValidator(_intrinsic)]


class CameraDocument(Document):
    """A :class:`~mitsim.sensor.camera.Camera`, size and ``matrix`` in px; ``sensor_from_camera`` is in mm."""

    name: str = Field(pattern="^[A-Za-z0-9][A-Za-z0-9._-]{0,99}$")
    model: Literal["perspective", "fisheye"]
    width: Side
    height: Side
    matrix: IntrinsicRows
    distortion: tuple[Number, ...] = Field(max_length=14)
    sensor_from_camera: RigidRows

    @model_validator(mode="after")
    def _check_distortion(self) -> CameraDocument:
        allowed = (4,) if self.model == "fisheye" else (0, 4, 5, 8, 12, 14)
        if len(self.distortion) not in allowed:
            raise ValueError(f"a {self.model} camera with {' or '.join(map(str, allowed))} distortion coefficients")
        return self


class RectificationDocument(Document):
    """A :class:`~mitsim.sensor.camera.Rectification`, size and matrices in px; ``baseline`` is in mm."""

    matrix_left: IntrinsicRows
    matrix_right: IntrinsicRows
    rotation_left: RotationRows
    rotation_right: RotationRows
    baseline: float = Field(gt=0, le=1e6)
    width: Side
    height: Side


class CalibrationDocument(Document):
    """Content of ``calibration.json``."""

    cameras: tuple[CameraDocument, ...] = Field(min_length=1, max_length=100)
    projector: CameraDocument | None = None
    rectification: RectificationDocument | None = None

    @field_validator("cameras")
    @classmethod
    def _check_names(cls, cameras: tuple[CameraDocument, ...]) -> tuple[CameraDocument, ...]:
        if len({camera.name for camera in cameras}) < len(cameras):
            raise ValueError("cameras of different names")
        return cameras


class PoseDocument(Document):
    """Content of ``pose.json``: ``world_from_sensor``, 4 x 4 [mm], null if unknown."""

    world_from_sensor: RigidRows | None

    def transform(self) -> Transform | None:
        """Return ``world_from_sensor``, None if unknown."""
        return None if self.world_from_sensor is None else Transform.from_matrix(self.world_from_sensor)


def calibration_table(rig: Rig) -> dict[str, Any]:
    """Return the content of ``calibration.json`` for a rig, not yet checked."""
    pair = {} if rig.rectification is None else vars(rig.rectification)
    return {
        "cameras": [_camera_table(name, camera) for name, camera in rig.cameras.items()],
        "projector": None if rig.projector is None else _camera_table("projector", rig.projector),
        "rectification": {key: np.asarray(value).tolist() for key, value in pair.items()} or None,
    }


def pose_table(pose: Transform | None) -> dict[str, Any]:
    """Return the content of ``pose.json``, not yet checked."""
    return {"world_from_sensor": None if pose is None else pose.matrix().tolist()}


def rig_of(document: CalibrationDocument) -> Rig:
    """Return the rig that a calibration document describes."""
    pair: dict[str, Any] = {}
    for key, value in document.rectification or ():
        pair[key] = np.array(value) if isinstance(value, tuple) else value
    return Rig(
        cameras={camera.name: _camera(camera) for camera in document.cameras},
        projector=None if document.projector is None else _camera(document.projector),
        rectification=Rectification(**pair) if pair else None,
    )


def _camera_table(name: str, camera: Camera) -> dict[str, Any]:
    return {
        "name": name,
        "model": camera.model,
        "width": int(camera.width),
        "height": int(camera.height),
        "matrix": np.asarray(camera.matrix, np.float64).tolist(),
        "distortion": np.ravel(camera.distortion).astype(float).tolist(),
        "sensor_from_camera": camera.sensor_from_camera.matrix().tolist(),
    }


def _camera(document: CameraDocument) -> Camera:
    return Camera(
        matrix=np.array(document.matrix),
        distortion=np.array(document.distortion),
        width=document.width,
        height=document.height,
        sensor_from_camera=Transform.from_matrix(document.sensor_from_camera),
        model=document.model,
    )
