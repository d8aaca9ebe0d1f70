"""The shot noise of dark current, in the sigma of clouds as in their scatter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.decoding.cloud import capture_cloud, sensor_geometry
from mitsim.decoding.coded_images import decoded_once
from mitsim.scene.test_targets import plate
from mitsim.sensor.preset import load_sensor
from mitsim.sensor.transforms import look_at


@pytest.mark.parametrize(("name", "dark_current"), [("kinect-v2", 1e7), ("david-sls-3", 1e6)])
def test_sigma_has_the_noise_of_dark_current(name, dark_current):
    """Of 1e7 e-/s repeats of kinect-v2 scatter 1.37 times as much as without; a warm imager, in 3 ms."""
    sensor = load_sensor(name)
    sensor = replace(sensor, imager=replace(sensor.imager, dark_current=dark_current))
    distance = float(np.sqrt(np.prod(sensor.working_range_mm)))
    corners = np.array([[x, y, distance] for x in (-0.03, 0.03) for y in (-0.03, 0.03)]) * [distance, distance, 1]
    simulated, geometry = SimulatedSensor(sensor), sensor_geometry(sensor)
    target = plate(0.3 * distance, "matt white", sensor.wavelength_nm)
    light = simulated.light(target, look_at([0, 0, distance], [0, 0, 0], [0, 1, 0]), seed=1, around=corners)
    captures = [simulated.expose(light, seed) for seed in range(20, 32)]
    clouds = [capture_cloud(one, sensor.settings, geometry, imager=sensor.imager) for one in captures]
    distances, sigma = (np.array(values) for values in zip(*((c.points[..., 2], c.sigma) for c in clouds), strict=True))
    there = np.isfinite(distances).all(axis=0)
    assert there.sum() > 500
    # the rays are within 3 deg of the axis: a depth scatters as a distance does
    scatter = np.sqrt(distances[:, there].var(axis=0, ddof=1).mean())
    assert scatter == pytest.approx(np.sqrt((sigma[:, there] ** 2).mean()), rel=0.03)
    # another way to decode has the same sigma: it is not counted twice
    again = decoded_once(captures[0], sensor.settings, sensor.imager, geometry)[0]
    np.testing.assert_array_equal(again.sigma, clouds[0].sigma)
