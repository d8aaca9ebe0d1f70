"""A drawn rig that is rendered, and decoded with the nominal one, errs as the accuracy of calibrations says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mitsim.capture.simulated.rendering import Rendering
from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.decoding.cloud import capture_cloud, sensor_geometry
from mitsim.maps.campaign.plan import coupon_pose
from mitsim.scene.test_targets import plate
from mitsim.sensor.noise_sources import Noise
from mitsim.sensor.preset import load_sensor
from mitsim.sensor.preset_covariance import preset_covariance
from mitsim.sensor.rig_parameters import moved
from mitsim.sensor.transforms import Transform
from mitsim.study.calibration.accuracy import measured_points
from tests.smaller_sensors import middle_part, narrow_search


@pytest.mark.parametrize(
    ("name", "part", "floor_mm"), [("david-sls-3", (560, 560), 0.005), ("ensenso-n35", (540, 340), 0.03)]
)
def test_rendered_plates_come_out_where_drawn_rigs_put_them(name, part, floor_mm):
    """Without noise; ``floor_mm`` is what code and decoder leave on such a plate with the right rig."""
    covariance = preset_covariance(load_sensor(name))  # of deviations, which a part of the image shares
    sensor = middle_part(load_sensor(name), *part)
    true = moved(sensor.rig, covariance.names, covariance.draw(np.random.default_rng(5)))
    assert true.projector is not None
    rendered = replace(sensor, rig=true, projector=replace(sensor.projector, optics=true.projector))
    distance = float(np.sqrt(np.prod(sensor.working_range_mm)))
    searched = sensor if sensor.matcher is None else narrow_search(sensor, 0.9 * distance, 1.1 * distance)
    size = 0.2 * distance
    pose = coupon_pose(np.array([0.12, 0.09, 0.99]), distance, sensor.rig.reference.sensor_from_camera.rotation[:, 2])
    pose = Transform(pose.rotation, pose.translation + sensor.rig.reference.centre)
    grid = np.linspace(-0.35, 0.35, 9) * size
    x, y = np.meshgrid(grid, grid)
    places = pose.points(np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=-1))
    geometry, offsets = sensor_geometry(sensor), []
    for one, rig in ((sensor, sensor.rig), (rendered, true)):
        capture = SimulatedSensor(one).capture(
            plate(size, "matt white", sensor.wavelength_nm),
            pose.inverse(),
            rendering=Rendering(samples=16, depth=1),
            seed=1,
            around=pose.points(size * np.array([[a, b, 0.0] for a in (-0.5, 0.5) for b in (-0.5, 0.5)])),
            noise=Noise.none(),
        )
        cloud = capture_cloud(capture, searched.settings, geometry)
        points = pose.inverse().points(cloud.points[cloud.valid].astype(float))
        points = points[(np.abs(points[:, :2]) < 0.42 * size).all(axis=1) & (np.abs(points[:, 2]) < 0.03 * distance)]
        assert len(points) > 2000
        # the decoded surface as a paraboloid over the plate, and where single ideal points come out
        terms = [points[:, 0] ** i * points[:, 1] ** j for i in range(3) for j in range(3 - i)]
        weights = np.linalg.lstsq(np.stack(terms, axis=1), points[:, 2], rcond=None)[0]
        ideal = pose.inverse().points(measured_points(sensor, places, rig))
        surface = np.stack([ideal[:, 0] ** i * ideal[:, 1] ** j for i in range(3) for j in range(3 - i)], axis=1)
        offsets.append((ideal[:, 2], surface @ weights))
    (nothing, floor), (predicted, seen) = offsets
    assert np.abs(nothing).max() < 1e-6
    shift = seen - floor
    assert np.abs(predicted).max() > 5 * floor_mm
    assert np.abs(shift - predicted).max() < floor_mm
    print(
        f"{name}: plate off by {predicted.mean():.4f} mm; rendered and decoded {shift.mean():.4f} mm, "
        f"worst difference {np.abs(shift - predicted).max():.4f} mm"
    )
