"""What a decoder is told of the images, beside the images themselves and the calibration."""

from __future__ import annotations

from dataclasses import dataclass

from mitsim.decode.grey_levels import MeasuredNoise
from mitsim.decode.roi import Window
from mitsim.sensor.imager import Imager

#: parts (column0, row0, column1, row1) of the raw images of two cameras that were read out, None where all was
Regions = tuple[Window | None, Window | None]


@dataclass(frozen=True)
class ImageContext:
    """What a decoder is told of the images.

    Attributes
    ----------
    sensor, source
        Carried into the cloud.
    full_scale
        Value of a saturated pixel [DN], ``2**bits - 1``.
    imager
        Gain, read noise and black level, from which the expected noise follows; or the noise of grey levels that the
        images have themselves (:mod:`mitsim.decode.structured_light.measured_noise`). None where neither is known.
    window
        (column0, row0, column1, row1) of the cloud's grid, ends not included: decode only this part. Pixels outside
        are ``NO_SURFACE``.
    read_out
        Parts of the raw images of the first and the second camera that hold anything; None is the whole.
    """

    sensor: str
    source: str
    full_scale: float
    imager: Imager | MeasuredNoise | None = None
    window: Window | None = None
    read_out: Regions = (None, None)
