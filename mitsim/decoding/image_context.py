"""Describe the properties of images that a decoder needs in addition to the images and the calibration."""

from __future__ import annotations

from dataclasses import dataclass

from characterisation.region_of_interest import Roi
from mitsim.decoding.grey_levels import MeasuredNoise
from mitsim.sensor.imager import Imager


@dataclass(frozen=True)
class ImageContext:
    """Properties of the images of a capture."""

    #: ``sensor``, ``source``: copied into the cloud
    sensor: str
    source: str
    full_scale: float  # value of a saturated pixel [DN], ``2**bits - 1``
    #: the imager, whose gain, read noise and black level give the expected noise; or noise measured in the images
    #: (:mod:`mitsim.decoding.structured_light.measured_noise`). None if neither is known
    imager: Imager | MeasuredNoise | None = None
    roi: Roi | None = None  # region of the cloud's grid to decode, None for all. Pixels outside are ``NO_SURFACE``
    #: regions of the raw images of the first and second camera that were read out; None for a whole image
    read_out: tuple[Roi | None, Roi | None] = (None, None)
    #: of merged exposures with linear levels: shortest exposure, to which the levels refer, over longest [1]
    share: float = 1.0
