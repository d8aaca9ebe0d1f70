"""Describe a camera's imager by the parameters of EMVA 1288, and the lens by its f-number and blur.

The fields are also the keys of ``[imager]`` in a sensor file and of a capture's settings, under the names of their
aliases and with these limits. :mod:`mitsim.sensor.image_formation` has the equations, and makes images with them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, ValidatorFunctionWrapHandler, WrapValidator, model_validator

_PLANCK_J_S = 6.62607015e-34
_LIGHT_M_S = 299792458.0

#: keys of the numbers without a default
DESCRIPTION = ("pixel_um", "quantum_efficiency", "full_well_e", "read_noise_e", "f_number")

Positive = Annotated[float, Field(gt=0)]


@dataclass(frozen=True)
class Imager:
    """Parameters of an imager; a number without a default is NaN if the file does not state it.

    - ``pixel_um``: pixel pitch; ``bits`` of its images; ``f_number`` of the lens.
    - ``quantum_efficiency`` at the sensor's wavelength [1]; ``full_well`` [e-].
    - ``read_noise`` [e-]: temporal, dark.
    - ``dsnu`` [e-] and ``prnu`` [1]: fixed pattern, standard deviations.
    - ``black_level`` [DN].
    - ``blur_px``: standard deviation of the lens's point spread function [px].
    - ``gamma`` of the response curve [1]; values over 1 brighten the shadows.
    - ``row_noise`` [e-]: temporal, one draw for each row and image.
    - ``column_pattern`` [e-]: fixed, one draw for each column.
    - ``dark_current`` [e-/s].
    - ``corner_illumination`` of the image's farthest corner relative to the centre [1]; None is the cos^4 law of each
      camera.
    - ``companding``: knees (DN_in, DN_out) of the curve from the converter's levels to grey levels, rising from (0, 0)
      to (2^bits of the converter, 2^``bits``). Empty is a linear converter. It replaces ``gamma``.
    - ``smoothing_px``: standard deviation of the Gaussian with which the device smooths its images before output [px].
    - ``corner_blur_px``: standard deviation of the point spread function in the image's farthest corner [px]; None is
      ``blur_px`` everywhere.
    """

    __pydantic_config__ = ConfigDict(extra="forbid", allow_inf_nan=False)

    pixel_um: Annotated[float, Field(gt=0)] = math.nan
    quantum_efficiency: Annotated[float, Field(gt=0, le=1)] = math.nan
    full_well: Annotated[float, Field(gt=0, alias="full_well_e")] = math.nan
    read_noise: Annotated[float, Field(ge=0, alias="read_noise_e")] = math.nan
    dsnu: Annotated[float, Field(ge=0, alias="dsnu_e")] = 0.0
    prnu: Annotated[float, Field(ge=0, le=1)] = 0.0
    bits: Annotated[int, Field(ge=1, le=16)] = 8
    black_level: Annotated[float, Field(ge=0, alias="black_level_dn")] = 0.0
    f_number: Annotated[float, Field(gt=0)] = math.nan
    blur_px: Annotated[float, Field(ge=0, le=5)] = 0.0
    gamma: Annotated[float, Field(ge=0.2, le=5)] = 1.0
    row_noise: Annotated[float, Field(ge=0, alias="row_noise_e")] = 0.0
    column_pattern: Annotated[float, Field(ge=0, alias="column_pattern_e")] = 0.0
    dark_current: Annotated[float, Field(ge=0, alias="dark_current_e_s")] = 0.0
    corner_illumination: Annotated[float, Field(gt=0, le=1)] | None = None
    companding: Annotated[tuple[tuple[Positive, Positive], ...], Field(max_length=32, alias="companding_dn")] = ()
    smoothing_px: Annotated[float, Field(ge=0, le=5)] = field(default=0.0, repr=False)
    corner_blur_px: Annotated[float, Field(ge=0, le=10)] | None = field(default=None, repr=False)

    @model_validator(mode="after")
    def _check_knees(self) -> Imager:
        """Check the levels and the companding curve of a file; code may make any imager."""
        if self.black_level >= 2**self.bits:
            raise ValueError(f"black_level_dn under full scale, {2**self.bits} DN")
        if not self.companding:
            return self
        if self.gamma != 1:
            raise ValueError("companding_dn and gamma are two curves: give one of them")
        levels = np.array([(0.0, 0.0), *self.companding])
        if (np.diff(levels, axis=0) <= 0).any():
            raise ValueError("companding_dn must rise from knee to knee, in and out")
        if levels[-1].tolist() not in [[2**n, 2**self.bits] for n in range(self.bits, 17)]:
            raise ValueError(f"companding_dn ends with [2^(bits of the converter, up to 16), {2**self.bits}]")
        return self

    @property
    def full_scale(self) -> int:
        """Return the largest grey level [DN]; a pixel at this level is saturated."""
        return int(2**self.bits - 1)

    @property
    def gain(self) -> float:
        """Return the system gain K [DN/e-] ahead of gamma and companding: a full well gives full scale."""
        last = self.companding[-1][0] - 1 if self.companding else self.full_scale
        return (last - self.converter_black) / self.full_well

    @property
    def knees(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the input and output levels of the companding curve, from (0, 0)."""
        levels = np.array([(0.0, 0.0), *self.companding])
        return levels[:, 0], levels[:, 1]

    @property
    def converter_black(self) -> float:
        """Return the converter level [DN_in] that is output as ``black_level``."""
        levels_in, levels_out = self.knees
        return float(np.interp(self.black_level, levels_out, levels_in)) if self.companding else self.black_level


def _read(value: Any, read: ValidatorFunctionWrapHandler) -> Imager:
    if isinstance(value, Imager):
        return value
    imager: Imager = read(value)
    missing = [f"imager.{key}" for key in DESCRIPTION if math.isnan(getattr(imager, key.removesuffix("_e")))]
    if missing:
        raise ValueError(f"a value of each of {', '.join(missing)}")
    return imager


#: type of an imager in a document, which states all its numbers
WrittenImager = Annotated[Imager, WrapValidator(_read)]


def electrons_per_radiance(imager: Imager, wavelength_nm: float, exposure_s: float) -> float:
    """Return the mean photo-electrons in a pixel per unit of radiance [e- / (W mm^-2 sr^-1)]."""
    area_mm2 = (imager.pixel_um * 1e-3) ** 2
    photons_per_joule = wavelength_nm * 1e-9 / (_PLANCK_J_S * _LIGHT_M_S)
    solid_angle = np.pi / (4.0 * imager.f_number**2)
    return float(solid_angle * area_mm2 * exposure_s * photons_per_joule * imager.quantum_efficiency)
