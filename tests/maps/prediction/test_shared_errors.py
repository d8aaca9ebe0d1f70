"""Errors that features share: closed forms of one wrong length, and the decoder's own geometry with a moved rig."""

import numpy as np
import pytest

from mitsim.maps.prediction.shared_errors import SharedErrors, independent_fields, terms
from mitsim.sensor.preset import load_sensor
from mitsim.sensor.preset_covariance import preset_covariance
from mitsim.sensor.rig_parameters import moved, path_error
from mitsim.study.calibration.accuracy import measured_points

RNG = np.random.default_rng(5)


def _places(sensor, count=400):
    near, far = sensor.working_range_mm
    depth = RNG.uniform(near, min(far, 2 * near), count)
    camera = sensor.rig.reference
    half = 0.4 * np.array([camera.width / camera.matrix[0, 0], camera.height / camera.matrix[1, 1]])
    return np.column_stack([RNG.uniform(-1, 1, (count, 2)) * half, np.ones(count)]) * depth[:, None]


def test_causes_that_move_points_alike_are_one_field():
    points = RNG.uniform(-100, 100, (200, 3)) + np.array([0, 0, 600])
    push = np.tile([0.0, 0.0, 1.0], (200, 1))
    found = independent_fields(points, np.stack([3 * push, 4 * push, np.zeros_like(push)]))
    assert len(found.coefficients) == 1
    np.testing.assert_allclose(np.abs(terms(points) @ found.coefficients[0]), 5 * push, atol=1e-9)


def test_no_cause_is_no_field():
    points = RNG.uniform(-100, 100, (50, 3)) + np.array([0, 0, 600])
    found = independent_fields(points, np.zeros((2, 50, 3)))
    assert found.along(points, points, points).shape == (50, 0)


def test_a_shift_counts_along_the_ray_by_what_it_moves_across_the_face():
    """A face at 60 deg to the ray that moves by 1 mm along its normal lies 2 mm farther along the ray."""
    points = np.array([[0.0, 0.0, 500.0]])
    normal = np.array([[np.sqrt(0.75), 0.0, -0.5]])
    shift = np.zeros((1, 30, 3))
    shift[0, 0] = -normal[0]  # the first term is 1
    found = SharedErrors(shift).along(points, np.array([[0.0, 0.0, 1.0]]), normal)
    assert found == pytest.approx(2.0)


@pytest.mark.parametrize("name", ["ensenso-n10", "zivid-2-m70", "kinect-v2"])
def test_the_spread_is_that_of_points_decoded_with_drawn_rigs(name):
    """Variance of each place over 400 drawn rigs, against the sum of squares of the fields; 1/sqrt(800) of noise."""
    sensor = load_sensor(name)
    covariance = preset_covariance(sensor)
    points = _places(sensor)
    nominal = measured_points(sensor, points, sensor.rig)

    def moves(values):
        rig = moved(sensor.rig, covariance.names, values)
        return measured_points(sensor, points, rig, path_error(covariance.names, values)) - nominal

    values, vectors = np.linalg.eigh(covariance.correlation)
    root = covariance.one_sigma[:, None] * vectors * np.sqrt(np.clip(values, 0, None))
    fields = independent_fields(points, np.array([moves(column) for column in root.T]))
    rng = np.random.default_rng(2)
    drawn = np.array([moves(covariance.draw(rng)) for _ in range(400)])
    found = np.sqrt(((terms(points) @ fields.coefficients) ** 2).sum(axis=(0, 2)))
    known = np.sqrt((drawn**2).sum(axis=2).mean(axis=0))
    assert np.median(found / known) == pytest.approx(1.0, abs=0.08)
    np.testing.assert_allclose(found, known, rtol=0.25)
