"""Decode the images of structured light once; the cloud, the checks and the noise of its points use the result.

Signal chain: stacks of a capture -> noise of their grey levels, known or measured -> projector coordinates of each
camera that measures. :func:`decode` goes on to the cloud; :mod:`mitsim.capture_checks` compares the coordinates with
images and calibration.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from characterisation.point_cloud import PointCloud
from mitsim.capture.capture import Capture
from mitsim.capture.decoding import Settings
from mitsim.decode.grey_levels import MeasuredNoise
from mitsim.decode.structured_light.decoder import decode_coordinates
from mitsim.decode.structured_light.projector_coordinate import ProjectorCoordinate
from mitsim.reconstruction.cloud import (
    bracket_exposures,
    capture_cloud,
    capture_pattern,
    decoder_settings,
    read_out_of,
)
from mitsim.reconstruction.decoder_registry import Coordinates, projector_size
from mitsim.reconstruction.noise import known_noise
from mitsim.sensor.decoder_settings import DecoderSettings
from mitsim.sensor.image_role import Axis
from mitsim.sensor.imager import Imager
from mitsim.sensor.light_code import LightCode, roles
from mitsim.sensor.preset import Sensor
from mitsim.sensor.roi import Roi


@dataclass(frozen=True)
class CodedImages:
    """Images of structured light that show one exposure, and their code.

    Attributes
    ----------
    stacks
        (P, H, W) images [DN] of the code, without an ambient image: of the first camera or, if two cameras triangulate,
        of both.
    code, size
        The code, and width and height of the projector [px].
    full_scale
        Value of a saturated pixel [DN].
    read_out
        Region that was read out of each camera, without cameras that were read out completely.
    """

    stacks: dict[str, NDArray[np.unsignedinteger[Any]]]
    code: LightCode
    size: tuple[int, int]
    full_scale: float
    read_out: dict[str, Roi]

    @classmethod
    def of(cls, capture: Capture, settings: Settings) -> CodedImages | None:
        """Return the coded images of a capture; None for another technology, a bracket, or too few images.

        Raises
        ------
        InputError
            If the capture has no code, or no size of the projector.
        """
        if capture.technology != "structured_light" or not isinstance(settings, DecoderSettings):
            return None
        code = capture_pattern(capture)
        if bracket_exposures(capture) is not None or not isinstance(code, LightCode):
            return None
        size = projector_size(capture)
        count, cameras = len(roles(code, *size)), 2 if settings.triangulate == "cameras" else 1
        stacks = {name: stack[:count] for name, stack in list(capture.images.items())[:cameras]}
        if len(stacks) < cameras or any(len(stack) < count for stack in stacks.values()):
            return None
        return cls(stacks, code, size, 2.0**capture.bits - 1, read_out_of(capture))

    def coordinates(self, settings: DecoderSettings, noise: Imager | MeasuredNoise | None) -> Coordinates:
        """Return the projector coordinates (H, W) of each camera, as the cloud is made from them.

        Raises
        ------
        InputError
            If the code is ambiguous over the projector.
        """
        out: dict[str, dict[Axis, ProjectorCoordinate]] = {}
        for name, stack in self.stacks.items():
            region = self.read_out.get(name)
            found = decode_coordinates(
                stack if region is None else np.ascontiguousarray(stack[:, *region.slices]),
                self.code,
                self.size,
                settings,
                full_scale=self.full_scale,
                imager=noise,
                interpolate=len(self.stacks) > 1,
            )
            if region is not None:
                shape = (stack.shape[1], stack.shape[2])
                found = {axis: each.placed(shape, region.slices) for axis, each in found.items()}
            out[name] = found
        return out


def decode(
    capture: Capture, sensor: Sensor | str | Path | None = None, *, range_mm: tuple[float, float] | None = None
) -> PointCloud:
    """Decode a capture to a cloud, with the standard deviation of its points where the noise is known or measurable.

    Parameters
    ----------
    capture
        The capture.
    sensor
        Sensor whose settings are used: loaded, the name of a preset, or the path of a sensor TOML file. By default
        those of the capture, or those of the preset that it names.
    range_mm
        Nearest and farthest depth to decode [mm], instead of the sensor's.

    Raises
    ------
    InputError
        If the sensor is unknown or of another technology, the range is invalid, or the capture is inconsistent.
    """
    settings, imager = decoder_settings(capture, sensor, range_mm)
    return capture_cloud(capture, settings, imager=known_noise(capture, imager))
