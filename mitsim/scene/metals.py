"""Optical constants of metals: complex refractive index n - ik per wavelength.

Values from the refractiveindex.info database (CC0): aluminium Rakic 1995, copper Johnson & Christy 1972, brass
Cu70Zn30 Querry 1985, stainless steel (austenitic) Karlsson & Ribbing 1982, carbon steel as iron Johnson & Christy
1974. They are of clean evaporated or polished metal; a machined alloy with its oxide reflects 3 to 10 % less.

Mitsuba's own presets are not used: in the monochrome variants they collapse to the visible average whatever the
wavelength, and beyond 885 nm they are zero, which renders as a perfect mirror.
"""

from __future__ import annotations

import numpy as np

#: wavelengths of the table [nm]
WAVELENGTHS_NM = np.array([405, 450, 520, 532, 640, 660, 830, 850, 940], float)

#: metal -> (n, k) at those wavelengths
CONSTANTS: dict[str, tuple[list[float], list[float]]] = {
    "aluminium": (
        [0.500, 0.633, 0.888, 0.939, 1.494, 1.627, 2.720, 2.588, 1.674],
        [4.898, 5.454, 6.281, 6.420, 7.610, 7.804, 8.212, 8.169, 8.608],
    ),
    "copper": (
        [1.301, 1.240, 1.181, 1.116, 0.257, 0.220, 0.265, 0.276, 0.310],
        [2.159, 2.393, 2.606, 2.596, 3.499, 3.752, 5.254, 5.420, 6.109],
    ),
    "brass": (
        [1.425, 1.094, 0.602, 0.568, 0.444, 0.445, 0.483, 0.490, 0.555],
        [1.799, 1.829, 2.464, 2.588, 3.609, 3.778, 5.115, 5.269, 5.944],
    ),
    "stainless_steel": (
        [1.538, 1.678, 1.935, 1.978, 2.396, 2.484, 3.173, 3.249, 3.538],
        [2.825, 3.117, 3.507, 3.573, 4.138, 4.226, 4.845, 4.905, 5.096],
    ),
    "carbon_steel": (
        [2.295, 2.584, 2.855, 2.895, 2.902, 2.919, 2.943, 2.948, 2.939],
        [2.615, 2.767, 2.909, 2.918, 3.077, 3.102, 3.412, 3.459, 3.680],
    ),
}


def refractive_index(metal: str, wavelength_nm: float) -> tuple[float, float]:
    """(n, k) of a metal [1], linear between the table's wavelengths.

    Raises
    ------
    ValueError
        Outside 400 to 945 nm: a constant that is extrapolated is a constant that is invented.
    """
    if not 400 <= wavelength_nm <= 945:
        raise ValueError(f"{metal}: optical constants are tabulated from 405 to 940 nm, not at {wavelength_nm:g} nm")
    n, k = CONSTANTS[metal]
    return float(np.interp(wavelength_nm, WAVELENGTHS_NM, n)), float(np.interp(wavelength_nm, WAVELENGTHS_NM, k))


def normal_reflectance(metal: str, wavelength_nm: float) -> float:
    """Fresnel reflectance at normal incidence [1]: ((n-1)^2 + k^2) / ((n+1)^2 + k^2)."""
    n, k = refractive_index(metal, wavelength_nm)
    return ((n - 1) ** 2 + k**2) / ((n + 1) ** 2 + k**2)
