"""A capture: the raw images of one measurement with everything needed to decode them.

A simulated and a real capture are the same thing; ``source`` says which it is and is carried into all that is made
from it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mitsim.sensor.camera import Rig
from mitsim.sensor.frames import Transform

Source = Literal["simulated", "device", "replay", "emulator"]
SOURCES: tuple[Source, ...] = ("simulated", "device", "replay", "emulator")


@dataclass(frozen=True)
class Capture:
    """Images of one measurement.

    Parameters
    ----------
    sensor
        Preset or model name (``ensenso-n10``, ``N35-604-16-BL``).
    technology
        How it is decoded: ``active_stereo``.
    source
        Where the images came from.
    rig
        Calibration of cameras and projector.
    images
        Camera name -> (frames, H, W) uint8 or uint16 [DN], in the order in which they were taken.
    bits
        Bits per pixel of the camera; full scale is 2**bits - 1.
    settings
        Exposure, gain and so on, as plain JSON values with units in their names (``exposure_s``).
    world_from_sensor
        Pose, if known.
    serial
        Serial number of the device, or "".
    """

    sensor: str
    technology: str
    source: Source
    rig: Rig
    images: dict[str, NDArray[np.unsignedinteger[Any]]]
    bits: int = 8
    settings: dict[str, Any] = field(default_factory=dict)
    world_from_sensor: Transform | None = None
    serial: str = ""

    def __post_init__(self) -> None:
        if self.source not in SOURCES:
            raise ValueError(f"capture source {self.source!r}: allowed are {', '.join(SOURCES)}")
        for name, stack in self.images.items():
            camera = self.rig.cameras[name]
            if stack.ndim != 3 or stack.shape[1:] != (camera.height, camera.width):
                raise ValueError(f"images of {name}: {stack.shape}, the camera is {camera.height} x {camera.width}")
