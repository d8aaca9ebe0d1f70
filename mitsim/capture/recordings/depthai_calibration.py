"""Read calibrations of Luxonis' DepthAI devices: JSON of versions 6 and 7, as read out of a device.

Signal chain: ``cameraData`` by socket -> K, distortion and model of each lens at the calibrated size -> chain of
extrinsics from one socket to the next, in centimetres -> rig in the frame of the left camera [mm].

- ``extrinsics`` of socket s: x_to = R x_s + T, where ``to`` is ``toCameraSocket``. -1 or an empty rotation ends the
  chain.
- The lens model is OpenCV's: 14 coefficients in its order, or for ``cameraType`` 1 the first four of its fisheye model.
- ``specTranslation`` is the design value, ``translation`` the calibrated one, which mitsim uses. A device that converts
  disparity to depth with the design value is wrong by their ratio, 2.6 % on one unit.
- An image of w x h may come from a camera calibrated at W x H. As in DepthAI, K is then multiplied by w / W, and
  (h - H w / W) / 2 is added to cy.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from characterisation.files.checked_files import read_bounded
from characterisation.files.errors import InputError
from mitsim.capture.recordings.json_fields import JsonFields, parsed_json
from mitsim.sensor.calibration_qualifiers import check_camera
from mitsim.sensor.camera import Camera, Rig
from mitsim.sensor.png import LONGEST_SIDE_PX
from mitsim.sensor.transforms import Transform

#: value of DepthAI's cameraType for a fisheye lens
_FISHEYE = 1

#: value of DepthAI's cameraType for a perspective lens
_PERSPECTIVE = 0

_CM = 10.0

#: socket that means none, as does -1
_NO_SOCKET = 255


@dataclass(frozen=True)
class DepthaiCalibration:
    """Content of a calibration: ``cameras`` by socket, each in its own frame; the pair; the name of the device.

    ``right_from_left`` of the calibrated extrinsics [mm]; ``spec_baseline_mm`` of the design, None if the file has
    none.
    """

    cameras: dict[int, Camera]
    left: int
    right: int
    right_from_left: Transform
    spec_baseline_mm: float | None
    name: str

    def rig(self, width: int | None = None, height: int | None = None) -> Rig:
        """Return the left and right camera for images of a size, by default that of the calibration."""
        left, right = self.cameras[self.left], self.cameras[self.right]
        if width is not None and height is not None:
            left, right = resized(left, width, height), resized(right, width, height)
        return Rig({"left": left, "right": replace(right, sensor_from_camera=self.right_from_left.inverse())})


def resized(camera: Camera, width: int, height: int) -> Camera:
    """Return a camera for images of another size: scaled to the width, then cut or padded evenly at top and bottom."""
    scale = width / camera.width
    matrix = camera.matrix * np.array([[scale], [scale], [1.0]])
    matrix[1, 2] += (height - camera.height * scale) / 2
    return replace(camera, matrix=matrix, width=width, height=height)


def is_depthai_calibration(table: Any) -> bool:
    """Return whether a JSON value is a calibration of this kind."""
    return isinstance(table, dict) and "cameraData" in table


def read_depthai_calibration(path: str | Path) -> DepthaiCalibration:
    """Read a calibration file.

    Raises InputError if it is no such file, or a value is missing or invalid; the error names the field.
    """
    path = Path(path)
    table = parsed_json(read_bounded(path, "a calibration.json of DepthAI"), path, "a calibration of DepthAI")
    if not is_depthai_calibration(table):
        raise InputError(path, "cameraData", "nothing", "a calibration of DepthAI, as saved from readCalibration2")
    return _calibration(JsonFields(table, path), path)


def _calibration(fields: JsonFields, path: Path) -> DepthaiCalibration:
    entries = fields.get("cameraData")
    if isinstance(entries, dict):  # newer files have a map from the socket's number
        entries = [[int(key) if re.fullmatch("[0-9]{1,3}", key) else key, value] for key, value in entries.items()]
    if not isinstance(entries, list) or not all(
        isinstance(entry, list) and len(entry) == 2 and isinstance(entry[0], int) and isinstance(entry[1], dict)
        for entry in entries
    ):
        raise fields.fault("cameraData", "a list of [socket, camera]")
    cameras: dict[int, Camera] = {}
    steps: dict[int, tuple[int, Transform, NDArray[np.float64] | None]] = {}
    for socket, table in entries:
        camera_fields = JsonFields(table, path, f"cameraData.{socket}.")
        if not camera_fields.get("width") and not camera_fields.get("height"):
            continue  # a socket without a camera
        cameras[socket] = _camera(camera_fields)
        check_camera(cameras[socket], path, f"cameraData.{socket}.intrinsicMatrix")
        to = camera_fields.integer("extrinsics.toCameraSocket", -1, 100)
        if to >= 0 and camera_fields.get("extrinsics.rotationMatrix"):
            steps[socket] = (to, _extrinsics(camera_fields), _translation(camera_fields, "extrinsics.specTranslation"))
    if not cameras:
        hint = "the device was not calibrated, or another file of it has the calibration of the factory"
        raise InputError(path, "cameraData", "no cameras in this calibration", "the cameras of a pair", hint)
    left = fields.integer("stereoRectificationData.leftCameraSocket", -1, _NO_SOCKET)
    right = fields.integer("stereoRectificationData.rightCameraSocket", -1, _NO_SOCKET)
    for side, socket in (("left", left), ("right", right)):
        if socket not in cameras:
            sockets = ", ".join(map(str, cameras)) or "none"
            field = f"stereoRectificationData.{side}CameraSocket"
            found = f"{socket}: no pair of cameras" if socket in (-1, _NO_SOCKET) else socket
            raise InputError(path, field, found, f"one of cameraData: {sockets}")
    motion, spec = _between(left, right, steps, path)
    name = fields.get("productName") or fields.get("boardName")
    return DepthaiCalibration(cameras, left, right, motion, spec, name if isinstance(name, str) and name else "depthai")


def _camera(fields: JsonFields) -> Camera:
    width, height = (fields.integer(side, 1, LONGEST_SIDE_PX) for side in ("width", "height"))
    matrix = fields.numbers("intrinsicMatrix", (3, 3))
    if matrix[0, 0] <= 0 or matrix[1, 1] <= 0 or matrix[1, 0] != 0 or np.any(matrix[2] != [0, 0, 1]):
        raise fields.fault("intrinsicMatrix", "fx 0 cx, 0 fy cy, 0 0 1, by rows")
    distortion = fields.numbers("distortionCoeff", (None,))
    kind = fields.integer("cameraType", 0, 100)
    if kind not in (_FISHEYE, _PERSPECTIVE):
        raise fields.fault("cameraType", "0 (perspective) or 1 (fisheye)")
    if kind == _FISHEYE and len(distortion) >= 4:
        return Camera(matrix, distortion[:4], width, height, model="fisheye")
    if kind == _PERSPECTIVE and len(distortion) in (0, 4, 5, 8, 12, 14):
        return Camera(matrix, distortion if len(distortion) else np.zeros(5), width, height)
    raise fields.fault("distortionCoeff", "4 or more for a fisheye; 0, 4, 5, 8, 12 or 14 for a perspective lens")


def _extrinsics(fields: JsonFields) -> Transform:
    rotation = fields.rotation("extrinsics.rotationMatrix", 1e-3)
    translation = _translation(fields, "extrinsics.translation")
    if translation is None:
        raise fields.fault("extrinsics.translation", "x, y and z [cm]")
    return Transform(rotation, translation)


def _translation(fields: JsonFields, field: str) -> NDArray[np.float64] | None:
    """Return a translation [mm]; None if absent."""
    if not isinstance(fields.get(field), dict):
        return None
    return np.array([float(fields.numbers(f"{field}.{axis}", ())) for axis in "xyz"]) * _CM


def _between(
    left: int, right: int, steps: dict[int, tuple[int, Transform, NDArray[np.float64] | None]], path: Path
) -> tuple[Transform, float | None]:
    """Return ``right_from_left`` along the chain of extrinsics, and the length of the design translation [mm]."""

    def chain(socket: int) -> dict[int, tuple[Transform, NDArray[np.float64] | None]]:
        """Return ``a_from_socket`` of every socket a up to the end of the chain, with the summed design translation."""
        out: dict[int, tuple[Transform, NDArray[np.float64] | None]] = {socket: (Transform.identity(), np.zeros(3))}
        motion, spec = out[socket]
        while socket in steps:
            socket, step, designed = steps[socket]
            if socket in out:
                raise InputError(path, "extrinsics.toCameraSocket", "cyclic extrinsics", "a chain that ends")
            motion = step @ motion
            spec = None if spec is None or designed is None else spec + designed
            out[socket] = (motion, spec)
        return out

    from_left, from_right = chain(left), chain(right)
    meeting = next((socket for socket in from_left if socket in from_right), None)
    if meeting is None:
        raise InputError(
            path, "extrinsics", f"no connection from socket {left} to {right}", "a chain that connects both"
        )
    (a, spec_a), (b, spec_b) = from_left[meeting], from_right[meeting]
    designed = None if spec_a is None or spec_b is None else float(np.linalg.norm(spec_a - spec_b))
    return b.inverse() @ a, designed or None
