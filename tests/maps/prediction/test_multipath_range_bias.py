"""How a time of flight is lengthened by light from elsewhere: closed forms, and a corner decoded in full."""

import math
from dataclasses import replace

import numpy as np
import pytest

from characterisation.point_cloud import Status
from mitsim.capture.simulated.rendering import Rendering
from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.decoding.cloud import capture_cloud, sensor_geometry
from mitsim.maps.prediction import Ideal, Predictor
from mitsim.maps.prediction.interreflections import InterreflectionEffect
from mitsim.maps.prediction.multipath_range_bias import path_amplitudes, path_bias, range_bias
from mitsim.maps.prediction.perturbation import SceneView
from mitsim.scene.backend import activate
from mitsim.scene.load import scene_from_dict
from mitsim.sensor.modulation import LIGHT_MM_S, expose_taps
from mitsim.sensor.noise_sources import Noise
from mitsim.sensor.preset import load_sensor
from mitsim.sensor.transforms import look_at

pytestmark = pytest.mark.usefixtures("no_other_scenes")

SIZE = (20, 30)
FACE = np.zeros(SIZE, int)


@pytest.fixture(scope="module")
def kinect():
    return load_sensor("kinect-v2")


def _light(code, path, strength):
    """Correlations (P, H, W) of light that has come a way [mm]: strength (1 + m cos(2 pi f L / c - delta))."""
    frequency, delay, contrast = code.images()
    phase = 2 * math.pi * frequency / LIGHT_MM_S * path - delay
    return np.broadcast_to((strength * (1 + contrast * np.cos(phase)))[:, None, None], (code.count, *SIZE)).copy()


def test_an_amplitude_has_the_phase_of_its_path_and_contrast(kinect):
    code = kinect.pattern
    found = path_amplitudes(_light(code, 700.0, 3.0), code)[:, 0, 0]
    np.testing.assert_allclose(np.abs(found), 3 * code.contrasts, rtol=1e-9)
    turns = code.frequencies_hz / LIGHT_MM_S * 700
    np.testing.assert_allclose(np.exp(1j * np.angle(found)), np.exp(2j * math.pi * turns), atol=1e-9)


@pytest.mark.parametrize("share", [0.02, 0.2])
@pytest.mark.parametrize("longer", [10.0, 60.0])
def test_light_from_one_other_way_lengthens_the_path_between_the_two(kinect, share, longer):
    """To first order by share / (1 + share) of the way: every frequency says nearly the same."""
    code, levels = kinect.pattern, 5000.0
    direct, other = (
        path_amplitudes(_light(code, path, size), code) * levels
        for path, size in ((1200.0, 1.0), (1200.0 + longer, share))
    )
    found, refused, _ = path_bias(direct, other, code, kinect.settings, kinect.imager, FACE, 3)
    assert found == pytest.approx(np.full(SIZE, share / (1 + share) * longer), rel=0.02)
    assert not refused.any()


def test_light_from_far_away_makes_the_phases_disagree(kinect):
    """As strong as direct light and 3 m longer: no path fits 16, 80 and 120 MHz, and the decoder says so."""
    code = kinect.pattern
    direct, other = (path_amplitudes(_light(code, path, 1.0), code) * 5000 for path in (1200.0, 4200.0))
    _, refused, _ = path_bias(direct, other, code, kinect.settings, kinect.imager, FACE, 3)
    assert refused.all()


def test_without_direct_light_nothing_is_said(kinect):
    code = kinect.pattern
    direct, other = (path_amplitudes(_light(code, 1200.0, size), code) for size in (0.0, 1.0))
    found, refused, noisier = path_bias(direct, other, code, kinect.settings, kinect.imager, FACE, 3)
    assert not found.any() and not refused.any() and (noisier == 1).all()


def test_a_path_becomes_the_depth_at_which_light_has_come_so_far():
    rng = np.random.default_rng(1)
    ray = np.column_stack([rng.uniform(-0.4, 0.4, (50, 2)), np.ones(50)])
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    distance, lamp = rng.uniform(500, 900, 50), np.array([80.0, 5.0, 0.0])
    ideal = Ideal(
        np.arange(50), distance[:, None] * ray, ray, distance, ray, np.zeros(50, np.int16), np.zeros(50, np.uint8)
    )
    moved = range_bias(np.full(50, 0.01), lamp, ideal)

    def path(depth):
        return depth + np.linalg.norm(depth[:, None] * ray - lamp, axis=1)

    np.testing.assert_allclose(path(distance + moved) - path(distance), 0.01, rtol=1e-5)


def test_a_white_corner_is_lengthened_as_the_full_render_is(kinect):
    """A plate and a wall in matt white: what is predicted of few paths, and what is decoded without noise of many."""
    activate()
    from mitsim.scene.backend import mi

    white = {"type": "matt_white"}
    upright = mi.ScalarTransform4f().translate([0, 150, 150]).rotate([1, 0, 0], 90).scale([150, 150, 1])
    flat = mi.ScalarTransform4f().scale([150, 150, 1])
    scene = scene_from_dict(
        {
            "plate": {"type": "rectangle", "to_world": flat, "bsdf": white},
            "wall": {"type": "rectangle", "to_world": upright, "bsdf": white},
        },
        kinect.wavelength_nm,
    )
    pose, geometry = look_at([0, -600, 450], [0, 60, 20], [0, 0, 1]), sensor_geometry(kinect)
    predictor = Predictor.of_sensor(kinect, geometry)
    surfaces = predictor.surfaces(scene, pose)
    ideal = predictor.ideal(surfaces)
    predicted = InterreflectionEffect(kinect)(SceneView(scene, pose, surfaces, ideal)).displaced
    noise = Noise(**dict.fromkeys(Noise.__dataclass_fields__, False))
    sensor = replace(kinect, pattern=kinect.pattern.model_copy(update={"delay_pattern_mm": 0.0}))
    around = pose.inverse().points(np.array([[x, y, z] for x in (-60.0, 60) for y in (0, 150) for z in (0.0, 60)]))
    capture = SimulatedSensor(sensor).capture(
        scene, pose, rendering=Rendering(samples=64, depth=2), seed=1, around=around, noise=noise
    )
    cloud = capture_cloud(capture, sensor.settings, geometry, imager=sensor.imager)
    decoded = ((cloud.points.reshape(-1, 3)[ideal.pixel] - ideal.point) * ideal.ray).sum(axis=1)
    world = pose.points(ideal.point)
    seen = (ideal.status == Status.VALID) & np.isfinite(decoded) & (np.abs(world[:, 0]) < 40)
    means = []
    for low in range(40, 140, 20):
        here = seen & (ideal.shape == 0) & (world[:, 1] > low) & (world[:, 1] < low + 20)
        assert here.sum() > 100
        means.append((decoded[here].mean(), predicted[here].mean()))
    found, expected = np.array(means).T
    assert found.max() > 15 and found.min() < 0.7 * found.max()
    np.testing.assert_allclose(expected, found, rtol=0.1)


@pytest.mark.parametrize("share", [0.1, 0.5])
def test_light_that_comes_nearly_in_phase_makes_a_path_less_noisy(kinect, rng, share):
    """Taps are exposed 400 times: the amplitude grows by the share, the shot noise by its root."""
    code, imager, charge = kinect.pattern, kinect.imager, 40_000.0
    direct, other = _light(code, 1200.0, charge), _light(code, 1260.0, share * charge)
    amplitudes = [path_amplitudes(light, code) * imager.gain for light in (direct, other)]
    noisier = path_bias(*amplitudes, code, kinect.settings, imager, FACE, 3)[2]
    scatter = []
    for light in (direct, direct + other):
        seen = np.array([expose_taps(light, code, imager, None, Noise(), rng) for _ in range(400)])
        phases = np.angle(np.einsum("k,nfkij->nfij", np.exp(1j * code.delays), seen.reshape(400, 3, 3, *SIZE)))
        turns = code.frequencies_hz / LIGHT_MM_S * 2 * math.pi
        scatter.append(np.sqrt((phases.std(axis=0) ** 2).mean(axis=(1, 2)))[-1] / turns[-1])  # that of 120 MHz [mm]
    assert noisier.mean() == pytest.approx(scatter[1] / scatter[0], rel=0.03)
    one, both = (charge * (1 + part) + 2 * imager.read_noise**2 for part in (0, share))  # of both taps
    assert noisier.mean() == pytest.approx(math.sqrt(both / one) / (1 + share), rel=0.05)
