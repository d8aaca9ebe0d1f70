"""Noise that fringes show themselves: that of the images, whatever the code; and sigma of points that have it."""

from __future__ import annotations

import numpy as np
import pytest

from mitsim.capture.capture import Capture
from mitsim.capture.decoding import Decoding
from mitsim.decoding.cloud import capture_cloud
from mitsim.decoding.coded_images import decoded_once
from mitsim.decoding.noise import sigma_source
from mitsim.decoding.structured_light.measured_noise import measured_noise
from mitsim.sensor.camera import Camera, Rig
from mitsim.sensor.decoder_settings import DecoderSettings
from mitsim.sensor.image_sequence import ImageSequence
from mitsim.sensor.light_code import GrayCode, GrayCodePhaseShift, PhaseShift, roles, value
from mitsim.sensor.transforms import Transform

WIDTH, HEIGHT = 256, 192
FRINGES = {"show": "fringes", "period_px": 20, "steps": 3}
MIXED = ImageSequence(
    kind="image_sequence",
    images=[
        FRINGES,
        FRINGES | {"period_px": 25, "shifts_deg": [0, 80, 200, 260], "steps": None},
        {"show": "white"},
        FRINGES | {"axis": "rows"},
        FRINGES | {"axis": "rows", "period_px": 18},
    ],
)
CODES = {
    "one period": PhaseShift(periods_px=[260], steps=4),
    "three steps": PhaseShift(periods_px=[260, 40], steps=3),
    "many": PhaseShift(periods_px=[260, 40, 16]),
    "after Gray": GrayCodePhaseShift(period_px=16),
    "mixed": MIXED,
}


def taken(code, deviation, rng, gamma=1.0, full=255, contrast=1.0):
    """Images of a code on a wall of many shades; ``deviation`` [DN] of the noise at each level."""
    u, v = np.meshgrid(np.linspace(10, 240, 300), np.linspace(10, 180, 200))
    albedo = 0.6 + 0.35 * np.sin(u / 31) * np.cos(v / 23)
    stack = []
    for role in roles(code, WIDTH, HEIGHT):
        shown = value(code, role, v if role.axis == "rows" else u) ** gamma
        level = full * (0.05 + 0.8 * albedo * (0.5 + contrast * (shown - 0.5)))
        stack.append(level + rng.normal(0, 1, level.shape) * deviation(level))
    return np.rint(np.clip(stack, 0, full)).astype(np.uint8 if full < 256 else np.uint16)


@pytest.mark.parametrize("name", CODES)
@pytest.mark.parametrize("noise", [0.4, 1.5, 5.0])
def test_the_noise_is_that_of_the_images(name, noise, rng):
    code = CODES[name]
    found = measured_noise([taken(code, lambda level: noise, rng)], roles(code, WIDTH, HEIGHT), 255)
    true = np.sqrt(noise**2 + 1 / 12)
    np.testing.assert_allclose(np.sqrt(found.variances), true, rtol=0.08)
    assert found.at_median_level[1] == pytest.approx(true, rel=0.05)


@pytest.mark.parametrize("name", CODES)
def test_the_gamma_of_a_projector_is_no_noise(name, rng):
    """Harmonics of gamma 2.2 are 30 DN, the noise is 1: what is left over is the noise of their phase."""
    code = CODES[name]
    stack = taken(code, lambda level: 1.0, rng, gamma=2.2)
    found = measured_noise([stack], roles(code, WIDTH, HEIGHT), 255)
    assert 0.95 < found.at_median_level[1] / np.sqrt(1 + 1 / 12) < 1.3


def test_shot_noise_grows_with_the_level(rng):
    code = CODES["many"]
    stack = taken(code, lambda level: np.sqrt(4 + 0.5 * level), rng, full=4095, contrast=0.6)
    found = measured_noise([stack], roles(code, WIDTH, HEIGHT), 4095)
    assert found.levels[-1] > 2 * found.levels[0]
    np.testing.assert_allclose(found.variances, 4 + 0.5 * found.levels, rtol=0.12)
    np.testing.assert_array_equal(found.variance(np.array([0.0, 1e5])), found.variances[[0, -1]].astype(np.float32))


@pytest.mark.parametrize("steps", [4, 5])
def test_the_noise_of_shots_is_whole_at_full_contrast(steps, rng):
    """Before, differences of the modulations of three periods described 8 % of it."""
    code = PhaseShift(periods_px=[260, 40, 16], steps=steps)
    stack = taken(code, lambda level: np.sqrt(4 + 0.5 * level), rng, full=4095)
    found = measured_noise([stack], roles(code, WIDTH, HEIGHT), 4095)
    assert np.sqrt(found.variances / (4 + 0.5 * found.levels + 1 / 12)).mean() == pytest.approx(1, abs=0.02)


@pytest.mark.parametrize(
    "code",
    [PhaseShift(periods_px=[260], steps=3), GrayCode(), GrayCodePhaseShift(period_px=16, steps=3)],
    ids=["three steps", "Gray", "after Gray"],
)
def test_where_nothing_is_left_over_nothing_is_told(code, rng):
    assert measured_noise([taken(code, lambda level: 1.0, rng)], roles(code, WIDTH, HEIGHT), 255) is None


def test_dark_and_saturated_images_tell_nothing(rng):
    code = CODES["many"]
    stack, every = taken(code, lambda level: 1.0, rng), roles(code, WIDTH, HEIGHT)
    assert measured_noise([stack // 32], every, 255) is None
    assert measured_noise([np.full_like(stack, 255)], every, 255) is None


def eye(x=0.0, turn=0.0):
    K = np.array([[260.0, 0, 110.3], [0, 260, 84.6], [0, 0, 1]])
    return Camera(K, np.array([-0.1, 0.03, 0, 0, 0]), 220, 170, Transform.from_degrees((0, turn, 0), (x, 0, 0)))


@pytest.mark.parametrize("pair", [False, True])
def test_points_scatter_as_their_sigma_says(pair, rng):
    """A plane, exact projections, and noise: residuals over sigma have a standard deviation of one."""
    K = np.array([[270.0, 0, 127.5], [0, 270, 95.5], [0, 0, 1]])
    beamer = Camera(K, np.zeros(5), WIDTH, HEIGHT, Transform.from_degrees((0.5, -11.0, 0.3), (100.0, 3.0, 5.0)))
    cameras = {"left": eye(), "right": eye(60.0, -6.0)} if pair else {"camera": eye()}
    code, images = CODES["many"], {}
    for name, each in cameras.items():
        rays = each.sensor_from_camera.directions(each.rays(each.pixel_grid()))
        points = each.centre + rays * ((500.0 - each.centre[2]) / rays[..., 2:])
        place = beamer.project(points)
        levels = [12 + 180 * value(code, role, place[..., 0]) for role in roles(code, WIDTH, HEIGHT)]
        images[name] = np.rint(levels + rng.normal(0, 1.5, np.shape(levels))).astype(np.uint8)
    capture = Capture(
        "rig",
        "structured_light",
        "device",
        Rig(cameras, beamer),
        images,
        decoding=Decoding(pattern=code),
    )
    settings = DecoderSettings(near_mm=50, far_mm=20000, triangulate="cameras" if pair else "projector")
    cloud, _, noise = decoded_once(capture, settings, None)
    inner = cloud.valid & np.isfinite(cloud.sigma)
    rays = cloud.points[inner] / np.linalg.norm(cloud.points[inner], axis=1, keepdims=True)
    off = (cloud.points[inner, 2] - 500.0) / rays[:, 2]
    ratio = off / cloud.sigma[inner]
    assert inner.sum() > 10000
    assert 1.4826 * np.median(np.abs(ratio)) == pytest.approx(1, abs=0.06)
    assert "from the contrast of the fringes and the residuals of their fit, 1.5 DN" in sigma_source(
        capture, cloud, noise
    )
    bare = capture_cloud(capture, settings)
    assert bare.sigma is None or not np.isfinite(bare.sigma[bare.valid]).any()
    assert "not known" in sigma_source(capture, bare, None)
