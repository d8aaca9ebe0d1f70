"""Describe a capture: the raw images of one measurement, with everything needed to decode them.

Simulated and real captures have the same type. Their ``source`` distinguishes them, and is passed on to every cloud,
map and report. Maps of depth, disparity or points that a device computes itself are ``derived``.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from characterisation.files.errors import InputError
from mitsim.capture.decoding import Decoding
from mitsim.sensor.camera import Rig
from mitsim.sensor.modulation import correlated_light
from mitsim.sensor.transforms import Transform

Source = Literal["simulated", "device", "replay", "emulator"]
SOURCES: tuple[Source, ...] = ("simulated", "device", "replay", "emulator")

#: maps that a capture may contain, and their units
DERIVED_UNITS = {"depth": "mm", "disparity": "px", "points": "mm"}


@dataclass(frozen=True)
class Capture:
    """Images of one measurement.

    Parameters
    ----------
    sensor
        Preset or model name (``ensenso-n10``, ``N35-604-16-BL``).
    technology
        Measuring principle, which selects the decoder, such as ``active_stereo``: a key of
        :data:`mitsim.decoding.decoder_registry.TECHNOLOGIES`.
    source
        Origin of the images: one of :data:`SOURCES`.
    rig
        Calibration of cameras and projector [px, mm]; the first camera is the reference.
    images
        By camera name, (frames, H, W) uint8 or uint16 [DN] in the order of acquisition. Empty if the device gave
        none.
    bits
        Bits per pixel of the cameras; full scale is 2**bits - 1 DN.
    decoding
        What decoding needs besides images and calibration: settings of the decoder, imager, pattern, exposure.
    settings
        Records of the device, the simulation or the import, as JSON values with units in their names. No decoder reads
        them.
    world_from_sensor
        Pose of the sensor in the world frame [mm], None if unknown.
    serial
        Serial number of the device, or "".
    derived
        Maps that the device itself computed, float32, NaN where a value is missing. ``depth`` (H, W) is along the
        axis [mm]. ``disparity`` (H, W) is of the rectified left image [px]. ``points`` (H, W, 3) are in the sensor
        frame [mm].

    Raises
    ------
    ValueError
        If the source is unknown, or an image or map has the wrong shape or type. An InputError if a region was read
        out of a camera that the capture does not have, or is not inside its image.
    """

    sensor: str
    technology: str
    source: Source
    rig: Rig
    images: dict[str, NDArray[np.unsignedinteger[Any]]]
    bits: int = 8
    decoding: Decoding = field(default_factory=Decoding)
    settings: dict[str, Any] = field(default_factory=dict)
    world_from_sensor: Transform | None = None
    serial: str = ""
    derived: dict[str, NDArray[np.float32]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.source not in SOURCES:
            raise ValueError(f"capture source {self.source!r}: allowed are {', '.join(SOURCES)}")
        for name, stack in self.images.items():
            if name not in self.rig.cameras:
                raise ValueError(f"images of {name}: the cameras are {', '.join(self.rig.cameras)}")
            camera = self.rig.cameras[name]
            if stack.ndim != 3 or stack.shape[1:] != (camera.height, camera.width):
                there = f"{camera.height} x {camera.width} pixels"
                raise ValueError(f"images of {name}: shape {stack.shape}, but the camera has {there}")
        # decoders take the cameras in the order of the rig
        ordered = {name: self.images[name] for name in self.rig.cameras if name in self.images}
        object.__setattr__(self, "images", ordered)
        for name, values in self.derived.items():
            if name not in DERIVED_UNITS:
                raise ValueError(f"map {name!r}: allowed are {', '.join(DERIVED_UNITS)}")
            if values.dtype != np.float32 or values.shape[2:] != ((3,) if name == "points" else ()) or values.ndim < 2:
                raise ValueError(f"map of {name}: {values.dtype} of shape {values.shape}")
        for name, region in self.decoding.read_out.items():
            where = f"capture of {self.sensor}: settings.json"
            if name not in self.rig.cameras:
                raise InputError(where, "read_out", repr(name), ", ".join(self.rig.cameras))
            camera = self.rig.cameras[name]
            if not region.fits(camera.width, camera.height):
                found = [region.left, region.top, region.width, region.height]
                allowed = f"[left, top, width, height] within {camera.width} x {camera.height} pixels"
                raise InputError(where, f"read_out.{name}", found, allowed)

    def brightness(self, camera: str) -> NDArray[np.float64]:
        """Return the light that a camera sees, (H, W) [DN]: the mean of its images but that of ambient light.

        An image of time of flight is a correlation about a zero level; its light is the range over the phase steps.
        """
        stack = self.images[camera]
        if self.technology == "time_of_flight":
            return correlated_light(stack)
        lit = stack[:-1] if self.decoding.ambient_image and len(stack) > 1 else stack
        return np.asarray(lit.mean(axis=0, dtype=np.float64))

    def plot(self, ax: Any = None, *, camera: str | None = None, image: int = 0) -> NDArray[np.object_]:
        """Draw an image of every camera in grey, with saturated pixels marked.

        All cameras share one scale. It is stretched to the grey levels that occur, since metal is dark but for its
        highlights. Of a capture without images, the maps that the device computed are drawn.

        Parameters
        ----------
        ax
            Axes to draw into, one for each camera; by default those of a new figure.
        camera
            Draw this camera alone.
        image
            Number of the image, from 0; negative numbers count from the last.

        Returns
        -------
        numpy.ndarray of matplotlib.axes.Axes
            (cameras,), in the order of ``images``.

        Raises
        ------
        InputError
            If there is no such camera or image, or another number of axes.

        Examples
        --------
        >>> import mitsim as ms
        >>> left, right = ms.read_capture("capture").plot()
        >>> left.get_title()
        'left: small, simulated'
        >>> left.figure.savefig("images.png")
        """
        # imported here because a capture alone does not need matplotlib
        from mitsim.capture.picture import draw_images, draw_maps

        caption = f"{self.sensor}, {self.source}"
        drawn = list(self.images) or list(self.rig.cameras)[:1]  # maps are of the reference
        if camera is not None and camera not in drawn:
            raise InputError("plot", "camera", repr(camera), ", ".join(drawn))
        if not self.images:
            if not self.derived:
                raise InputError(f"capture of {self.sensor}", "images", "none", "at least one image or map to draw")
            depth = {name: values[..., 2] if name == "points" else values for name, values in self.derived.items()}
            return draw_maps(depth, DERIVED_UNITS, caption, ax)
        stacks = self.images if camera is None else {camera: self.images[camera]}
        return draw_images(stacks, 2**self.bits - 1, caption, ax, image)
