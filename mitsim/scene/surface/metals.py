"""Return optical constants of metals: complex refractive index n - ik by wavelength.

The points are the sources' own, in ``optical_constants.csv`` (CC0, from the refractiveindex.info database), with linear
interpolation. They are of clean evaporated or polished metal; a machined alloy with its oxide reflects 3 to 10 % less.

Chromium is Johnson & Christy's (1974), one measurement of one film over the whole range. Another common table (the
preset of several renderers, which ends at 885 nm) gives reflectances of .69 at 405 nm and .63 at 850 nm instead of .53
and .57. Electroplated chrome may lie anywhere between.

Mitsuba's own presets are not used: in the monochrome variants they reduce to the visible average at every wavelength,
and beyond 885 nm they are zero, which renders as a perfect mirror.
"""

from __future__ import annotations

import csv
from importlib.resources import files

import numpy as np
from numpy.typing import NDArray

from characterisation.files.errors import InputError

#: wavelengths at which every metal has tabulated constants [nm]
WAVELENGTH_RANGE_NM = (400.0, 1000.0)


def _read_table() -> dict[str, NDArray[np.float64]]:
    text = files("mitsim.scene.surface").joinpath("optical_constants.csv").read_text(encoding="utf-8")
    rows: dict[str, list[list[float]]] = {}
    for row in csv.DictReader(line for line in text.splitlines() if not line.startswith("#")):
        rows.setdefault(row["metal"], []).append([float(row[name]) for name in ("wavelength_nm", "n", "k")])
    return {metal: np.array(points) for metal, points in rows.items()}


#: metal -> (points, 3): wavelength [nm], n, k
CONSTANTS: dict[str, NDArray[np.float64]] = _read_table()


def refractive_index(metal: str, wavelength_nm: float) -> tuple[float, float]:
    """Return (n, k) of a metal [1], linear between the source's wavelengths.

    Raises InputError outside 400 to 1000 nm, since extrapolated constants have no source.
    """
    low, high = WAVELENGTH_RANGE_NM
    if not low <= wavelength_nm <= high:
        allowed = f"{low:g} to {high:g} nm, for which optical constants are tabulated"
        raise InputError(f"finish of {metal}", "wavelength_nm", f"{wavelength_nm:g} nm", allowed)
    wavelengths, n, k = CONSTANTS[metal].T
    return float(np.interp(wavelength_nm, wavelengths, n)), float(np.interp(wavelength_nm, wavelengths, k))


def normal_reflectance(metal: str, wavelength_nm: float) -> float:
    """Return the Fresnel reflectance at normal incidence [1]: ((n-1)^2 + k^2) / ((n+1)^2 + k^2)."""
    n, k = refractive_index(metal, wavelength_nm)
    return ((n - 1) ** 2 + k**2) / ((n + 1) ** 2 + k**2)
