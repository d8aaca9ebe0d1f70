"""The variance of grey levels against images that are exposed again and again."""

from __future__ import annotations

import numpy as np
import pytest

from mitsim.decoding.grey_levels import grey_level_variance
from mitsim.sensor.image_formation import expose
from mitsim.sensor.imager import Imager
from mitsim.sensor.noise_sources import Noise


@pytest.mark.parametrize("gamma", [1.0, 1.8, 2.2])
@pytest.mark.parametrize("electrons", [500, 3000, 8000])
@pytest.mark.parametrize("smoothing_px", [0.0, 0.6])
def test_the_variance_is_that_of_repeated_images(gamma, electrons, smoothing_px):
    """Before, that of gamma 1: deviations of 0.77, 1.22 and 1.59 times the truth for gamma 2.2."""
    imager = Imager(
        pixel_um=5,
        quantum_efficiency=0.6,
        full_well=10000,
        read_noise=12,
        dsnu=0,
        prnu=0,
        bits=12,
        black_level=64,
        f_number=4,
        gamma=gamma,
        smoothing_px=smoothing_px,
    )
    image = expose(np.full((400, 400), float(electrons)), imager, None, Noise(), np.random.default_rng(2))
    told = grey_level_variance(np.array([image.mean()], np.float32), imager)[0]
    # 160 000 pixels, of which smoothing leaves a third independent: 0.6 % of the variance
    assert told == pytest.approx(float(image.var()), rel=0.025)
