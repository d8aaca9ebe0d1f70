"""How a code in phase is pulled: closed forms, and a corner that is rendered and decoded in full."""

import math
from dataclasses import replace

import numpy as np
import pytest

from mitsim.capture.simulated.rendering import Rendering
from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.decoding.cloud import capture_cloud, sensor_geometry
from mitsim.maps.prediction import Ideal, Predictor
from mitsim.maps.prediction.interreflections import InterreflectionEffect
from mitsim.maps.prediction.multipath_phase_bias import WINDOW_PX, amplitude, finest_fringe, fringes, phase_bias
from mitsim.scene.backend import activate
from mitsim.scene.load import scene_from_dict
from mitsim.sensor.light_code import PhaseShift
from mitsim.sensor.noise_sources import Noise
from mitsim.sensor.preset import load_sensor
from mitsim.sensor.transforms import look_at
from tests.smaller_sensors import middle_part

pytestmark = pytest.mark.usefixtures("no_other_scenes")

SIZE = (40, 60)
FACE = np.zeros(SIZE, int)


@pytest.fixture(scope="module")
def david():
    return load_sensor("david-sls-3")


@pytest.mark.parametrize("step", [1, 3])
def test_light_in_a_steady_ratio_turns_the_phase_by_its_argument(step):
    rng = np.random.default_rng(1)
    direct = np.exp(1j * rng.uniform(-math.pi, math.pi, SIZE)) * 1e-9
    for z in (0.3, 0.3j, -0.5 + 0.2j, 2 * np.exp(2j)):
        found, _ = phase_bias(direct, (z * direct, z * direct), FACE, step)
        np.testing.assert_allclose(found, np.angle(1 + z), atol=1e-5)


def test_even_light_pulls_the_more_the_less_there_is_of_the_own_code():
    """At a limb that is turned from the projector, direct light falls to a tenth within three pixels."""
    column = np.broadcast_to(np.arange(SIZE[1]), SIZE)
    size = np.clip((column - 10) / 30, 0.1, 1.0)
    direct = size * np.exp(2j * math.pi * column / 18)
    other = 0.05j * np.exp(2j * math.pi * column / 18)
    found, _ = phase_bias(direct, (other, other), FACE, 1)
    np.testing.assert_allclose(found, np.arctan(0.05 / size), atol=1e-5)


def test_a_code_that_turns_fast_against_the_own_one_pulls_nothing():
    column = np.broadcast_to(np.arange(SIZE[1]), SIZE)
    direct = np.exp(2j * math.pi * column / 18)
    against = 0.3 * np.exp(-2j * math.pi * column / 18)
    found, uneven = phase_bias(direct, (against, against), FACE, 1)
    # a Gaussian of 2 px passes exp(-(2 pi 2 / 9)^2 / 2) of a period of 9; the rest scatters the points
    passed = math.exp(-((2 * math.pi * WINDOW_PX / 9) ** 2) / 2)
    assert np.abs(found[:, 15:-15]).max() < 0.3 * passed + 1e-3
    assert uneven[:, 15:-15] == pytest.approx(0.3 * math.sqrt((1 - passed**2) / 2), rel=0.02)


def test_noise_of_few_paths_is_no_pull():
    """Of two independent renders: the mean square of what is left, over that of their mean; and a pull stays."""
    rng = np.random.default_rng(2)
    direct = np.ones(SIZE, complex)
    noise = (rng.normal(size=(2, *SIZE)) + 1j * rng.normal(size=(2, *SIZE))) * 0.1
    middle = noise.mean(axis=0)
    alone, noisy = phase_bias(direct, (noise[0], noise[1]), FACE, 3)
    mean, _ = phase_bias(direct, (middle, middle), FACE, 3)
    assert np.mean(alone**2) < 0.1 * np.mean(mean**2)
    assert np.sqrt(np.mean(noisy**2)) < 0.5 * 0.1  # nor is it what scatters points
    pull, _ = phase_bias(direct, (noise[0] + 0.4j, noise[1] + 0.4j), FACE, 3)
    # two renders have 0.1 / sqrt(2) of noise in phase, in each of 2400 pixels
    assert pull.mean() == pytest.approx(math.atan(0.4), abs=3 * 0.1 / math.sqrt(2 * 2400))


def test_faces_do_not_mix_and_without_direct_light_there_is_no_pull():
    shape = np.where(np.arange(SIZE[1]) < 30, 0, 1) * np.ones((SIZE[0], 1), int)
    shape[:4] = -1
    other = np.where(shape == 0, 0.2j, -0.2j)
    direct = np.ones(SIZE, complex)
    found, _ = phase_bias(direct, (other, other), shape, 1)
    np.testing.assert_allclose(found[shape == 0], math.atan(0.2), atol=1e-5)
    np.testing.assert_allclose(found[shape == 1], -math.atan(0.2), atol=1e-5)
    assert not np.any(phase_bias(0 * direct, (other, other), shape, 1))


def test_a_phase_becomes_the_depth_at_which_the_ray_meets_that_stripe(david):
    small = middle_part(david, 160, 120)
    predictor = Predictor.of_sensor(small, sensor_geometry(small)).thinned(40)
    fringe = finest_fringe(david)
    rng = np.random.default_rng(3)
    ray = np.column_stack([rng.uniform(-0.3, 0.3, (50, 2)), np.ones(50)])
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    distance = rng.uniform(400, 600, 50)
    point, phase = predictor.grid.origin + distance[:, None] * ray, rng.uniform(-0.02, 0.02, 50)
    ideal = Ideal(np.arange(50), point, ray, distance, ray, np.zeros(50, np.int16), np.zeros(50, np.uint8))
    found = fringe.range_bias(phase, ideal)
    place = point + found[:, None] * ray - fringe.centre
    before = (point - fringe.centre) @ fringe.along / ((point - fringe.centre) @ fringe.optical_axis)
    after = place @ fringe.along / (place @ fringe.optical_axis)
    np.testing.assert_allclose(after - before, phase / (2 * math.pi) * fringe.period, rtol=1e-8)
    assert fringe.period == pytest.approx(16 / 1800)


@pytest.mark.parametrize("axis", ["columns", "rows"])
def test_the_amplitude_of_the_fringes_has_their_phase(david, axis):
    code = PhaseShift(periods_px=[400, 20], axis=axis, mean=0.4, contrast=0.3)
    images = fringes(replace(david, pattern=code))
    found = amplitude(images)
    number = np.arange(images.shape[1 if axis == "rows" else 2])
    wave = np.exp(2j * math.pi * (number + 0.5) / 20) * 1.5 * 0.3
    np.testing.assert_allclose(
        found, np.broadcast_to(wave[:, None] if axis == "rows" else wave, found.shape), atol=1e-6
    )
    assert finest_fringe(replace(david, pattern=code)).period == pytest.approx(20 / 1800)


def test_a_sensor_without_fringes_has_none():
    n10 = load_sensor("ensenso-n10")
    assert finest_fringe(n10) is None and len(fringes(n10)) == 0
    assert InterreflectionEffect(n10).light.count == 1


def test_a_corner_of_metal_is_pulled_as_the_full_render_is(david):
    """A plate and a wall of Ra 0.37, stripes along their edge: what is predicted, and what is decoded without noise."""
    activate()
    from mitsim.scene.backend import mi

    david = middle_part(david, 640, 480)
    metal = {"type": "machined_metal", "metal": "aluminium", "process": "ground", "Ra": 0.37}
    upright = mi.ScalarTransform4f().translate([0, 30, 30]).rotate([1, 0, 0], 90).scale([30, 30, 1])
    scene = scene_from_dict(
        {
            "plate": {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale([30, 30, 1]), "bsdf": metal},
            "wall": {"type": "rectangle", "to_world": upright, "bsdf": metal},
        },
        david.wavelength_nm,
    )
    pose, geometry = look_at([0, -420, 200], [0, 30, 5], [0, 0, 1]), sensor_geometry(david)
    predictor = Predictor.of_sensor(david, geometry)
    surfaces = predictor.surfaces(scene, pose)
    ideal = predictor.ideal(surfaces)
    world = pose.points(ideal.point)
    high = world[:, 2]
    strip = (ideal.shape == 1) & (np.abs(world[:, 0]) < 4) & (high > 1) & (high < 11)

    light = InterreflectionEffect(david, paths=200_000, photons=3_000_000).render(scene, pose).at(ideal.point)
    predicted = finest_fringe(david).range_bias(light.displaced, ideal)
    around = pose.inverse().points(np.array([[x, 30, z] for x in (-5.0, 5) for z in (0.0, 12)]))
    noise = Noise(**dict.fromkeys(Noise.__dataclass_fields__, False))
    capture = SimulatedSensor(david).capture(
        scene, pose, rendering=Rendering(samples=100, depth=2), seed=1, around=around, noise=noise
    )
    cloud = capture_cloud(capture, david.settings, geometry, imager=david.imager)
    decoded = ((cloud.points.reshape(-1, 3)[ideal.pixel] - ideal.point) * ideal.ray).sum(axis=1)

    means = []
    for low in np.arange(1.0, 11.0):
        here = strip & (high > low) & (high < low + 1) & np.isfinite(decoded)
        assert here.sum() > 100
        means.append((decoded[here].mean(), predicted[here].mean()))
    found, expected = np.array(means).T
    assert np.nanmean(light.rho[strip]) > 1 and found.max() > 1 and found[-1] < 0.2
    # the window of 4 px takes some 0.08 mm off the top of a bow that is 40 px wide
    assert np.sqrt(np.mean((found - expected) ** 2)) < 0.1
