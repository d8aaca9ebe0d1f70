"""Lobes: normalisation and half widths."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad

from mitsim.scene.surface.microfacet import (
    GGX_PER_BECKMANN,
    shadowing,
    slope_density,
)
from tests.figures_of_surfaces import alpha_of_half_width, half_width

both = pytest.mark.parametrize("distribution", ["beckmann", "ggx"])


@both
def test_slopes_are_all_counted_once(distribution):
    """The integral of P over the plane of slopes, in units of alpha: 2 r P / pi pi."""
    total = quad(lambda r: 2 * r * float(slope_density(r**2, distribution)), 0, np.inf)[0]
    assert np.isclose(total, 1.0)


def test_both_lobes_have_the_same_median_slope():
    def inside(radius, distribution):
        return quad(lambda r: 2 * r * float(slope_density(r**2, distribution)), 0, radius)[0]

    assert np.isclose(inside(np.sqrt(np.log(2)), "beckmann"), 0.5)
    assert np.isclose(inside(np.sqrt(np.log(2)) / GGX_PER_BECKMANN, "ggx"), 0.5)


@given(st.floats(0.002, 0.5), st.sampled_from(["beckmann", "ggx"]))
def test_half_width_and_back(alpha, distribution):
    assert np.isclose(alpha_of_half_width(half_width(alpha, distribution), distribution), alpha, rtol=1e-6)


def test_a_lobe_too_wide_to_fall_to_half_has_no_half_width():
    with pytest.raises(ValueError, match="no half width"):
        half_width(3.0, "ggx")


@both
def test_shadowing_falls_from_one(distribution):
    values = shadowing(np.array([0.0, 0.1, 1.0, 10.0, 1e3]), distribution)
    assert values[0] == 1
    assert np.all(np.diff(values) <= 0)
    assert values[-1] < 0.01
