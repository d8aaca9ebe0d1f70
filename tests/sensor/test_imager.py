"""The imager against the closed forms of EMVA 1288, and its reference implementation against the imager."""

from __future__ import annotations

import tracemalloc
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import TypeAdapter
from scipy import stats

from characterisation.files.errors import InputError
from mitsim.sensor.image_formation import converter, counted_below, expose, fixed_pattern
from mitsim.sensor.imager import Imager, electrons_per_radiance
from mitsim.sensor.noise_sources import Noise
from mitsim.sensor.preset import load_sensor
from mitsim.sensor.sensor_file import ImagerTable

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
NAMES = [field.name for field in fields(Noise)]
SHAPE = (400, 500)


def flat(electrons: float, shape: tuple[int, int] = SHAPE) -> np.ndarray:
    return np.full(shape, electrons)


def test_electrons_from_radiance_by_hand():
    # E = pi L / 4 N^2 = pi / 16 W/mm^2 for L = 1; photons = E A t lambda / hc
    energy = np.pi / 16 * 36e-6 * 1e-3
    photons = energy * 850e-9 / (6.62607015e-34 * 299792458)
    assert np.isclose(electrons_per_radiance(IMAGER, 850, 1e-3), 0.5 * photons, rtol=1e-9)


@pytest.mark.parametrize("mean", [0.0, 50.0, 500.0, 5000.0, 15000.0])
def test_temporal_noise_is_shot_read_and_quantisation(mean, rng):
    image = expose(flat(mean), IMAGER, None, Noise(), rng).astype(float)
    expected = IMAGER.gain**2 * (mean + IMAGER.read_noise**2) + 1 / 12
    n = image.size
    assert abs(image.mean() - (mean * IMAGER.gain + 64)) < 5 * np.sqrt(expected / n) + 1e-3
    # the variance of 2e5 samples is known to sqrt(2/n) = 0.3 %: five of those
    assert abs(image.var(ddof=1) / expected - 1) < 5 * np.sqrt(2 / n)


def test_photon_transfer_returns_the_gain_and_the_read_noise(rng):
    means, variances = [], []
    for electrons in np.linspace(0, 16000, 13):
        a, b = (expose(flat(electrons, (300, 300)), IMAGER, None, Noise(), rng).astype(float) for _ in range(2))
        means.append(0.5 * (a.mean() + b.mean()))
        variances.append(0.5 * ((a - b) ** 2).mean())
    slope = np.polyfit(means, variances, 1)[0]
    assert np.isclose(slope, IMAGER.gain, rtol=0.02)
    # the dark variance of 9e4 differences is known to sqrt(2/n) = 0.5 %, its root to half of that: five of those
    read_noise = np.sqrt(variances[0] - 1 / 12) / IMAGER.gain
    assert abs(read_noise / IMAGER.read_noise - 1) < 5 * 0.5 * np.sqrt(2 / 9e4)


def test_fixed_pattern_from_averaged_stacks_as_the_standard_measures_it(rng):
    imager = replace(IMAGER, dsnu=25.0, prnu=0.012)
    pattern = fixed_pattern(imager, (300, 300), np.random.default_rng(8))
    count, half = 32, 0.5 * imager.full_well
    spatial = {}
    for mean in (0.0, half):
        stack = expose(np.full((count, 300, 300), mean), imager, pattern, Noise(), rng).astype(float)
        temporal = stack.var(axis=0, ddof=1).mean() / count
        spatial[mean] = (stack.mean(axis=0).var(ddof=1) - temporal) / imager.gain**2
    # a deviation of n = 9e4 pixels is known to 1 / sqrt(2n) = 0.24 %, here by 1 + 1/32 (30/25)^2 in the dark and by
    # 1 + 1/32 (100^2 + 30^2) / 120^2 + 2 (25/120)^2, under 1.12, at half of the well: five of those
    assert abs(np.sqrt(spatial[0.0]) / 25.0 - 1) < 5 * 0.0024 * 1.05
    assert abs(np.sqrt(spatial[half] - spatial[0.0]) / half / 0.012 - 1) < 5 * 0.0024 * 1.12


def test_dynamic_range_and_best_signal_to_noise_ratio_are_those_of_full_well_and_read_noise(rng):
    # vendors' figures: SNR max = 10 log10(full well), DR = 20 log10(full well / read noise)
    imager = replace(IMAGER, bits=16, black_level=2000)
    near_full = 0.9 * imager.full_well
    bright, dark = (expose(flat(mean), imager, None, Noise(), rng) / imager.gain for mean in (near_full, 0.0))
    ratio = (bright.mean() - dark.mean()) / bright.std()
    assert ratio == pytest.approx(near_full / np.sqrt(near_full + 30**2), rel=0.01)
    assert 20 * np.log10(imager.full_well / dark.std()) == pytest.approx(20 * np.log10(20000 / 30), abs=0.05)


@pytest.mark.parametrize("mean", [0.3, 7.0, 99.0, 100.0, 163.0, 1000.0, 9000.0])
def test_shot_noise_is_poisson_distributed(mean, rng):
    # an imager of one grey level an electron shows the counts themselves
    counter = replace(IMAGER, full_well=65535, read_noise=0, bits=16, black_level=0)
    counts = expose(flat(mean, (500, 1000)), counter, None, Noise.only("shot", "quantisation"), rng).ravel()
    low, high = stats.poisson.ppf([1e-4, 1 - 1e-4], mean).astype(int)
    edges = np.unique(np.linspace(low, high + 1, 30).astype(int))
    found = np.histogram(counts, [-np.inf, *(edges - 0.5), np.inf])[0]
    expected = counts.size * np.diff(stats.poisson.cdf([-1, *(edges - 1), np.inf], mean))
    known = expected > 5
    chi2 = ((found - expected) ** 2 / np.where(known, expected, 1))[known].sum()
    assert stats.chi2.sf(chi2, known.sum() - 1) > 1e-3


@pytest.mark.parametrize("mean", [100, 200, 1000, 10000])
def test_fast_shot_noise_has_the_distribution_function_of_poisson(mean):
    # exact for round(mu + s z + (z^2 - 1)/6), which rises with z: P(<= k) is that of the z with k + 1/2
    s = np.sqrt(mean)
    k = np.arange(int(mean - 7 * s), int(mean + 7 * s))
    z = 3 * (np.sqrt(s * s + 2 / 3 * (k + 0.5 - mean + 1 / 6)) - s)
    assert np.abs(stats.norm.cdf(z) - stats.poisson.cdf(k, mean)).max() < 0.013 / mean


@pytest.mark.parametrize("read", [1.0, 3.0, 4.9, 5.0, 7.2, 30.0])
@pytest.mark.parametrize("over", [1.0, 3.0, 12.0, 80.0, 2000.0])
def test_shot_and_read_noise_drawn_together_have_the_distribution_function_of_their_sum(read, over):
    # Poisson convolved with a normal, against the z of mu + s z + mu/s^2 (z^2 - 1)/6, which rises with z
    mean = max(counted_below(read), over)
    s = np.sqrt(mean + read**2)
    x = mean + s * np.linspace(-7, 7, 701)
    k = np.arange(int(mean + 10 * np.sqrt(mean) + 40))
    expected = stats.poisson.pmf(k, mean) @ stats.norm.cdf((x - k[:, None]) / read)
    c = mean / s**2 / 6
    z = (np.sqrt(np.maximum(s * s + 4 * c * (c + x - mean), 0)) - s) / (2 * c)
    assert np.abs(stats.norm.cdf(z) - expected).max() < 1.4e-4


@pytest.mark.parametrize("read", [0.0, 0.5, 1.0, 3.0, 4.9, 5.0, 7.2])
def test_shot_noise_is_counted_where_the_kurtosis_of_the_charge_is_over_a_hundredth(read):
    means = np.geomspace(1e-3, 1e4, 2000)
    kurtosis = means / (means + read**2) ** 2
    assert kurtosis[means >= counted_below(read)].max() <= 0.01 * (1 + 1e-9)
    if read < 5:
        just_under = 0.99 * counted_below(read)
        assert just_under / (just_under + read**2) ** 2 > 0.01


@pytest.mark.parametrize("read", [0.7, 2.0, 7.2])
@pytest.mark.parametrize("mean", [0.0, 1.5, 20.0, 150.0])
def test_mean_variance_and_skewness_are_those_of_a_poisson_count_with_read_noise(read, mean, rng):
    variance, n = mean + read**2, 500_000
    # room for 9 deviations below zero and above the mean; a grey level is under 1/50 of a deviation
    imager = replace(IMAGER, full_well=mean + 10 * np.sqrt(variance) + 10 * read, read_noise=read, bits=16)
    imager = replace(imager, black_level=65535 / 2)
    image = expose(flat(mean, (500, 1000)), imager, None, Noise(), rng)
    charge = (image.astype(float) - imager.black_level) / imager.gain
    found = charge.mean(), charge.var(), ((charge - charge.mean()) ** 3).mean()
    # variances of the first three sample moments (Kendall & Stuart, Advanced Theory of Statistics, ch. 10), from the
    # central moments of the sum, of which all cumulants from the third on are mu
    m2, m3, m4 = variance, mean, mean + 3 * variance**2
    m6 = mean + 15 * mean * variance + 10 * mean**2 + 15 * variance**3
    errors = np.sqrt(np.array([m2, m4 - m2**2, m6 - m3**2 - 6 * m2 * m4 + 9 * m2**3]) / n)
    for moment, expected, error in zip(found, (mean, variance, mean), errors, strict=True):
        assert abs(moment - expected) < 5 * error


def test_row_noise_moves_whole_rows_of_one_image(rng):
    imager = replace(IMAGER, row_noise=50.0, bits=16)
    stack = (
        expose(np.full((20, 400, 50), 5000.0), imager, None, Noise.only("row"), rng)
        / converter(imager, Noise.only("row")).gain
    )
    assert np.allclose(stack.std(axis=2), 0, atol=1e-3)
    rows = stack[..., 0]
    assert rows.std(ddof=1) == pytest.approx(50, rel=5 / np.sqrt(2 * 8000))
    between_images = np.corrcoef(rows)[np.triu_indices(20, 1)]
    # 190 correlations of 400 rows: the largest of them stays under 4.5 / sqrt(400)
    assert np.abs(between_images).max() < 4.5 / np.sqrt(400)


def test_column_pattern_is_the_same_in_every_image(rng):
    imager = replace(IMAGER, column_pattern=50.0)
    pattern = fixed_pattern(imager, (40, 5000), rng)
    stack = expose(np.full((3, 40, 5000), 5000.0), imager, pattern, Noise.only("column"), None).astype(float)
    assert np.all(stack == stack[0, 0])
    gain = converter(imager, Noise.none()).gain
    assert stack[0, 0].std() / gain == pytest.approx(50, rel=5 / np.sqrt(2 * 5000))
    assert np.allclose((stack[0, 0] - stack[0, 0].mean()) / gain, pattern.column - pattern.column.mean(), atol=0.5)


@pytest.mark.parametrize("sources", [("dark",), ("dark", "shot")])
@pytest.mark.parametrize("mean", [0.0, 400.0])
def test_dark_current_adds_its_shot_noise_and_no_mean(sources, mean, rng):
    imager = replace(IMAGER, dark_current=600.0, bits=16, black_level=4000)
    image = expose(flat(mean), imager, None, Noise.only(*sources, "quantisation"), rng, exposure_s=0.5) / imager.gain
    variance = 300.0 + (mean if "shot" in sources else 0.0)
    n = image.size
    assert abs(image.mean() - 4000 / imager.gain - mean) < 5 * np.sqrt(variance / n)
    # besides sqrt(2/n), the excess kurtosis 1/mu of a Poisson distribution, 1/300, is nothing
    assert abs(image.var() / variance - 1) < 5 * np.sqrt(2 / n)


def test_gamma_is_the_response_curve():
    imager = replace(IMAGER, gamma=2.2)
    electrons = np.linspace(0, 25000, 97)[None]
    expected = np.rint(64 + 4031 * np.minimum(electrons / 20000, 1) ** (1 / 2.2))
    assert np.abs(expose(electrons, imager, None, Noise.only("quantisation"), None) - expected).max() <= 1
    below = expose(flat(0.0), imager, None, Noise(), np.random.default_rng(1))
    assert below.min() == 64


#: 10 bits to 8, as an N35-604 does: out = in, in // 4 + 67, in // 8 + 128
COMPANDED = replace(
    IMAGER, full_well=16000, bits=8, black_level=5, companding=((89.333, 89.333), (488.0, 189.0), (1024.0, 256.0))
)


def converter_levels(imager: Imager) -> np.ndarray:
    """Electrons of which each level of the converter is made, (1, levels)."""
    levels = np.arange(imager.companding[-1][0])
    return ((levels - imager.converter_black) / imager.gain)[None]


def test_companding_is_the_table_that_the_chip_has():
    levels = np.arange(1024)
    table = np.where(levels < 90, levels, np.where(levels < 488, levels // 4 + 67, levels // 8 + 128))
    found = expose(converter_levels(COMPANDED), COMPANDED, None, Noise.only("quantisation"), None)[0]
    assert np.array_equal(found, table)
    assert COMPANDED.gain == pytest.approx(1018 / 16000)
    assert expose(flat(1e9, (1, 1)), COMPANDED, None, Noise.only("quantisation"), None) == 255
    assert expose(flat(0.0, (1, 1)), COMPANDED, None, Noise.only("quantisation"), None) == 5


@pytest.mark.parametrize(
    ("level_in", "step", "level_out"),
    [
        (45.0, 1, 45.0),
        (200.0, 4, 200 / 4 + 67 - 3 / 8),
        (400.0, 4, 400 / 4 + 67 - 3 / 8),
        (750.0, 8, 750 / 8 + 128 - 7 / 16),
    ],
)
def test_photon_transfer_of_a_companded_imager_has_the_quantisation_of_its_segment(level_in, step, level_out, rng):
    # the chip cuts to whole grey levels, which takes half a step off, less half a level of the converter
    mean = (level_in - 5) / COMPANDED.gain
    image = expose(flat(mean), COMPANDED, None, Noise(), rng).astype(float)
    converted = COMPANDED.gain**2 * (mean + COMPANDED.read_noise**2)
    expected = (converted + step**2 / 12) / step**2
    n = image.size
    assert abs(image.mean() - level_out) < 5 * np.sqrt(expected / n) + 1e-3
    # a Gaussian of sigma steps: what Sheppard's 1/12 leaves out of the variance is under 4 exp(-2 (pi sigma)^2), with
    # sigma 0.83 at least 5e-6; 2e5 samples know the variance to sqrt(2/n) = 0.3 %, five of those
    assert np.sqrt(converted) / step > 0.83
    assert abs(image.var(ddof=1) / expected - 1) < 5 * np.sqrt(2 / n)


def test_the_preset_of_the_n35_compands_by_its_file():
    assert load_sensor("ensenso-n35").imager.companding == COMPANDED.companding


def imager_table(**changes) -> ImagerTable:
    given = {
        "pixel_um": 5.3,
        "quantum_efficiency": 0.45,
        "full_well_e": 17000,
        "read_noise_e": 40,
        "f_number": 1.6,
        "companding_dn": [[89.333, 89.333], [488, 189], [1024, 256]],
    }
    return TypeAdapter(ImagerTable).validate_python(given | changes)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"companding_dn": [[100, 90], [90, 189], [1024, 256]]}, "rise"),
        ({"companding_dn": [[1000, 256]]}, "ends with"),
        ({"bits": 10}, "ends with"),
        ({"gamma": 2.2}, "two curves"),
        ({"black_level_dn": 256}, "full scale"),
    ],
)
def test_a_companding_curve_that_no_chip_has_is_refused(changes, said):
    assert imager_table().companding[-1] == (1024, 256)
    with pytest.raises(ValueError, match=said):
        imager_table(**changes)


def test_a_smooth_ramp_of_light_shows_the_knees_in_its_histogram(rng):
    # every level of the converter equally often: a grey level counts as many as it is wide, 1, 4 and 8
    electrons = rng.uniform(converter_levels(COMPANDED).min(), COMPANDED.full_well, (1000, 1000))
    found = expose(electrons, COMPANDED, None, Noise.only("quantisation"), None)
    counts = np.bincount(found.ravel(), minlength=256) / (1e6 / 1024)
    for levels, width in ((slice(10, 89), 1), (slice(89, 90), 3), (slice(90, 189), 4), (slice(189, 255), 8)):
        # mean of n levels of about 977 counts and more each: five deviations
        n = len(counts[levels])
        assert counts[levels].mean() == pytest.approx(width, rel=5 / np.sqrt(977 * width * n) + 1e-3)


def test_companding_without_quantisation_keeps_the_curve_and_drops_the_steps():
    ideal = converter(COMPANDED, Noise.none())
    assert converter(ideal, Noise.none()) == ideal
    assert (ideal.bits, ideal.full_scale) == (16, 65535)
    electrons = np.linspace(0, 16000, 997)[None]
    found = expose(electrons, COMPANDED, None, Noise.none(), None)[0] / 256
    level_in = (ideal.converter_black + electrons[0] * ideal.gain) / 64
    expected = np.where(level_in < 89.333, level_in, np.where(level_in < 488, level_in / 4 + 67, level_in / 8 + 128))
    # half a level of its converter is 1/128 DN_in, and cutting takes up to 1/256 DN_out
    assert np.abs(found - expected).max() < 1 / 128 + 1 / 256 + 1e-3


def test_saturation_is_full_scale_and_black_is_the_black_level():
    still = Noise.only("quantisation")
    image = expose(np.array([[0.0, 1e3, 2e4, 1e9]]), IMAGER, None, still, None)
    assert image[0].tolist() == [64, round(64 + 1e3 * IMAGER.gain), 4095, 4095]
    assert expose(np.zeros((2, 2)), replace(IMAGER, bits=8, black_level=4), None, still, None).dtype == np.uint8


def test_without_quantisation_a_converter_of_16_bits_takes_its_place():
    for bits in (1, 8, 12, 16):
        imager = replace(IMAGER, bits=bits, black_level=2**bits / 64)
        ideal = converter(imager, Noise.without("quantisation"))
        assert ideal.full_scale == 65535
        assert ideal.black_level / 65535 == pytest.approx(imager.black_level / imager.full_scale, rel=1e-12)
        assert converter(ideal, Noise.none()) == ideal
        image = expose(np.array([[0.0, 1234.5, 2e4]]), imager, None, Noise.none(), None)
        assert image.dtype == np.uint16
        assert image[0, 2] == 65535
        assert (image[0].astype(float) - ideal.black_level)[:2] / ideal.gain == pytest.approx([0, 1234.5], abs=0.16)
    assert converter(IMAGER, Noise()) is IMAGER


def test_fixed_pattern_is_fixed_and_has_its_sizes():
    imager = replace(IMAGER, dsnu=40.0, prnu=0.01)
    one, again = (fixed_pattern(imager, (500, 500), np.random.default_rng(3)) for _ in range(2))
    assert np.array_equal(one.offset, again.offset)
    assert np.array_equal(one.response, again.response)
    assert np.isclose(one.offset.std(), 40, rtol=0.02)
    assert np.isclose(one.response.std(), 0.01, rtol=0.02)
    still = Noise.only("dsnu", "prnu", "quantisation")
    image = expose(flat(5000.0, (500, 500)), imager, one, still, None).astype(float) / imager.gain
    assert np.isclose(image.std(), np.hypot(40, 50), rtol=0.02)


@pytest.mark.parametrize(
    ("source", "deviation"),
    [
        ("shot", np.sqrt(5000)),
        ("read", 30),
        ("row", 35),
        ("dark", np.sqrt(2000)),
        ("dsnu", 40),
        ("prnu", 50),
        ("column", 45),
    ],
)
def test_each_switch_is_its_own_source(source, deviation, rng):
    imager = replace(IMAGER, dsnu=40.0, prnu=0.01, row_noise=35.0, column_pattern=45.0, dark_current=2000.0)
    pattern = fixed_pattern(imager, (1000, 1000), rng)
    alone, rest = Noise.only(source), Noise.without(source, "quantisation")
    gain = converter(imager, alone).gain
    found = expose(flat(5000.0, (1000, 1000)), imager, pattern, alone, rng, 1.0) / gain
    # rows and columns are 1000 draws, known to 1 / sqrt(2000) = 2.2 %: four of those
    assert found.std() == pytest.approx(deviation, rel=0.09)
    without = expose(flat(5000.0, (1000, 1000)), imager, pattern, rest, rng, 1.0) / gain
    everything = np.hypot.reduce([np.sqrt(5000), 30, 35, np.sqrt(2000), 40, 50, 45])
    assert without.std() == pytest.approx(np.sqrt(everything**2 - deviation**2), rel=0.02)


def test_images_of_one_call_and_of_two_streams_are_independent():
    stack = expose(np.full((6, 200, 300), 800.0), IMAGER, None, Noise(), np.random.default_rng([1, 0]))
    other = expose(np.full((6, 200, 300), 800.0), IMAGER, None, Noise(), np.random.default_rng([1, 1]))
    correlation = np.corrcoef(np.concatenate([stack, other]).reshape(12, -1))
    # 66 pairs of 6e4 pixels
    assert np.abs(correlation[np.triu_indices(12, 1)]).max() < 4.5 / np.sqrt(6e4)
    again = expose(np.full((6, 200, 300), 800.0), IMAGER, None, Noise(), np.random.default_rng([1, 0]))
    assert np.array_equal(stack, again)


def test_images_may_be_exposed_one_by_one_in_any_order():
    stack = np.full((5, 90, 700), 800.0)
    together = expose(stack, IMAGER, None, Noise(), np.random.default_rng(6))
    streams = np.random.default_rng(6).spawn(5)
    for index in (3, 0, 4, 2, 1):
        assert np.array_equal(expose(stack[index], IMAGER, None, Noise(), streams[index]), together[index])


def test_a_stack_costs_the_memory_of_one_image():
    pixels = 256 * 512
    electrons = np.full((40, 256, 512), 3000.0, np.float32)
    pattern = fixed_pattern(IMAGER, (256, 512), np.random.default_rng(1))
    tracemalloc.start()
    try:
        expose(electrons, IMAGER, pattern, Noise(), np.random.default_rng(1))
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    # the output of 2 bytes a pixel, and four images in single precision; the stack in floating point would be 40
    assert peak < 40 * pixels * 2 + 4.5 * pixels * 4


def test_what_cannot_be_exposed_is_refused():
    with pytest.raises(ValueError, match="rng"):
        expose(flat(1.0), IMAGER, None, Noise(), None)
    with pytest.raises(ValueError, match="finite"):
        expose(flat(np.nan), IMAGER, None, Noise.none(), None)


def test_noise_is_named_on_the_command_line():
    assert Noise.parse("all") == Noise()
    assert Noise.parse(" none ") == Noise.none()
    assert Noise.parse("shot, read") == Noise.only("shot", "read") == replace(Noise.none(), shot=True, read=True)
    assert Noise.parse("no-speckle,no-row") == Noise.without("speckle", "row") == Noise(speckle=False, row=False)
    assert not Noise.without("shot", "read", "row", "dark").temporal


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("shott", "did you mean 'shot'"),
        ("no-quantization", "did you mean 'quantisation'"),
        ("shot,no-read", "allowed"),
        ("", "allowed"),
        ("all,shot", "allowed"),
    ],
)
def test_a_misspelt_source_is_answered_with_the_nearest(text, said):
    with pytest.raises(InputError, match=said):
        Noise.parse(text)


@given(st.lists(st.sampled_from(NAMES), min_size=1, unique=True))
def test_noise_keeps_or_leaves_out_what_is_named(names):
    kept = {name for name in NAMES if getattr(Noise.parse(",".join(names)), name)}
    left = {name for name in NAMES if not getattr(Noise.parse(",".join(f"no-{name}" for name in names)), name)}
    assert kept == left == set(names)


@given(st.text(max_size=20))
def test_any_text_is_noise_or_an_input_error(text):
    try:
        assert isinstance(Noise.parse(text), Noise)
    except InputError as error:
        assert "--noise" in str(error)


def test_the_reference_implementation_of_the_standard_finds_our_parameters(tmp_path: Path, monkeypatch):
    process = pytest.importorskip("emva1288.process", reason="pip install emva1288 to compare with EMVA's own code")
    # its release 1.0.2 calls a function that NumPy 2 has dropped
    monkeypatch.setattr(np, "asfarray", lambda values: np.asarray(values, float), raising=False)
    imager = replace(IMAGER, full_well=12000, read_noise=12, dsnu=8.0, prnu=0.01, bits=12, black_level=80)
    shape = (240, 320)
    pattern = fixed_pattern(imager, shape, np.random.default_rng(4))
    rng = np.random.default_rng(5)
    # exposure [ns] -> photons -> files, as its parser hands them on (which leaves its file open, a warning to us)
    images: dict[str, dict[float, dict[float, list[str]]]] = {"temporal": {1e6: {}}, "spatial": {1e6: {}}}

    def write(kind: str, photons: float, count: int) -> None:
        electrons = np.full((count, *shape), photons * imager.quantum_efficiency)
        names = images[kind][1e6].setdefault(photons, [])
        for index, image in enumerate(expose(electrons, imager, pattern, Noise(), rng)):
            names.append(f"{kind} {photons:.1f} {index}.npy")
            np.save(tmp_path / names[-1], image)

    # pairs at 50 levels up to and past saturation, and a stack each in the dark and at half of saturation
    for photons in np.linspace(0, 1.1 * imager.full_well / imager.quantum_efficiency, 51):
        write("temporal", float(photons), 2)
    for photons in (0.0, 0.5 * imager.full_well / imager.quantum_efficiency):
        write("spatial", photons, 24)
    loaded = process.LoadImageData(images, path=str(tmp_path), loglevel=40, fload=np.load)
    found = process.Results1288(process.Data1288(loaded.data, loglevel=40).data, loglevel=40)
    # 7.7e4 pixels know the variance of a pair to 0.51 %, a deviation to 0.26 %. K, a line through 32 such variances
    # that weights the large ones, is known to 0.0051 sqrt(9/5 / 32) = 0.12 %, and with it QE; the read noise to
    # hypot(0.26, 0.12) %, DSNU and PRNU to 0.3 % with what is left of temporal noise. Five of those
    assert abs(found.K / imager.gain - 1) < 5 * 0.0012
    assert abs(found.QE / 50 - 1) < 5 * 0.0012
    assert abs(found.sigma_d / 12 - 1) < 5 * 0.0029
    assert abs(found.DSNU1288 / 8 - 1) < 5 * 0.003
    assert abs(found.PRNU1288 / 1.0 - 1) < 5 * 0.003
