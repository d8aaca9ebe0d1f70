"""Lengths and flatness of drawn rigs: closed forms of stereo, the decoders' own geometry, drift."""

from __future__ import annotations

import numpy as np
import pytest

from characterisation.files.errors import InputError
from mitsim.decoding.structured_light.geometry import structured_light_geometry
from mitsim.decoding.structured_light.newton_polynomial import evaluate
from mitsim.sensor.drift import Drift, drift_modes
from mitsim.sensor.preset import load_sensor, presets
from mitsim.sensor.preset_covariance import with_drift
from mitsim.sensor.rig_covariance import RigCovariance
from mitsim.sensor.rig_parameters import moved, parameter_names, parameter_values
from mitsim.sensor.unknowns import CalibrationUnknowns
from mitsim.study.calibration import virtual_calibration
from mitsim.study.calibration.accuracy import accuracy, measured_points, measuring_volume
from mitsim.study.calibration.board import seen_by_all
from mitsim.study.calibration.virtual_calibration import calibrate
from mitsim.study.virtual.study_unknowns import calibration_covariance
from tests.smaller_sensors import binned


def some_points(sensor, rng, count=200):
    volume = measuring_volume(sensor.measuring_eyes, sensor.working_range_mm)
    return volume.points(rng.uniform(-0.9, 0.9, (count, 3)))


@pytest.mark.parametrize("name", presets())
def test_the_nominal_rig_measures_what_is_there(name, rng):
    sensor = load_sensor(name)
    points = some_points(sensor, rng)
    assert seen_by_all(points, sensor.measuring_eyes).all()
    assert np.abs(measured_points(sensor, points, sensor.rig) - points).max() < 2e-3  # rectification's own rays


def test_vergence_moves_depth_by_the_law_of_stereo(rng):
    """dZ = Z^2 delta / B on the axis of a parallel pair: the closed form."""
    sensor = load_sensor("realsense-d435")
    points = np.array([[0.0, 0.0, z] for z in (300.0, 600.0, 1200.0)])
    delta = 1e-4
    true = moved(sensor.rig, ["right.rotation_y_rad"], [delta])
    error = measured_points(sensor, points, true)[:, 2] - points[:, 2]
    # a right camera that turns toward +x sees the point farther left, at a larger disparity: nearer
    across = 1 + (50.0 / points[:, 2]) ** 2
    assert np.allclose(error, -(points[:, 2] ** 2) * delta * across / 50.0, rtol=5e-3)


def test_baseline_error_scales_all_lengths(n10, rng):
    eyes = n10.measuring_eyes
    place = n10.rig.cameras["right"].centre
    names = tuple(f"right.position_{axis}_mm" for axis in "xyz")
    scale = 1e-3
    found = accuracy(n10, eyes, RigCovariance(names, scale**2 * np.outer(place, place), "a test"), 20, rng)
    share = found.bars / found.lengths
    assert np.allclose(share, share[:, :1], rtol=1e-3, atol=1e-9)  # a true rig that is larger reads shorter
    assert found.numbers()["sphere_spacing_relative"] == pytest.approx(np.sqrt(np.mean(share[:, 0] ** 2)), rel=1e-3)
    assert found.flatness.max() < 1e-6
    assert 0.4 < share.std() / scale < 1.8


def test_a_code_is_triangulated_as_the_decoder_does(rng):
    sensor = binned(load_sensor("david-sls-3"), 3)
    true = moved(sensor.rig, ["projector.rotation_y_rad", "projector.focal_x_px", "projector.k1"], [2e-4, 0.5, 1e-3])
    camera = sensor.rig.reference
    geometry = structured_light_geometry(sensor.rig, "camera", sensor.pattern, 350, 700)
    rows, columns = rng.integers(100, 300, 50), rng.integers(170, 460, 50)
    rays = camera.rays(np.stack([columns, rows], axis=-1).astype(float))
    points = rays / rays[:, 2:] * rng.uniform(400, 600, (50, 1))
    points = points[seen_by_all(points, sensor.measuring_eyes)]
    kept = np.rint(camera.project(points)).astype(int)
    u = true.projector.project(points)[:, 0]
    inverse, _ = evaluate(*(each[:, kept[:, 1], kept[:, 0]] for each in (geometry.nodes, geometry.differences)), u)
    decoded = geometry.ray[kept[:, 1], kept[:, 0]] / inverse[:, None]
    assert len(points) > 20
    assert np.abs(measured_points(sensor, points, true) - decoded).max() < 1e-3
    assert np.abs(decoded - points).max() > 0.05  # and the true rig is another


def test_time_of_flight_has_its_offset_along_the_ray(rng):
    sensor = load_sensor("kinect-v2")
    points = some_points(sensor, rng)
    found = measured_points(sensor, points, sensor.rig, (3.0, 0.01))
    assert np.allclose(np.linalg.norm(found, axis=1), 3 + 1.01 * np.linalg.norm(points, axis=1))


def test_a_row_error_moves_rows_by_the_focal_length_and_no_depth(n10):
    names = parameter_names(n10.rig, projector=False)
    modes = {mode.name: mode for mode in drift_modes(n10.rig, names, Drift())}
    assert set(modes) == {
        "focal length of left",
        "focal length of right",
        "vergence of right",
        "row error of right",
        "roll of right",
        "baseline to right",
    }
    right = n10.rig.cameras["right"]
    point = right.sensor_from_camera.points(np.array([0.0, 0.0, 600.0]))
    turned = moved(
        n10.rig,
        list(modes["row error of right"].step),
        np.array(list(modes["row error of right"].step.values())) * 1e-4,
    )
    shift = turned.cameras["right"].project(point) - right.project(point)
    assert shift == pytest.approx([0, 1e-4 * right.matrix[1, 1]], abs=1e-4)
    longer = moved(
        n10.rig, list(modes["baseline to right"].step), np.array(list(modes["baseline to right"].step.values())) * 1e-3
    )
    assert np.linalg.norm(longer.cameras["right"].centre) == pytest.approx(1.001 * np.linalg.norm(right.centre))


def test_drift_adds_to_a_covariance(n10):
    names = parameter_names(n10.rig, projector=False)
    nothing = RigCovariance(names, np.zeros((len(names),) * 2), "one-sigma figures")
    assert not with_drift(nothing, n10, Drift.none()).covariance.any()
    found = with_drift(nothing, n10, Drift(vergence_mrad=0.3, row_mrad=0.0, roll_mrad=0.2, focal_relative=1e-3))
    sigma = dict(zip(names, found.one_sigma, strict=True))
    assert sigma["right.rotation_y_rad"] == pytest.approx(3e-4, rel=0.01)
    assert sigma["right.rotation_z_rad"] == pytest.approx(2e-4)
    assert sigma["left.focal_x_px"] == pytest.approx(0.62618) and sigma["left.k1"] == 0
    assert sigma["right.position_x_mm"] == pytest.approx(100.775 * 5 * 23e-6)
    assert "vergence_mrad 0.3" in found.source
    with pytest.raises(InputError, match=r"drift: roll_mrad.*0 or more"):
        Drift(roll_mrad=-1)


def test_parameters_that_a_covariance_does_not_name_drift_all_the_same(n10, tmp_path):
    def one_sigma(sensor, parameter):
        (nominal,) = parameter_values(sensor.rig, [parameter])
        file = f'source = "own"\n[one_sigma]\n"{parameter}" = 0.0\n[nominal]\n"{parameter}" = {nominal}\n'
        (tmp_path / "own.toml").write_text(file)
        table = CalibrationUnknowns(covariance="own.toml", row_mrad=0, roll_mrad=0, focal_relative=0)
        return calibration_covariance(sensor, table, tmp_path)

    turning = one_sigma(n10, "right.position_x_mm")
    ends = np.array([[-50.0, 0, 600], [150, 0, 600]])
    step = dict(zip(turning.names, turning.one_sigma, strict=True))
    (first, second) = measured_points(n10, ends, moved(n10.rig, list(step), list(step.values())))
    # an angle e between the eyes moves a depth z by z^2 e / b, and a length by z e / b of it
    expected = 200 * 600 * 0.24e-3 / 100.775
    assert abs(np.linalg.norm(second - first) - 200) == pytest.approx(expected, rel=0.05)
    later = one_sigma(load_sensor("kinect-v2"), "path.scale")
    assert later.one_sigma[later.names.index("path.offset_mm")] == pytest.approx(1.0)


def test_the_same_seed_gives_the_same_calibration(monkeypatch):
    monkeypatch.setattr(virtual_calibration, "_DRAWS", 20)
    one, other, third = (calibrate(load_sensor("kinect-v2"), poses=8, seed=seed) for seed in (3, 3, 4))
    assert np.array_equal(one.covariance.covariance, other.covariance.covariance)
    assert one.covariance.details == other.covariance.details
    assert not np.array_equal(one.covariance.covariance, third.covariance.covariance)
    assert one.covariance.names[-2:] == ("path.offset_mm", "path.scale")
    with pytest.raises(InputError, match="--poses"):
        calibrate(load_sensor("kinect-v2"), poses=3)
