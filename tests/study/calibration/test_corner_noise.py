"""Noise of corners and of projector coordinates follows from imager, lens and code."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from characterisation.point_cloud import Status
from mitsim.decoding.structured_light.decoder import decode_coordinates
from mitsim.sensor.decoder_settings import DecoderSettings
from mitsim.sensor.image_formation import expose
from mitsim.sensor.light_code import GrayCode, PhaseShift, roles, value
from mitsim.sensor.noise_sources import Noise
from mitsim.sensor.preset import load_sensor
from mitsim.study.calibration.corner_noise import WHITE, board_level, coordinate_noise, corner_noise


def test_without_noise_the_detector_errs_less_the_softer_the_image(n10):
    quiet = [
        corner_noise(
            replace(n10, focus_mm=None, imager=replace(n10.imager, blur_px=blur, bits=16, black_level=0)),
            600,
            40,
            noise=Noise.none(),
        )
        for blur in (0.28, 0.7, 1.5)
    ]
    assert quiet[0].sigma > quiet[1].sigma > quiet[2].sigma
    assert quiet[2].sigma < 0.015
    # 150 places in a pixel have no mean error beyond chance
    assert all(each.bias < 4 * each.sigma / np.sqrt(150) for each in quiet)


def test_the_detector_is_right_in_the_mean_and_the_error_is_of_a_known_size(n10):
    """Calibrations with such a detector have 0.02 to 0.1 px; test_virtual_calibration.py under 0.05."""
    found = corner_noise(n10, 600, 40)
    assert 0.01 < found.sigma < 0.1
    assert found.bias < 5 * found.sigma / np.sqrt(150)


def test_noise_of_a_soft_corner_falls_with_the_light(n10):
    """Where read noise rules, a corner's noise goes as noise over contrast."""
    soft = replace(n10.imager, blur_px=1.0, bits=16, black_level=1000, prnu=0, dsnu=0, row_noise=0, read_noise=300)
    quiet = replace(soft, read_noise=150)
    loud, less = (
        corner_noise(replace(n10, imager=each, focus_mm=None), 600, 40, noise=Noise.only("read")).sigma
        for each in (soft, quiet)
    )
    assert loud / less == pytest.approx(2, rel=0.1)


def test_the_level_is_that_of_the_exposure_rule(n10):
    assert board_level(n10, 600) == pytest.approx(board_level(n10, 450))
    # 0.40 of full scale at 600 mm, where the middle of the range lies at 566
    assert board_level(n10, 500) == pytest.approx(0.40 * (600 / np.sqrt(400 * 800)) ** 2 * WHITE / 0.85, rel=1e-6)
    kinect = load_sensor("kinect-v2")  # a written exposure: by the inverse square
    assert board_level(kinect, 1500) / board_level(kinect, 3000) == pytest.approx(4, rel=1e-6)


def test_a_phase_at_a_corner_is_as_noisy_as_decoded_images(rng):
    """The mean of as many decoded pixels as the formula averages over."""
    zivid = load_sensor("zivid-2-m70")
    code = PhaseShift(periods_px=[1290, 140, 15], steps=[4, 4, 8])
    sensor = replace(zivid, pattern=code)
    projector = sensor.projector.optics
    every = roles(code, projector.width, projector.height)
    level = board_level(sensor, 700) * sensor.imager.full_well
    u = np.broadcast_to(np.linspace(300, 340, 200), (200, 200))
    light = np.stack([level * value(code, role, u) for role in every])
    stack = expose(light, sensor.imager, None, Noise.only("shot", "read", "quantisation"), rng)
    settings = DecoderSettings(near_mm=450, far_mm=1250)
    found = decode_coordinates(
        stack,
        code,
        (projector.width, projector.height),
        settings,
        full_scale=sensor.imager.full_scale,
        imager=sensor.imager,
    )["columns"]
    one = np.std((found.value - u)[found.status == Status.VALID])
    assert (found.status == Status.VALID).mean() > 0.99, np.unique(found.status)
    assert coordinate_noise(sensor, 700, 30.0) * np.sqrt(47.0**2 / 2) == pytest.approx(one, rel=0.1)


def test_a_line_fitted_to_stripes_is_better_than_a_stripe(rng):
    """Against stripes as they are decoded, along rows that are slightly stretched."""
    zivid = load_sensor("zivid-2-m70")
    code = GrayCode(bits=8)  # stripes of 8 px
    sensor = replace(zivid, pattern=code)
    projector = sensor.projector.optics
    every = roles(code, projector.width, projector.height)
    scale = projector.matrix[0, 0] / sensor.rig.reference.matrix[0, 0]
    settings = DecoderSettings(near_mm=450, far_mm=1250)
    errors = []
    for _ in range(1000):
        columns = np.arange(47) - 23.0
        u = 600 + rng.uniform(0, 8) + scale * rng.uniform(0.8, 1.25) * columns[None]
        stack = np.stack([200 * value(code, role, u) for role in every]).astype(np.float32)
        found = decode_coordinates(stack, code, (projector.width, projector.height), settings, full_scale=255)
        errors.append(np.polyfit(columns, (found["columns"].value - u)[0], 1)[1])
    wanted = coordinate_noise(sensor, 700, 30.0)
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(wanted, rel=0.1)
    assert wanted < 8 / np.sqrt(12)


def test_smoothing_by_the_device_does_not_lower_a_mean_over_a_window():
    """Before, the noise of smoothed pixels counted as independent between them: 0.3 of the true one at 1 px."""
    sensor = load_sensor("zivid-2-m70")
    smoothed = replace(sensor, imager=replace(sensor.imager, smoothing_px=1.0))
    assert coordinate_noise(smoothed, 700, 30.0) == coordinate_noise(sensor, 700, 30.0)
