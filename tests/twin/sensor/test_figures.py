"""Features of the dots of an image, where a patch has no dots."""

from __future__ import annotations

import numpy as np

from mitsim.sensor.camera import Camera
from mitsim.twin.sensor.figures import FIGURES, SpecimenField, patch_figures


def test_a_saturated_patch_has_no_detail_in_its_bright_half(rng):
    """Before, a division by zero, with a warning of NumPy in the output of the command, and NaN."""
    camera = Camera(np.array([[500.0, 0, 39.5], [0, 500, 19.5], [0, 0, 1]]), np.zeros(5), 80, 40)
    field = SpecimenField.of(camera, np.ones((40, 80), bool), 40)
    image = rng.normal(100.0, 4.0, (40, 80))
    image[:, 36:] = 255.0
    noise, saturated = patch_figures(image, field, 7)[:, FIGURES.index("noise in the bright half")]
    # the normal deviate of 4 DN: its mean absolute value is 0.80 of it, in either half
    assert 2.0 < np.exp(noise) < 20.0
    assert saturated < np.log(0.01)
