"""What a perturbation, and the map's bias, do to expected points."""

import math

import numpy as np
import pytest

from characterisation.maps.noise_structure import noise_structure
from characterisation.maps.performance_map import PerformanceMap
from characterisation.maps.shipped import map_path
from mitsim.decoding.cloud import sensor_geometry
from mitsim.maps.prediction import Predictor
from mitsim.maps.prediction.perturbation import Perturbation, together
from mitsim.maps.prediction.point_statistics import ViewPoints, expected_points
from mitsim.scene.load import load_scene
from mitsim.sensor.preset import load_sensor
from mitsim.sensor.transforms import look_at


def test_a_perturbation_changes_what_the_map_says(scenes):
    ideal, given, plain = white_view("ensenso-n10", scenes, "pillar1")
    many = np.ones(len(ideal.pixel))
    shared = np.stack([0.1 * many, 0.2 * many], axis=1)
    moved = Perturbation(0.5 * many, 2 * many, 3 * many, 0.3 * many, shared)
    found = expected_points(*given, perturbation=moved)
    assert 50 < len(plain.fraction) < len(plain.shown)  # also pixels next to an edge show the pillar
    assert found.fraction == pytest.approx(0.5 * plain.fraction)
    assert found.fraction_error == pytest.approx(0.5 * plain.fraction_error)
    assert found.sigma == pytest.approx(np.hypot(2 * plain.sigma, 0.3))
    assert found.displaced == pytest.approx(3 + plain.displaced)
    np.testing.assert_allclose(found.shared, np.tile([0.1, 0.2], (len(found.fraction), 1)))
    np.testing.assert_array_equal(found.persistent, plain.persistent)


@pytest.mark.parametrize("kept", [0.65, 0.1])
def test_points_that_are_lost_make_means_noisier(scenes, kept):
    """The variance of the mean of independent points is that of the number that is left; it was kept times as large."""
    ideal, given, plain = white_view("kinect-v2", scenes, "pillar1")
    many, none = np.ones(len(ideal.pixel)), np.zeros(len(ideal.pixel))
    found = expected_points(*given, perturbation=Perturbation(kept * many, many, none, none, np.zeros((len(many), 0))))
    rng, left = np.random.default_rng(2), 400 * found.fraction.mean()
    means = [rng.standard_normal(rng.binomial(400, left / 400) or 1).mean() for _ in range(4000)]
    correlated = plain.area - 1 / plain.fraction  # what neighbours have in common stays
    of_means = (np.var(means) * 400 + correlated).mean()
    assert found.area.mean() == pytest.approx(of_means, rel=0.1)


def test_two_perturbations_are_one():
    some = np.array([0.5, 1.0])
    first = Perturbation(some, 2 * some, 3 * some, 3 * some, np.zeros((2, 1)))
    second = Perturbation(some, some, some, 4 * some, np.ones((2, 2)))
    both = together([first, second], 2)
    np.testing.assert_allclose(both.kept, [0.25, 1])
    np.testing.assert_allclose(both.noisier, [0.5, 2])
    np.testing.assert_allclose(both.displaced, [2, 4])
    np.testing.assert_allclose(both.scattered, [2.5, 5])
    np.testing.assert_array_equal(both.shared, [[0, 1, 1]] * 2)


@pytest.mark.parametrize("name", ["ensenso-n10", "david-sls-3", "kinect-v2"])
def test_the_bias_of_flat_faces_is_the_map_s(name, scenes):
    _, given, known = white_view(name, scenes, "plane")
    structure = noise_structure(given[3], "matt_white", math.nan, known.distance, known.normal)
    assert np.abs(known.displaced).max() > 0
    assert known.displaced == pytest.approx(structure.bias_share * known.sigma)


def white_view(name, scenes, shape):
    sensor, performance_map = load_sensor(name), PerformanceMap.load(map_path(name))
    predictor = Predictor.of_sensor(sensor, sensor_geometry(sensor)).thinned(4)
    scene = load_scene(scenes / "two_pillars/matt_white.xml", sensor.wavelength_nm)
    away = float(performance_map.data["distance"][1])
    pose = look_at([0, -0.8 * away, 0.6 * away], [0, 0, 20], [0, 0, 1])
    surfaces = predictor.surfaces(scene, pose)
    ideal, labels = predictor.ideal(surfaces), predictor.labels(scene, pose, surfaces)
    given = ViewPoints(ideal, labels, pose), scene, scene.names.index(shape), performance_map
    return ideal, given, expected_points(*given)


def test_an_error_of_f_that_a_map_cannot_know_is_not_0(scenes):
    """A map of the nearest and farthest distance alone: F of the whole map lies within twice the stated error.

    Before, the error of F between two distances, which is unknown, counted as 0.
    """
    _, given, whole = white_view("ensenso-n10", scenes, "pillar1")
    ends = PerformanceMap(given[3].data.isel(distance=[0, -1]))
    found = expected_points(*given[:3], ends, *given[4:])
    off = np.abs(found.fraction - whole.fraction)
    assert off.max() > 1e-3
    assert np.mean(off <= 2 * found.fraction_error) > 0.95
