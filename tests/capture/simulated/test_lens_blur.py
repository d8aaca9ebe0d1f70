"""A lens that blurs more away from its axis, against blurs of known width."""

from __future__ import annotations

import numpy as np
import pytest

from characterisation.region_of_interest import Roi
from mitsim.capture.simulated.lens_blur import blur_by_lens, gaussian_blur
from mitsim.sensor.camera import Camera
from mitsim.sensor.imager import Imager
from mitsim.sensor.transforms import Transform

WIDTH, HEIGHT = 201, 161
CAMERA = Camera(
    np.array([[300.0, 0, 100.0], [0, 300.0, 80.0], [0, 0, 1.0]]), np.zeros(5), WIDTH, HEIGHT, Transform.identity()
)
WHOLE = Roi(0, 0, WIDTH, HEIGHT)


def chip(middle: float, corner: float | None) -> Imager:
    return Imager(
        pixel_um=5.0,
        quantum_efficiency=0.5,
        full_well=1e4,
        read_noise=5.0,
        dsnu=0.0,
        prnu=0.0,
        bits=8,
        black_level=0.0,
        f_number=2.0,
        blur_px=middle,
        corner_blur_px=corner,
    )


@pytest.mark.parametrize(("column", "row"), [(100, 80), (150, 80), (160, 130), (40, 30)])
def test_a_point_spreads_with_the_variance_of_its_place(column, row):
    """The variance of what becomes of one lit pixel is blur^2 + (corner^2 - blur^2) rho^2."""
    image = np.zeros((HEIGHT, WIDTH), np.float32)
    image[row, column] = 1.0
    seen = blur_by_lens(image, chip(0.8, 2.5), CAMERA, WHOLE).astype(float)
    rho = ((column - 100) ** 2 + (row - 80) ** 2) / (100**2 + 80**2)
    across = np.arange(WIDTH) - column
    variance = (seen.sum(axis=0) * across**2).sum() / seen.sum()
    assert variance == pytest.approx(0.8**2 + (2.5**2 - 0.8**2) * rho, rel=0.05)


def test_without_a_corner_it_is_the_even_blur_to_the_last_bit():
    image = np.random.default_rng(1).random((HEIGHT, WIDTH)).astype(np.float32)
    even = gaussian_blur(image, 1.3)
    for corner in (None, 1.3):
        assert np.array_equal(blur_by_lens(image, chip(1.3, corner), CAMERA, WHOLE), even)
    assert blur_by_lens(image, chip(0.0, None), CAMERA, WHOLE) is image


def test_a_part_is_that_of_the_whole():
    image = np.random.default_rng(2).random((HEIGHT, WIDTH)).astype(np.float32)
    part = Roi(110, 20, 70, 90)
    inner = np.s_[15:-15, 15:-15]
    whole = blur_by_lens(image, chip(0.5, 2.0), CAMERA, WHOLE)[part.slices]
    alone = blur_by_lens(np.ascontiguousarray(image[part.slices]), chip(0.5, 2.0), CAMERA, part)
    assert np.allclose(whole[inner], alone[inner], atol=1e-6)
