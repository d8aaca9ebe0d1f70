"""Phases against closed forms: exact without noise, as noisy as theory says with it, and unwrapped as often."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import erfc
from scipy.stats import norm

from characterisation.files.errors import InputError
from characterisation.point_cloud import Status
from mitsim.decoding.structured_light.decoder import decode_coordinates
from mitsim.decoding.structured_light.phase_shift import Fringes, decode_fringes, fit_phases
from mitsim.decoding.structured_light.projector_gamma import correct_phase, estimate_gamma, harmonic_ratio
from mitsim.decoding.structured_light.unwrapping import unwrap, unwrapping_path
from mitsim.sensor.decoder_settings import DecoderSettings
from mitsim.sensor.imager import Imager
from mitsim.sensor.light_code import PhaseShift, roles, value

EXTENT = 1024
SIZE = (EXTENT, EXTENT)
SETTINGS = DecoderSettings(near_mm=300, far_mm=900)
HIERARCHICAL = PhaseShift(periods_px=[1100, 150, 20], steps=8)
HETERODYNE = PhaseShift(periods_px=[EXTENT / 45, EXTENT / 49.5, EXTENT / 50], steps=[4, 4, 6])
U = np.linspace(3, EXTENT - 4, 200 * 150).reshape(150, 200)


def phase_noise(steps: int, sigma_i: float, modulation: float) -> float:
    """Return the expected standard deviation of an N-step phase [rad], for noise sigma_I and modulation B [DN]."""
    return float(np.sqrt(2.0 / steps) * sigma_i / modulation)


def failure_rate(path, relative_noise: float) -> float:
    """Return the expected share of pixels with a wrong fringe order.

    ``relative_noise`` is sigma_I / B of Gaussian noise. Each step fails with P = erfc(0.5 / (sqrt(2) sigma)). Here
    sigma is the noise of its residual [cycles]. The sum over the steps is an upper bound, and close to the true rate
    while P is small. Rejected pixels are not considered.
    """
    return float(min(1.0, sum(erfc(0.5 / (np.sqrt(2) * gain * relative_noise)) for gain in path.noise)))


def draw(code, u=U, offset=20.0, height=200.0):
    """Noise-free images of a surface that shows projector coordinates ``u``."""
    return np.stack([offset + height * value(code, role, u) for role in roles(code, EXTENT, EXTENT)])


def wrapped(angle):
    return np.angle(np.exp(1j * angle))


def shifts_of(steps):
    return 2 * np.pi * np.arange(steps) / steps


@pytest.mark.parametrize("steps", range(3, 9))
def test_phase_modulation_and_offset_come_back(steps, rng):
    phi, B, A = rng.uniform(0, 2 * np.pi, (40, 50)), rng.uniform(5, 80, (40, 50)), rng.uniform(90, 150, (40, 50))
    delta = shifts_of(steps)
    fit = fit_phases(A + B * np.cos(phi - delta[:, None, None]), [delta])
    # float32 holds grey levels up to 255 to 1.5e-5 DN, and B is 5 DN or more
    assert np.abs(wrapped(fit.phase[0] - phi)).max() < 2e-5
    np.testing.assert_allclose(fit.modulation[0], B, atol=1e-4)
    np.testing.assert_allclose(fit.offset, A, atol=1e-4)
    # and for equidistant steps it is the usual arctan
    images = A + B * np.cos(phi - delta[:, None, None])
    usual = np.arctan2(np.tensordot(np.sin(delta), images, 1), np.tensordot(np.cos(delta), images, 1))
    assert np.abs(wrapped(fit.phase[0] - usual)).max() < 2e-5


def test_shifts_need_not_be_equidistant(rng):
    phi, delta = rng.uniform(0, 2 * np.pi, (30, 30)), np.array([0, 0.9, 2.0, 4.4])
    fit = fit_phases(100 + 60 * np.cos(phi - delta[:, None, None]), [delta])
    assert np.abs(wrapped(fit.phase[0] - phi)).max() < 1e-5


@pytest.mark.parametrize("code", [HIERARCHICAL, HETERODYNE], ids=["hierarchical", "heterodyne"])
def test_without_noise_the_coordinate_is_exact(code):
    found = decode_coordinates(draw(code), code, SIZE, SETTINGS, full_scale=255)["columns"]
    assert (found.status == Status.VALID).all()
    assert np.abs(found.value - U).max() < 1e-5
    assert np.isnan(found.sigma).all()


@pytest.mark.parametrize("bits", [8, 10, 12])
def test_whole_grey_levels_cost_what_quantisation_must(bits, rng):
    """Rounding is noise of variance 1/12 DN^2 where a fringe spans many grey levels and no offset is a whole one."""
    full = 2**bits - 1
    images = draw(HIERARCHICAL, height=200 * full / 255, offset=rng.uniform(10, 30, U.shape) * full / 255)
    images = np.rint(images).astype(np.uint8 if bits == 8 else np.uint16)
    found = decode_coordinates(images, HIERARCHICAL, SIZE, SETTINGS, full_scale=full)["columns"]
    modulation, error = 100 * full / 255, found.value - U
    expected = 20 / (2 * np.pi) * phase_noise(8, np.sqrt(1 / 12), modulation)
    assert np.isclose(error.std(), expected, rtol=0.05)  # 30000 pixels: standard error 0.4 %
    # eight half grey levels at worst, weighed by 2/8 |sin|: the sum of eight |sin| is at most 2 / sin(pi/8)
    worst = 20 / (2 * np.pi) * np.tan(0.5 * 2 / 8 * 2 / np.sin(np.pi / 8) / modulation)
    assert np.abs(error).max() < 1.02 * worst  # 2 %: the same rounding makes B smaller by up to 0.65 DN


@pytest.mark.parametrize("steps", range(3, 9))
@pytest.mark.parametrize("signal", [600.0, 2000.0, 6000.0])
def test_noise_is_that_of_the_closed_form(steps, signal, rng):
    """sigma_phi = sqrt(2/N) sigma_I / B, sigma_I of EMVA 1288 at the mean level; 60000 pixels: standard error 0.3 %."""
    imager = Imager(5, 0.5, 10000, 12, 0, 0, 12, 40, 4)
    code = PhaseShift(periods_px=[1100, 250, 60, 16], steps=steps)
    u = np.linspace(3, EXTENT - 4, 60000).reshape(200, 300)
    electrons = rng.poisson(draw(code, u, 0.1 * signal, signal)) + rng.normal(0, 12, (4 * steps, *u.shape))
    images = np.rint(electrons * imager.gain + imager.black_level).astype(np.uint16)
    found = decode_coordinates(images, code, SIZE, SETTINGS, full_scale=4095, imager=imager)["columns"]
    valid = found.status == Status.VALID
    assert valid.mean() > 0.9999  # a quarter of a cycle is 5.7 sigma at the faintest
    level = 0.6 * signal
    sigma_i = np.sqrt((level + 12**2) * imager.gain**2 + 1 / 12)
    expected = 16 / (2 * np.pi) * phase_noise(steps, sigma_i, signal / 2 * imager.gain)
    assert np.isclose(np.std((found.value - u)[valid]), expected, rtol=0.05)
    assert np.isclose(np.median(found.sigma), expected, rtol=0.05)  # and each pixel is told so


def noisy_phases(periods, u, sigma, rng):
    phase = 2 * np.pi * (u + 0.5) / np.array(periods)[:, None] + rng.normal(0, sigma, (len(periods), u.size))
    return np.mod(phase, 2 * np.pi).astype(np.float32)


def test_wrong_fringes_are_as_frequent_as_the_closed_form_says(rng):
    periods, steps = (1200.0, 100.0), (4, 4)
    path = unwrapping_path(periods, steps, EXTENT)
    relative = 0.5 / norm.isf(0.01) / path.noise[0]  # about 1 % on either side
    u, n = rng.uniform(100, 900, 200_000), 200_000
    phase = noisy_phases(periods, u, phase_noise(4, relative, 1), rng)
    found, _ = unwrap(phase, path, EXTENT, np.full(n, relative**2, np.float32), 0, 1e9)
    wrong, rate = np.mean(np.abs(found - u) > 50), failure_rate(path, relative)
    assert np.isclose(rate, 0.02, rtol=1e-3)
    assert abs(wrong - rate) < 4 * np.sqrt(rate / n)


def test_most_wrong_fringes_are_refused(rng):
    """A residual of more than 1/4 cycle is refused, so a wrong fringe is believed beyond 3/4 cycle only."""
    periods, n = (1200.0, 100.0), 200_000
    path = unwrapping_path(periods, (4, 4), EXTENT)
    relative, u = 0.3 / path.noise[0], rng.uniform(250, 750, n)
    phase = noisy_phases(periods, u, phase_noise(4, relative, 1), rng)
    found, refused = unwrap(phase, path, EXTENT, np.full(n, relative**2, np.float32), 0, 1e9)
    wrong = np.abs(found - u) > 50
    believed, rate = np.mean(wrong & ~refused), 2 * (norm.sf(0.75, scale=0.3) - norm.sf(1.25, scale=0.3))
    assert abs(believed - rate) < 4 * np.sqrt(rate / n)
    assert believed < 0.2 * wrong.mean()


def test_heterodyne_failures_lie_between_the_worst_step_and_the_sum(rng):
    periods = tuple(HETERODYNE.periods_px)
    path = unwrapping_path(periods, (4, 4, 4), EXTENT)
    assert len(path.beats) == 3 and np.isclose(path.beats[0].period, 2 * EXTENT)
    relative, n = 0.5 / 2.3 / max(path.noise), 200_000
    u = rng.uniform(250, 750, n)
    phase = noisy_phases(periods, u, phase_noise(4, relative, 1), rng)
    found, _ = unwrap(phase, path, EXTENT, np.full(n, relative**2, np.float32), 0, 1e9)
    wrong, most = np.mean(np.abs(found - u) > periods[-1] / 2), failure_rate(path, relative)
    least = 2 * norm.sf(2.3)
    slack = 4 * np.sqrt(most / n)
    assert least - slack < wrong < most + slack


def test_k_sigma_refuses_what_the_normal_distribution_says(rng):
    periods, n = (1200.0, 100.0), 100_000
    path = unwrapping_path(periods, (4, 4), EXTENT)
    relative, u = 0.02 / path.noise[0], rng.uniform(250, 750, n)
    phase = noisy_phases(periods, u, phase_noise(4, relative, 1), rng)
    _, refused = unwrap(phase, path, EXTENT, np.full(n, relative**2, np.float32), 0, 2.0)
    rate = 2 * norm.sf(2)
    assert abs(refused.mean() - rate) < 4 * np.sqrt(rate / n)


def test_at_the_ends_of_a_period_as_long_as_the_projector_nothing_is_guessed():
    code = PhaseShift(periods_px=[EXTENT, 128, 16], steps=4)
    u = np.arange(EXTENT, dtype=float)[None]
    found = decode_coordinates(draw(code, u), code, SIZE, SETTINGS, full_scale=255)["columns"]
    assert (found.status[0, [0, -1]] == Status.PHASE_INCONSISTENT).all()
    assert (found.status[0, 1:-1] == Status.VALID).all()


@given(st.lists(st.floats(8, 3000), min_size=1, max_size=5, unique=True))
def test_any_set_of_periods_is_either_exact_or_refused(periods):
    periods = tuple(sorted(periods, reverse=True))
    if any(a / b < 1.01 for a, b in pairwise(periods)):
        return  # periods that are nearly equal tell nearly nothing
    try:
        path = unwrapping_path(periods, (8,) * len(periods), 500)
    except InputError as error:
        assert "periods_px" in str(error) and max(periods) < 500
        return
    if not path.noise or max(path.noise) < 100:  # steps that float32 can make
        u = np.linspace(5, 494, 400)
        phase = np.mod(2 * np.pi * (u + 0.5) / np.array(periods)[:, None], 2 * np.pi).astype(np.float32)
        found, refused = unwrap(phase, path, 500, np.zeros(400, np.float32), 0.01, 5)
        assert not refused.any()
        assert np.abs(found - u).max() < 1e-6 * max(periods[-1], 10)


@pytest.mark.parametrize("reason", ["saturated", "faint", "contradictory"])
def test_each_reason_is_told(reason):
    images = draw(HIERARCHICAL)
    spot = np.s_[40:60, 70:90]
    if reason == "saturated":
        images[(5, *spot)] = 255
        expected = Status.SATURATED
    elif reason == "faint":
        images[(slice(None), *spot)] = 21 + 0.01 * (images[(slice(None), *spot)] - 21)
        expected = Status.LOW_MODULATION
    else:  # another surface's light in the middle period
        images[(slice(8, 16), *spot)] = images[(slice(8, 16), *spot)][::-1]
        expected = Status.PHASE_INCONSISTENT
    found = decode_coordinates(images, HIERARCHICAL, SIZE, SETTINGS, full_scale=255)["columns"]
    outside = np.ones(U.shape, bool)
    outside[spot] = False
    assert (found.status[outside] == Status.VALID).all()
    # a few phases survive being turned round: those near 0 and pi
    assert np.mean(found.status[spot] == expected) > (0.8 if reason == "contradictory" else 0.999)
    np.testing.assert_array_equal(np.isnan(found.value), found.status != Status.VALID)


@pytest.mark.parametrize("steps", [5, 6, 8])
@pytest.mark.parametrize("gamma", [0.7, 1.0, 1.8, 2.4])
def test_gamma_is_found_and_taken_out(gamma, steps, rng):
    phi = np.linspace(0, 40 * np.pi, 60 * 50, endpoint=False).reshape(50, 60)
    delta = shifts_of(steps)
    albedo = rng.uniform(0.4, 1, phi.shape)
    images = 15 + 200 * albedo * (0.5 + 0.5 * np.cos(phi - delta[:, None, None])) ** gamma
    found = estimate_gamma(images, 0.5, 0.5)
    # at five steps the third harmonic falls onto the second; the albedo, unlike the phase, is random
    assert abs(found - gamma) < (0.02 if steps == 5 else 2e-3)
    phase = fit_phases(images, [delta]).phase[0]
    before = np.abs(wrapped(phase - phi)).max()
    after = np.abs(wrapped(correct_phase(phase, gamma, steps, 0.5, 0.5) - phi)).max()
    assert after < 2e-5 + 1e-3 * before


@pytest.mark.parametrize("white", [False, True])
def test_saturated_pixels_do_not_count_for_gamma(white):
    """Before, gamma 3 with 20 % of the pixels clipped was estimated as less, and bent what it should straighten."""
    asked = SETTINGS.model_copy(update={"correct_gamma": True})
    steps = 4 if white else 5
    code, width = PhaseShift(periods_px=[1290, 60], steps=steps), 1280
    u = np.tile(np.linspace(0, width - 1, 3840), (20, 1))
    albedo = np.where(np.arange(20) % 5 == 0, 1.6, 0.8)[:, None]  # every fifth row is clipped
    images = 10 + 240 * albedo * np.stack([value(code, role, u) for role in roles(code, width, 20)]) ** 3.0
    fringes = Fringes.of([role for role in roles(code, width, 20) if role.kind == "phase"], 0.5, 0.5)
    black, full = np.full(u.shape, 10.0), 10 + 240 * albedo + 0 * u
    found = decode_fringes(
        np.clip(images, 0, 255),
        fringes,
        width,
        asked,
        full_scale=255,
        white_black=(np.minimum(full, 255), black) if white else None,
    )
    unclipped = found.status == Status.VALID
    assert unclipped.mean() > 0.75
    assert np.abs(found.value - u)[unclipped].max() < 0.05


def test_the_ratio_of_the_harmonics_is_pans():
    for gamma in (0.5, 1.0, 1.7, 2.2, 3.0):
        assert np.isclose(harmonic_ratio(gamma, 0.5, 0.5), (gamma - 1) / (gamma + 2), atol=1e-5)
    assert abs(harmonic_ratio(2.2, 0.5, 0.3)) < abs(harmonic_ratio(2.2, 0.5, 0.5))


def test_a_whole_decoding_corrects_gamma_on_request():
    bent = draw(HIERARCHICAL, offset=0, height=1)
    images = 20 + 200 * bent**2.2
    plain = decode_coordinates(images, HIERARCHICAL, SIZE, SETTINGS, full_scale=255)["columns"]
    asked = SETTINGS.model_copy(update={"correct_gamma": True})
    right = decode_coordinates(images, HIERARCHICAL, SIZE, asked, full_scale=255)["columns"]
    assert np.nanmax(np.abs(right.value - U)) < 0.1 * np.nanmax(np.abs(plain.value - U)) < 0.1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"full_scale": 0}, "full_scale"),
        ({"full_scale": 256}, "full_scale"),
        ({"stack": np.zeros((7, 5, 5), np.uint8)}, "shape"),
        ({"stack": np.zeros((24, 5, 5), np.int64)}, "dtype"),
        ({"extent": 3000}, "3000 px or more"),
    ],
)
def test_what_cannot_be_decoded_is_refused(change, message):
    stack, extent, full_scale = np.zeros((24, 5, 5), np.uint8), EXTENT, 255
    stack, extent, full_scale = ({"stack": stack, "extent": extent, "full_scale": full_scale} | change).values()
    with pytest.raises(InputError, match=message):
        decode_coordinates(stack, HIERARCHICAL, (extent, extent), SETTINGS, full_scale=full_scale)


def test_gamma_needs_five_steps_and_fringes():
    with pytest.raises(InputError, match="steps"):
        estimate_gamma(np.zeros((4, 5, 5)), 0.5, 0.5)
    with pytest.raises(InputError, match="fringes"):
        estimate_gamma(np.zeros((6, 5, 5)), 0.5, 0.5)
