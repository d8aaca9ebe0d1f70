"""The checksum that tells whether a map is of a sensor as it is now."""

from pathlib import Path

import numpy as np

import characterisation
from characterisation import PerformanceMap
from mitsim.sensor.preset import load_sensor
from mitsim.sensor.sensor_text import sensor_checksum


def test_how_a_caller_prints_arrays_does_not_change_a_sensor():
    sensor = load_sensor("ensenso-n10")
    before = sensor_checksum(sensor)
    taste = {"suppress": True, "linewidth": 200, "sign": "+", "formatter": {"float": "{:.1f}".format}}
    with np.printoptions(precision=2, **taste):
        assert sensor_checksum(sensor) == before


def test_every_shipped_map_is_of_its_preset_as_it_is_now():
    shipped = Path(characterisation.__file__).parent.glob("maps/*.nc")
    maps = {file.stem: PerformanceMap.load(file).data.attrs["sensor_checksum"] for file in shipped}
    assert len(maps) >= 9
    assert maps == {name: sensor_checksum(load_sensor(name)) for name in maps}
