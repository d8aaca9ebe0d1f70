"""Decode the images of structured light once; the cloud, the checks and the noise of its points use the result.

Signal chain: stacks of a capture -> noise of their grey levels, known or measured -> projector coordinates of each
camera that measures. :func:`mitsim.decoding.cloud.capture_cloud` goes on to the cloud;
:mod:`mitsim.decoding.checks` compares the coordinates with images and calibration.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from characterisation.point_cloud import PointCloud
from characterisation.region_of_interest import Roi
from mitsim.capture.capture import Capture
from mitsim.capture.decoding import Settings
from mitsim.decoding.cloud import capture_cloud
from mitsim.decoding.decoder_registry import Coordinates, Geometry, projector_size
from mitsim.decoding.grey_levels import MeasuredNoise, with_dark_noise
from mitsim.decoding.structured_light.decoder import decode_coordinates
from mitsim.decoding.structured_light.measured_noise import measured_noise
from mitsim.decoding.structured_light.projector_coordinate import ProjectorCoordinate
from mitsim.sensor.decoder_settings import DecoderSettings
from mitsim.sensor.image_role import Axis
from mitsim.sensor.imager import Imager
from mitsim.sensor.light_code import GrayCode, LightCode, roles


@dataclass(frozen=True)
class CodedImages:
    """Images of structured light that show one exposure, and their code."""

    #: (P, H, W) images [DN] of the code, without an ambient image: of the first camera or, if two cameras triangulate,
    #: of both
    stacks: dict[str, NDArray[np.unsignedinteger[Any]]]
    #: ``code``, ``size``: the code, and width and height of the projector [px]
    code: LightCode
    size: tuple[int, int]
    settings: DecoderSettings  # limits of the decoder
    full_scale: float  # value of a saturated pixel [DN]
    noise: Imager | MeasuredNoise | None  # the imager, or the noise that the fringes show; None if neither is known
    read_out: dict[str, Roi]  # region that was read out of each camera, without cameras that were read out completely

    @classmethod
    def of(cls, capture: Capture, settings: Settings, imager: Imager | None = None) -> CodedImages | None:
        """Return the coded images of a capture; None for another technology, a bracket, or too few images.

        Raises InputError if the capture has no size of the projector.
        """
        stated, code = capture.decoding, capture.decoding.pattern
        if capture.technology != "structured_light" or not isinstance(settings, DecoderSettings):
            return None
        if stated.bracket_s is not None or not isinstance(code, LightCode):
            return None
        size, full_scale = projector_size(capture), 2.0**capture.bits - 1
        count, cameras = len(roles(code, *size)), 2 if settings.triangulate == "cameras" else 1
        stacks = {name: stack[:count] for name, stack in list(capture.images.items())[:cameras]}
        if len(stacks) < cameras or any(len(stack) < count for stack in stacks.values()):
            return None
        noise = with_dark_noise(imager, stated.exposures_s)
        if noise is None:
            noise = _fringe_noise(capture.images, code, size, full_scale)
        return cls(stacks, code, size, settings, full_scale, noise, stated.read_out)

    @cached_property
    def coordinates(self) -> Coordinates:
        """Projector coordinates (H, W) of each camera, as the cloud is made from them.

        Raises InputError if the code is ambiguous over the projector.
        """
        out: dict[str, dict[Axis, ProjectorCoordinate]] = {}
        for name, stack in self.stacks.items():
            region = self.read_out.get(name)
            coordinates = decode_coordinates(
                stack if region is None else np.ascontiguousarray(stack[:, *region.slices]),
                self.code,
                self.size,
                self.settings,
                full_scale=self.full_scale,
                imager=self.noise,
                interpolate=len(self.stacks) > 1,
            )
            if region is not None:
                shape = (stack.shape[1], stack.shape[2])
                coordinates = {
                    axis: coordinate.placed(shape, region.slices) for axis, coordinate in coordinates.items()
                }
            out[name] = coordinates
        return out


def decoded_once(
    capture: Capture, settings: Settings, imager: Imager | None, geometry: Geometry | None = None
) -> tuple[PointCloud, CodedImages | None, Imager | MeasuredNoise | None]:
    """Return the cloud of a capture; its coded images, decoded already, if it has any; and the noise of its images.

    The noise is that of the imager or, without one, the noise that fringes show.

    ``capture``, ``settings``: images of a code, and the settings that decode them. ``imager``: the imager that took
    them, if its numbers are known. ``geometry``: of the capture's rig, if it is prepared already. Raises InputError if
    the settings belong to another technology, or the capture is inconsistent.
    """
    images = CodedImages.of(capture, settings, imager)
    if images is None:
        return capture_cloud(capture, settings, geometry, imager=imager), None, imager
    cloud = capture_cloud(capture, settings, geometry, imager=images.noise, coordinates=images.coordinates)
    return cloud, images, images.noise


def _fringe_noise(
    images: Mapping[str, NDArray[np.unsignedinteger[Any]]], code: LightCode, size: tuple[int, int], full_scale: float
) -> MeasuredNoise | None:
    """Return the noise that the images of each camera show, None if it cannot be measured."""
    if isinstance(code, GrayCode):
        return None
    image_roles = roles(code, *size)
    stacks = [stack[: len(image_roles)] for stack in images.values() if len(stack) >= len(image_roles)]
    return measured_noise(stacks, image_roles, full_scale) if stacks else None
