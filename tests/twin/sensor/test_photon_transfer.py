"""Photon transfer on simulated repeats with everything known: the line, and how often its intervals hold the truth."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from mitsim.sensor.image_formation import expose, fixed_pattern
from mitsim.sensor.imager import Imager
from mitsim.sensor.noise_sources import Noise
from mitsim.twin.sensor import noise
from mitsim.twin.sensor.noise import fine_gain, fit_imager, smoothing_of
from mitsim.twin.sensor.photon_transfer import Repeats, fixed_variance, one_image_line, repeated_line

TRUE = Imager(
    pixel_um=6,
    quantum_efficiency=0.5,
    full_well=15000,
    read_noise=25,
    dsnu=0,
    prnu=0,
    bits=10,
    black_level=40,
    f_number=2,
)
FILE = replace(TRUE, full_well=21000, read_noise=40)
RAMP = np.tile(np.linspace(300, 13000, 80), (60, 1))


def repeats(rng, imager, electrons, count=8, fixed=None):
    return np.stack([expose(electrons, imager, fixed, Noise(), rng) for _ in range(count)])


def whole(images):
    return Repeats.of(images, np.ones(images.shape[1:], bool), images[0].size)


def test_intervals_of_gain_and_read_noise_hold_the_truth_as_often_as_they_say():
    """300 units: of 95 % intervals 95 % hold it, give or take 1.3 % of chance, of which three are allowed."""
    held = np.zeros((300, 2), bool)
    for seed in range(300):
        rng = np.random.default_rng(seed)
        stack = repeats(rng, TRUE, RAMP)
        line = repeated_line([whole(stack)], FILE)
        assert line is not None
        for index, ((value, spread), truth) in enumerate(
            ((line.full_well(FILE), TRUE.full_well), (line.read_noise(), TRUE.read_noise))
        ):
            held[seed, index] = abs(value - truth) < 1.96 * spread
    print("coverage of full well, read noise:", held.mean(axis=0))
    assert (held.mean(axis=0) > 0.95 - 3 * 0.0126).all() and (held.mean(axis=0) < 0.95 + 3 * 0.0126).all()


def test_light_that_differs_between_repeats_is_no_gain():
    """Speckle drawn anew gives v = kappa mu + (0.02 mu)^2: before, full wells of a fifth of the truth, +- 1 %."""
    held, even = [], np.tile(RAMP, (5, 1))
    for seed in range(30):
        rng = np.random.default_rng(seed)
        images = [expose(even * rng.normal(1, 0.02, even.shape), TRUE, None, Noise(), rng) for _ in range(8)]
        value, spread = repeated_line([whole(np.stack(images))], FILE).full_well(FILE)
        assert spread < 0.2 * value
        held.append(abs(value - TRUE.full_well) < 1.96 * spread)
    assert np.mean(held) > 0.95 - 3 * 0.04
    images = [expose(RAMP * rng.normal(1, 0.2, RAMP.shape).clip(0), TRUE, None, Noise(), rng) for _ in range(8)]
    assert repeated_line([whole(np.stack(images))], FILE) is None  # where speckle hides the shot noise


@pytest.mark.parametrize("smoothing", [0.0, 0.5, 1.0])
def test_smoothing_by_the_device_is_undone(smoothing):
    """It counted twice, in the line and in the file: a full well of 10,000 e- became 24,000, and 110,000 with 1 px."""
    z = []
    for seed in range(40):
        chip = replace(TRUE, smoothing_px=smoothing)
        stack = repeats(np.random.default_rng(seed), chip, RAMP)[:, 6:-6, 6:-6]  # mirrored light has more noise
        line = repeated_line([whole(stack)], replace(FILE, smoothing_px=smoothing))
        assert line is not None
        for (value, spread), truth in ((line.full_well(FILE), 15000), (line.read_noise(), 25)):
            z.append((value - truth) / spread)
    assert np.mean(np.abs(z) < 1.96) > 0.95 - 3 * 0.035 and np.std(z) > 0.6


@pytest.mark.parametrize(("gamma", "companding"), [(1.8, ()), (1.0, ((357.0, 357.0), (2048, 756), (4096, 1024)))])
def test_a_curve_of_the_imager_is_undone_first(gamma, companding):
    chip = replace(TRUE, gamma=gamma, companding=companding)
    rng = np.random.default_rng(3)
    stack = repeats(rng, chip, np.tile(np.linspace(2500, 12500, 300), (300, 1)), 6)
    line = repeated_line([whole(stack)], replace(chip, full_well=20000))
    value, spread = line.full_well(replace(chip, full_well=20000))
    assert value == pytest.approx(chip.full_well, rel=0.02) and spread < 0.02 * value


def test_fixed_pattern_comes_out_of_repeats_in_even_light():
    chip = replace(TRUE, prnu=0.012, dsnu=0.0)
    truth, there = [], np.ones((200, 200), bool)
    for seed in range(12):
        rng = np.random.default_rng(seed)
        stack = repeats(rng, chip, np.full(there.shape, 9000.0), 16, fixed_pattern(chip, there.shape, rng))
        level, variance, spread = fixed_variance(stack, there, chip)
        truth.append((variance - (0.012 * level) ** 2) / spread)
    # a dozen units: their mean in standard uncertainties, and the spread of these
    assert abs(np.mean(truth)) < 3 / np.sqrt(12) and 0.4 < np.std(truth) < 1.7


@pytest.mark.parametrize("smoothing", [0.0, 0.5, 1.0])
def test_the_smoothing_of_the_file_is_taken_out_of_repeats(smoothing, monkeypatch):
    """Before, full wells of 2.4 and 11 times the truth: a simulation with this file smooths its noise once more."""
    chip = replace(TRUE, bits=14, smoothing_px=smoothing, prnu=0.02)
    rng, even = np.random.default_rng(11), np.full((200, 200), 9000.0)
    monkeypatch.setattr(noise, "_specimen_mask", lambda source, _: np.ones(source.image.shape, bool))

    def group(kind, electrons, fixed=None):
        images = repeats(rng, chip, electrons, 16, fixed)
        return [SimpleNamespace(kind=kind, name=f"{kind}_{i}", image=image) for i, image in enumerate(images)]

    ramp = np.tile(np.linspace(300, 13000, 320), (240, 1))
    groups = [group("on", ramp), group("off", even, fixed_pattern(chip, even.shape, rng))]
    sensor = SimpleNamespace(
        technology="structured_light", imager=replace(chip, full_well=21000, read_noise=40, prnu=0)
    )
    found = fit_imager(groups, sensor, {}).imager
    assert found.full_well == pytest.approx(TRUE.full_well, rel=0.03)
    assert found.read_noise == pytest.approx(TRUE.read_noise, rel=0.1)
    assert found.prnu == pytest.approx(0.02, rel=0.05)


@pytest.mark.parametrize(
    "changes",
    [
        {"black_level": 2.3, "read_noise": 7.0, "dsnu": 7.0},
        {"black_level": 8.0},
        {"black_level": 0.0, "read_noise": 60.0},
        {"black_level": 1.0, "read_noise": 90.0, "dsnu": 30.0},
        {"black_level": 8.0, "read_noise": 35.0, "row_noise": 20.0},
        {"black_level": 8.0, "read_noise": 35.0, "column_pattern": 20.0},
    ],
    ids=["hardly any noise", "noise of 0.4 DN", "black at 0", "black at 1", "rows", "columns"],
)
def test_rounding_and_black_are_no_noise(changes, monkeypatch):
    """Of 8 bits. Before: a black level of 2.127 +- 0.001 for 2.3, and of 0.390 +- 0.002 for 0; read noise of 43 +- 0
    for 7 e-, and of 22.6 +- 0.2 for 25 e-. Beyond 4 u lies one of 16,000 numbers."""
    chip = replace(TRUE, bits=8, **changes)
    monkeypatch.setattr(noise, "_specimen_mask", lambda source, _: np.ones(source.image.shape, bool))
    truth = {"black_level_dn": chip.black_level, "full_well_e": chip.full_well, "dsnu_e": chip.dsnu}
    truth["read_noise_e"] = float(np.hypot(chip.read_noise, chip.row_noise))  # which contains that of rows
    for seed in range(4):
        rng = np.random.default_rng(seed)
        ramp = np.tile(np.linspace(300, 13000, 160), (120, 1))
        fixed, groups = fixed_pattern(chip, ramp.shape, rng), []
        for kind, electrons in (("dark", 0 * ramp), ("on", ramp)):
            images = repeats(rng, chip, electrons, 4, fixed)
            groups.append([SimpleNamespace(kind=kind, name=f"{kind}_{i}", image=one) for i, one in enumerate(images)])
        sensor = SimpleNamespace(
            technology="structured_light", imager=replace(chip, full_well=21000, read_noise=40, dsnu=3)
        )
        found = {one.key.removeprefix("imager."): one for one in fit_imager(groups, sensor, {}).estimates}
        assert {"black_level_dn", "full_well_e", "read_noise_e"} <= found.keys()
        for key in found.keys() & truth.keys():
            assert abs(found[key].value - truth[key]) < 4 * found[key].uncertainty, key


@pytest.mark.parametrize(("read", "brightest"), [(7.0, 560.0), (25.0, 118.0)])
def test_one_dim_image_of_little_noise_has_no_line(read, brightest, monkeypatch):
    """Of 8 bits. Before, a traceback of a singular matrix, as of a D435, and a read noise of 22.9 +- 0.3 for 25 e-."""
    monkeypatch.setattr(noise, "_specimen_mask", lambda source, _: np.ones(source.image.shape, bool))
    chip, rng = replace(TRUE, bits=8, black_level=8.0, read_noise=read), np.random.default_rng(1)
    image = expose(np.tile(np.linspace(118.0 * (read > 7), brightest, 320), (240, 1)), chip, None, Noise(), rng)
    sensor = SimpleNamespace(technology="structured_light", imager=chip)
    found = fit_imager([[SimpleNamespace(kind="off", name="off", image=image)]], sensor, {})
    assert not found.known and not found.estimates


@pytest.mark.parametrize("count", [1, 4])
def test_one_level_determines_neither_full_well_nor_read_noise(count, monkeypatch):
    """Before, the file's full well of 18,000 e- was kept, and the read noise was 51 +- 4 e- for 25 e-."""
    monkeypatch.setattr(noise, "_specimen_mask", lambda source, _: np.ones(source.image.shape, bool))
    images = repeats(np.random.default_rng(3), TRUE, np.full((200, 240), 9000.0), count)
    group = [SimpleNamespace(kind="off", name=f"off_{i}", image=image) for i, image in enumerate(images)]
    sensor = SimpleNamespace(technology="structured_light", imager=replace(TRUE, full_well=18000))
    found = fit_imager([group], sensor, {})
    assert not found.known and not found.estimates and found.imager == sensor.imager


def test_one_even_image_gives_the_sum_of_noise_and_fixed_pattern():
    rng = np.random.default_rng(5)
    image = expose(np.tile(np.linspace(500, 12000, 400), (400, 1)), TRUE, None, Noise(), rng)
    line = one_image_line(image, np.ones(image.shape, bool), FILE)
    value, spread = line.full_well(FILE)
    assert abs(value - TRUE.full_well) < 3 * spread < 0.2 * value


def test_a_single_level_has_no_line():
    rng = np.random.default_rng(5)
    image = expose(np.full((80, 80), 5000.0), TRUE, None, Noise(), rng)
    assert one_image_line(image, np.ones(image.shape, bool), FILE) is None
    assert repeated_line([whole(repeats(rng, TRUE, np.full((40, 40), 5000.0)))], FILE) is None


@pytest.mark.parametrize("smoothing", [0.35, 0.6, 1.0])
def test_smoothing_by_the_device_is_told_by_neighbours_in_finest_detail(smoothing):
    there = np.ones((240, 240), bool)
    for seed in range(6):
        rng = np.random.default_rng(seed)
        image = expose(np.full(there.shape, 6000.0), replace(TRUE, smoothing_px=smoothing), None, Noise(), rng)
        value, spread = smoothing_of(image, there)
        assert abs(value - smoothing) < max(3.5 * spread, 0.02)
    assert fine_gain(smoothing) < fine_gain(0.2) < 1


def test_an_image_that_was_not_smoothed_is_told_so():
    rng = np.random.default_rng(2)
    image = expose(np.full((240, 240), 6000.0), TRUE, None, Noise(), rng)
    assert smoothing_of(image, np.ones(image.shape, bool))[0] < 0.2


def test_three_repeats_of_eight_bits_are_not_fooled_by_whole_grey_levels():
    """Noise of half a grey level: binned by their own mean, images that are all alike would have none."""
    chip = replace(TRUE, bits=8, black_level=10, read_noise=30.0)
    found = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        images = [repeats(rng, chip, np.tile(np.linspace(low, 9000, 300), (200, 1)), 3) for low in (100, 2000)]
        line = repeated_line([whole(one) for one in images], replace(chip, full_well=20000))
        value, spread = line.full_well(replace(chip, full_well=20000))
        found.append((value - chip.full_well) / spread)
    assert abs(np.mean(found)) < 3 / np.sqrt(12)


def test_dark_images_alone_tell_no_gain():
    """Levels that differ by chance alone: before, 6 of 10 had a full well of 9,773 to 306,405 e- for 10,000."""
    chip = replace(TRUE, bits=8, black_level=10, full_well=10000, read_noise=40)
    for seed in range(10):
        dark = repeats(np.random.default_rng(seed), chip, np.zeros((480, 640)), 2)
        assert repeated_line([whole(dark)], chip) is None
