"""Convert the grey levels of a capture to photo-electrons, and compute the noise of their mean over its images.

Signal chain: grey levels [DN] -> companding or gamma inverted -> black level subtracted, divided by the gain ->
electrons [e-]. EMVA 1288 (:mod:`mitsim.sensor.image_formation`) gives the variance of a pixel's mean over n images
[e-^2]. With q the width of a grey level [e-]:

    v = (mu + D t + read^2 + q^2 / 12) / n + dsnu^2 + (prnu mu)^2

The device's fixed pattern is not known, so it counts as noise. The pixels of a block share row and column noise. Above
the first knee of a companding curve, and with a gamma, a grey level is wider than q, so v is too small there.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from characterisation.files.arrays import Floats
from characterisation.files.errors import InputError
from mitsim.capture.capture import Capture
from mitsim.sensor.image_formation import converter
from mitsim.sensor.imager import Imager
from mitsim.sensor.noise_sources import Noise
from mitsim.sensor.preset import load_sensor, presets
from mitsim.sensor.sensor import Sensor
from mitsim.sensor.sensor_file import Purpose


@dataclass(frozen=True)
class PixelNoise:
    """Variance of a pixel's mean over the images [e-^2]: ``fixed`` + ``shot`` mu + ``relative`` mu^2.

    ``row`` and ``column`` [e-^2] are the variances of noise that a whole row or column shares. ``gain`` [DN/e-] is that
    of the converter.
    """

    fixed: float
    shot: float
    relative: float
    row: float
    column: float
    gain: float

    def variance(self, electrons: Floats) -> Floats:
        """Return the variance [e-^2] of the noise that is independent between pixels, at mean ``electrons`` [e-]."""
        mu = np.maximum(electrons, 0.0)
        return np.asarray(self.fixed + self.shot * mu + self.relative * mu**2)


def pixel_noise(imager: Imager, chip: Imager, count: int, exposure_s: float, ambient: bool) -> PixelNoise:
    """Return the noise of the mean of ``count`` images; shot noise of the scene's own light is neglected.

    ``chip`` is the imager with the capture's number of bits (:func:`chip_of`). If an ``ambient`` image with the
    projector off is subtracted, its read noise adds, and the fixed pattern cancels.
    """
    per_image = 1.0 / count + (1.0 if ambient else 0.0)
    level = 1.0 / chip.gain  # e- of a grey level
    temporal = imager.read_noise**2 + imager.dark_current * exposure_s + level**2 / 12
    # the fixed pattern of offsets cancels in the difference from the dark image
    offset, column = (0.0, 0.0) if ambient else (imager.dsnu**2, imager.column_pattern**2)
    return PixelNoise(
        temporal * per_image + offset, 1.0 / count, imager.prnu**2, imager.row_noise**2 * per_image, column, chip.gain
    )


def linearised(levels: NDArray[np.unsignedinteger[Any]] | Floats, chip: Imager) -> Floats:
    """Return the photo-electrons [e-] of grey levels [DN], by the inverse of the imager's response curve."""
    values = np.asarray(levels, np.float64)
    if chip.companding:
        knees = np.array([(0.0, 0.0), *chip.companding])
        # a level represents all levels of the converter that the curve rounds down to it
        inner = np.interp(values + 0.5, knees[:, 1], knees[:, 0]) - 0.5
        return np.asarray((inner - chip.converter_black) / chip.gain)
    if chip.gamma == 1.0:
        return np.asarray((values - chip.black_level) / chip.gain)
    share = np.clip((values - chip.black_level) / (chip.full_scale - chip.black_level), 0.0, None)
    return np.asarray(chip.full_well * share**chip.gamma)


def sensor_of(capture: Capture, name: str | None, where: str | Path, purpose: Purpose = "simulation") -> Sensor:
    """Return the sensor of a name or file, by default the preset that a capture names.

    Raises InputError if the capture names none.

    Parameters
    ----------
    capture, where
        It may name its sensor; name of the capture, for errors.
    name, purpose
        Of a preset, or path of a sensor file, None for the capture's; what the sensor is for.
    """
    if name is None and capture.sensor not in presets():
        found = f"none, and {where} comes from {capture.sensor}, which is not a preset"
        types = {preset: preset.partition("-")[2] for preset in presets()}  # the name without its maker
        alike = [preset for preset, of_type in types.items() if of_type and of_type in capture.sensor.casefold()]
        hint = f"its type may be {' or '.join(alike)}" if alike else ""
        raise InputError("--sensor", "", found, f"one of {', '.join(presets())}, or the path of a .toml file", hint)
    return load_sensor(capture.sensor if name is None else name, purpose)


def chip_of(capture: Capture, imager: Imager, where: str) -> Imager:
    """Return the imager, or its converter before companding, with the capture's number of bits; else InputError."""
    for chip in (imager, converter(imager, Noise.without("quantisation"))):
        if chip.bits == capture.bits:
            return chip
    raise InputError(where, "bits", capture.bits, f"{imager.bits}, as the sensor file says", "or another --sensor")
