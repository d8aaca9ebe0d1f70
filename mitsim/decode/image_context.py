"""Properties of the images that a decoder needs beside the images themselves and the calibration."""

from __future__ import annotations

from dataclasses import dataclass

from mitsim.decode.grey_levels import MeasuredNoise
from mitsim.sensor.imager import Imager
from mitsim.sensor.roi import Roi


@dataclass(frozen=True)
class ImageContext:
    """Properties of the images of a capture.

    Attributes
    ----------
    sensor, source
        Carried into the cloud.
    full_scale
        Value of a saturated pixel [DN], ``2**bits - 1``.
    imager
        Gain, read noise and black level, from which the expected noise follows; or the noise of grey levels measured
        in the images themselves (:mod:`mitsim.decode.structured_light.measured_noise`). None where neither is known.
    roi
        Region of the cloud's grid: decode only this. Pixels outside are ``NO_SURFACE``.
    read_out
        Region of the raw image of the first and of the second camera that was read out; None is the whole image.
    """

    sensor: str
    source: str
    full_scale: float
    imager: Imager | MeasuredNoise | None = None
    roi: Roi | None = None
    read_out: tuple[Roi | None, Roi | None] = (None, None)
