"""Light that a face's mirror-like part and its lobe share: none is lost or won as the share changes with the angle."""

from __future__ import annotations

import numpy as np
import pytest

from mitsim.scene.surface.coherence import coherent_weight
from mitsim.scene.surface.energy import facets
from mitsim.scene.surface.machined import machined
from mitsim.scene.surface.machined_face import MachinedFace
from mitsim.scene.surface.processes import PROCESSES
from tests.figures_of_surfaces import lobe_factor


def returned(scatter, angle, shared):
    """Directional albedo [1] of the lobe alone, with or without its share, on a finer grid than the code's."""
    total = 0.0
    for share, alphas, distribution in (
        (scatter.beckmann * scatter.energy_factor[1], (scatter.alpha_u, scatter.alpha_v), "beckmann"),
        ((1 - scatter.beckmann) * scatter.energy_factor[0], scatter.ggx_alpha, "ggx"),
    ):
        weight, cosine = facets(angle, *alphas, distribution, (250, 120, 6))
        if shared:
            mean = (np.cos(angle) + cosine) / 2
            weight = weight * (1 - coherent_weight(scatter.phase_variance, mean))
            weight = weight * lobe_factor(scatter.lobe_numbers, mean)
        total += share * weight.sum()
    return total


@pytest.mark.parametrize("wavelength", [465, 850])
@pytest.mark.parametrize("process", list(PROCESSES))
def test_the_lobe_keeps_its_share_of_the_energy(process, wavelength):
    """From 0 to 75 deg, over Ra from all mirror to none, to half a percent of the light."""
    for roughness in np.geomspace(0.02, 0.6, 6) * (4 if PROCESSES[process].feed_marks else 1):
        scatter = machined(MachinedFace(process=process, Ra=float(roughness)), wavelength)
        for angle in np.radians([0, 31, 47, 58, 63, 69, 75]):
            share = np.exp(-scatter.phase_variance * np.cos(angle) ** 2)
            lost = (1 - share) * returned(scatter, angle, False) - returned(scatter, angle, True)
            assert abs(lost) < 0.005


def test_a_lay_is_kept_on_average_over_the_azimuth():
    scatter = machined(MachinedFace(process="ground", Ra=0.2, lay="u"), 850)
    assert scatter.alpha_u < scatter.alpha_v
    for angle in np.radians([30, 60, 75]):
        lobe = (1 - scatter.coherent_at(angle)) * returned(scatter, angle, False)
        assert returned(scatter, angle, True) == pytest.approx(lobe, abs=0.01)


def test_no_light_is_moved_where_there_is_no_coherence():
    rough = machined(MachinedFace(process="bead_blasted", Ra=2.0), 465)
    assert rough.coherent_at(np.radians(75)) < 1e-9
    assert np.abs(lobe_factor(rough.lobe_numbers, np.linspace(0.25, 1, 50)) - 1).max() < 0.005
