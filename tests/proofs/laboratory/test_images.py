"""The laboratory's imager, speckle, masks and shares have the statistics that they are made to have."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from characterisation.region_of_interest import Roi
from mitsim.sensor.pattern import RandomDots
from mitsim.sensor.preset import load_sensor
from tests.figures_of_surfaces import mean_run_length
from tests.proofs.laboratory.imager import (
    Exposed,
    blurred,
    corner_loss,
    electrons_per_second,
    grey_levels,
    speckle,
    speckle_contrast,
)
from tests.proofs.laboratory.masks import another_mask
from tests.proofs.laboratory.page import share_inside, wilson


def test_grey_levels_have_the_mean_and_the_variance_of_emva_1288():
    sensor = load_sensor("ensenso-n10")
    imager = replace(sensor.imager, corner_illumination=1.0, blur_px=0.0, row_noise=0.0, prnu=0.0, dsnu=0.0, bits=12)
    sensor = replace(sensor, imager=imager)
    camera = sensor.rig.cameras["left"]
    roi = Roi(100, 100, 300, 200)
    seconds, electrons = 1e-3, 5000.0
    light = np.full((2, roi.height, roi.width), electrons / (electrons_per_second(sensor) * seconds), np.float32)
    how = Exposed(camera, roi, seconds, 1, 2)
    images = grey_levels(sensor, how, light, np.zeros_like(light[0]), np.zeros_like(light[0]))[:, *roi.slices]
    gain = (4095 - imager.black_level) / imager.full_well
    variance = gain**2 * (electrons + imager.read_noise**2) + 1 / 12
    count = images[0].size
    assert images[0].mean() == pytest.approx(imager.black_level + gain * electrons, abs=5 * np.sqrt(variance / count))
    assert images[0].var() == pytest.approx(variance, rel=5 * np.sqrt(2 / count))
    noise = images.astype(float) - images.mean(axis=(1, 2), keepdims=True)
    correlation = (noise[0] * noise[1]).mean() / (noise[0].std() * noise[1].std())
    assert abs(correlation) < 5 / np.sqrt(count)


def test_the_fixed_pattern_belongs_to_the_unit():
    sensor = load_sensor("ensenso-n10")
    sensor = replace(sensor, imager=replace(sensor.imager, prnu=0.2))
    camera, roi = sensor.rig.cameras["left"], Roi(0, 0, 100, 80)
    light = np.full((1, 80, 100), 8000 / (electrons_per_second(sensor) * 1e-3), np.float32)

    def image(unit: int, noise: int) -> np.ndarray:
        how = Exposed(camera, roi, 1e-3, unit, noise)
        return grey_levels(sensor, how, light, 0 * light[0], 0 * light[0])[0][roi.slices].ravel().astype(float)

    assert np.corrcoef(image(1, 1), image(1, 2))[0, 1] > 0.9
    assert abs(np.corrcoef(image(1, 1), image(2, 1))[0, 1]) < 0.3  # the lens's loss is the same


def test_speckle_has_mean_one_and_the_variance_of_its_cells():
    contrast = np.full((300, 400), 0.2, np.float32)
    gain = speckle(contrast, 0.25, np.random.default_rng(1))
    # a pixel is the mean of 16 whole cells
    assert gain.mean() == pytest.approx(1, abs=5 * 0.05 / np.sqrt(gain.size))
    assert gain.std() == pytest.approx(0.05, rel=0.02)
    # of any size: blocks that are large against a cell have the variance of their number of cells
    gain = speckle(np.full((600, 600), 0.2, np.float32), 0.37, np.random.default_rng(1))
    blocks = gain.reshape(60, 10, 60, 10).mean((1, 3))
    assert blocks.var() == pytest.approx((0.2 * 0.37 / 10) ** 2, rel=0.12)
    assert (speckle(0 * contrast, 0.25, np.random.default_rng(1)) == 1).all()


def test_white_paint_has_less_speckle_than_metal_and_a_wide_spectrum_less_than_a_narrow_one():
    narrow = load_sensor("ensenso-n10")
    camera = narrow.rig.reference
    wide = replace(narrow, linewidth_nm=200.0)
    metal, paint = (speckle_contrast(narrow, camera, height) for height in (0.5, float("nan")))
    assert paint < 0.5 * metal
    assert speckle_contrast(wide, camera, 0.5) < 0.9 * metal
    assert speckle_contrast(replace(narrow, linewidth_nm=None), camera, 0.5) == 0


def test_a_blur_keeps_the_light_and_has_its_variance_beside_that_of_the_pixel():
    image = np.zeros((41, 41))
    image[20, 20] = 1
    place = np.arange(41) - 20
    row = blurred(image, 0.9).sum(axis=0)
    assert row.sum() == pytest.approx(1, abs=1e-5)
    assert (row * place**2).sum() == pytest.approx(0.9**2 + 1 / 12, rel=0.01)


def test_the_corner_has_the_loss_of_the_cos4_law():
    sensor = load_sensor("ensenso-n10")
    camera = sensor.rig.cameras["left"]
    loss = corner_loss(sensor.imager, camera, Roi(0, 0, camera.width, camera.height))
    x, y = camera.matrix[:2, 2].round().astype(int)
    off = np.arctan(np.hypot(camera.matrix[0, 2] / camera.matrix[0, 0], camera.matrix[1, 2] / camera.matrix[1, 1]))
    assert loss[y, x] == pytest.approx(1, abs=1e-5)
    assert loss[0, 0] == pytest.approx(np.cos(off) ** 4, rel=1e-3)


def test_another_mask_has_the_statistics_of_the_presets_and_is_another():
    sensor = load_sensor("ensenso-n35")
    pattern, optics = sensor.pattern, sensor.projector.optics
    assert isinstance(pattern, RandomDots)
    preset, other = sensor.patterns(), another_mask(pattern, optics.width, optics.height, 4)
    assert other.shape == preset.shape
    assert abs(np.corrcoef(preset[0].ravel(), other[0].ravel())[0, 1]) < 0.02
    for frame, there in zip(other, preset, strict=True):
        assert mean_run_length(frame, 0.5) == pytest.approx(mean_run_length(there, 0.5), rel=0.02)
        assert (frame.mean(), frame.std()) == pytest.approx((there.mean(), there.std()), rel=0.02)
    right, down = (round(value) for value in pattern.shifts_px[1])
    moved = np.roll(other[0], (down, right), (0, 1))
    np.testing.assert_allclose(other[1][20:-20, 20:-20], moved[20:-20, 20:-20], atol=1e-3)


def test_wilsons_interval_is_that_of_the_textbook():
    assert wilson(0.8, 10) == pytest.approx((0.4902, 0.9433), abs=1e-4)
    assert wilson(1.0, 20) == pytest.approx((0.8389, 1.0), abs=1e-4)


def test_measurements_that_fail_together_count_as_one_trial_of_a_world():
    worlds = np.array([1, 1, 1, 1, 1, 1, 1, 1, 0, 0], float)
    alone, together = share_inside(worlds), share_inside(np.tile(worlds, (7, 1)))
    assert (together.low, together.high) == pytest.approx((alone.low, alone.high), abs=1e-9)
    rng = np.random.default_rng(2)
    apart = share_inside((rng.random((7, 400)) < 0.9).astype(float))
    assert apart.high - apart.low == pytest.approx(2 * 1.96 * np.sqrt(0.09 / 2800), rel=0.15)
    assert share_inside(np.full((2, 3), np.nan)).of == 0
