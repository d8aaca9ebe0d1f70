"""Captures of a surface that stands outside the range of the decoder, and captures that no warning is for."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from characterisation.region_of_interest import Roi
from mitsim.capture.capture import Capture
from mitsim.capture.decoding import Decoding
from mitsim.capture.folder import write_capture
from mitsim.capture.simulated.rendering import Rendering
from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.cli.program import app
from mitsim.decoding.cloud import capture_cloud
from mitsim.decoding.depth_range import _coarse_capture, depths_of, neighbour_agreement, surface_beyond
from mitsim.maps.campaign.plan import coupon_pose
from mitsim.scene.test_targets import plate
from mitsim.sensor.camera import stereo_rectification
from mitsim.sensor.preset import load_sensor
from mitsim.sensor.transforms import Transform
from tests.smaller_sensors import middle_part

NAMES = ["ensenso-n10", "david-sls-3", "kinect-v2"]


def middle_of(sensor):
    return float(np.sqrt(np.prod(sensor.working_range_mm)))


@pytest.fixture(scope="module")
def strip():
    """The N10's middle 140 rows: all of a row is searched."""
    return middle_part(load_sensor("ensenso-n10"), 752, 140)


@pytest.fixture(scope="module", params=NAMES)
def taken(request, strip):
    """A preset, and its capture of a plate that fills most of the image.

    Of one camera its middle 300 x 240 pixels, of two their middle 140 rows.
    """
    sensor = strip if request.param == strip.name else middle_part(load_sensor(request.param), 300, 240)
    distance = middle_of(sensor)
    pose = coupon_pose(np.array([0.1, 0.0, 0.995]), distance, np.array([0, 0, 1.0]))
    scene = plate(0.6 * distance, "matt white", sensor.wavelength_nm)
    return sensor, SimulatedSensor(sensor).capture(scene, pose.inverse(), rendering=Rendering(samples=4), seed=3)


def test_a_surface_nearer_or_farther_than_the_range_is_found(taken):
    sensor, capture = taken
    middle, shares = middle_of(sensor), []
    ranges = [(0.3, 0.6), (1.7, 3.0)] if sensor.technology != "time_of_flight" else [(0.3, 0.6)]
    for near, far in ranges:
        settings = sensor.settings.model_copy(update={"near_mm": near * middle, "far_mm": far * middle})
        found = surface_beyond(capture, capture_cloud(capture, settings), settings)
        assert found is not None
        # a plate of 0.6 of the distance, turned by 6 deg: its depth is within 0.3 sin 6 deg of the middle's, and the
        # axis of a rectified camera is some degrees off
        assert 0.93 * middle < found.depths[0] < found.depths[1] < 1.07 * middle
        shares.append(found.share)
    whole = capture_cloud(capture, sensor.settings)
    assert min(shares) > 0.7 * whole.valid.mean()


def test_an_ordinary_capture_is_not_looked_at_twice(taken, monkeypatch):
    sensor, capture = taken
    cloud = capture_cloud(capture, sensor.settings)
    assert neighbour_agreement(cloud) > 0.95

    def twice(*_):
        raise AssertionError("decoded twice")

    monkeypatch.setattr("mitsim.decoding.depth_range.capture_cloud", twice)
    assert surface_beyond(capture, cloud, sensor.settings) is None


def test_noise_is_no_surface(taken, rng):
    sensor, capture = taken
    noise = {name: rng.integers(20, 200, stack.shape).astype(stack.dtype) for name, stack in capture.images.items()}
    strange = replace(capture, images=noise)
    assert surface_beyond(strange, capture_cloud(strange, sensor.settings), sensor.settings) is None


def test_two_images_of_other_things_are_no_surface(strip):
    """Dots everywhere, and no surface that both see: the matcher makes points of a fifth of the image."""
    distance = middle_of(strip)
    pose = coupon_pose(np.array([0.1, 0.0, 0.995]), distance, np.array([0, 0, 1.0]))
    capture = SimulatedSensor(strip).capture(
        plate(2 * distance, "matt white", strip.wavelength_nm), pose.inverse(), rendering=Rendering(samples=4), seed=3
    )
    mixed = {"left": capture.images["left"], "right": capture.images["right"][:, ::-1, ::-1].copy()}
    strange = replace(capture, images=mixed)
    cloud = capture_cloud(strange, strip.settings)
    assert cloud.valid.mean() > 0.1
    assert surface_beyond(strange, cloud, strip.settings) is None


@pytest.mark.parametrize("binned", [True, False])
def test_fewer_pixels_look_along_the_same_rays(n10, binned):
    """The ray of a coarse pixel is that of the middle of its pixels, or of the pixel that was kept."""
    camera = n10.rig.reference
    stack = np.zeros((1, camera.height, camera.width), np.uint8)
    pair = stereo_rectification(*list(n10.rig.cameras.values())[:2])
    capture = Capture(
        n10.name,
        n10.technology,
        "simulated",
        replace(n10.rig, rectification=pair),
        dict.fromkeys(n10.rig.cameras, stack),
        decoding=Decoding(read_out={"left": Roi(10, 20, 300, 200)}),
    )
    few = _coarse_capture(capture, 3, binned=binned)
    eye = few.rig.reference
    assert (eye.height, eye.width) == few.images["left"].shape[1:]
    mine = eye.rays(np.array([[40.0, 50.0]]))
    whole = camera.rays(np.array([[3 * 40.0 + 1, 3 * 50.0 + 1]]))  # of 120, 121, 122 the middle one
    np.testing.assert_allclose(mine, whole, atol=1e-9)
    region = few.decoding.read_out["left"]
    assert 3 * region.left >= 10 and 3 * region.top >= 20 and 3 * region.right <= 310 and 3 * region.bottom <= 220
    fewer = few.rig.rectification
    depth = fewer.depth(pair.disparity(500.0) / 3)  # a disparity in coarse pixels is a third as large
    np.testing.assert_allclose(depth, 500.0, rtol=1e-9)


def test_depth_is_along_the_axis_of_the_rectified_pair(n10):
    left, right = list(n10.rig.cameras.values())[:2]
    pair = stereo_rectification(left, right)
    point = np.array([[30.0, -20.0, 600.0]])
    depth = depths_of(point, n10.rig, n10.settings)
    assert depth[0] == pytest.approx(float((pair.rotation_left @ point[0])[2]))  # the left camera is the sensor's frame
    one = load_sensor("david-sls-3")
    assert depths_of(point, one.rig, one.settings)[0] == pytest.approx(600.0)


def test_depth_of_a_camera_with_a_reference_is_along_its_rectified_axis():
    """Before, it was along the axis of the camera, which may be turned from the baseline."""
    carmine = load_sensor("primesense-carmine-1.09")
    camera = replace(carmine.rig.reference, sensor_from_camera=Transform.from_degrees([0, 15, 0], [0, 0, 0]))
    rig = replace(carmine.rig, cameras={"camera": camera})
    depth = depths_of(np.array([[30.0, -20.0, 600.0]]), rig, carmine.settings)[0]
    baseline = rig.projector.centre / np.linalg.norm(rig.projector.centre)
    along = np.array([30.0, -20.0, 600.0]) - np.dot([30.0, -20.0, 600.0], baseline) * baseline
    axis = camera.sensor_from_camera.rotation[:, 2]
    axis = axis - (axis @ baseline) * baseline
    assert depth == pytest.approx(along @ axis / np.linalg.norm(axis))


@pytest.mark.parametrize("taken", ["kinect-v2"], indirect=True)
def test_a_surface_nearer_than_the_range_is_found_where_a_wider_one_were_ambiguous(taken):
    """Before, time of flight refused the wider range, and nothing was said."""
    sensor, capture = taken
    settings = sensor.settings.model_copy(update={"near_mm": 1.5 * middle_of(sensor)})
    found = surface_beyond(capture, capture_cloud(capture, settings), settings)
    assert found is not None and found.depths[1] < settings.near_mm


def test_decode_warns_in_one_line(strip, tmp_path):
    distance = middle_of(strip)
    pose = coupon_pose(np.array([0, 0, 1.0]), distance, np.array([0, 0, 1.0]))
    capture = SimulatedSensor(strip).capture(
        plate(0.6 * distance, "matt white", strip.wavelength_nm), pose.inverse(), rendering=Rendering(samples=4), seed=3
    )
    decoding = Decoding(near_mm=1000.0, far_mm=2000.0)
    far = write_capture(replace(capture, sensor="MINE", decoding=decoding), tmp_path / "far")
    near = write_capture(capture, tmp_path / "near")
    told = {}
    for folder in (far, near):
        done = CliRunner().invoke(app, ["decode", str(folder), "-o", str(tmp_path / f"{folder.name}.ply")])
        assert done.exit_code == 0, done.output
        told[folder.name] = [line for line in done.stderr.splitlines() if "warning" in line]
    assert told["near"] == []
    (line,) = told["far"]
    assert line.startswith(f"warning: {far}: a surface is at a depth of ")
    assert "searches 1000 to 2000 mm: change near_mm and far_mm in settings.json" in line
    depths = [float(number) for number in re.findall(r"(\d+) to (\d+) mm \(a coarse", line)[0]]
    assert 0.93 * distance < depths[0] <= depths[1] < 1.07 * distance
