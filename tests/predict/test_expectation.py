"""What a disturbance, and the map's bias, do to expected points."""

import math

import numpy as np
import pytest

from characterisation.maps.noise_structure import noise_structure
from characterisation.maps.performance_map import PerformanceMap
from characterisation.maps.shipped import map_path
from mitsim.capture.cloud import sensor_geometry
from mitsim.predict import Predictor
from mitsim.predict.disturbance import Disturbance
from mitsim.predict.expectation import expected_points
from mitsim.scene.load import load_scene
from mitsim.sensor.frames import look_at
from mitsim.sensor.preset import load_sensor


def test_points_that_are_blinded_come_back_whatever_the_map_says(scenes):
    sensor = load_sensor("ensenso-n10")
    performance_map = PerformanceMap.load(map_path("ensenso-n10"))
    predictor = Predictor.of_sensor(sensor, sensor_geometry(sensor)).thinned(4)
    scene = load_scene(scenes / "two_pillars/two_pillars.xml", sensor.wavelength_nm)
    pose = look_at([0, -400, 300], [0, 0, 20], [0, 0, 1])
    surfaces = predictor.surfaces(scene, pose)
    ideal, labels = predictor.ideal(surfaces), predictor.labels(scene, pose, surfaces)
    many = np.ones(len(ideal.pixel))
    given = scene, scene.names.index("pillar1"), performance_map, pose
    plain = expected_points(ideal, labels, *given)
    moved = Disturbance(0.5 * many, 2 * many, 0 * many, 0.3 * many, 3 * many, 0.25 * many, 0.1 * many)
    found = expected_points(ideal, labels, *given, disturbance=moved)
    assert len(plain.fraction) > 50
    assert found.fraction == pytest.approx(plain.fraction * 0.5 * 0.75 + 0.25)
    assert found.fraction_error == pytest.approx(plain.fraction_error * 0.5 * 0.75)
    assert found.sigma == pytest.approx(np.hypot(2 * plain.sigma, 0.1))
    assert found.displaced == pytest.approx(3 + plain.displaced)
    assert found.persistent == pytest.approx(np.hypot(plain.persistent, 0.3))


@pytest.mark.parametrize(("name", "foretold"), [("ensenso-n10", False), ("david-sls-3", True), ("kinect-v2", False)])
def test_a_bias_of_flat_faces_counts_once(name, foretold, scenes):
    sensor, performance_map = load_sensor(name), PerformanceMap.load(map_path(name))
    predictor = Predictor.of_sensor(sensor, sensor_geometry(sensor)).thinned(4)
    assert predictor.foretells_bias is foretold
    scene = load_scene(scenes / "two_pillars/matt_white.xml", sensor.wavelength_nm)
    away = float(performance_map.data["distance"][1])
    pose = look_at([0, -0.8 * away, 0.6 * away], [0, 0, 20], [0, 0, 1])
    surfaces = predictor.surfaces(scene, pose)
    ideal, labels = predictor.ideal(surfaces), predictor.labels(scene, pose, surfaces)
    given = ideal, labels, scene, scene.names.index("plane"), performance_map, pose
    known = expected_points(*given)
    structure = noise_structure(performance_map, "matt_white", math.nan, known.distance, known.normal)
    assert np.abs(known.displaced).max() > 0
    assert known.displaced == pytest.approx(structure.bias_share * known.sigma)
    assert not expected_points(*given, biased=False).displaced.any()
