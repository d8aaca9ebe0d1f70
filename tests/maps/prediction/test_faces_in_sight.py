"""Which faces of a view see others, against form factors in closed form."""

import numpy as np
import pytest

from mitsim.decoding.cloud import sensor_geometry
from mitsim.maps.prediction import Predictor
from mitsim.maps.prediction.faces_in_sight import faces_in_sight, in_words
from mitsim.scene.load import scene_from_dict
from mitsim.scene.ray_casting.self_view import seen_faces
from mitsim.sensor.preset import load_sensor
from mitsim.sensor.transforms import look_at

pytestmark = pytest.mark.usefixtures("no_other_scenes")

WHITE = {"type": "matt_white"}


def scene_of(shapes):
    sensor = load_sensor("ensenso-n10")
    return scene_from_dict({name: one | {"bsdf": WHITE} for name, one in shapes.items()}, sensor.wavelength_nm), sensor


def placed(scale, rotate=None, shift=(0, 0, 0)):
    from mitsim.scene.backend import activate, mi

    activate()
    at = mi.ScalarTransform4f().translate(list(shift))
    return (at.rotate([0, 1, 0], rotate) if rotate else at).scale(scale)


def shares(shapes, position):
    scene, sensor = scene_of(shapes)
    return faces_in_sight(
        Predictor.of_sensor(sensor, sensor_geometry(sensor)), scene, look_at(position, [0, 0, 0], [0, 1, 0])
    )


def test_a_single_plate_sees_nothing():
    plate = {"plate": {"type": "rectangle", "to_world": placed(100)}}
    assert shares(plate, [0, -200, 500]) == {}
    assert in_words({}) == ""


def test_a_plate_beside_a_wall_sees_it():
    wall = {"type": "rectangle", "to_world": placed([60, 100, 1], 90.0, (-100, 0, 60))}  # it faces +x
    found = shares({"plate": {"type": "rectangle", "to_world": placed(100)}, "wall": wall}, [250, 0, 450])
    assert set(found) == {"plate", "wall"} and 0.05 < found["plate"] < 0.5
    assert "plate" in in_words(found) and "map of flat coupons" in in_words(found)


@pytest.mark.parametrize("radius, height", [(50.0, 100.0), (80.0, 60.0)])
def test_the_diffuse_share_is_the_form_factor_of_a_disc(radius, height):
    """A small face below a parallel disc of radius R at height h sees it with R^2 / (R^2 + h^2)."""
    disc = {"type": "disk", "to_world": placed(radius, 180.0, (0, 0, height))}
    scene, _ = scene_of({"disc": disc})
    count = 20_000
    up, down = np.tile([0.0, 0.0, 1.0], (count, 1)), np.tile([0.0, 0.0, -1.0], (count, 1))
    seen = seen_faces(scene, np.zeros((count, 3)), up, down).mean(axis=0)
    expected = radius**2 / (radius**2 + height**2)
    assert abs(seen[0] - expected) < 4 * np.sqrt(expected * (1 - expected) / count) + 0.01  # the start is 0.3 % off
    assert seen[1] == 1.0  # the mirrored view ray, straight up, and 20 deg about it, meet the disc
