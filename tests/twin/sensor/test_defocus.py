"""A projector's focus from blurs by depth that are known."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from mitsim.sensor.camera import Camera
from mitsim.sensor.imager import Imager
from mitsim.twin.sensor import defocus
from mitsim.twin.sensor.defocus import _fitted, fit_defocus, modulation


@pytest.mark.parametrize(("aperture", "focus"), [(30.0, 3450.0), (12.0, 800.0)])
def test_aperture_and_focus_come_back(aperture, focus):
    rng, focal, still = np.random.default_rng(3), 1900.0, 0.65
    depth = rng.uniform(0.8 * focus, 1.1 * focus, 400)
    disc = aperture * focal * np.abs(1 / depth - 1 / focus)  # a disc's deviation along an axis: a quarter of it
    blur = np.hypot(still, disc / 4) + rng.normal(0, 0.03, 400)
    blur[::23] += 1.5  # walls that are no walls
    found = _fitted(np.stack([depth, blur], axis=1), focal)
    assert found[0] == pytest.approx(still, abs=0.03)
    assert found[1] == pytest.approx(aperture, rel=0.08)
    assert found[2] == pytest.approx(focus, rel=0.01)


@pytest.mark.parametrize(("dn", "seen"), [(40.0, False), (60.0, True)])
@pytest.mark.parametrize("full_well", [2000.0, 20000.0])
def test_a_dim_block_is_none_whatever_an_electron_is_in_grey_levels(monkeypatch, full_well, dn, seen):
    """Before, the limit of 50 DN was one of electrons: 0.6 DN of an imager of 20,000 e- and 8 bits."""
    of_noise = {"read_noise": 5, "dsnu": 0, "prnu": 0}
    chip = Imager(
        pixel_um=6, quantum_efficiency=0.5, full_well=full_well, bits=8, black_level=0, f_number=2, **of_noise
    )
    size, focal, widths = (320, 384), 900.0, np.array([2.0, 4, 8, 16, 32])
    projector = Camera(np.array([[focal, 0, 0], [0, focal, 0], [0, 0, 1]]), np.zeros(5), 100, 100)
    z = np.tile(np.linspace(500, 1100, size[1]), (size[0], 1))
    points = np.stack([z * 0, z * 0, z], axis=-1)
    capture = SimpleNamespace(rig=SimpleNamespace(projector=projector), bits=8)
    monkeypatch.setattr(defocus, "decoder_settings", lambda _: (None, None))
    monkeypatch.setattr(defocus, "capture_cloud", lambda *_: SimpleNamespace(points=points))
    monkeypatch.setattr(defocus, "_DEEP", 0.2)
    black = np.zeros(size)
    white = black + dn / chip.gain
    ratio = modulation(0.8, widths)[:, None, None] * (white - black)
    pairs = np.stack([ratio, 0 * ratio], axis=1)
    found = fit_defocus(SimpleNamespace(capture=capture), chip, white, black, pairs, widths)
    assert (found is not None) == seen
