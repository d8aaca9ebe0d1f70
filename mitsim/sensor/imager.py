"""Describe a camera's imager by the parameters of EMVA 1288, and the lens by its f-number and blur.

:mod:`mitsim.sensor.image_formation` has the equations, and makes images with these parameters.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

_PLANCK_J_S = 6.62607015e-34
_LIGHT_M_S = 299792458.0


@dataclass(frozen=True)
class Imager:
    """Parameters of an imager.

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

    pixel_um: float
    quantum_efficiency: float
    full_well: float
    read_noise: float
    dsnu: float
    prnu: float
    bits: int
    black_level: float
    f_number: float
    blur_px: float = 0.0
    gamma: float = 1.0
    row_noise: float = 0.0
    column_pattern: float = 0.0
    dark_current: float = 0.0
    corner_illumination: float | None = None
    companding: tuple[tuple[float, float], ...] = ()
    smoothing_px: float = field(default=0.0, repr=False)
    corner_blur_px: float | None = field(default=None, repr=False)

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


def electrons_per_radiance(imager: Imager, wavelength_nm: float, exposure_s: float) -> float:
    """Return the mean photo-electrons in a pixel per unit of radiance [e- / (W mm^-2 sr^-1)]."""
    area_mm2 = (imager.pixel_um * 1e-3) ** 2
    photons_per_joule = wavelength_nm * 1e-9 / (_PLANCK_J_S * _LIGHT_M_S)
    solid_angle = np.pi / (4.0 * imager.f_number**2)
    return float(solid_angle * area_mm2 * exposure_s * photons_per_joule * imager.quantum_efficiency)
