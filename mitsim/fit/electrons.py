"""Grey levels of a capture back to photo-electrons, and the noise of their mean over its images.

Signal chain: grey levels [DN] -> companding or gamma undone -> less black, over the gain -> electrons [e-]. The noise
of a pixel's mean over n images [e-^2], by EMVA 1288 (:mod:`mitsim.sensor.image_formation`), q the grey level's width:

    v = (mu + D t + read^2 + q^2 / 12) / n + dsnu^2 + (prnu mu)^2

The device's fixed pattern is not known, so it counts as noise; rows and columns are shared by the pixels of a block.
Above the first knee of a companding curve, and with a gamma, a level is wider than q: there v is too small.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mitsim.capture.capture import Capture
from mitsim.errors import InputError
from mitsim.sensor.image_formation import converter
from mitsim.sensor.imager import Imager
from mitsim.sensor.noise_sources import Noise

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class PixelNoise:
    """Variance of a pixel's mean over the images [e-^2]: ``fixed`` + ``shot`` mu + ``relative`` mu^2.

    ``row`` and ``column`` [e-^2] are shared by a row and a column. ``gain`` [DN/e-] of the converter.
    """

    fixed: float
    shot: float
    relative: float
    row: float
    column: float
    gain: float

    def variance(self, electrons: Floats) -> Floats:
        """Of independent noise at mean electrons."""
        mu = np.maximum(electrons, 0.0)
        return np.asarray(self.fixed + self.shot * mu + self.relative * mu**2)


def pixel_noise(imager: Imager, chip: Imager, count: int, exposure_s: float, ambient: bool) -> PixelNoise:
    """Noise of the mean of ``count`` images, less one of the scene's own light if there is such."""
    per_image = 1.0 / count + (1.0 if ambient else 0.0)
    level = 1.0 / chip.gain  # e- of a grey level
    temporal = imager.read_noise**2 + imager.dark_current * exposure_s + level**2 / 12
    # what does not change with the images cancels against the dark one
    offset, column = (0.0, 0.0) if ambient else (imager.dsnu**2, imager.column_pattern**2)
    return PixelNoise(
        temporal * per_image + offset, 1.0 / count, imager.prnu**2, imager.row_noise**2 * per_image, column, chip.gain
    )


def linearised(levels: NDArray[np.unsignedinteger[Any]] | Floats, chip: Imager) -> Floats:
    """Photo-electrons [e-] of grey levels [DN]: the imager's curve undone."""
    values = np.asarray(levels, np.float64)
    if chip.companding:
        known = np.array([(0.0, 0.0), *chip.companding])
        # a level stands for the converter's levels that the curve cuts off to it
        inner = np.interp(values + 0.5, known[:, 1], known[:, 0]) - 0.5
        return np.asarray((inner - chip.converter_black) / chip.gain)
    if chip.gamma == 1.0:
        return np.asarray((values - chip.black_level) / chip.gain)
    share = np.clip((values - chip.black_level) / (chip.full_scale - chip.black_level), 0.0, None)
    return np.asarray(chip.full_well * share**chip.gamma)


def chip_of(capture: Capture, imager: Imager, where: str) -> Imager:
    """The imager whose grey levels the capture has.

    Raises
    ------
    InputError
        If they have another number of bits than the sensor's.
    """
    for chip in (imager, converter(imager, Noise.without("quantisation"))):
        if chip.bits == capture.bits:
            return chip
    raise InputError(where, "bits", capture.bits, f"{imager.bits}, as the sensor file says", "or another --sensor")
