"""The checksum that tells whether a map is of a sensor as it is now."""

import numpy as np

from mitsim.maps.campaign.plan import sensor_checksum
from mitsim.sensor.preset import load_sensor


def test_how_a_caller_prints_arrays_does_not_change_a_sensor():
    sensor = load_sensor("ensenso-n10")
    before = sensor_checksum(sensor)
    taste = {"suppress": True, "linewidth": 200, "sign": "+", "formatter": {"float": "{:.1f}".format}}
    with np.printoptions(precision=2, **taste):
        assert sensor_checksum(sensor) == before
