"""Decoders that a maker may have built: drawn inside the stated ranges, the same for a day, and switched off."""

import math
from dataclasses import replace

import numpy as np
import pytest

from characterisation.files.errors import InputError
from mitsim.sensor.preset import load_sensor, presets
from mitsim.sensor.unknowns import DecoderUnknowns, UnknownsTable, unknowns_of
from mitsim.study.virtual.drawn_decoder import check_decoder, decoder_is_drawn, decoder_numbers, drawn_decoder

SEEDS = range(1, 121)


def decoders_of(name):
    sensor = load_sensor(name)
    return sensor, sensor.unknowns.decoder, [drawn_decoder(sensor, sensor.unknowns.decoder, seed) for seed in SEEDS]


def within(ends, value):
    return ends[0] * (1 - 1e-12) <= value <= ends[1] * (1 + 1e-12)


@pytest.mark.parametrize("name", ["ensenso-n10", "ensenso-n35", "realsense-d435", "oak-d-pro"])
def test_drawn_matchers_lie_inside_the_stated_ranges(name):
    sensor, ranges, drawn = decoders_of(name)
    own = sensor.matcher
    for one in drawn:
        assert one.method in ranges.methods
        blocks = {"sgbm": ranges.blocks_px, "census": ranges.sums_px}.get(one.method)
        assert one.block_size % 2 == 1
        assert (
            within(ranges.block_factor, one.block_size / own.block_size) if blocks is None else one.block_size in blocks
        )
        assert within(ranges.p1, one.p1) and within(ranges.p2_over_p1, one.p2 / one.p1)
        assert within(ranges.thresholds, one.minimum_contrast_dn / own.minimum_contrast_dn)
        assert within(ranges.left_right_px, one.left_right_px)
        if one.method != "correlation":
            assert within(ranges.uniqueness_percent, one.uniqueness_percent)
        assert one.median_px in ranges.medians_px and one.speckle_px in ranges.speckles_px
        assert one.disparity_step in (ranges.disparity_steps_px or [own.disparity_step])
        assert one.census_window_px in ranges.census_windows_px and one.mode in ranges.modes
        assert (one.near_mm, one.far_mm, one.reference_mm) == (own.near_mm, own.far_mm, own.reference_mm)
    # every choice occurs: one of two is missing in 120 draws with a probability of 2^-119, one of four with 1e-15
    assert {one.method for one in drawn} == set(ranges.methods)
    assert {one.median_px for one in drawn} == set(ranges.medians_px)
    assert {one.mode for one in drawn} == set(ranges.modes)
    middle = np.mean([math.log(one.p1) for one in drawn])
    spread = math.log(ranges.p1[1] / ranges.p1[0]) / math.sqrt(12)
    assert abs(middle - np.mean(np.log(ranges.p1))) < 4 * spread / math.sqrt(len(drawn))


@pytest.mark.parametrize(
    ("keys", "fits"),
    [
        ({"blocks_px": [15]}, False),
        ({"blocks_px": [15], "p1": (4, 9)}, True),
        ({"blocks_px": [31], "methods": ["census", "correlation"]}, True),
        ({"blocks_px": [], "p1": (10, 125), "p2_over_p1": (1, 8)}, True),
        ({"p1": (125, 125), "p2_over_p1": (8, 8)}, False),
        ({"p1": (125, 125), "p2_over_p1": (8, 8), "methods": ["census"]}, True),
    ],
)
def test_ranges_that_opencv_cannot_sum_are_rejected_and_no_other(keys, fits):
    sensor, table = load_sensor("ensenso-n10"), DecoderUnknowns.model_validate(keys)
    if fits:
        check_decoder(sensor, table, "study.toml")
        assert all(drawn_decoder(sensor, table, seed).p2 <= 1000 for seed in SEEDS)
    else:
        with pytest.raises(InputError, match=r"study.toml: unknowns.decoder: blocks_px.*32767.*lower the upper ends"):
            check_decoder(sensor, table, "study.toml")
    for name in presets():
        preset = load_sensor(name)
        check_decoder(preset, preset.unknowns.decoder, name)


def test_ranges_of_sensor_and_study_that_contradict_one_another_are_an_error_of_input():
    high, steep = ({"decoder": {key: ends}} for key, ends in (("p1", (4, 100)), ("p2_over_p1", (2, 12))))
    with pytest.raises(InputError, match="p1 times p2_over_p1 up to 1000"):
        unknowns_of(UnknownsTable.model_validate(high), UnknownsTable.model_validate(steep))


def test_several_frames_and_one_camera_keep_methods_that_decode_them():
    sensor = load_sensor("ensenso-n35")
    ranges = DecoderUnknowns()
    assert {drawn_decoder(sensor, ranges, seed).method for seed in SEEDS} == {"census", "correlation"}
    sensor = load_sensor("primesense-carmine-1.09")
    assert {drawn_decoder(sensor, ranges, seed).method for seed in SEEDS} == {"correlation"}


@pytest.mark.parametrize("name", presets())
def test_a_seed_decides_a_decoder_and_none_is_the_sensors_own(name):
    sensor = load_sensor(name)
    ranges = sensor.unknowns.decoder
    assert drawn_decoder(sensor, ranges, 0) == sensor.settings
    assert drawn_decoder(sensor, ranges.model_copy(update={"known": True}), 5) == sensor.settings
    assert not decoder_is_drawn(sensor, ranges.model_copy(update={"known": True}))
    drawn = [drawn_decoder(sensor, ranges, seed) for seed in (5, 6)]
    assert drawn[0] == drawn_decoder(sensor, ranges, 5)
    assert drawn[0] != drawn[1]
    numbers = [decoder_numbers(one) for one in (*drawn, sensor.settings)]
    assert numbers[0].keys() == numbers[1].keys() == numbers[2].keys()
    assert numbers[0] != numbers[1]
    assert all(math.isfinite(value) for one in numbers for value in one.values())


def test_fringe_decoders_draw_their_threshold_and_a_stated_smoothing():
    sensor = load_sensor("zivid-2-m70")
    ranges = sensor.unknowns.decoder
    drawn = [drawn_decoder(sensor, ranges, seed) for seed in SEEDS]
    assert {one.smoothing_px for one in drawn} == set(ranges.smoothings_px) == {0, 1.5}
    own = sensor.decoder.minimum_modulation_dn
    assert all(within(ranges.thresholds, one.minimum_modulation_dn / own) for one in drawn)
    plain = load_sensor("david-sls-3")
    assert {drawn_decoder(plain, plain.unknowns.decoder, seed).smoothing_px for seed in SEEDS} == {0.0}


def test_an_empty_list_keeps_the_setting_and_a_study_narrows_the_sensors_ranges():
    sensor = load_sensor("ensenso-n10")
    lists = ("methods", "blocks_px", "contrast_windows_px", "prefilter_caps", "medians_px", "speckles_px", "sub_pixel")
    kept = DecoderUnknowns.model_validate({key: [] for key in lists})
    for seed in SEEDS[:20]:
        one = drawn_decoder(sensor, kept, seed)
        for key in (
            "method",
            "block_size",
            "contrast_window_px",
            "prefilter_cap",
            "median_px",
            "speckle_px",
            "sub_pixel",
        ):
            assert getattr(one, key) == getattr(sensor.matcher, key)
    narrower = type(sensor.unknowns).model_validate({"decoder": {"blocks_px": [7]}})
    table = unknowns_of(sensor.unknowns, narrower).decoder
    assert (table.blocks_px, table.methods) == ([7], ["sgbm", "census"])
    blocks = {one.block_size for one in (drawn_decoder(sensor, table, seed) for seed in SEEDS) if one.method == "sgbm"}
    assert blocks == {7}


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("p1", [8, 4]),
        ("p1", [8, 400]),
        ("p2_over_p1", [0.5, 4]),
        ("blocks_px", [6]),
        ("contrast_windows_px", [3]),
        ("methods", ["bm"]),
    ],
)
def test_ranges_that_no_matcher_can_have_are_refused(key, value):
    with pytest.raises(ValueError, match=key):
        DecoderUnknowns.model_validate({key: value})


def test_a_sensor_of_one_method_draws_the_blocks_around_its_own():
    sensor = load_sensor("primesense-carmine-1.09")
    ranges = sensor.unknowns.decoder
    sizes = {drawn_decoder(sensor, ranges, seed).block_size for seed in SEEDS}
    assert sizes == {7, 9, 11}
    wider = replace(sensor, matcher=sensor.matcher.model_copy(update={"block_size": 21}))
    assert max(drawn_decoder(wider, ranges, seed).block_size for seed in SEEDS) > 21
