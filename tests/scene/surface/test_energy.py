"""What a perfect mirror's lobe returns, against the table that was rendered with Mitsuba."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mitsim.scene.surface.energy import NOMINAL_INCIDENCE, compensation, directional_albedo, energy_factors

ANGLES = np.radians([0.1, 30, 45, 60, 75, 85])
TABLE = {
    ("beckmann", 0.1): (1, 1, 1, 1, 0.975, 0.913),
    ("beckmann", 0.2): (1, 1, 0.997, 0.972, 0.914, 0.927),
    ("beckmann", 0.3): (1, 0.991, 0.967, 0.924, 0.902, 0.936),
    ("beckmann", 0.4): (0.990, 0.958, 0.921, 0.890, 0.901, 0.939),
    ("beckmann", 0.5): (0.943, 0.903, 0.875, 0.869, 0.900, 0.940),
    ("beckmann", 0.7): (0.749, 0.766, 0.792, 0.835, 0.892, 0.933),
    ("ggx", 0.1): (0.988, 0.986, 0.982, 0.969, 0.923, 0.873),
    ("ggx", 0.2): (0.947, 0.939, 0.924, 0.894, 0.850, 0.867),
    ("ggx", 0.3): (0.877, 0.863, 0.844, 0.817, 0.808, 0.847),
    ("ggx", 0.4): (0.786, 0.773, 0.760, 0.749, 0.767, 0.815),
    ("ggx", 0.5): (0.687, 0.681, 0.678, 0.685, 0.723, 0.777),
    ("ggx", 0.7): (0.503, 0.513, 0.531, 0.565, 0.626, 0.692),
}


@pytest.mark.parametrize(("distribution", "alpha"), list(TABLE))
def test_the_table_of_lost_energy_is_reproduced(distribution, alpha):
    found = [directional_albedo(angle, alpha, alpha, distribution) for angle in ANGLES]
    assert np.allclose(found, TABLE[distribution, alpha], atol=0.01)


def test_an_elongated_lobe_loses_less_than_its_wide_side_alone():
    wide = directional_albedo(NOMINAL_INCIDENCE, 0.4, 0.4, "ggx")
    elongated = directional_albedo(NOMINAL_INCIDENCE, 0.1, 0.4, "ggx")
    narrow = directional_albedo(NOMINAL_INCIDENCE, 0.1, 0.1, "ggx")
    assert wide < elongated < narrow
    assert np.isclose(elongated, directional_albedo(NOMINAL_INCIDENCE, 0.4, 0.1, "ggx"), atol=1e-6)


@given(st.floats(0.005, 0.5), st.sampled_from(["beckmann", "ggx"]))
def test_a_perfect_mirror_gets_everything_back_and_a_dark_one_nothing(alpha, distribution):
    kept = directional_albedo(NOMINAL_INCIDENCE, alpha, alpha, distribution)
    assert np.isclose(compensation(alpha, alpha, distribution, 1.0) * kept, 1.0)
    assert compensation(alpha, alpha, distribution, 0.0) == 1.0


def test_factors_of_both_lobes_are_in_the_order_ggx_beckmann():
    ggx, beckmann = energy_factors(0.5, 0.5, 1.0)
    assert ggx > beckmann > 1
