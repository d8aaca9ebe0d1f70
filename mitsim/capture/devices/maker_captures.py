"""Live cameras of any make as sources of captures.

Signal chain: the ``[device]`` table -> an open camera (:mod:`mitsim.capture.devices`) -> its shot, in the maker's terms
-> a :class:`~mitsim.capture.capture.Capture`, and the maker's own files with it.

NxLib computes the points of an Ensenso. Recordings show that they are in the frame of the rectified left camera
(:mod:`mitsim.capture.recordings.nxlib_calibration`); they are rotated to the sensor frame, that of the raw left camera.
The disparity of the same shot verifies this for every capture. The frame in which both agree is used. Points that agree
in neither frame are kept only as the maker's file.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from characterisation.files.documents import Document, read_toml, validate
from characterisation.files.errors import InputError
from mitsim.capture.capture import Capture
from mitsim.capture.decoding import read_settings
from mitsim.capture.devices.depthai_camera import DepthaiCamera, DepthaiShot, depthai
from mitsim.capture.devices.depthai_settings import DepthaiSettings
from mitsim.capture.devices.device_error import DeviceError
from mitsim.capture.devices.ensenso import EnsensoCamera, EnsensoSettings, EnsensoShot, open_ensenso
from mitsim.capture.npy import encode_npy
from mitsim.capture.recordings.depthai_calibration import read_depthai_calibration
from mitsim.capture.recordings.ensenso import read_ensenso
from mitsim.sensor.camera import Rectification, Rig
from mitsim.sensor.png import encode_png

#: largest median difference of points and disparity in the same frame, relative to the distance
AGREEMENT = 1e-4


class EnsensoTable(Document):
    """The ``[device]`` table of an Ensenso, with its serial number."""

    kind: Literal["ensenso"]
    serial: str = Field(pattern="^[A-Za-z0-9][A-Za-z0-9._-]{0,49}$")
    settings: EnsensoSettings = EnsensoSettings()


class DepthaiTable(Document):
    """The ``[device]`` table of a DepthAI camera: its ``id``, address or USB port; "" for the only one."""

    kind: Literal["depthai"]
    id: str = Field(default="", pattern="^[A-Za-z0-9._:-]{0,99}$")
    settings: DepthaiSettings = DepthaiSettings()


OpenDevice = EnsensoCamera | DepthaiCamera

DeviceTable = Annotated[EnsensoTable | DepthaiTable, Field(discriminator="kind")]


def device_table(device: str, settings: Path | None) -> EnsensoTable | DepthaiTable:
    """Return the ``[device]`` table of a camera that is named in one word, with the settings of a TOML file.

    Raises InputError for an unknown kind of camera, or settings that the camera does not have.
    """
    kind, _, name = device.partition(":")
    if kind == "ensenso" and name:
        chosen = EnsensoSettings() if settings is None else read_toml(settings, EnsensoSettings)
        return validate("--device", {"kind": kind, "serial": name, "settings": chosen}, EnsensoTable)
    if kind == "depthai":
        set_to = DepthaiSettings() if settings is None else read_toml(settings, DepthaiSettings)
        return validate("--device", {"kind": kind, "id": name, "settings": set_to}, DepthaiTable)
    raise InputError("--device", "", repr(device), "ensenso:SERIAL, depthai or depthai:ID")


@dataclass(frozen=True)
class DeviceCapture:
    """A capture, and the maker's files of it by name."""

    capture: Capture
    originals: dict[str, bytes]


def open_device(table: EnsensoTable | DepthaiTable) -> OpenDevice:
    """Open the camera of a ``[device]`` table and apply its settings.

    Raises MissingEnvironmentError without the package of the maker. Raises DeviceError if the camera is not connected,
    or rejects its settings.
    """
    if isinstance(table, EnsensoTable):
        return open_ensenso(table.serial, table.settings)
    return DepthaiCamera(table.settings, table.id, depthai())


def device_capture(shot: EnsensoShot | DepthaiShot) -> DeviceCapture:
    """Return the capture of a camera's shot.

    Raises DeviceError if its calibration cannot be read.
    """
    return ensenso_capture(shot) if isinstance(shot, EnsensoShot) else depthai_capture(shot)


def ensenso_capture(shot: EnsensoShot) -> DeviceCapture:
    """Return the capture of an Ensenso's shot, with the calibration of the device at that moment."""
    serial = str(shot.node.get("SerialNumber", "camera"))
    capture = _read_node(shot.node, shot.images, serial)
    # image_set is a setting of recordings
    settings = {name: value for name, value in capture.settings.items() if name != "image_set"}
    originals = {f"{serial}_calib.json": _json(shot.node)}
    derived: dict[str, NDArray[np.float32]] = {}
    pair = capture.rig.rectification
    assert pair is not None  # read_ensenso sets it
    if shot.disparity is not None:
        if shot.disparity.shape == (pair.height, pair.width):
            derived["disparity"] = shot.disparity
        else:  # cropped or scaled by DisparityMap's parameters, so it does not match the rectified image
            originals["disparity.npy"] = encode_npy(shot.disparity)
    if shot.points is not None:
        in_place = None
        if "disparity" in derived and shot.points.shape[:2] == shot.disparity.shape:  # type: ignore[union-attr]
            in_place = points_in_left_camera(shot.points, derived["disparity"], pair)
        if in_place is None:
            originals["points.npy"] = encode_npy(shot.points)
        else:
            derived["points"] = in_place
    return DeviceCapture(replace(capture, source=shot.source, settings=settings, derived=derived), originals)


def depthai_capture(shot: DepthaiShot) -> DeviceCapture:
    """Return the capture of a DepthAI camera's shot: raw images, and the disparity of its own matcher."""
    size = shot.images["left"].shape[::-1]
    derived = {} if shot.disparity is None else {"disparity": shot.disparity}
    decoding, records = read_settings(f"camera {shot.model}", shot.settings, "active_stereo")
    capture = Capture(
        sensor=shot.model,
        technology="active_stereo",
        source="device",
        rig=depthai_rig(shot.calibration, (int(size[0]), int(size[1]))),
        images={name: image[None] for name, image in shot.images.items()},
        bits=8 * shot.images["left"].dtype.itemsize,
        decoding=decoding,
        settings=records,
        serial=shot.serial,
        derived=derived,
    )
    return DeviceCapture(capture, {"calibration.json": _json(shot.calibration)})


def points_in_left_camera(
    points: NDArray[np.float32], disparity: NDArray[np.float32], pair: Rectification
) -> NDArray[np.float32] | None:
    """Return points (H, W, 3) [mm] in the left camera's frame if they agree with the disparity (H, W) [px], else None.

    The points may be in that frame already, or in that of the rectified left image.
    """
    depth = pair.depth(disparity)
    rows, columns = np.mgrid[: disparity.shape[0], : disparity.shape[1]]
    k = pair.matrix_left
    rays = np.stack([(columns - k[0, 2]) / k[0, 0], (rows - k[1, 2]) / k[1, 1], np.ones(disparity.shape)], axis=-1)
    rectified = rays * depth[..., None]
    seen = np.isfinite(rectified).all(axis=-1) & np.isfinite(points).all(axis=-1)
    if not seen.any():
        return None
    limit = AGREEMENT * float(np.median(depth[seen]))
    turned = rectified @ pair.rotation_left  # rows: R^T x
    if np.median(np.linalg.norm(points[seen] - turned[seen], axis=-1)) <= limit:
        return points
    if np.median(np.linalg.norm(points[seen] - rectified[seen], axis=-1)) <= limit:
        return (points @ pair.rotation_left).astype(np.float32)
    return None


def _read_node(node: dict[str, Any], images: dict[str, NDArray[np.unsignedinteger[Any]]], serial: str) -> Capture:
    """Read a camera's node and images with the reader for recordings, which contain the same data."""
    with TemporaryDirectory() as folder, _read_from(f"camera {serial}"):
        base = Path(folder) / f"0_{serial}"
        for side, stack in images.items():
            for frame, image in enumerate(stack):
                number = f"_{frame:02d}" if len(stack) > 1 else ""
                Path(f"{base}{number}_{side}.png").write_bytes(encode_png(image))
        Path(f"{base}_calib.json").write_bytes(_json(node))
        return read_ensenso(folder)


def depthai_rig(calibration: dict[str, Any], size: tuple[int, int]) -> Rig:
    """Return cameras ``left`` and ``right`` for images of ``size`` (columns, rows) from the calibration of a device.

    Raises DeviceError if it is not the calibration of a stereo pair.
    """
    with TemporaryDirectory() as folder, _read_from("camera depthai"):
        file = Path(folder) / "calibration.json"
        file.write_bytes(_json(calibration))
        return read_depthai_calibration(file).rig(*size)


@contextmanager
def _read_from(where: str) -> Iterator[None]:
    """Turn errors in a device's calibration into device errors, since they are not in a user's file."""
    try:
        yield
    except InputError as error:
        found = f"{error.field}: {error.found}" if error.field else f"{error.found}"
        raise DeviceError(where, "read its calibration", found, error.allowed, "calibrate the device") from None


def _json(value: Any) -> bytes:
    return (json.dumps(value, indent=1) + "\n").encode()
