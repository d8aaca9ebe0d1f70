"""The automatic exposure of a time-of-flight sensor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.scene.test_targets import plate
from mitsim.sensor.exposure import ExposurePolicy
from mitsim.sensor.noise_sources import Noise
from mitsim.sensor.preset import load_sensor
from mitsim.sensor.sensor_file import AutomaticExposure
from mitsim.sensor.transforms import look_at


@pytest.mark.parametrize("distance", [1000.0, 3000.0])
def test_an_automatic_exposure_fills_a_tap(distance):
    """At the level 1 and 90 %, a tenth of all pixels has a full tap, and so a level at full scale."""
    kinect = load_sensor("kinect-v2")
    rule = AutomaticExposure(rule="automatic", percentile=90, level=1.0, limits_s=(1e-6, 1.0))
    policy = ExposurePolicy("automatic", None, rule, None, rule.limits_s)
    pose = look_at([0, 0, distance], [0, 0, 0], [0, 1, 0])
    capture = SimulatedSensor(replace(kinect, exposure=policy)).capture(
        plate(4 * distance, "matt white", 860), pose, seed=1, noise=Noise.none()
    )
    full = (capture.images["depth"] == 2**capture.bits - 1).any(axis=0)
    assert np.mean(full) == pytest.approx(0.1, abs=1e-3)
