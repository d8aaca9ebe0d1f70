"""Operate a live DepthAI camera (OAK-D and similar) with the package ``depthai`` 3.

Signal chain: settings -> pipeline of two cameras and the device's own matcher -> synchronised frames of one sequence
number -> raw left and right images, disparity -> with the calibration stored in the device, as JSON.

The device's depth is never used: its conversion may use the design baseline or the calibrated one
(:mod:`mitsim.capture.devices.depthai_settings`). Dot projector and flood light are switched off on closing, on every
error and on Ctrl-C. The tests use the real package's frames, queues and calibrations. Its pipelines need a device; they
have not been run on one.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from datetime import timedelta
from typing import Any

import numpy as np
from numpy.typing import NDArray

from characterisation.files.errors import in_one_line
from mitsim.capture.devices.depthai_settings import DepthaiSettings, configuration, configure
from mitsim.capture.devices.device_error import DeviceError, imported_package
from mitsim.capture.devices.live_camera import LiveCamera

Image = NDArray[np.unsignedinteger[Any]]

#: outputs of the matcher's node that hold the images, by camera
_IMAGES = {"left": "syncedLeft", "right": "syncedRight"}


@dataclass(frozen=True)
class DepthaiShot:
    """The data of one capture.

    - ``images`` of ``left`` and ``right`` (H, W) [DN], raw.
    - ``disparity`` (H, W) of the device's own matcher in its rectified left image [px], NaN where missing, or None.
    - ``calibration``: as stored in the device, in its own JSON.
    - ``settings``: the values set, and those that the frames report, with units in the names.
    """

    images: dict[str, Image]
    disparity: NDArray[np.float32] | None
    calibration: dict[str, Any]
    settings: dict[str, Any]
    model: str
    serial: str


class DepthaiCamera(LiveCamera):
    """An open camera; a context manager that switches its light off and closes it.

    ``identifier``: its id, address or USB port, if there are several; ``dai``: the package ``depthai``. Raises
    DeviceError if there is no such camera, or it rejects the settings.
    """

    def __init__(self, settings: DepthaiSettings, identifier: str, dai: Any) -> None:
        self.where, self.settings = f"camera depthai{':' + identifier if identifier else ''}", settings
        self._dai, self._device, self._pipeline, self._last = dai, None, None, -1  # number of the last frames taken
        with self._closed_on_error("open"):
            self._device = dai.Device(dai.DeviceInfo(identifier)) if identifier else dai.Device()
            self._pipeline = dai.Pipeline(self._device)
            stereo = stereo_pipeline(self._pipeline, settings, dai)
            self._queues = {name: getattr(stereo, output).createOutputQueue() for name, output in _IMAGES.items()}
            if settings.disparity:
                self._queues["disparity"] = stereo.disparity.createOutputQueue()
            self._configuration = configuration(stereo.initialConfig)
            self.calibration: dict[str, Any] = self._device.readCalibration().eepromToJson()
            self.model, self.serial = str(self._device.getDeviceName()), str(self._device.getDeviceId())
            self._pipeline.start()
            self._light(settings.dot_projector, settings.flood_light)
            for _ in range(settings.warm_up_frames):
                aligned_frames(self._queues, settings.timeout_s, self.where)

    def take(self) -> DepthaiShot:
        """Take one capture; its frames are exposed after the call.

        Raises DeviceError if the camera fails; its light is switched off before the error is raised.
        """
        with self._closed_on_error("capture"):
            asked, deadline = self._dai.Clock.now(), time.monotonic() + self.settings.timeout_s
            newest = self._last
            for queue in self._queues.values():  # queued frames are older than the call
                for old in queue.tryGetAll():
                    newest = max(newest, old.getSequenceNum())
            # the frame in progress may have begun before the call: skip one more
            frames = aligned_frames(self._queues, self.settings.timeout_s, self.where, newest + 2)
            begin = self._dai.CameraExposureOffset.START
            while any(frames[name].getTimestamp(begin) < asked for name in _IMAGES):  # more may be on their way
                if time.monotonic() >= deadline:
                    fault = f"no frame exposed after the call within {self.settings.timeout_s:g} s"
                    raise DeviceError(self.where, "capture", fault, "frames", "Close and open the camera again")
                number = frames["left"].getSequenceNum()
                frames = aligned_frames(self._queues, self.settings.timeout_s, self.where, number + 1)
            self._last = frames["left"].getSequenceNum()
            settings = {
                "maker": "Luxonis",
                "stereo": self._configuration,
                "spec_baseline": False,
                **self.settings.model_dump(mode="json", include={"dot_projector", "flood_light", "frames_per_second"}),
                **frame_settings(frames["left"]),
            }
            images = {name: pixels(frames[name]) for name in _IMAGES}
            own = frames.get("disparity")
            disparity = None if own is None else disparity_of(pixels(own), self.settings.subpixel_bits)
            return DepthaiShot(images, disparity, self.calibration, settings, self.model, self.serial)

    def _release(self) -> None:
        with suppress(Exception):  # the camera may be disconnected
            self._light(0.0, 0.0)
        with suppress(Exception):
            if self._pipeline is not None:
                self._pipeline.stop()
        with suppress(Exception):
            if self._device is not None:
                self._device.close()

    def _fault_of(self, error: BaseException, operation: str) -> BaseException:
        return fault_of(error, self._dai, self.where, operation)

    def _light(self, dots: float, flood: float) -> None:
        if self._device is None:
            return
        for share, switch, name in (
            (dots, self._device.setIrLaserDotProjectorIntensity, "dot_projector"),
            (flood, self._device.setIrFloodLightIntensity, "flood_light"),
        ):
            if not switch(share) and share > 0:
                found, expected = "a camera without one", "one that has it (OAK-D Pro)"
                raise DeviceError(self.where, f"set {name}", found, expected, f"Write {name} = 0")


def depthai() -> Any:
    """Import the package without its log messages, or raise an error with the installation command."""
    os.environ.setdefault("DEPTHAI_LEVEL", "error")  # it warns if there is no USB bus
    os.environ.setdefault("DEPTHAI_INSTALL_SIGNAL_HANDLER", "0")  # mitsim handles Ctrl-C
    return imported_package("depthai", "depthai", "DepthAI cameras", "pip install 'mitsim[depthai]'")


def stereo_pipeline(pipeline: Any, settings: DepthaiSettings, dai: Any) -> Any:
    """Add two cameras and a ``StereoDepth`` node to a pipeline that is not started, and return the node.

    Neither its rectification nor its depth may use design values.
    """
    outputs = []
    for socket in (dai.CameraBoardSocket.CAM_B, dai.CameraBoardSocket.CAM_C):
        camera = pipeline.create(dai.node.Camera).build(socket)
        if settings.exposure_s is not None:
            camera.initialControl.setManualExposure(round(1e6 * settings.exposure_s), settings.sensitivity_iso)
        grey = dai.ImgFrame.Type.GRAY8
        outputs.append(camera.requestOutput(settings.size_px, type=grey, fps=settings.frames_per_second))
    preset = getattr(dai.node.StereoDepth.PresetMode, settings.preset)
    stereo = pipeline.create(dai.node.StereoDepth).build(*outputs, presetMode=preset)
    configure(stereo.initialConfig, settings, dai)
    stereo.setDisparityToDepthUseSpecTranslation(False)
    stereo.setRectificationUseSpecTranslation(False)
    stereo.setDepthAlignmentUseSpecTranslation(False)
    return stereo


def pixels(frame: Any) -> Image:
    """Return a copy of the grey levels or raw disparities (H, W) of an ``ImgFrame``."""
    image = np.array(frame.getFrame())
    if image.ndim != 2 or image.dtype not in (np.uint8, np.uint16):
        found = f"{image.dtype} {image.shape} of type {frame.getType()}"
        raise DeviceError("camera depthai", "read a frame", found, "a grey image of 8 or 16 bits")
    return image


def disparity_of(raw: Image, subpixel_bits: int) -> NDArray[np.float32]:
    """Return the disparity [px] of raw values in units of 2^-bits px; 0 is missing."""
    return np.where(raw == 0, np.float32(np.nan), raw.astype(np.float32) / np.float32(2**subpixel_bits))


def frame_settings(frame: Any) -> dict[str, Any]:
    """Return the values that a frame reports."""
    read = {
        "exposure_s": frame.getExposureTime().total_seconds(),
        "sensitivity_iso": frame.getSensitivity(),
        "imager_temperature_degC": frame.getSensorTemperature(),
        "sequence_number": frame.getSequenceNum(),
    }
    return {name: value for name, value in read.items() if value is not None}


def aligned_frames(
    queues: Mapping[str, Any], timeout_s: float, where: str, first: int = 0, now: Callable[[], float] = time.monotonic
) -> dict[str, Any]:
    """Return the next frames of a common sequence number, ``first`` or more, one from each queue.

    Raises DeviceError if they do not arrive in time.
    """
    deadline = now() + timeout_s
    newest: dict[str, Any] = {}
    wanted = first
    while len(newest) < len(queues) or any(frame.getSequenceNum() < wanted for frame in newest.values()):
        for name, queue in queues.items():
            while name not in newest or newest[name].getSequenceNum() < wanted:
                left = deadline - now()
                frame = queue.get(timedelta(seconds=left)) if left > 0 else None
                if frame is None:
                    found = f"no frame of {name} within {timeout_s:g} s"
                    hint = "Check the cable (USB 3), or lower frames_per_second"
                    raise DeviceError(where, "capture", found, "frames", hint)
                newest[name] = frame
                wanted = max(wanted, frame.getSequenceNum())
    return newest


def fault_of(error: BaseException, dai: Any, where: str, operation: str) -> BaseException:
    """Return the error to raise instead of an error: a DeviceError for errors of the package, else the error itself."""
    if isinstance(error, DeviceError) or not isinstance(error, RuntimeError):
        return error
    message = in_one_line(error)
    lowered, rule = message.lower(), "On Linux its udev rule is needed: docs.luxonis.com"
    found, expected = "the camera disconnected or failed", "a connected camera"
    hint = "Check the cable and the power, then open it again"
    if any(words in lowered for words in ("no available devices", "cannot find any device", "failed to find device")):
        listed: list[str] = []
        with suppress(Exception):
            listed = [str(info.getDeviceId()) for info in dai.Device.getAllAvailableDevices()]
        there = f"Connected: {', '.join(listed)}" if listed else "None is connected"
        found, expected, hint = "no such camera", "one that answers", f"{there}. Check the cable. {rule}"
    elif "already_in_use" in lowered or "already used" in lowered:
        found, expected, hint = "the camera in use", "a free camera", "Close the other program"
    elif "permission" in lowered:
        found, expected, hint = "permission denied", "a camera that you may open", rule
    return DeviceError(where, operation, f"{found} ({message})", expected, hint)
