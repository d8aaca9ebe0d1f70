"""The knee of a companding imager, from the noise of one image."""

from dataclasses import replace
from functools import cache
from unittest import mock

import numpy as np
import pytest

from mitsim.sensor.image_formation import expose
from mitsim.sensor.imager import Imager
from mitsim.sensor.noise_sources import Noise
from mitsim.twin.compare.denoise import denoised
from mitsim.twin.finish.electrons import linearised
from mitsim.twin.sensor import response
from mitsim.twin.sensor.photon_transfer import TransferLine, one_image_line
from mitsim.twin.sensor.response import Knee, first_knee, quiet_pixels
from tests.twin.compare.test_denoise import plate

STRAIGHT = Imager(6.0, 0.3, 6000.0, 10.0, 0.0, 0.0, 8, 4.0, 1.8)
WELL, SEEDS = 12000.0, 32


def capture(seed: int, bends: bool, size: tuple[int, int] = (200, 232)) -> tuple[np.ndarray, float]:
    """Grey levels (H, W) of a half-printed surface in uneven light, and the knee: a level that 40 to 70 % exceed."""
    rng = np.random.default_rng(1000 + seed)
    y, x = np.mgrid[-1 : 1 : size[0] * 1j, -1 : 1 : size[1] * 1j]
    terms = (x, y, x * y, x * x - 1 / 3, y * y - 1 / 3)
    light = 80 + rng.uniform(-3, 3) + sum(rng.uniform(-10, 10) * term for term in terms)
    print_ = plate(seed, size=size) / 92
    print_[:, size[1] // 2 :] = 1
    level, chip = float(np.floor(np.quantile(light * print_, rng.uniform(0.3, 0.6)))), STRAIGHT
    if bends:
        chip = replace(STRAIGHT, full_well=WELL, companding=Knee(level, 1.0).companding(8))
    electrons = linearised(light * print_, chip).astype(np.float32)
    return expose(electrons, chip, None, Noise(), np.random.default_rng(100 + seed)).astype(float), level


simulated_bias = response._bias


@cache
def bent(seed: int) -> tuple[np.ndarray, float, Knee | None, float]:
    """A capture with a knee of slope 0.5, its level, the knee that is found, and by how much it was moved for bias."""
    image, level = capture(seed, True)
    found = [np.nan]

    def kept(*given):
        both = simulated_bias(*given)
        found.append(both[0])
        return both

    with mock.patch.object(response, "_bias", kept):
        return image, level, first_knee(image, np.ones(image.shape, bool), STRAIGHT), found[-1]


def test_the_interval_of_a_knee_holds_it():
    errors = []
    for seed in range(SEEDS):
        _, level, knee, _ = bent(seed)
        if knee is not None:  # in few of them, little is brighter than the knee
            errors.append((knee.level - level) / knee.uncertainty)
    assert len(errors) >= 30
    # more than 4 of 31 outside 95 % intervals are chance once in 50; uncertainties too small by 1.5 leave 6 outside
    assert np.sum(np.abs(errors) > 1.96) <= 4
    # the standard deviation of 31 is known to 13 %
    assert 0.75 < np.sqrt(np.mean(np.square(errors))) < 1.25


def test_the_error_of_a_knee_does_not_grow_with_its_bias():
    """The slope of the error on the bias that was subtracted is 0; it would be 1 without the subtraction."""
    found = [(level, knee, bias) for _, level, knee, bias in map(bent, range(SEEDS)) if knee is not None]
    off, bias, u = np.array([(knee.level - level, bias, knee.uncertainty) for level, knee, bias in found]).T
    weight = 1 / u**2
    off, bias = (each - np.average(each, weights=weight) for each in (off, bias))
    known_to = 1 / np.sqrt(np.sum(weight * bias**2))
    assert known_to < 0.25
    assert abs(np.sum(weight * bias * off) * known_to**2) < 2 * known_to


def test_behind_a_knee_the_full_well_is_right():
    wells = []
    for seed in range(3):
        image, level, knee, _ = bent(seed)
        there = np.ones(image.shape, bool)
        assert knee is not None and abs(knee.level - level) < 3 * knee.uncertainty
        chip = replace(STRAIGHT, companding=knee.companding(8))
        quiet = quiet_pixels(image, denoised(image, there), there)
        wells.append(one_image_line(image.astype(np.uint8), quiet, chip).not_negative().full_well(chip)[0])
    # the wells of a wrong, straight curve would be under a half or over twice as deep
    assert np.median(wells) == pytest.approx(WELL, rel=0.25)


def test_a_straight_imager_has_no_knee():
    for seed in range(5):
        image, _ = capture(seed, False)
        assert first_knee(image, np.ones(image.shape, bool), STRAIGHT) is None


def test_the_curve_of_a_knee_is_one_that_a_sensor_file_takes():
    for level in (80.0, 40.5, 200.0):
        (first, at), (reached, near), (last, full) = Knee(level, 1.0).companding(8)
        assert first == at == level and full == 256 and np.log2(last).is_integer()
        assert (near - at) / (reached - first) == pytest.approx(0.5)
        assert near < full and reached < last


def test_an_offset_is_negative_by_chance_or_not():
    covariance = np.array([[4.0, -0.1], [-0.1, 0.01]])
    by_chance = TransferLine(-3.0, 1.0, covariance).not_negative()
    assert by_chance.offset == 0 and by_chance.slope == pytest.approx(1 - 0.1 / 4.0 * 3)
    assert by_chance.covariance[1, 1] == pytest.approx(0.01 - 0.01 / 4)
    far = TransferLine(-7.0, 1.0, covariance)
    assert far.not_negative() is far
