"""The imager against the closed forms of EMVA 1288."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mitsim.sensor.imager import Imager, electrons_per_radiance, expose, fixed_pattern

IMAGER = Imager(pixel_um=6.0, quantum_efficiency=0.5, full_well=20000, read_noise=30, dsnu=0, prnu=0, bits=12,
                black_level=64, f_number=2.0)  # fmt: skip


def test_electrons_from_radiance_by_hand():
    # E = pi L / 4 N^2 = pi / 16 W/mm^2 for L = 1; photons = E A t lambda / hc
    energy = np.pi / 16 * 36e-6 * 1e-3
    photons = energy * 850e-9 / (6.62607015e-34 * 299792458)
    assert np.isclose(electrons_per_radiance(IMAGER, 850, 1e-3), 0.5 * photons, rtol=1e-9)


@pytest.mark.parametrize("mean", [50.0, 500.0, 5000.0, 15000.0])
def test_temporal_noise_is_shot_read_and_quantisation(mean, rng):
    image = expose(np.full((400, 500), mean), IMAGER, None, rng).astype(float)
    expected = IMAGER.gain**2 * (mean + IMAGER.read_noise**2) + 1 / 12
    n = image.size
    assert abs(image.mean() - (mean * IMAGER.gain + 64)) < 5 * np.sqrt(expected / n) + 1e-3
    # the variance of 2e5 samples is known to sqrt(2/n) = 0.3 %: five of those
    assert abs(image.var(ddof=1) / expected - 1) < 5 * np.sqrt(2 / n)


def test_photon_transfer_returns_the_gain(rng):
    means, variances = [], []
    for electrons in np.linspace(200, 16000, 12):
        a, b = (expose(np.full((300, 300), electrons), IMAGER, None, rng).astype(float) for _ in range(2))
        means.append(0.5 * (a.mean() + b.mean()))
        variances.append(0.5 * ((a - b) ** 2).mean())
    slope = np.polyfit(means, variances, 1)[0]
    assert np.isclose(slope, IMAGER.gain, rtol=0.02)


def test_saturation_is_full_scale_and_black_is_the_black_level():
    image = expose(np.array([[0.0, 1e3, 2e4, 1e9]]), IMAGER, None, None)
    assert image[0].tolist() == [64, round(64 + 1e3 * IMAGER.gain), 4095, 4095]
    assert expose(np.zeros((2, 2)), replace(IMAGER, bits=8, black_level=4), None, None).dtype == np.uint8


def test_fixed_pattern_is_fixed_and_has_its_sizes():
    imager = replace(IMAGER, dsnu=40.0, prnu=0.01)
    one, again = (fixed_pattern(imager, (500, 500), np.random.default_rng(3)) for _ in range(2))
    assert np.array_equal(one.offset, again.offset)
    assert np.array_equal(one.response, again.response)
    assert np.isclose(one.offset.std(), 40, rtol=0.02)
    assert np.isclose(one.response.std(), 0.01, rtol=0.02)
    flat = expose(np.full((500, 500), 5000.0), imager, one, None).astype(float) / imager.gain
    assert np.isclose(flat.std(), np.hypot(40, 50), rtol=0.02)
