"""Options for reading a recording: what a user says of it that its files do not."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from characterisation.files.errors import InputError
from mitsim.sensor.preset import named_sensor


@dataclass(frozen=True)
class ReadOptions:
    """Options for reading a recording; None if not given.

    - ``sensor``: a preset or sensor file.
    - ``calibration``: see :mod:`mitsim.capture.recordings.calibration_file`; ``camera`` of it.
    - ``frame``: which of several.
    - ``range_mm``: depths to decode.
    - ``scale_mm`` of a depth image's grey level, its ``invalid`` level, and ``along`` the ``axis`` or the ``ray``.
    - ``unit`` and ``axes`` of a cloud; ``link``: an Ensenso's node that transformed it.
    - ``subpixel_bits`` of disparities.
    - ``topic`` of a bag of ROS: one, or those of a left and a right camera.
    - ``images``: a pattern of file names for each camera; ``channel`` of colour images.

    All kinds use ``exposure_s``; ``pose``, a file with ``world_from_sensor``; ``sample`` of a coupon; ``projector``,
    ``on`` or ``off``.
    """

    sensor: str | None = None
    calibration: str | None = None
    camera: str | None = None
    frame: int | str | None = None
    range_mm: tuple[float, float] | None = None
    scale_mm: float | None = None
    invalid: int | None = None
    along: str | None = None
    unit: str | None = None
    axes: str | None = None
    link: str | None = None
    subpixel_bits: int | None = None
    topic: tuple[str, ...] | None = None
    images: dict[str, str] | None = None
    channel: str | None = None
    exposure_s: float | None = None
    pose: str | None = None
    sample: str | None = None
    projector: str | None = None

    @property
    def named(self) -> str | None:
        """Return the name of the sensor, if one is given."""
        return None if self.sensor is None else named_sensor(self.sensor)[0]

    @property
    def cameras(self) -> str | None:
        """Return the source of the cameras: the calibration, else the sensor."""
        return self.calibration or self.sensor

    def cameras_of(self, path: str | Path, kind: str) -> str:
        """Return the source of the cameras of a recording, such as ``a stereo pair``, which needs one.

        Raises InputError if none is given.
        """
        if self.cameras is None:
            raise InputError(path, "", f"{kind} alone", "the camera that took it: --calibration FILE, or --sensor")
        return self.cameras
