"""Lobes of the 100 measured MERL materials: their ABC fits against the equivalent widths made from them by others."""

from __future__ import annotations

import csv

import numpy as np
import pytest

from tests.figures_of_surfaces import alpha_of_half_width, half_width

pytestmark = pytest.mark.real


def read(path):
    return {row["material"]: row for row in csv.DictReader(path.read_text().splitlines())}


def test_widths_of_the_measured_lobes_are_those_of_the_table(real_data):
    """Half width of A / (1 + B (1 - cos theta))^C, and alpha of the GGX and Beckmann lobes of that half width.

    Low et al., ACM TOG 31(1), 2012. Within 10 % for every material.
    """
    if not (real_data / "merl_fits").is_dir():
        pytest.skip(f"no MERL fits in {real_data}")
    fits = read(real_data / "merl_fits" / "merl_abc_low2012.csv")
    table = read(real_data / "merl_fits" / "merl_equiv_alpha.csv")
    assert len(table) > 90
    for material, row in table.items():
        b, c = float(fits[material]["B"]), float(fits[material]["C"])
        width = np.arccos(1 - (2 ** (1 / c) - 1) / b)
        assert np.isclose(np.degrees(width), float(row["half_width_deg"]), rtol=0.1), material
        for distribution in ("ggx", "beckmann"):
            alpha = alpha_of_half_width(width, distribution)
            assert np.isclose(alpha, float(row[f"alpha_{distribution}_halfwidth"]), rtol=0.1), material
            if alpha < 0.6:
                assert np.isclose(half_width(alpha, distribution), width, rtol=1e-6), material
