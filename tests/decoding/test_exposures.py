"""Merging of exposure brackets: unbiased, as noisy as the closed form, and smooth where an exposure saturates."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from characterisation.files.errors import InputError
from mitsim.decoding.exposures import merge_exposures
from mitsim.sensor.image_formation import expose
from mitsim.sensor.imager import Imager
from mitsim.sensor.noise_sources import Noise

IMAGER = Imager(
    pixel_um=6.0,
    quantum_efficiency=0.5,
    full_well=20000,
    read_noise=12,
    dsnu=0,
    prnu=0,
    bits=12,
    black_level=64,
    f_number=2.0,
)
TIMES = (1e-3, 4e-3, 16e-3)

#: level without light, and merged levels per grey level of the shortest exposure
BLACK = IMAGER.black_level * 65535 / IMAGER.full_scale
SCALE = (65535 - BLACK) / (IMAGER.full_scale - IMAGER.black_level)


def bracket(
    rates: np.ndarray, rng: np.random.Generator | None, imager: Imager = IMAGER, times: tuple[float, ...] = TIMES
) -> np.ndarray:
    """Images (E, P, H, W) of rates (P, H, W) [e-/s]."""
    noise = Noise.only("quantisation") if rng is None else Noise()
    return np.stack([expose(rates * time, imager, None, noise, rng) for time in times])


def merge(stack: np.ndarray, imager: Imager = IMAGER, times: tuple[float, ...] = TIMES) -> np.ndarray:
    return merge_exposures(stack, times, imager.black_level, imager.full_scale, imager.gamma)


def electrons(merged: np.ndarray, imager: Imager = IMAGER) -> np.ndarray:
    """Electrons in the shortest exposure that merged levels stand for."""
    return (merged - BLACK) / SCALE / imager.gain


def naive(stack: np.ndarray, times: tuple[float, ...], black: float, full: int, gamma: float) -> np.ndarray:
    """Pixel by pixel, in double precision, without tables; NaN where saturated."""
    first = int(np.argmin(times))
    out = np.full(stack.shape[1:], np.nan)
    for place in np.ndindex(stack.shape[1:]):
        if stack[(first, *place)] >= full:
            continue
        total = time = 0.0
        for exposure, duration in enumerate(times):
            share = (float(stack[(exposure, *place)]) - black) / (full - black)
            share = share if gamma == 1 else max(share, 0.0) ** gamma
            weight = 1.0 if exposure == first else min(max((0.95 - share) / 0.15, 0.0), 1.0)
            total += weight * share
            time += weight * duration
        out[place] = total / time * times[first]
    black16 = black * 65535 / full
    return np.clip(np.rint(black16 + out * (65535 - black16)), 0, 65535)


@pytest.mark.parametrize("gamma", [1.0, 2.2])
@pytest.mark.parametrize("bits", [8, 12, 16])
@pytest.mark.parametrize("order", [(0, 1, 2), (2, 0, 1)])
def test_merging_equals_a_loop_over_pixels(gamma, bits, order, rng):
    times = tuple(TIMES[i] for i in order)
    full = 2**bits - 1
    black = full / 50
    stack = rng.integers(0, full + 1, (3, 2, 30, 40)).astype(np.uint8 if bits == 8 else np.uint16)
    stack[:, 0, 0] = full
    merged = merge_exposures(stack, times, black, full, gamma)
    expected = naive(stack, times, black, full, gamma)
    saturated = np.isnan(expected)
    assert np.all(merged[saturated] == 65535)
    # single precision may round a level the other way
    assert np.abs(merged - expected)[~saturated].max() <= 1
    assert np.mean(merged[~saturated] == expected[~saturated]) > 0.98


def expected_variance(signal: float) -> float:
    """Of the merged signal [e-^2], for a signal [e-] in the shortest exposure away from the hand-overs."""
    used = [time / TIMES[0] for time in TIMES if signal * time / TIMES[0] < 0.75 * IMAGER.full_well] or [1.0]
    each = IMAGER.read_noise**2 + 1 / 12 / IMAGER.gain**2
    rounding = 1 / 12 / (SCALE * IMAGER.gain) ** 2
    return sum(signal * share + each for share in used) / sum(used) ** 2 + rounding


@pytest.mark.parametrize("signal", [0.0, 5.0, 20.0, 60.0])
def test_merging_of_faint_light_is_unbiased(signal, rng):
    merged = electrons(merge(bracket(np.full((1, 500, 600), signal / TIMES[0]), rng)))
    assert abs(merged.mean() - signal) < 5 * np.sqrt(expected_variance(signal) / merged.size)


# Fainter light has less noise than half a grey level of the shortest exposure, and rounding to 1/16 of it is no longer
# independent of the sum's own steps of 1/21: 1.4 % more variance at 20 e-
@pytest.mark.parametrize("signal", [100.0, 200.0, 700.0, 3000.0, 9000.0, 17000.0])
def test_merging_is_unbiased_and_has_the_noise_of_the_closed_form(signal, rng):
    merged = electrons(merge(bracket(np.full((1, 500, 600), signal / TIMES[0]), rng)))
    variance, n = expected_variance(signal), merged.size
    assert abs(merged.mean() - signal) < 5 * np.sqrt(variance / n)
    assert abs(merged.var() / variance - 1) < 5 * np.sqrt(2 / n)


def test_a_bracket_is_worth_the_root_of_its_total_exposure(rng):
    # shot noise alone, three exposures unsaturated: sqrt(1 + 4 + 16) = 4.6
    still = Imager(**(vars(IMAGER) | {"read_noise": 0.0}))
    stack = bracket(np.full((1, 500, 600), 500 / TIMES[0]), rng, still)
    single = (stack[0] / still.gain).std()
    merged = electrons(merge(stack, still), still).std()
    assert single / merged == pytest.approx(np.sqrt(21), rel=0.02)


def test_no_bias_where_an_exposure_fades_out(rng):
    # through the whole hand-over of the longest exposure, 60 to 110 % of its full well
    signals = np.linspace(0.6, 1.1, 40) * IMAGER.full_well / 16
    rates = np.broadcast_to(signals[:, None, None] / TIMES[0], (40, 200, 250))
    merged = electrons(merge(bracket(rates, rng)))
    deviation = merged.std(axis=(1, 2))
    bias = merged.mean(axis=(1, 2)) - signals
    # The weight w of the longest exposure falls by 1 / (0.15 F) for an electron of its noise, of variance v = 0.95 F at
    # most. To second order that pulls the estimate by v / (0.15 F) 5 / (5 + 16 w)^2, 5 being the shares of time of the
    # other two: 6.3 5 / 25 = 1.3 e- at most, where w is small, against 16 e- of noise
    assert np.abs(bias).max() < 0.95 / 0.15 / 5 + 5 * deviation.max() / np.sqrt(200 * 250)
    # and the noise goes smoothly from that of all three exposures to that of two
    assert np.all(deviation < 1.05 * np.sqrt((5 * signals[-1] + 2 * 150) / 25))


def test_levels_rise_with_light_through_every_hand_over():
    signals = np.linspace(0, 1.02 * IMAGER.full_well, 200_000)
    merged = merge(bracket(signals.reshape(1, 1, -1) / TIMES[0], None))
    levels = merged.ravel().astype(float)
    # without noise each level is known to half a grey level of the exposures it comes from: where a longer exposure
    # hands over to the shortest, the sum may fall back by a part of that half level
    assert np.diff(levels).min() >= -0.5 * SCALE - 1
    assert (
        np.abs(levels[signals < 19990] - BLACK - signals[signals < 19990] * IMAGER.gain * SCALE).max()
        <= 0.5 * SCALE + 1
    )
    assert np.all(np.diff(levels.reshape(-1, 200).mean(axis=1)) >= 0)
    assert levels[-1] == 65535


def test_mean_levels_rise_with_light_in_noise(rng):
    signals = np.linspace(800, 1400, 61)
    rates = np.broadcast_to(signals[:, None, None] / TIMES[0], (61, 200, 250))
    means = electrons(merge(bracket(rates, rng))).mean(axis=(1, 2))
    # steps of 10 e-, means known to about 16 / sqrt(5e4) = 0.07 e-
    assert np.all(np.diff(means) > 9)
    assert np.all(np.diff(means) < 11)


def test_one_exposure_is_itself_in_16_bits(rng):
    stack = rng.integers(0, 256, (1, 1, 40, 50)).astype(np.uint8)
    merged = merge_exposures(stack, (1e-3,), 4, 255)
    assert np.abs(merged[0] - stack[0, 0] * 257.0).max() <= 1
    assert np.array_equal(merged[0] == 65535, stack[0, 0] == 255)


@given(
    st.integers(1, 4),
    st.sampled_from([np.uint8, np.uint16]),
    st.floats(0.5, 3),
    st.floats(0, 0.5),
    st.integers(0, 2**32 - 1),
)
def test_any_stack_merges_and_keeps_what_is_saturated(count, kind, gamma, black_share, seed):
    rng = np.random.default_rng(seed)
    full = int(np.iinfo(kind).max)
    stack = rng.integers(0, full + 1, (count, 2, 3, 4)).astype(kind)
    times = 10.0 ** rng.uniform(-6, 1, count)
    merged = merge_exposures(stack, times, black_share * full, full, gamma)
    assert np.all(merged[stack[np.argmin(times)] == full] == 65535)


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"stack": np.zeros((3, 4, 4), np.uint8)}, "stack"),
        ({"stack": np.zeros((2, 1, 4, 4))}, "stack"),
        ({"stack": np.zeros((0, 1, 4, 4), np.uint8)}, "stack"),
        ({"exposures_s": (1e-3,)}, "exposures_s"),
        ({"exposures_s": (1e-3, 0.0)}, "exposures_s"),
        ({"exposures_s": (1e-3, np.nan)}, "exposures_s"),
        ({"exposures_s": (1e-3, -1.0)}, "exposures_s"),
        ({"full_scale": 1023}, "full_scale"),
        ({"full_scale": 0}, "full_scale"),
        ({"black_level": -1}, "black_level"),
        ({"black_level": 255}, "black_level"),
        ({"gamma": 0}, "gamma"),
        ({"gamma": np.nan}, "gamma"),
    ],
)
def test_what_cannot_be_merged_is_named(change, field):
    given = {
        "stack": np.zeros((2, 1, 4, 4), np.uint8),
        "exposures_s": (1e-3, 4e-3),
        "black_level": 4,
        "full_scale": 255,
    }
    with pytest.raises(InputError, match=field):
        merge_exposures(**(given | change))
