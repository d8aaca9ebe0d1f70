"""The exposures that a user sets in a room: no matt white plate saturates by light of the room."""

import math

import numpy as np
import pytest

from mitsim.sensor.modulation import expose_taps
from mitsim.sensor.noise_sources import Noise
from mitsim.sensor.preset import load_sensor
from mitsim.sensor.room_light import exposures_in_room, room_irradiance


@pytest.fixture(scope="module")
def zivid():
    return load_sensor("zivid-2-m70")


def shown(sensor, exposures, distance_mm, irradiance):
    """Return the share of full scale of a matt white plate under projector and room.

    By the sensor's rule: 45 % at 700 mm. The room adds in the ratio of the irradiances on the plate.
    """
    by_projector = 0.45 * (700 / distance_mm) ** 2 * exposures[0] / sensor.exposure.base_s
    return by_projector * (1 + irradiance * distance_mm**2 / sensor.projector.plane_irradiance)


def test_bright_rooms_shorten_the_exposure_until_a_white_plate_does_not_saturate(zivid):
    own = zivid.exposure.exposures(None, zivid.imager.full_well)
    for illuminance in (2000.0, 5000.0):
        irradiance = room_irradiance(illuminance, 0.2, zivid.wavelength_nm, 300.0)
        for distance in (560.0, 700.0, 1100.0):
            set_here = exposures_in_room(zivid, own, distance, irradiance)
            assert shown(zivid, own, distance, irradiance) > 0.9  # the rule's exposure is too long here
            assert shown(zivid, set_here, distance, irradiance) == pytest.approx(0.9)


def test_the_rule_of_the_sensor_holds_where_nothing_saturates(zivid):
    own = zivid.exposure.exposures(None, zivid.imager.full_well)
    assert exposures_in_room(zivid, own, 560.0, 0.0) == own
    assert exposures_in_room(zivid, own, 1100.0, room_irradiance(500.0, 0.2, zivid.wavelength_nm, 300.0)) == own


def test_a_plate_that_is_too_near_in_the_dark_becomes_no_darker_in_a_room(zivid):
    own = zivid.exposure.exposures(None, zivid.imager.full_well)
    irradiance = room_irradiance(1500.0, 0.2, zivid.wavelength_nm, 300.0)
    set_here = exposures_in_room(zivid, own, 400.0, irradiance)
    assert shown(zivid, set_here, 400.0, irradiance) == pytest.approx(shown(zivid, own, 400.0, 0.0))


def test_every_exposure_of_a_bracket_is_shortened_alike(zivid):
    own = zivid.exposure.exposures(None, zivid.imager.full_well)[0]
    both = exposures_in_room(zivid, (own, 4 * own), 700.0, room_irradiance(5000.0, 0.2, zivid.wavelength_nm, 300.0))
    assert math.isclose(both[1], 4 * both[0]) and both[0] < own


@pytest.mark.parametrize("distance", [600.0, 800.0])
def test_time_of_flight_fills_the_fuller_of_its_two_taps(distance):
    """Of a plate by daylight the simulated taps are full just above the exposure over 0.9."""
    kinect = load_sensor("kinect-v2")
    own, code = kinect.exposure.exposures(None, kinect.imager.full_well), kinect.pattern
    radiance = 0.85 / np.pi * kinect.projector.plane_irradiance / distance**2
    frequencies, delays, contrasts = code.images()
    turns = np.linspace(0, 1, 4001) * 2 * np.pi * frequencies[:, None] / 16e6
    light = radiance * (1 + contrasts[:, None] * np.cos(turns - delays[:, None]))[:, None]
    room = room_irradiance(60000.0, 1.0, kinect.wavelength_nm, 40.0)

    def saturates(seconds):
        correlations = (light + 0.85 / np.pi * room) * kinect.electrons() * seconds
        levels = expose_taps(correlations, code, kinect.imager, None, Noise.only("quantisation"), None)
        return (levels == 2**kinect.imager.bits - 1).any()

    (set_here,) = exposures_in_room(kinect, own, distance, room)
    assert set_here < own[0]
    assert not saturates(0.999 * set_here / 0.9) and saturates(1.001 * set_here / 0.9)
