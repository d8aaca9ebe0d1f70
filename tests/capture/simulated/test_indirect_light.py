"""Light by way of other surfaces, smoothed over the pixels of one shape."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from characterisation.region_of_interest import Roi
from mitsim.capture.simulated import simulate
from mitsim.capture.simulated.indirect_light import IndirectLight, KeptSettings, smoothed
from mitsim.capture.simulated.rendering import Rendering
from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.scene.backend import mi
from mitsim.scene.load import load_scene, scene_from_dict
from mitsim.sensor.noise_sources import Noise
from mitsim.sensor.preset import load_sensor
from mitsim.sensor.transforms import look_at

pytestmark = pytest.mark.usefixtures("no_other_scenes")

ROOT = Path(__file__).parents[3]


@given(st.integers(1, 30), st.integers(1, 30), st.floats(0.1, 4.0), st.integers(0, 2**32 - 1))
def test_what_is_even_on_each_shape_stays_and_nothing_leaks(height, width, sigma, seed):
    rng = np.random.default_rng(seed)
    shape = rng.integers(-1, 3, (height, width))
    light = np.stack([shape + 2.0, 5.0 - shape]).astype(np.float32)
    np.testing.assert_allclose(smoothed(light, shape, sigma), light, rtol=2e-6)


def test_noise_falls_by_the_pixels_that_are_averaged():
    """Standard deviation falls to 1 / (2 sqrt(pi) sigma): the Gaussian's own area is 4 pi sigma^2."""
    noise = np.random.default_rng(3).standard_normal((2, 300, 300)).astype(np.float32)
    left = smoothed(noise, np.zeros((300, 300), int), 2.0)[:, 20:-20, 20:-20]
    # 270400 values, 50 of a kind: relative standard error of a standard deviation 1 / sqrt(2 * 5400), 1 %
    assert left.std() == pytest.approx(1 / (2 * np.sqrt(np.pi) * 2.0), rel=0.03)


def test_a_corner_is_as_bright_as_many_light_paths_make_it_and_less_noisy():
    sensor = load_sensor("ensenso-n10")
    sensor = replace(sensor, rig=replace(sensor.rig, cameras={"left": sensor.rig.reference}))
    scene = load_scene(ROOT / "scenes/two_pillars/matt_white.xml", sensor.wavelength_nm)
    pose = look_at([120, -180, 480], scene.centre, [0, 1, 0])
    simulated = SimulatedSensor(sensor)
    around = pose.inverse().points(scene.centre + np.array([[x, y, 0] for x in (-20, 20) for y in (-20, 20)]))

    def light(seed, samples, depth=2, indirect=None):
        rendering, noise = Rendering(samples, depth, indirect), Noise(speckle=False)
        return simulated.light(scene, pose, seed=seed, rendering=rendering, around=around, noise=noise).radiance

    direct = light(1, 16, depth=1)["left"]
    truth = light(1, 64)["left"] - direct
    few = [light(seed, 16, indirect=IndirectLight(4, 1.5))["left"] - direct for seed in (1, 2, 3)]
    coarse = light(1, 4, depth=1)["left"]  # without noise, whatever the seed
    plain = [light(seed, 4)["left"] - coarse for seed in (1, 2, 3)]
    assert np.mean(few) == pytest.approx(np.mean(truth), rel=0.03)
    # of independent pixels 0.19 would be left; a few bright paths make most of the noise
    assert np.var(few, axis=0, ddof=1).mean() < 0.4**2 * np.var(plain, axis=0, ddof=1).mean()


def test_direct_light_alone_is_not_touched():
    sensor = load_sensor("ensenso-n10")
    scene = load_scene(ROOT / "scenes/coupon/matt_white.xml", sensor.wavelength_nm)
    pose = look_at([0, 0, 500], [0, 0, 0], [0, 1, 0])
    simulated = SimulatedSensor(sensor)
    around = pose.inverse().points(np.array([[-5.0, -5, 0], [5, 5, 0]]))
    kept = simulated.capture(scene, pose, rendering=Rendering(samples=4), seed=1, around=around)
    with_rule = simulated.capture(
        scene, pose, rendering=Rendering(samples=4, indirect=IndirectLight(4, 2.0)), seed=1, around=around
    )
    for name, images in kept.images.items():
        np.testing.assert_array_equal(images, with_rule.images[name])
    assert with_rule.settings["indirect_light"] == {"samples": 4, "smoothing_px": 2.0}


def test_a_flat_coupon_is_not_traced_and_two_of_them_do_not_light_each_other(monkeypatch):
    """Two squares of one plane are traced, and are as dark as the one that is not."""
    sensor = replace(load_sensor("ensenso-n10"), ambient_image=True)
    square = {"type": "rectangle", "bsdf": {"type": "matt_white"}}
    at = mi.ScalarTransform4f()
    halves = {
        name: {**square, "to_world": at.translate([x, 0, 0]).scale([10, 20, 1])} for name, x in (("a", -10), ("b", 10))
    }
    pose, simulated = look_at([0, 0, 500], [0, 0, 0], [0, 1, 0]), SimulatedSensor(sensor)
    roi = Roi.between(340, 200, 400, 240)

    def dark(shapes):
        scene = scene_from_dict(shapes, sensor.wavelength_nm)
        return simulated.indirect_radiance(scene, pose, "left", IndirectLight(1, 1.5), seed=1, depth=2, roi=roi)

    two = dark(halves)
    monkeypatch.setattr(simulate, "trace", None)
    one = dark({"both": {**square, "to_world": at.scale([20, 20, 1])}})
    assert not two.any()
    assert one.dtype == two.dtype
    np.testing.assert_array_equal(one, two)


def test_a_part_of_many_pixels_has_about_as_many_paths_as_one_of_few():
    settings = KeptSettings(16, 4.0, 8, 2.5, most_pixels=400_000)
    assert settings.for_pixels(400_000) == settings
    for count in (500_000, 1_600_000, 5_000_000):
        fewer = settings.for_pixels(count)
        assert (
            1 <= fewer.samples * count <= max(16 * 400_000, count) and math.isqrt(fewer.samples) ** 2 == fewer.samples
        )
        assert fewer.kept >= 1
        assert fewer.smoothing_px / math.sqrt(count) == pytest.approx(2.5 / math.sqrt(400_000))  # as sharp on the part
    assert settings.for_pixels(1_600_000) == replace(settings, samples=4, kept=2, smoothing_px=5.0)
    assert replace(settings, most_pixels=None).for_pixels(5_000_000).samples == 16
