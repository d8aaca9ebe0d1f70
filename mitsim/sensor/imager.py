"""The camera's imager, in the terms of EMVA 1288.

Signal chain: radiance [W/(mm^2 sr)] -> irradiance on the imager through the lens -> photons in a pixel during the
exposure -> photo-electrons (quantum efficiency) -> shot noise -> fixed pattern (PRNU, DSNU) -> read noise -> full
well -> gain and black level -> quantisation -> grey levels [DN].

    mu_e = QE A t (pi L / 4 N^2) lambda / (h c),      N the f-number, A the pixel's area
    sigma^2 = K^2 (sigma_read^2 + mu_e) + 1/12        K = full scale / full well [DN/e-]

Left out: the lens's own vignetting, dark current (exposures are milliseconds), row noise, cross-talk.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_PLANCK_J_S = 6.62607015e-34
_LIGHT_M_S = 299792458.0


@dataclass(frozen=True)
class Imager:
    """Parameters of an imager; electrons are e-, grey levels DN.

    ``pixel_um`` pitch; ``quantum_efficiency`` at the sensor's wavelength [1]; ``full_well`` [e-]; ``read_noise``
    [e-] temporal, dark; ``dsnu`` [e-] and ``prnu`` [1] fixed pattern, standard deviations; ``bits``; ``black_level``
    [DN]; ``f_number`` of the lens; ``blur_px`` standard deviation of the lens's point spread [px].
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

    @property
    def full_scale(self) -> int:
        """Largest grey level [DN]; a pixel that shows it is saturated."""
        return int(2**self.bits - 1)

    @property
    def gain(self) -> float:
        """System gain K [DN/e-]: a full well just reaches full scale."""
        return (self.full_scale - self.black_level) / self.full_well


@dataclass(frozen=True)
class FixedPattern:
    """What one physical imager always adds: ``offset`` [e-] (DSNU) and ``response`` [1] (1 + PRNU), (H, W)."""

    offset: NDArray[np.float32]
    response: NDArray[np.float32]


def fixed_pattern(imager: Imager, shape: tuple[int, int], rng: np.random.Generator) -> FixedPattern:
    """Draw the fixed pattern of one camera; the same generator state gives the same camera."""
    offset = rng.normal(0.0, 1.0, shape).astype(np.float32) * np.float32(imager.dsnu)
    response = 1 + rng.normal(0.0, 1.0, shape).astype(np.float32) * np.float32(imager.prnu)
    return FixedPattern(offset, response)


def electrons_per_radiance(imager: Imager, wavelength_nm: float, exposure_s: float) -> float:
    """Mean photo-electrons in a pixel per unit of radiance [e- / (W mm^-2 sr^-1)]."""
    area_mm2 = (imager.pixel_um * 1e-3) ** 2
    photons_per_joule = wavelength_nm * 1e-9 / (_PLANCK_J_S * _LIGHT_M_S)
    solid_angle = np.pi / (4.0 * imager.f_number**2)
    return float(solid_angle * area_mm2 * exposure_s * photons_per_joule * imager.quantum_efficiency)


def expose(
    electrons: NDArray[np.floating], imager: Imager, pattern: FixedPattern | None, rng: np.random.Generator | None
) -> NDArray[np.uint8] | NDArray[np.uint16]:
    """Grey levels [DN] of mean photo-electrons (..., H, W).

    ``pattern`` None switches the fixed pattern off, ``rng`` None the shot and read noise; saturation and quantisation
    stay.
    """
    charge = np.asarray(electrons, np.float32)
    if pattern is not None:
        charge = charge * pattern.response
    if rng is not None:
        charge = rng.poisson(np.maximum(charge, 0)).astype(np.float32)
    if pattern is not None:
        charge = charge + pattern.offset
    if rng is not None:
        charge = charge + rng.normal(0.0, 1.0, charge.shape).astype(np.float32) * np.float32(imager.read_noise)
    level = np.minimum(charge, imager.full_well) * imager.gain + imager.black_level
    quantised = np.clip(np.rint(level), 0, imager.full_scale)
    return quantised.astype(np.uint8) if imager.bits <= 8 else quantised.astype(np.uint16)
