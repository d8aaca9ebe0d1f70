"""Smoothing by the device: noise through a Gaussian, against its closed form."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mitsim.decoding.grey_levels import grey_level_variance
from mitsim.sensor.image_formation import expose
from mitsim.sensor.imager import Imager
from mitsim.sensor.noise_sources import Noise
from mitsim.sensor.point_spread import point_spread

IMAGER = Imager(
    pixel_um=6.0,
    quantum_efficiency=0.5,
    full_well=20000,
    read_noise=30,
    dsnu=0,
    prnu=0,
    bits=12,
    black_level=64,
    f_number=2.0,
)


@pytest.mark.parametrize("smoothing", [0.4, 0.7, 1.2])
def test_smoothed_noise_has_the_variance_and_the_correlation_of_the_weights(smoothing, rng):
    """White noise of variance v through weights w along both axes: v (sum w^2)^2; at a lag, by w's own correlation."""
    chip = replace(IMAGER, smoothing_px=smoothing)
    image = expose(np.full((600, 600), 4000.0), chip, None, Noise(), rng).astype(float)
    weights = point_spread(smoothing)
    gain = float((weights**2).sum())
    white = IMAGER.gain**2 * (4000 + IMAGER.read_noise**2)
    expected = white * gain**2 + 1 / 12
    # 360 000 pixels, of which 1 / (4 pi s^2) are independent: five standard deviations of the variance
    spread = 5 * np.sqrt(2 * max(4 * np.pi * smoothing**2, 1) / image.size)
    assert abs(image.var() / expected - 1) < spread
    lag = float((weights[1:] * weights[:-1]).sum()) / gain
    off = image - image.mean()
    found = float((off[:, 1:] * off[:, :-1]).mean()) / (white * gain**2)
    assert found == pytest.approx(lag, abs=spread)
    assert abs(image.mean() - (64 + 4000 * IMAGER.gain)) < 0.05


@pytest.mark.parametrize("row_noise", [0.0, 50.0])
@pytest.mark.parametrize("smoothing", [0.0, 0.7, 1.2])
def test_the_decoder_expects_the_noise_of_smoothed_images(smoothing, row_noise, rng):
    """Before, 26 DN were expected where 0.7 px left 12."""
    chip = replace(IMAGER, smoothing_px=smoothing, row_noise=row_noise)
    image = expose(np.full((6000, 50), 4000.0), chip, None, Noise(), rng).astype(float)
    level = np.array([image.mean()], np.float32)
    # 6000 rows, of which 1 in sqrt(4 pi) s is independent: five standard deviations of the standard deviation
    spread = 2.5 * np.sqrt(2 * max(np.sqrt(4 * np.pi) * smoothing, 1) / len(image))
    assert np.sqrt(grey_level_variance(level, chip)[0]) == pytest.approx(image.std(), rel=spread)


def test_a_device_that_does_not_smooth_gives_the_bytes_it_gave(rng):
    electrons = np.linspace(0, 20000, 64 * 64).reshape(64, 64)
    one, two = (expose(electrons, replace(IMAGER, smoothing_px=s), None, Noise.none(), None) for s in (0.0, 1e-9))
    np.testing.assert_array_equal(one, two)
