"""The exposures that a user sets in a room: no matt white plate saturates by light of the room."""

import math

import pytest

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
