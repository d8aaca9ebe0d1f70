"""Speckle against closed forms, Monte-Carlo interference, and what the literature says."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from scipy.special import j1

from characterisation.files.errors import InputError
from mitsim.sensor.speckle import (
    SpeckleOptics,
    SpeckleSurface,
    bandwidth_contrast,
    contrast,
    correlation_size_px,
    lateral_shift_std,
    speckle_field,
    speckle_size_um,
    speckles_in_pixel,
)

RQ_PER_RA = np.sqrt(np.pi / 2)
LASER = {
    "height_um": 1.0,
    "coherent_share": 0.0,
    "wavelength_nm": 633,
    "linewidth_nm": 0.0,
    "u_illumination": 0.0,
    "u_observation": 0.01,
    "pixel_um": 1e-6,
    "f_number": 8.0,
    "depolarising": False,
}
SHAPE = (240, 320)


def contrast_of(**numbers):
    """Speckle contrast from the numbers of surface and optics together."""
    surface = SpeckleSurface(*(numbers.pop(name) for name in ("height_um", "coherent_share", "depolarising")))
    return contrast(surface, SpeckleOptics(**numbers))


def test_a_laser_on_a_rough_surface_has_full_contrast():
    assert contrast_of(**LASER) == pytest.approx(1, abs=1e-6)


def test_every_term_is_its_closed_form():
    r = 0.3 / 0.7
    assert contrast_of(**LASER | {"coherent_share": 0.3}) == pytest.approx(np.sqrt(1 + 2 * r) / (1 + r), rel=1e-6)
    assert contrast_of(**LASER | {"coherent_share": 1.0}) == 0
    assert contrast_of(**LASER | {"u_illumination": 0.02}) == pytest.approx(1 / np.sqrt(5), rel=1e-6)
    assert contrast_of(**LASER | {"pixel_um": 5.0}) == pytest.approx(speckles_in_pixel(5.0, 633, 8) ** -0.5, rel=1e-6)
    assert contrast_of(**LASER | {"depolarising": True}) == pytest.approx(np.sqrt(0.5), rel=1e-6)


def test_the_area_of_a_speckle_is_that_of_a_round_pupil():
    # the integral of (2 J1(x) / x)^2 over the plane, in rings: 4 / pi (lambda N)^2. Beyond R it is 8 / (pi^3 R)
    radius = np.linspace(1e-6, 400, 400_001)
    rings = 2 * np.pi * radius * (2 * j1(np.pi * radius) / (np.pi * radius)) ** 2
    area = np.trapezoid(rings, radius) + 8 / (np.pi**3 * 400)
    assert speckle_size_um(633, 8) ** 2 == pytest.approx(area * (0.633 * 8) ** 2, rel=1e-4)


@pytest.mark.parametrize("width", [1.0, 2.0, 4.0])
def test_pixels_average_speckle_as_light_through_a_round_pupil(width, rng):
    # coherent light through a round pupil, 8 samples to lambda N, added up over square pixels and blocks of 6 x 6
    samples, n = 8, 1024
    frequency = np.fft.fftfreq(n)
    pupil = np.hypot(frequency, frequency[:, None]) <= 0.5 / samples
    edge = int(samples * width)
    variances, blocks = [], []
    for _ in range(12):
        field = np.fft.ifft2(np.fft.fft2(rng.standard_normal((n, n)) + 1j * rng.standard_normal((n, n))) * pupil)
        light = np.abs(field) ** 2
        light /= light.mean()
        for found, side in ((variances, edge), (blocks, 6 * edge)):
            count = n // side
            found.append(light[: count * side, : count * side].reshape(count, side, count, side).mean((1, 3)).var())
    pixel = np.array(variances) * speckles_in_pixel(width, 1000, 1.0)
    # the samples inside a pixel stand for its area: at width 1 they lose 1 / (8 width)^2 of it
    assert abs(pixel.mean() - 1) < 4 * pixel.std() / np.sqrt(12) + 1 / edge**2
    model = [speckle_field((600, 600), 0.1, correlation_size_px(width, 1000, 1.0), rng).shift for _ in range(2)]
    averaged = np.mean([each.reshape(2, 100, 6, 100, 6).mean((2, 4)).var() for each in model])
    block = np.array(blocks) * speckles_in_pixel(width, 1000, 1.0) / averaged
    # correlation of a Gaussian form ends sooner than that of a pupil with sharp edges: 6 % of a block's variance
    assert abs(block.mean() - 1) < 4 * block.std() / np.sqrt(12) + 0.06


def test_large_speckle_is_not_averaged_and_small_speckle_by_its_area():
    assert speckles_in_pixel(0.01, 633, 8) == pytest.approx(1, abs=1e-5)
    assert correlation_size_px(0.5, 633, 8) == pytest.approx(speckle_size_um(633, 8) / 0.5, rel=0.01)
    # of the speckles of a large pixel only those on its edges, a share of about 1 / width, are more than its area holds
    over = np.array([speckles_in_pixel(width, 1000, 1.0) / (np.pi / 4 * width**2) - 1 for width in (20, 40, 80)])
    assert np.all(over > 0)
    assert np.all(over[1:] < 0.6 * over[:-1])


def test_the_terms_multiply():
    changes = [
        {"coherent_share": 0.5},
        {"linewidth_nm": 30.0},
        {"u_illumination": 0.01},
        {"pixel_um": 6.0},
        {"depolarising": True},
    ]
    alone = np.prod([contrast_of(**LASER | change) for change in changes])
    together = LASER | {key: value for change in changes for key, value in change.items()}
    assert contrast_of(**together) == pytest.approx(alone, rel=1e-5)


@pytest.mark.parametrize(
    ("wavelength", "linewidth", "expected"),
    [
        (450, 20, [0.996, 0.94, 0.83, 0.65, 0.48, 0.39]),
        (850, 30, [0.999, 0.99, 0.96, 0.865, 0.70, 0.58]),
        (550, 300, [0.78, 0.43, 0.31, 0.22, 0.15, 0.12]),
    ],
)
def test_bandwidth_leaves_an_led_its_speckle_on_machined_metal(wavelength, linewidth, expected):
    # Ra 0.1 to 5 um; the figures are rounded to two places or three
    found = [bandwidth_contrast(RQ_PER_RA * Ra, wavelength, linewidth) for Ra in (0.1, 0.4, 0.8, 1.6, 3.2, 5.0)]
    assert np.allclose(found, expected, atol=0.0051)


@pytest.mark.parametrize("height_um", [0.5, 1.0, 3.0])
def test_bandwidth_term_agrees_with_interference_of_a_rough_surface(height_um, rng):
    wavelength, linewidth, scatterers, draws = 450.0, 20.0, 100, 3000
    sigma_k = 2 * np.pi * linewidth / np.sqrt(8 * np.log(2)) / wavelength**2 * 1e3
    # the lamp's spectrum, from -4 to 4 standard deviations, finer than the speckle's own correlation in k
    offsets = np.linspace(-4, 4, 33)
    spectrum = np.exp(-(offsets**2) / 2) / np.exp(-(offsets**2) / 2).sum()
    heights = height_um * rng.standard_normal((draws, scatterers))
    # far from specular each scatterer adds a path of its own; the height adds 2 h
    start = rng.uniform(0, 2 * np.pi, (draws, scatterers))
    intensity = np.zeros(draws)
    for offset, weight in zip(offsets, spectrum, strict=True):
        intensity += weight * np.abs(np.exp(1j * (start + 2 * heights * sigma_k * offset)).sum(axis=1)) ** 2
    found = intensity.std(ddof=1) / intensity.mean()
    # a contrast of n draws is known to about C sqrt((1 + 2 C^2) / 2n) for a gamma distribution
    expected = bandwidth_contrast(height_um, wavelength, linewidth)
    assert abs(found - expected) < 4 * expected * np.sqrt((1 + 2 * expected**2) / (2 * draws))


def round_spot(radius: float, n: int) -> np.ndarray:
    place = np.arange(n) - n // 2
    return (np.hypot(place, place[:, None]) <= radius).astype(float)


def gaussian_spot(deviation: float, n: int) -> np.ndarray:
    place = np.arange(n) - n // 2
    return np.exp(-(place**2 + place[:, None] ** 2) / (2 * deviation**2))


def centroid_spread(spot: np.ndarray, cutoff: float, draws: int, rng: np.random.Generator) -> float:
    """Deviation of the centroid [px] of coherent images of a rough spot (n, n) through a round aperture.

    ``cutoff`` is the largest spatial frequency of the amplitude, sin u / lambda [1/px]. Every point of the grid stands
    for many scatterers: its amplitude is complex Gaussian. (Unit phasors, 8 in a speckle here, lose 6 % of the spread.)
    """
    n = len(spot)
    frequency = np.fft.fftfreq(n)
    pupil = np.hypot(frequency, frequency[:, None]) <= cutoff
    place = np.arange(n) - n // 2
    found = []
    for _ in range(draws):
        field = np.sqrt(spot) * (rng.standard_normal((n, n)) + 1j * rng.standard_normal((n, n)))
        image = np.abs(np.fft.ifft2(np.fft.fft2(field) * pupil)) ** 2
        found += [(image.sum(axis=0) * place).sum() / image.sum(), (image.sum(axis=1) * place).sum() / image.sum()]
    return float(np.std(found))


def expected_spread(spot: np.ndarray, cutoff: float) -> float:
    """The same from the covariance of speckle, I I' |2 J1(r) / r|^2, r = 2 pi cutoff |x - x'|, without blur."""
    n = len(spot)
    lag = np.fft.fftfreq(2 * n) * 2 * n
    r = np.hypot(lag, lag[:, None]) * 2 * np.pi * cutoff
    r[0, 0] = 1e-9
    moment = np.fft.fft2(spot * (np.arange(n) - n // 2), (2 * n, 2 * n))
    variance = (np.abs(moment) ** 2 * np.fft.fft2((2 * j1(r) / r) ** 2).real).sum() / (2 * n) ** 2
    return float(np.sqrt(variance) / spot.sum())


@pytest.mark.parametrize("spot", [round_spot(24, 128), round_spot(36, 128), gaussian_spot(12, 128)])
def test_speckle_moves_the_centroid_of_a_spot_as_its_covariance_says(spot, rng):
    # 2 x 600 centroids know the deviation to 1 / sqrt(2400) = 2 %: three of those
    assert abs(centroid_spread(spot, 0.2, 600, rng) / expected_spread(spot, 0.2) - 1) < 0.06


def test_lateral_shift_is_that_of_a_large_round_spot():
    # lambda / sin u = 1 / cutoff px; the formula takes lambda in nm and gives mm. The tails of a round aperture's image
    # reach beyond the spot: the rest falls as 1 / radius
    formula = lateral_shift_std(1.0, 1e6, 0.2)
    short = np.array([1 - expected_spread(round_spot(radius, 512), 0.2) / formula for radius in (30, 60, 120)])
    assert np.all(short > 0)
    assert np.allclose(short[:-1] / short[1:], 2, rtol=0.2)
    assert abs(2 * short[2] - short[1]) < 0.005
    # a Gaussian spot: 1 / sqrt(2) of it, from the integral of x^2 I^2
    gaussian = [expected_spread(gaussian_spot(deviation, 512), 0.2) / formula for deviation in (20, 40)]
    assert 2 * gaussian[1] - gaussian[0] == pytest.approx(np.sqrt(0.5), rel=0.005)


@pytest.mark.parametrize(("sin_u", "dx_um"), [(0.01, 7.2), (0.02, 3.6), (0.05, 1.4)])
def test_lateral_shift_has_the_published_size(sin_u, dx_um):
    assert lateral_shift_std(1.0, 450, sin_u) * 1e3 == pytest.approx(dx_um, abs=0.05)
    assert lateral_shift_std(0.5, 450, sin_u) == pytest.approx(lateral_shift_std(1.0, 450, sin_u) / 2)


def test_coherent_contrast_rises_with_roughness_and_saturates_as_leonard_and_toal_found():
    # He-Ne, normal incidence: about linear in Ra, saturated at Ra about 0.1 um. A = exp(-(4 pi Rq / lambda)^2)
    Ra = np.array([0.005, 0.01, 0.02, 0.04, 0.1, 0.4])
    share = np.exp(-((4 * np.pi * RQ_PER_RA * Ra / 0.633) ** 2))
    found = np.array(
        [
            contrast_of(**LASER | {"height_um": RQ_PER_RA * ra, "coherent_share": a})
            for ra, a in zip(Ra, share, strict=True)
        ]
    )
    assert np.all(np.diff(found[:5]) > 0)
    # sqrt(1 - A^2) = sqrt(2 g) (1 - g/2 + ..): with g = 0.06 at Ra 0.01 um linear to 3 %
    g = (4 * np.pi * RQ_PER_RA * Ra[:2] / 0.633) ** 2
    assert np.all(found[:2] < np.sqrt(2 * g))
    assert np.all(found[:2] > np.sqrt(2 * g) * (1 - g / 2))
    assert found[4] > 0.999
    assert found[5] == pytest.approx(1, abs=1e-6)


def test_white_light_contrast_is_usable_where_asakura_used_it():
    # polychromatic 0.2 to 5 um: falls by a large factor all the way, while the coherent one is saturated
    white = [bandwidth_contrast(RQ_PER_RA * Ra, 550, 300) for Ra in (0.2, 0.5, 1, 2, 5)]
    assert np.all(np.diff(white) < 0)
    assert white[0] > 4 * white[-1]


@pytest.mark.parametrize("size", [0.3, 1.0, 3.0])
@pytest.mark.parametrize("C", [0.01, 0.2, 0.5, 0.9, 1.0])
@pytest.mark.parametrize("as_map", [False, True])
def test_gain_is_a_gamma_field_of_the_contrast(size, C, as_map, rng):
    field = speckle_field(SHAPE, np.full(SHAPE, C) if as_map else C, size, rng)
    independent = field.gain.size / (1 + size**2)
    assert field.gain.dtype == np.float32
    assert field.gain.shape == SHAPE
    assert abs(field.gain.mean() - 1) < 4 * C / np.sqrt(independent)
    assert abs(field.gain.std() / C - 1) < 4 * np.sqrt((1 + 2 * C**2) / (2 * independent))
    if size < 0.7:
        assert stats.kstest(field.gain.ravel(), stats.gamma(C**-2, scale=C**2).cdf).pvalue > 1e-3


def test_full_contrast_is_exponential(rng):
    gain = speckle_field(SHAPE, 1.0, 0.5, rng).gain
    assert stats.kstest(gain.ravel(), stats.expon.cdf).pvalue > 1e-3


def test_no_contrast_is_no_speckle(rng):
    assert np.all(speckle_field(SHAPE, 0.0, 2.0, rng).gain == 1)
    half = np.zeros(SHAPE)
    half[:, 160:] = 0.7
    gain = speckle_field(SHAPE, half, 2.0, rng).gain
    assert np.all(gain[:, :160] == 1)
    assert np.isfinite(gain).all()
    assert gain[:, 160:].std() == pytest.approx(0.7, rel=0.05)


@pytest.mark.parametrize("size", [1.0, 2.0, 5.0])
def test_neighbours_correlate_over_one_speckle(size):
    # in 20 fields of 256 x 256 a correlation is known to about size / 256 / sqrt(20)
    wanted = [np.exp(-np.pi * (lag / size) ** 2) for lag in range(1, 6)]
    found = np.zeros(5)
    for seed in range(20):
        shift = speckle_field((256, 256), 0.1, size, np.random.default_rng(seed)).shift
        found += [(shift[..., :-lag] * shift[..., lag:]).mean() / 20 for lag in range(1, 6)]
    assert np.allclose(found, wanted, atol=4 * size / 256 / np.sqrt(40))


def test_shift_and_gain_are_independent_unit_fields(rng):
    field = speckle_field((480, 752), 0.5, 1.0, rng)
    n = 480 * 752 / 2
    assert field.shift.shape == (2, 480, 752)
    assert field.shift.dtype == np.float32
    assert np.allclose(field.shift.std(axis=(1, 2)), 1, atol=4 / np.sqrt(2 * n))
    both = np.corrcoef([field.gain.ravel(), *field.shift.reshape(2, -1)])
    assert np.all(np.abs(both[np.triu_indices(3, 1)]) < 4 / np.sqrt(n))


def test_the_same_generator_gives_the_same_speckle():
    one, again = (speckle_field(SHAPE, 0.4, 1.5, np.random.default_rng(5)) for _ in range(2))
    assert np.array_equal(one.gain, again.gain)
    assert np.array_equal(one.shift, again.shift)


@given(st.floats(0, 1), st.floats(0, 6))
def test_any_contrast_and_size_gives_a_finite_positive_gain(C, size):
    field = speckle_field((24, 31), C, size, np.random.default_rng(1))
    assert np.isfinite(field.gain).all()
    assert field.gain.min() >= 0
    assert np.isfinite(field.shift).all()


@given(
    st.tuples(
        st.floats(0, 10),
        st.floats(0, 1),
        st.floats(300, 2000),
        st.floats(0, 300),
        st.floats(0, 0.5),
        st.floats(1e-3, 0.5),
        st.floats(0.5, 20),
        st.floats(0.7, 32),
        st.booleans(),
    )
)
def test_contrast_is_between_0_and_1(values):
    assert 0 <= contrast_of(**dict(zip(LASER, values, strict=True))) <= 1


def test_speckle_larger_than_the_image_is_refused(rng):
    with pytest.raises(InputError, match="size_px"):
        speckle_field(SHAPE, 0.5, 1e4, rng)
