"""Operate a live Ensenso stereo camera through the tree of the manufacturer's NxLib.

Signal chain: settings -> parameters of the camera's node, read back -> capture with projector flash -> raw pairs, one
for each FlexView frame -> NxLib's own disparity and point map -> the node of that capture, with calibration and
settings.

``Link`` transforms NxLib's point maps to a workspace, where the distance |V| would be wrong. The link is therefore
removed while the camera is open, and recorded with each shot. On closing, on every error and on Ctrl-C, the link and
every changed parameter are restored. After an error the camera must be opened again.

The code follows the package ``ensenso-nxlib`` and the manufacturer's public ROS driver. It has run with an emulation of
the library, never with a device.
"""

from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from characterisation.files.documents import Document
from mitsim.capture.devices.device_error import DeviceError, imported_package
from mitsim.capture.devices.ensenso_faults import fault_of, no_library
from mitsim.capture.devices.live_camera import LiveCamera

Value = bool | int | float | str
Images = NDArray[np.unsignedinteger[Any]]

#: accepted relative difference of a number that is read back from the value set; assumed
READ_BACK_SHARE = 0.02

#: disparities are in sixteenths of a pixel (NxLib, node DisparityMap)
DISPARITY_SCALE = 16.0

#: disparity of a pixel without one (NxLib, node DisparityMap)
NO_DISPARITY = -32768

_UNLINKED = {"Target": "", "Rotation": None, "Translation": None}


class EnsensoSettings(Document):
    """Settings applied before captures are taken; settings left out stay as they are in the camera.

    - ``exposure_s``: fixed, with automatic exposure off; ``gain``: fixed, with automatic gain off.
    - ``flex_view``: number of frames with a shifted pattern, 0 for one frame without (N35: 2 to 8; X36: up to 16).
    - ``maps``: NxLib also computes its own disparity and point map.
    - ``capture_timeout_s``: by default NxLib's own.
    - ``parameters``: others by their path under the camera's ``Parameters``
      (``DisparityMap/StereoMatching/NumberOfDisparities``).
    """

    exposure_s: Annotated[float, Field(gt=0, le=10)] | None = None
    gain: Annotated[float, Field(ge=1, le=100)] | None = None
    hardware_gamma: bool | None = None
    projector: bool = True
    front_light: bool = False
    flex_view: int = Field(default=0, ge=0, le=16)
    maps: bool = True
    capture_timeout_s: Annotated[float, Field(gt=0, le=600)] | None = None
    parameters: dict[str, Value] = Field(default_factory=dict, max_length=100)

    def wanted(self) -> dict[str, Value]:
        """Return the parameters to set, by their path under ``Parameters``; NxLib's exposures are in ms."""
        wanted: dict[str, Value] = {
            "Capture/Projector": self.projector,
            "Capture/FrontLight": self.front_light,
            "Capture/FlexView": self.flex_view or False,
        }
        if self.exposure_s is not None:
            wanted |= {"Capture/AutoExposure": False, "Capture/Exposure": 1000.0 * self.exposure_s}
        if self.gain is not None:
            wanted |= {"Capture/AutoGain": False, "Capture/Gain": self.gain}
        if self.hardware_gamma is not None:
            wanted["Capture/HardwareGamma"] = self.hardware_gamma
        return wanted | self.parameters


@dataclass(frozen=True)
class EnsensoShot:
    """The data of one capture.

    - ``node`` of the tree, with the ``Link`` that was removed.
    - ``images``: ``left`` and ``right`` (frames, H, W) [DN], raw.
    - ``disparity`` (h, w) [px] and ``points`` (h, w, 3) [mm] of NxLib, in the camera's frame without the ``Link``, NaN
      where missing, or None.
    - ``source``: ``device``, ``emulator`` of an emulated library, ``replay`` of NxLib's file cameras, ``simulated`` of
      its virtual ones.
    """

    node: dict[str, Any]
    images: dict[str, Images]
    disparity: NDArray[np.float32] | None
    points: NDArray[np.float32] | None
    source: Literal["device", "emulator", "replay", "simulated"]


class EnsensoCamera(LiveCamera):
    """An open camera; a context manager that restores its previous state."""

    def __init__(self, serial: str, settings: EnsensoSettings, nxlib: Any) -> None:
        self.where, self.serial, self.settings = f"camera {serial}", serial, settings
        self._nxlib, self._session, self._camera = nxlib, nxlib.NxLib(), None
        self._before: dict[str, Value] = {}
        self._link: dict[str, Any] | None = None
        self._started = False
        with self._closed_on_error("open"):
            self._session.__enter__()
            self._started = True
            self._camera = nxlib.StereoCamera(serial)
            self._camera.open()
            self._unlink()
            for path, value in settings.wanted().items():
                self._set(path, value)
            self._synchronize()
            self._check_read_back()

    def take(self) -> EnsensoShot:
        """Take one capture, with all its FlexView frames.

        Raises DeviceError if the camera fails; its previous state is restored before the error is raised.
        """
        with self._closed_on_error("capture"):
            camera, seconds = self._camera, self.settings.capture_timeout_s
            assert camera is not None
            camera.capture({} if seconds is None else {"Timeout": round(1000 * seconds)})
            disparity = points = None
            if self.settings.maps:
                values = camera.compute_disparity_map().get_binary_data()[..., 0]
                disparity = values.astype(np.float32) / DISPARITY_SCALE
                disparity[values == NO_DISPARITY] = np.nan
                points = np.asarray(camera.compute_point_map().get_binary_data(), np.float32)
            node = camera.get_node().value()
            if (node.get("Link") or {}).get("Target"):
                found, hint = "a Link that cannot be removed", "Clear the camera's Link in NxView"
                raise DeviceError(self.where, "capture", found, "points in the camera's frame", hint)
            if self._link is not None:
                node["Link"] = self._link
            return EnsensoShot(node, self._images(), disparity, points, self._source(node))

    def _release(self) -> None:
        for path, value in reversed(self._before.items()):
            with suppress(Exception):  # the camera may be disconnected
                _write(self._item(f"Parameters/{path}"), value)
        with suppress(Exception):
            if self._link is not None:
                self._item("Link").set_json(json.dumps(self._link), True)
        with suppress(Exception):
            if self._before:
                self._synchronize()
        with suppress(Exception):
            if self._camera is not None:
                self._camera.close()
        with suppress(Exception):
            if self._started:
                self._session.__exit__(None, None, None)

    def _fault_of(self, error: BaseException, operation: str) -> BaseException:
        return fault_of(error, self._nxlib, self.where, operation, self._serials())

    def _item(self, path: str) -> Any:
        item = self._camera
        for step in path.split("/"):
            item = item[step]  # type: ignore[index]
        return item

    def _unlink(self) -> None:
        item = self._item("Link")
        if not item.exists():
            return
        link = item.value()
        if isinstance(link, dict) and any(link.get(key) for key in _UNLINKED):
            self._link = link
            item.set_json(json.dumps(_UNLINKED), True)

    def _set(self, path: str, value: Value) -> None:
        item = self._item(f"Parameters/{path}")
        if not item.exists():
            if value is False:  # it cannot be switched on, so it is off
                return
            expected = f"a camera with this parameter, to set it to {value}"
            raise DeviceError(self.where, f"set {path}", "no such parameter", expected, "Leave it out of the settings")
        before = self._before.setdefault(path, item.value())
        # older trees have a number for FlexView
        _write(item, 0 if value is False and not isinstance(before, bool) else value)

    def _check_read_back(self) -> None:
        """Reject a camera whose parameters differ from the values set."""
        for path, value in self.settings.wanted().items():
            item = self._item(f"Parameters/{path}")
            if not item.exists():
                continue
            reading = item.value()
            tolerance = READ_BACK_SHARE * abs(value) if isinstance(value, float) else 0
            numbers = isinstance(reading, int | float) and isinstance(value, int | float)
            if not (abs(reading - value) <= tolerance if numbers else reading == value):
                hint = "Set a value within the camera's range, which NxView shows"
                raise DeviceError(self.where, f"set {path}", f"{reading}, read back", f"{value}", hint)

    def _synchronize(self) -> None:
        command = self._nxlib.NxLibCommand("Synchronize")
        command.parameters()["Cameras"] = self.serial
        command.execute()

    def _images(self) -> dict[str, Images]:
        """Return the raw images by side, (frames, H, W); the node is a list if there are several."""
        raw = self._item("Images/Raw")
        pairs = [raw[index] for index in range(raw.count())] if raw.is_array() else [raw]
        return {side.lower(): np.stack([_image(pair[side]) for pair in pairs]) for side in ("Left", "Right")}

    def _source(self, node: dict[str, Any]) -> Literal["device", "emulator", "replay", "simulated"]:
        if self._nxlib.NxLibItem()["Emulator"].exists():  # written by mitsim's emulation of the library
            return "emulator"
        ports = json.dumps([node.get("Sensor"), node.get("Port")])
        if '"Virtual"' in ports:
            return "simulated"
        return "replay" if '"File"' in ports else "device"

    def _serials(self) -> list[str]:
        """Return the serial numbers of the stereo cameras that NxLib lists."""
        with suppress(Exception):
            cameras = self._nxlib.NxLibItem()["Cameras"].value()
            return sorted(name for name, node in cameras.items() if isinstance(node, dict) and "ModelName" in node)
        return []


def open_ensenso(serial: str, settings: EnsensoSettings) -> EnsensoCamera:
    """Open a camera by its serial number, and configure it.

    NxLib's shared library is that of the SDK, or of ``NXLIB_LIBRARY_PATH``. Raises MissingEnvironmentError without the
    package ``ensenso-nxlib``, DeviceError without the SDK, or if the camera cannot be opened or rejects the settings.
    """
    nxlib = imported_package("nxlib", "ensenso-nxlib", "Ensenso cameras", "pip install 'mitsim[ensenso]'")
    try:
        return EnsensoCamera(serial, settings, nxlib)
    except OSError as error:  # CDLL's
        raise no_library(f"camera {serial}", error) from None


def _write(item: Any, value: Value) -> None:
    write = {bool: item.set_bool, int: item.set_int, float: item.set_double, str: item.set_string}[type(value)]
    write(value)


def _image(item: Any) -> Images:
    data = item.get_binary_data()[..., 0]
    return data.view(np.uint16) if data.dtype == np.int16 else data  # type: ignore[no-any-return]  # read as signed
