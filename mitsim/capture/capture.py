"""A capture: the raw images of one measurement with everything needed to decode them.

A simulated and a real capture are the same thing; ``source`` says which it is and is carried into all that is made
from it. Where a device gives maps of depth, disparity or points, with its images or without, they are ``derived``.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from mitsim.sensor.camera import Rig
from mitsim.sensor.transforms import Transform

if TYPE_CHECKING:
    from characterisation.point_cloud import PointCloud
    from mitsim.sensor.preset import Sensor

Source = Literal["simulated", "device", "replay", "emulator"]
SOURCES: tuple[Source, ...] = ("simulated", "device", "replay", "emulator")

#: maps that a capture may hold, and their units
DERIVED_UNITS = {"depth": "mm", "disparity": "px", "points": "mm"}


@dataclass(frozen=True)
class Capture:
    """Images of one measurement.

    Parameters
    ----------
    sensor
        Preset or model name (``ensenso-n10``, ``N35-604-16-BL``).
    technology
        How it is decoded: ``active_stereo``; an entry of :data:`mitsim.reconstruction.decoder_registry.TECHNOLOGIES`.
    source
        Where the images came from.
    rig
        Calibration of cameras and projector.
    images
        Camera name -> (frames, H, W) uint8 or uint16 [DN], in the order in which they were taken. Empty where the
        device gave none.
    bits
        Bits per pixel of the camera; full scale is 2**bits - 1.
    settings
        Exposure, gain and so on, as plain JSON values with units in their names (``exposure_s``).
    world_from_sensor
        Pose, if known.
    serial
        Serial number of the device, or "".
    derived
        What the device itself made of its images, float32, NaN where it has nothing: ``depth`` (H, W) along the axis
        [mm], ``disparity`` (H, W) of the rectified left image [px], ``points`` (H, W, 3) in the sensor frame [mm].
    pose_covariance
        (6, 6) of the pose, if known: rotation vector about the world's axes [rad], place of the sensor's origin in the
        world [mm].
    taken_by
        The sensor that took it, where this process simulated it: :meth:`cloud` decodes with its settings. It is not
        written to a folder.
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
    derived: dict[str, NDArray[np.float32]] = field(default_factory=dict)
    pose_covariance: NDArray[np.float64] | None = None
    taken_by: Sensor | None = field(default=None, repr=False, compare=False)

    def __post_init__(self) -> None:
        if self.source not in SOURCES:
            raise ValueError(f"capture source {self.source!r}: allowed are {', '.join(SOURCES)}")
        for name, stack in self.images.items():
            camera = self.rig.cameras[name]
            if stack.ndim != 3 or stack.shape[1:] != (camera.height, camera.width):
                raise ValueError(f"images of {name}: {stack.shape}, the camera is {camera.height} x {camera.width}")
        for name, values in self.derived.items():
            if name not in DERIVED_UNITS:
                raise ValueError(f"map {name!r}: allowed are {', '.join(DERIVED_UNITS)}")
            if values.dtype != np.float32 or values.shape[2:] != ((3,) if name == "points" else ()) or values.ndim < 2:
                raise ValueError(f"map of {name}: {values.dtype} {values.shape}")
        if self.pose_covariance is not None and self.world_from_sensor is None:
            raise ValueError("the covariance of a pose that is not known")

    def cloud(
        self, sensor: Sensor | str | Path | None = None, *, range_mm: tuple[float, float] | None = None
    ) -> PointCloud:
        """Decode the images into a point cloud.

        Parameters
        ----------
        sensor
            Decode with the settings of this sensor: loaded, a preset's name, or the path of a sensor TOML file. Left
            out, those of the sensor that was rendered, the capture's own, or those of the preset that it names.
        range_mm
            Nearest and farthest depth [mm] to be decoded, in place of the sensor's.

        Returns
        -------
        PointCloud
            Points (H, W, 3) float32 [mm] in the sensor frame, NaN where missing; ``status`` (H, W) says why.

        Raises
        ------
        InputError
            If the sensor is not known or of another technology, or the range makes no sense.

        Examples
        --------
        >>> import mitsim as ms
        >>> cloud = ms.read_capture("capture").cloud("small.toml")
        >>> cloud.points.shape
        (240, 320, 3)
        >>> round(float(cloud.valid.mean()), 1) > 0
        True
        """
        # decoders are not needed to hold a capture
        from mitsim.reconstruction.cloud import capture_cloud, decoder_settings, in_range
        from mitsim.reconstruction.noise import known_noise

        chosen = self.taken_by if sensor is None else sensor
        if chosen is None or isinstance(chosen, str | Path):
            settings, imager = decoder_settings(self, None if chosen is None else str(chosen), range_mm)
        else:
            settings = in_range(chosen.settings, range_mm, f"capture of {self.sensor}")
            imager = chosen.imager if chosen.imager.bits == self.bits else None
        return capture_cloud(self, settings, imager=known_noise(self, imager))
