"""Time of flight against closed forms: exact without noise, as noisy as theory says with it, unwrapped as often."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.stats import norm

from characterisation.files.errors import InputError
from characterisation.point_cloud import Status
from mitsim.decoding.image_context import ImageContext
from mitsim.decoding.time_of_flight import (
    _longest_path,
    decode_time_of_flight,
    joint_path,
    time_of_flight_geometry,
    unambiguous_path,
)
from mitsim.sensor.camera import Camera, Rig
from mitsim.sensor.image_formation import fixed_pattern
from mitsim.sensor.imager import Imager
from mitsim.sensor.modulation import (
    LIGHT_MM_S,
    AmplitudeModulation,
    TimeOfFlightSettings,
    delay_pattern,
    delayed,
    expose_taps,
)
from mitsim.sensor.noise_sources import Noise
from mitsim.sensor.transforms import Transform

SETTINGS = TimeOfFlightSettings(near_mm=400, far_mm=4600)
FULL_SCALE = 32767.0
MIDDLE = 16384.0
SHAPE = (90, 120)


def modulation(frequencies=(16.0, 80.0, 120.0), steps=3, contrast=1.0):
    return AmplitudeModulation(
        kind="amplitude_modulation", frequencies_mhz=list(frequencies), steps=steps, contrast=contrast
    )


def rig(distortion=(-0.3, 0.1, 0.002, -0.001, 0.0), place=None, lamp=(80.0, -15.0, 6.0)):
    """A camera whose lens bends by 5 px at the corners, turned in the sensor frame, and a lamp beside it."""
    matrix = np.array([[90.0, 0, 60.3], [0, 91.0, 44.1], [0, 0, 1]])
    place = place or Transform.from_degrees([5, -10, 20], [12.0, -7.0, 30.0])
    camera = Camera(matrix, np.array(distortion), SHAPE[1], SHAPE[0], place)
    wide = np.array([[60.0, 0, 60], [0, 60.0, 45], [0, 0, 1]])
    there = Transform(place.rotation, place.points(np.array(lamp)))
    return Rig({"depth": camera}, Camera(wide, np.zeros(5), 121, 91, there))


def geometry_of(own=None):
    return time_of_flight_geometry(own or rig(), SETTINGS.near_mm, SETTINGS.far_mm)


def path_to(geometry, own, distance):
    """Optical path lamp - point - camera, summed up in 3D."""
    points = geometry.camera.centre + geometry.ray * distance[..., None]
    return distance + np.linalg.norm(points - own.projector.centre, axis=-1)


def draw(code, path, amplitude=8000.0):
    """Noise-free differences of the taps [DN] of light that came one way."""
    phases = [2 * np.pi * f * path / LIGHT_MM_S for f in code.frequencies_hz]
    return np.stack([MIDDLE + amplitude * np.cos(phi - delta) for phi in phases for delta in code.delays])


def decode(stack, geometry, code, settings=SETTINGS, imager=None):
    return decode_time_of_flight(stack, geometry, code, settings, ImageContext("test", "simulated", FULL_SCALE, imager))


@pytest.mark.parametrize(
    ("frequencies", "steps"),
    [
        ((16.0, 80.0, 120.0), 3),
        ((16.0, 80.0, 120.0), 4),
        ((14.0,), 3),
        ((60.0, 80.0), 5),
        ((10.5, 47.0, 90.25, 103.0), 4),
    ],
)
@pytest.mark.parametrize("lamp", [(80.0, -15.0, 6.0), (0.0, 0.0, 0.0), (-30.0, 200.0, 90.0)])
def test_closed_form_phases_come_back_as_points(frequencies, steps, lamp, rng):
    code, own = modulation(frequencies, steps), rig(lamp=lamp)
    geometry = geometry_of(own)
    depth = rng.uniform(SETTINGS.near_mm + 1, SETTINGS.far_mm - 1, SHAPE)
    distance = depth / geometry.cosine
    cloud = decode(draw(code, path_to(geometry, own, distance)), geometry, code)
    assert cloud.valid.all()
    # float32 levels up to 24384 DN are good to 1e-3 DN of an amplitude of 8000, phases to 2.4e-7 rad, and a few steps
    # of arithmetic add as much again: under 2e-6 rad; points are float32 as well, to 5e-4 mm
    exact = 2e-6 * LIGHT_MM_S / (4 * np.pi * code.frequencies_hz[-1]) + 5e-4
    off = cloud.points - (geometry.camera.centre + geometry.ray * distance[..., None])
    assert np.linalg.norm(off, axis=-1).max() < exact
    # and the grid's own rays, lens and all, are those that the points lie on
    along = np.linalg.norm(cloud.points - cloud.grid.origin, axis=-1)[..., None] * cloud.grid.rays()
    assert np.abs(cloud.grid.origin + along - cloud.points).max() < 2e-3


def hypothesis_distances(code):
    """Distance [rad] of every wrong number of turns from the right one, by brute force over the circle of phases."""
    turns = round(Fraction(code.frequencies_mhz[-1]) / 8)  # 8 MHz divides 16, 80 and 120
    ratio = code.frequencies_hz / code.frequencies_hz[-1]
    shifts = np.linspace(-0.5, 0.5, 20001)
    squared = [
        (np.angle(np.exp(2j * np.pi * ratio[:, None] * (n + shifts))) ** 2).sum(axis=0).min() for n in range(1, turns)
    ]
    return np.sqrt(squared)


@pytest.mark.parametrize("sigma", [0.1, 0.25, 0.4])
def test_unwrapping_fails_as_often_as_the_nearest_wrong_path_says(sigma, rng):
    """Of two hypotheses a distance D apart, white noise picks the wrong one with Q(D / 2 sigma).

    The share of failures lies between the largest of these and their sum. At 0.1 rad the sum is 1e-9: every one of
    the distances of the range comes out right. The preset kinect-v2 has a third of that on matt white at 4.5 m.
    """
    code, count = modulation(), 200_000
    path = rng.uniform(2 * 500, 2 * 4500, (1, count))
    phase = np.stack([2 * np.pi * f * path / LIGHT_MM_S for f in code.frequencies_hz])
    noisy = np.mod(phase + sigma * rng.standard_normal(phase.shape), 2 * np.pi).astype(np.float32)
    variance = np.full(phase.shape, sigma**2, np.float32)
    found, told, _ = joint_path(noisy, variance, code, 0.0)
    period = unambiguous_path(code)
    off = (found - path + period / 2) % period - period / 2
    wave = LIGHT_MM_S / code.frequencies_hz[-1]
    failed = (np.abs(off) > wave / 2).mean()
    each = norm.sf(hypothesis_distances(code) / (2 * sigma))
    spread = 4 * np.sqrt(each.sum() / count)
    assert each.max() - spread <= failed <= each.sum() + spread
    if sigma == 0.1:
        assert failed == 0
    right = np.abs(off) < wave / 2
    if failed == 0:  # else the failures take the tails with them
        assert np.isclose(off[right].std() / told.mean(), 1, atol=4 / np.sqrt(2 * count))
        wanted = sigma / np.sqrt(((2 * np.pi * code.frequencies_hz / LIGHT_MM_S) ** 2).sum())
        assert np.isclose(told.mean(), wanted, rtol=1e-5)


def test_disagreement_is_a_chi_square_of_one_less_than_the_frequencies(rng):
    """By noise alone it has mean F - 1 and variance 2 (F - 1)."""
    code, count, sigma = modulation(), 100_000, 0.05
    path = rng.uniform(1000, 9000, (1, count))
    phase = np.stack([2 * np.pi * f * path / LIGHT_MM_S for f in code.frequencies_hz])
    noisy = np.mod(phase + sigma * rng.standard_normal(phase.shape), 2 * np.pi).astype(np.float32)
    chi_square = joint_path(noisy, np.full(phase.shape, sigma**2, np.float32), code, 0.0)[2]
    assert abs(chi_square.mean() - 2) < 4 * 2 / np.sqrt(count)
    # fourth central moment of a chi-square of 2 is 144: its variance has the variance (144 - 16) / n
    assert abs(chi_square.var() - 4) < 4 * np.sqrt(128 / count)


IMAGER = Imager(10.0, 0.2, 200000.0, 60.0, 0.0, 0.0, 15, MIDDLE, 1.1)


@pytest.mark.parametrize("charge", [3e3, 3e4, 2e5])
def test_the_taps_have_the_noise_of_all_their_charge(charge, rng):
    """Var(A - B) = w + 2 sigma_read^2, whatever the phase; its mean is the correlation without the offset."""
    code, own = modulation(steps=4, contrast=0.6), replace(IMAGER, bits=16, black_level=32768.0)
    phi = 0.7
    correlation = charge * (1 + 0.6 * np.cos(phi - code.delays))
    light = np.broadcast_to(np.tile(correlation, 3)[:, None, None], (12, 150, 200))
    levels = expose_taps(light, code, own, None, Noise.only("shot", "read", "quantisation"), rng)
    difference = (levels.astype(float) - own.black_level) / own.gain
    wanted = np.tile(correlation - charge, 3)
    variance = charge + 2 * own.read_noise**2 + 1 / (12 * own.gain**2)
    assert np.abs(difference.mean(axis=(1, 2)) - wanted).max() < 4 * np.sqrt(variance / 30000)
    # of a normal variance over n pixels the relative standard error is sqrt(2 / n); the largest of twelve within 4.5
    assert np.abs(difference.var(axis=(1, 2)) / variance - 1).max() < 4.5 * np.sqrt(2 / 30000)


def test_ambient_light_and_equal_offsets_cancel_and_their_noise_stays(rng):
    code = modulation(steps=3, contrast=0.5)
    light = np.full((9, 100, 100), 1000.0) + 500 * np.cos(0.4 - np.tile(code.delays, 3))[:, None, None]
    quiet = expose_taps(light, code, IMAGER, None, Noise.none(), None)
    lit = expose_taps(light + 50000, code, IMAGER, None, Noise.none(), None)
    assert np.abs(quiet.astype(int) - lit).max() <= 1
    noisy = [expose_taps(light + a, code, IMAGER, None, Noise.only("shot"), rng).std() for a in (0, 50000)]
    # the spread over all pixels and images holds the correlation too, 500 / sqrt(2) e-
    of_shot = [np.sqrt(1000 + a + 500**2 / 2) for a in (0, 50000)]
    gain = 32767 / 200000  # quantisation off: 16 bits, black level in the middle
    assert np.allclose(noisy, np.array(of_shot) * gain, rtol=0.02)


def test_a_pixel_with_a_full_tap_is_saturated_and_no_other():
    code = modulation(steps=3, contrast=1.0)
    light = np.empty((9, 2, 3))
    correlation = 1 + np.cos(np.tile(code.delays, 3))
    light[:] = 1e5 * correlation[:, None, None]
    light[:, 0, 1] = 199_000 * correlation  # the fullest tap holds 199 000 of 200 000 e-
    light[:, 1, 2] = 201_000 * correlation
    levels = expose_taps(light, code, IMAGER, None, Noise.only("quantisation"), None)
    saturated = (levels == IMAGER.full_scale).any(axis=0)
    np.testing.assert_array_equal(saturated, [[False, False, False], [False, False, True]])


def test_a_difference_below_the_scale_is_saturated_and_not_a_wrong_point(rng):
    """With black at a quarter of the scale a strong difference is cut off at 0, and the phases are wrong."""
    code, own = modulation(steps=4), rig()
    geometry = geometry_of(own)
    distance = rng.uniform(700, 4000, SHAPE)
    path = path_to(geometry, own, distance)
    chip = Imager(pixel_um=10, quantum_efficiency=0.2, full_well=20000, read_noise=20, bits=12, black_level=1024)
    frequency, delay, contrast = (values[:, None, None] for values in code.images())
    correlation = contrast * np.cos(2 * np.pi * frequency * path / LIGHT_MM_S - delay)
    gain = (4095 - 1024) / 20000
    for charge, any_cut in ((6000.0, False), (8000.0, True)):  # electrons of both taps; 1024 DN are 6669 of them
        stack = expose_taps(charge * (1 + correlation), code, chip, None, Noise(), rng)
        cloud = decode_time_of_flight(stack, geometry, code, SETTINGS, ImageContext("test", "simulated", 4095.0, chip))
        cut = (1024 + gain * charge * correlation).min(axis=0) < -70  # 5 sigma below 0
        assert cut.any() == any_cut and (cloud.status[cut] == Status.SATURATED).all()
        off = np.linalg.norm(cloud.points - geometry.camera.centre, axis=-1)[cloud.valid] - distance[cloud.valid]
        assert np.sqrt(np.mean((off / cloud.sigma[cloud.valid]) ** 2)) == pytest.approx(
            1, abs=0.2
        )  # of the noise, those are kept that stay above 0


def test_a_delay_of_the_pixels_is_a_longer_path(rng):
    """For light of several paths at once too; the offset of a pixel (DSNU) is that of its difference."""
    code = AmplitudeModulation(
        kind="amplitude_modulation", frequencies_mhz=[20.0, 75.0], steps=5, contrast=0.8, delay_pattern_mm=30.0
    )
    extra = delay_pattern(code, SHAPE, rng)
    assert np.isclose(extra.std(), 30.0, rtol=4 / np.sqrt(2 * extra.size))
    paths, weights = rng.uniform(1000, 9000, (3, *SHAPE)), rng.uniform(0.1, 1, (3, *SHAPE))

    def correlations(longer):
        return np.stack(
            [
                (weights * (1 + 0.8 * np.cos(2 * np.pi * f * (paths + longer) / LIGHT_MM_S - delta))).sum(axis=0)
                for f in code.frequencies_hz
                for delta in code.delays
            ]
        ).astype(np.float32)

    assert np.abs(delayed(correlations(0.0), code, extra) - correlations(extra)).max() < 1e-5
    own = replace(IMAGER, dsnu=400.0)
    pattern = fixed_pattern(own, SHAPE, rng)
    level = expose_taps(np.full((10, *SHAPE), 1e4), code, own, pattern, Noise.only("dsnu", "quantisation"), None)
    # half a step of the difference, and of each tap, whose converter has gain 61439 / full well
    assert np.abs((level - MIDDLE) / own.gain - pattern.offset).max() <= 0.501 / own.gain + 200000 / 61439


def test_sigma_is_the_scatter_of_the_points(rng):
    code, own = modulation(contrast=[0.7, 0.6, 0.5]), rig()
    geometry = geometry_of(own)
    distance = np.full(SHAPE, 2000.0)
    path = path_to(geometry, own, distance)
    charge = np.linspace(8e3, 2e5, SHAPE[1])  # of both taps, from left to right
    light = np.stack(
        [
            charge * (1 + m * np.cos(2 * np.pi * f * path / LIGHT_MM_S - delta))
            for f, m in zip(code.frequencies_hz, code.contrasts, strict=True)
            for delta in code.delays
        ]
    )
    scaled = []
    for _ in range(8):
        stack = expose_taps(light, code, IMAGER, None, Noise.only("shot", "read", "quantisation"), rng)
        cloud = decode(stack, geometry, code, imager=IMAGER)
        assert cloud.valid.all()
        scaled.append((np.linalg.norm(cloud.points - geometry.camera.centre, axis=-1) - distance) / cloud.sigma)
    scaled = np.array(scaled)
    # 86 400 draws: relative standard error of a standard deviation 0.24 %; weights and sigma from the noisy amplitudes
    # themselves cost 0.5 % more
    assert abs(scaled.std() - 1) < 4 * 0.0024 + 0.005
    assert abs(scaled.mean()) < 4 / np.sqrt(scaled.size) + 0.005
    # without an imager nobody knows
    assert decode(stack, geometry, code).sigma is None


def test_every_refusal_has_its_reason():
    code, own = modulation(), rig()
    geometry = geometry_of(own)
    depth = np.full(SHAPE, 2000.0)
    depth[10] = 6000.0  # beyond the range, within the unambiguous path
    depth[11] = 200.0
    distance = depth / geometry.cosine
    stack = draw(code, path_to(geometry, own, distance))
    stack[:, 20] = MIDDLE
    stack[4, 30] = FULL_SCALE
    stack[3:6, 40] = np.roll(stack[3:6, 40], 1, axis=0)  # 80 MHz off by a third of a turn: no path has such phases
    cloud = decode(stack, geometry, code)
    wanted = {10: "OUT_OF_RANGE", 11: "OUT_OF_RANGE", 20: "LOW_MODULATION", 30: "SATURATED", 40: "PHASE_INCONSISTENT"}
    for row in range(SHAPE[0]):
        assert np.all(cloud.status[row] == Status[wanted.get(row, "VALID")]), row
    np.testing.assert_array_equal(cloud.valid, cloud.status == Status.VALID)


def test_one_frequency_too_faint_is_enough_and_darkness_beside_the_lamp_is_no_surface():
    code = modulation()
    own = rig()
    narrow = replace(own.projector, width=61)  # half as wide, on the camera's left
    own = Rig(own.cameras, narrow)
    geometry = geometry_of(own)
    stack = draw(code, path_to(geometry, own, np.full(SHAPE, 1500.0)))
    stack[6:] = MIDDLE
    cloud = decode(stack, geometry, code)
    assert not cloud.valid.any()
    np.testing.assert_array_equal(cloud.status == Status.LOW_MODULATION, geometry.seen)
    np.testing.assert_array_equal(cloud.status == Status.NO_SURFACE, ~geometry.seen)
    assert 0.2 < geometry.seen.mean() < 0.9


def test_an_edge_within_a_pixel_gives_a_point_between(rng):
    """Mixed pixels are points like others, unless the frequencies contradict one another; they are not hidden."""
    code, own = modulation(), rig(lamp=(0.0, 0.0, 0.0))
    geometry = geometry_of(own)
    near, far = np.full(SHAPE, 1500.0), np.full(SHAPE, 1700.0)
    share = np.broadcast_to(np.linspace(0, 1, SHAPE[1]), SHAPE)
    stack = MIDDLE + (1 - share) * (draw(code, 2 * near) - MIDDLE) + share * (draw(code, 2 * far) - MIDDLE)
    cloud = decode(stack, geometry, code)
    distance = np.linalg.norm(cloud.points - geometry.camera.centre, axis=-1)
    between = cloud.valid & (distance > 1505) & (distance < 1695)
    assert between.mean() > 0.5
    assert (np.diff(np.nan_to_num(distance[0][cloud.valid[0]])) >= -1e-3).all()


@given(arrays(np.uint16, (6, 4, 5), elements=st.integers(0, 32767)))
def test_any_images_decode_to_a_whole_cloud(stack):
    code = modulation((30.0, 50.0), 3)
    camera = Camera(np.array([[4.0, 0, 2], [0, 4.0, 1.5], [0, 0, 1]]), np.zeros(5), 5, 4)
    lamp = Camera(
        np.array([[4.0, 0, 2], [0, 4.0, 1.5], [0, 0, 1]]),
        np.zeros(5),
        5,
        4,
        Transform(np.eye(3), np.array([50.0, 0, 0])),
    )
    geometry = time_of_flight_geometry(Rig({"depth": camera}, lamp), 400, 4600)
    cloud = decode(stack, geometry, code, imager=IMAGER)
    np.testing.assert_array_equal(cloud.valid, cloud.status == Status.VALID)
    inside = cloud.points[..., 2][cloud.valid]
    assert ((inside > 399.9) & (inside < 4600.1)).all()
    assert (cloud.sigma[cloud.valid] > 0).all()
    assert np.isnan(cloud.sigma[~cloud.valid]).all()


def test_what_cannot_be_decoded_is_told():
    code, geometry = modulation(), geometry_of()
    stack = np.zeros((9, *SHAPE), np.uint16)
    with pytest.raises(InputError, match=r"\(9, 90, 120\)"):
        decode(stack[:8], geometry, code)
    with pytest.raises(InputError, match="the frequencies repeat after that"):
        decode(np.zeros((6, *SHAPE), np.uint16), geometry, modulation((80.0, 120.0)))
    assert np.isclose(unambiguous_path(code), LIGHT_MM_S / 8e6)
    assert np.isclose(unambiguous_path(modulation((999.0, 1000.0))), 64 * LIGHT_MM_S / 1e9)
    with pytest.raises(InputError, match="the light source"):
        time_of_flight_geometry(Rig(rig().cameras), 400, 4600)


def test_pixels_beyond_the_fold_of_the_distortion_are_left_out_with_their_reason():
    """r (1 - 1.5 r^2) ends at 0.3143, 28 px from the axis."""
    own = rig(distortion=(-1.5, 0, 0, 0, 0))
    geometry, code = geometry_of(own), modulation()
    distance = np.where(np.isfinite(geometry.ray[..., 0]), 900.0, 700.0)
    path = np.nan_to_num(path_to(geometry, own, distance), nan=1500.0)
    cloud = decode(draw(code, path), geometry, code)
    radius = np.linalg.norm((own.reference.pixel_grid() - [60.3, 44.1]) / [90.0, 91.0], axis=-1)
    assert (cloud.status[radius > 0.3145] == Status.UNCALIBRATED).all()
    assert cloud.valid[radius < 0.314].all()


def test_a_pixel_without_a_ray_does_not_end_the_check_of_the_range():
    """Before, the longest path was NaN, and an ambiguous range was accepted."""
    geometry = geometry_of()
    cosine = geometry.cosine.copy()
    cosine[0, 0] = np.nan
    assert _longest_path(replace(geometry, cosine=cosine), 3000.0) == pytest.approx(
        _longest_path(geometry, 3000.0), rel=0.05
    )
