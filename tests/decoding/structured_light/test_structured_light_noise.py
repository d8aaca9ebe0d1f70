"""What two cameras and a code say of their own noise, against captures that are drawn again and again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mitsim.decoding.image_context import ImageContext
from mitsim.decoding.matching.stereo_geometry import stereo_geometry
from mitsim.decoding.structured_light.two_cameras import decode_structured_light_stereo
from mitsim.sensor.camera import Camera, Rig
from mitsim.sensor.decoder_settings import DecoderSettings
from mitsim.sensor.imager import Imager
from mitsim.sensor.light_code import GrayCode, PhaseShift, roles, value
from mitsim.sensor.transforms import Transform

WIDTH, HEIGHT, PROJECTOR = 120, 60, (400, 300)
SETTINGS = DecoderSettings(near_mm=400, far_mm=800)
IMAGER = Imager(
    pixel_um=5,
    quantum_efficiency=0.6,
    full_well=20000,
    read_noise=20,
    dsnu=0,
    prnu=0,
    bits=12,
    black_level=64,
    f_number=4,
)
CODE = PhaseShift(periods_px=[420, 60, 12], steps=6)
HALF_TURN = Transform.from_degrees([0, 0, 180], [0, 0, 0])


def rig() -> Rig:
    """Two turned cameras with bent lenses, and a projector between them."""
    K = np.array([[220.0, 0, 59.5], [0, 220.0, 29.5], [0, 0, 1]])
    left = Camera(K, np.array([-0.1, 0.02, 0, 0, 0]), WIDTH, HEIGHT)
    right = Camera(K, np.array([-0.08, 0, 0, 0, 0]), WIDTH, HEIGHT, Transform.from_degrees([1, -9, 0.5], [100, 1, 3]))
    lamp = Camera(
        np.array([[500.0, 0, 199.5], [0, 500.0, 149.5], [0, 0, 1]]),
        np.zeros(5),
        *PROJECTOR,
        Transform.from_degrees([0, -4.5, 0], [50, -20, 0]),
    )
    return Rig({"left": left, "right": right}, lamp)


def mean_levels(eye: Camera, lamp: Camera, code: PhaseShift | GrayCode) -> np.ndarray:
    """Grey levels (P, H, W) [DN] without noise of a tilted plane at 600 mm."""
    place, n = eye.sensor_from_camera, np.array([0.25, 0.1, -1.0])
    rays = place.directions(eye.rays(eye.pixel_grid()))
    points = place.translation + rays * ((600 * n[2] - place.translation @ n) / (rays @ n))[..., None]
    u = lamp.project(points)[..., 0]
    return np.stack([IMAGER.black_level + 300 + 1500 * value(code, role, u) for role in roles(code, *PROJECTOR)])


def decoded(stacks, code, **options):
    return decode_structured_light_stereo(
        stacks,
        stereo_geometry(rig()),
        code,
        SETTINGS,
        PROJECTOR,
        ImageContext("drawn", "simulated", 4095, **options),
    )


@pytest.fixture(scope="module")
def draws():
    """Clouds of 60 draws of shot and read noise, without quantisation."""
    eyes = rig()
    means = [mean_levels(eye, eyes.projector, CODE) for eye in eyes.cameras.values()]
    rng = np.random.default_rng(8)
    dark = (IMAGER.gain * IMAGER.read_noise) ** 2 + 1 / 12
    clouds = []
    for _ in range(60):
        stacks = [
            (m + rng.standard_normal(m.shape) * np.sqrt((m - IMAGER.black_level) * IMAGER.gain + dark)) for m in means
        ]
        clouds.append(decoded([stack.astype(np.float32) for stack in stacks], CODE, imager=IMAGER))
    return clouds


def test_the_noise_along_the_ray_is_that_which_is_told(draws):
    """Of both cameras, through interpolation: pooled over all pixels within 2 %.

    The pooled variance of 60 draws at n independent pixels is known to sqrt(2 / (59 n)); a pixel shares its raw ones
    with about nine neighbours, and 4000 / 9 of them make 0.9 % of the variance, 0.45 % of the standard deviation.
    """
    ranges = np.stack([np.linalg.norm(cloud.points.astype(float) - cloud.grid.origin, axis=-1) for cloud in draws])
    always = np.isfinite(ranges).all(axis=0)
    told = np.stack([cloud.sigma for cloud in draws]).astype(float)[:, always]
    measured = ranges[:, always].var(axis=0, ddof=1)
    ratio = np.sqrt(measured.mean() / (told**2).mean())
    print(f"noise measured over told: {ratio:.4f}, at {always.sum()} pixels; median {np.median(told):.3f} mm")
    assert always.sum() > 3000
    assert abs(ratio - 1) < 0.02


def test_noise_is_told_where_there_are_points_and_nowhere_else(draws):
    for cloud in draws[:3]:
        np.testing.assert_array_equal(np.isfinite(cloud.sigma), cloud.valid)


def test_without_an_imager_or_of_stripes_alone_no_noise_is_told():
    eyes = rig()
    for code, imager in ((CODE, None), (GrayCode(bits=5), IMAGER)):
        stacks = [mean_levels(eye, eyes.projector, code).astype(np.float32) for eye in eyes.cameras.values()]
        assert decoded(stacks, code, imager=imager).sigma is None


def test_sigma_has_no_sign_if_the_projector_is_turned():
    """The coordinates of a row fall then, and all standard deviations were negative."""
    eyes = rig()
    turned = replace(eyes.projector, sensor_from_camera=eyes.projector.sensor_from_camera @ HALF_TURN)
    clouds = []
    for lamp in (eyes.projector, turned):
        stacks = [mean_levels(eye, lamp, CODE) for eye in eyes.cameras.values()]
        clouds.append(decoded(stacks, CODE, imager=IMAGER))
    plain, other = (np.nanmedian(cloud.sigma) for cloud in clouds)
    assert other == pytest.approx(plain, rel=0.1) and np.nanmin(clouds[1].sigma) > 0
