"""Gloss of lobes against the table of the reference, and the inverse."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mitsim.scene.surface.gloss import alpha_of_gloss, base_gloss, lobe_gloss
from mitsim.scene.surface.microfacet import fresnel

PAINT, ALUMINIUM = (1.5, 0.0), (0.96, 6.7)

#: alpha: paint 60 Beckmann, paint 60 GGX, 60 GGX on a white base, 20 GGX, 85 GGX, aluminium 60 GGX
TABLE = """
.005 89 86 88 66 95 876
.01 88 79 81 46 85 801
.02 73 61 63 22 63 622
.03 57 47 49 12 47 481
.05 37 31 32 5.0 28 311
.1 16 14 16 1.3 11 139
.15 8.6 7.4 9.3 .6 4.9 76
.2 5.1 4.5 6.3 .3 2.6 46
.3 2.4 2.0 3.8 .2 .9 21
.4 1.4 1.1 2.9 .1 .4 11
"""


@pytest.mark.parametrize("row", TABLE.strip().splitlines())
def test_the_table_of_gloss_is_reproduced(row):
    """Within 3 % of the printed value and half a unit of its last digit, which is how far it was rounded."""
    alpha, *printed = row.split()
    a = float(alpha)
    # a white base of reflectance 0.9 whose light is partly kept by the coat's underside (0.596 for n = 1.5)
    passed = 1 - float(fresnel(0.5, *PAINT))
    white = 0.9 * passed**2 / (1.5**2 * (1 - 0.9 * 0.596))
    found = [
        lobe_gloss(a, PAINT, "beckmann"),
        lobe_gloss(a, PAINT, "ggx"),
        lobe_gloss(a, PAINT, "ggx") + base_gloss(white),
        lobe_gloss(a, PAINT, "ggx", 20),
        lobe_gloss(a, PAINT, "ggx", 85),
        lobe_gloss(a, ALUMINIUM, "ggx"),
    ]
    for ours, text in zip(found, printed, strict=True):
        digits = len(text.partition(".")[2])
        assert abs(ours - float(text)) < 0.03 * float(text) + 0.5 * 10.0**-digits, (alpha, text, ours)


def test_a_mirror_of_black_glass_reads_100_and_smooth_paint_89():
    assert np.isclose(lobe_gloss(3e-4, (1.567, 0.0), "beckmann"), 100, atol=0.1)
    assert np.isclose(lobe_gloss(3e-4, PAINT, "beckmann"), 89.2, atol=0.2)


@given(st.floats(0.005, 0.4), st.sampled_from(["beckmann", "ggx"]))
@settings(max_examples=30)
def test_gloss_and_back(alpha, distribution):
    def reading(candidate):
        return lobe_gloss(candidate, ALUMINIUM, distribution)

    assert np.isclose(alpha_of_gloss(reading(alpha), reading, (0.002, 0.5)), alpha, rtol=1e-4)


def test_a_gloss_that_no_lobe_has_is_refused_with_those_that_there_are():
    with pytest.raises(ValueError, match=r"GU at 60 deg, for alpha 0\.5 to 0\.002"):
        alpha_of_gloss(2000, lambda alpha: lobe_gloss(alpha, ALUMINIUM, "ggx"), (0.002, 0.5))
