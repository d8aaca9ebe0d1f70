"""A process prepares a sensor once, and never mistakes it for another one."""

from dataclasses import replace

import numpy as np
import pytest

from mitsim.capture.simulated import render
from mitsim.maps.campaign.orders import prepared_sensor
from mitsim.sensor.sensor_file import MisalignmentTable, RoomTable


def changes(sensor):
    nudged = np.nextafter(sensor.rig.reference.matrix, np.inf)
    camera = replace(sensor.rig.reference, matrix=nudged)
    name = next(iter(sensor.rig.cameras))
    return {
        "smoothing": {"imager": replace(sensor.imager, smoothing_px=0.7)},
        "room": {"room": RoomTable(irradiance_w_mm2=1e-7)},
        "misalignment": {"misalignment": MisalignmentTable(row_mrad=1.0)},
        "notes": {"notes": ("another",)},
        "last digit": {"rig": replace(sensor.rig, cameras={**sensor.rig.cameras, name: camera})},
    }


@pytest.mark.parametrize("change", ["smoothing", "room", "misalignment", "notes", "last digit"])
def test_a_sensor_that_differs_anywhere_is_prepared_anew(n10, change):
    other = replace(n10, **changes(n10)[change])
    assert prepared_sensor(n10).sensor is n10
    assert prepared_sensor(other).sensor is other
    assert render.simulated_sensor(n10).sensor is n10
    assert render.simulated_sensor(other).sensor is other


def test_an_equal_sensor_is_prepared_once(n10):
    prepared = prepared_sensor(n10)
    assert prepared_sensor(replace(n10)) is prepared
    assert prepared.simulated is render.simulated_sensor(replace(n10))
