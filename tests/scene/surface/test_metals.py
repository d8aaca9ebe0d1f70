"""Optical constants against the reflectances of the reference table, which was interpolated by others."""

from __future__ import annotations

import numpy as np
import pytest

from characterisation.files.errors import InputError
from mitsim.scene.surface.metals import CONSTANTS, WAVELENGTH_RANGE_NM, normal_reflectance, refractive_index
from mitsim.scene.surface.microfacet import fresnel

WAVELENGTHS = (405, 450, 520, 532, 640, 660, 830, 850, 940)
REFLECTANCES = {
    "aluminium": (0.924, 0.922, 0.917, 0.916, 0.907, 0.904, 0.866, 0.870, 0.918),
    "copper": (0.477, 0.538, 0.591, 0.602, 0.926, 0.943, 0.964, 0.964, 0.968),
    "brass": (0.375, 0.434, 0.721, 0.752, 0.882, 0.891, 0.932, 0.935, 0.941),
    "stainless_steel": (0.574, 0.603, 0.630, 0.634, 0.666, 0.669, 0.690, 0.691, 0.696),
    "carbon_steel": (0.481, 0.496, 0.510, 0.511, 0.530, 0.533, 0.567, 0.572, 0.595),
    "chromium": (0.535, 0.555, 0.558, 0.556, 0.554, 0.557, 0.570, 0.571, 0.574),
    "nickel": (0.520, 0.571, 0.626, 0.634, 0.696, 0.707, 0.745, 0.748, 0.762),
}


@pytest.mark.parametrize("metal", list(CONSTANTS))
def test_metals_reflect_as_the_tables_say(metal):
    found = [normal_reflectance(metal, wavelength) for wavelength in WAVELENGTHS]
    assert np.allclose(found, REFLECTANCES[metal], atol=0.01)


@pytest.mark.parametrize("metal", list(CONSTANTS))
def test_the_sources_cover_the_range_without_extrapolation(metal):
    wavelengths = CONSTANTS[metal][:, 0]
    assert wavelengths[0] <= WAVELENGTH_RANGE_NM[0]
    assert wavelengths[-1] >= WAVELENGTH_RANGE_NM[1]
    assert np.all(np.diff(wavelengths) > 0)
    assert np.all(CONSTANTS[metal] > 0)


def test_no_constant_is_extrapolated():
    with pytest.raises(InputError, match="1064 nm; allowed: 400 to 1000 nm"):
        refractive_index("aluminium", 1064)


def test_fresnel_at_normal_incidence_brewster_and_grazing():
    n, k = refractive_index("copper", 660)
    assert np.isclose(fresnel(1.0, n, k), normal_reflectance("copper", 660))
    assert np.allclose(fresnel(np.cos(np.radians([0, 45, 75])), 1.5, 0.0), [0.04, 0.0502, 0.2531], atol=1e-4)
    assert np.isclose(fresnel(0.0, 2.0, 3.0), 1.0)
    assert np.allclose(fresnel(np.linspace(0.01, 1, 20), 0.0, 1.0), 1.0)
