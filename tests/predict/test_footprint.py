"""What an average over a footprint moves points by: dense sums over exact rays, and rendered captures."""

import math

import numpy as np
import pytest
from scipy.optimize import brentq

from characterisation.point_cloud import Status
from mitsim.capture.cloud import capture_cloud, sensor_geometry
from mitsim.capture.simulate import SimulatedSensor
from mitsim.predict import Predictor
from mitsim.predict.footprint import EQUALISED, displacement, footprint_of
from mitsim.scene.footprint import FootprintRays, footprint_displacement
from mitsim.scene.load import scene_from_dict
from mitsim.sensor.camera import stereo_rectification
from mitsim.sensor.frames import look_at
from mitsim.sensor.imager import Noise
from mitsim.sensor.preset import load_sensor

RADIUS = 20.0
WHITE = {"type": "matt_white"}
POSE = look_at([40, 30, 510], [0, 0, 0], [0, 1, 0])


def predictor_of(sensor):
    return Predictor.of_sensor(sensor, sensor_geometry(sensor))


def pillar(sensor, axis):
    end = {"x": [60.0, 0, 0], "y": [0, 60.0, 0]}[axis]
    ends = {"p0": [-value for value in end], "p1": end}
    return scene_from_dict({"pillar": {"type": "cylinder", "radius": RADIUS, **ends, "bsdf": WHITE}},
                           sensor.wavelength_nm)  # fmt: skip


def seen(sensor, scene, pose=POSE):
    predictor = predictor_of(sensor)
    ideal = predictor.ideal(predictor.surfaces(scene, pose))
    return predictor, ideal, predictor.displaced(scene, pose, ideal)


@pytest.mark.parametrize("name", ["ensenso-n10", "david-sls-3", "realsense-d435", "primesense-carmine-1.09"])
def test_on_a_flat_face_that_is_squarely_lit_nothing_moves(name):
    sensor = load_sensor(name)
    from mitsim.scene.backend import activate, mi

    activate()
    plate = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(40), "bsdf": WHITE}
    _, ideal, moved = seen(sensor, scene_from_dict({"plate": plate}, sensor.wavelength_nm),
                           look_at([0, 0, 600], [0, 0, 0], [0, 1, 0]))  # fmt: skip
    inner = (ideal.status == Status.VALID) & (np.abs(ideal.point[:, :2]) < 25).all(1)
    assert inner.sum() > 100
    assert np.abs(moved[inner]).max() < 0.01


@pytest.mark.parametrize(
    ("name", "axis"),
    [
        ("ensenso-n10", "x"),
        ("ensenso-n10", "y"),
        ("realsense-d435", "x"),
        ("realsense-d435", "y"),
        ("david-sls-3", "y"),
    ],
)
def test_on_a_pillar_points_move_as_a_dense_sum_over_exact_rays_says(name, axis):
    sensor = load_sensor(name)
    predictor, ideal, moved = seen(sensor, pillar(sensor, axis))
    inner = np.abs(POSE.points(ideal.point)[:, "xy".index(axis)]) < 45  # the sum below knows of no ends
    least = 0.4 if name == "david-sls-3" else 0.6  # a pixel is small: its average is of something far down the side
    square = np.flatnonzero((ideal.status == Status.VALID) & (ideal.normal[:, 2] > least) & inner)
    by_tilt = square[np.argsort(np.where(axis == "x", *ideal.normal[square, 1::-1].T))]
    chosen = by_tilt[:: max(1, len(by_tilt) // 8)]
    exact = np.array([dense(sensor, predictor, axis, ideal, number) for number in chosen])
    # three nodes each way are 10 % off down the side of a wide block; rays in single precision up to a micrometre
    np.testing.assert_allclose(moved[chosen], exact, rtol=0.11, atol=max(1e-3, 0.03 * np.abs(exact).max()))
    assert np.abs(exact).max() > 4e-3


@pytest.mark.parametrize("name", ["ensenso-n10", "david-sls-3"])
def test_where_the_light_ends_points_move_as_many_nodes_say(name):
    """To the limb, and into the terminator, where a part of each footprint has no light."""
    sensor = load_sensor(name)
    scene = pillar(sensor, "y")
    step = 2 if name == "ensenso-n10" else 5
    predictor = predictor_of(sensor).thinned(step)
    footprint, surfaces = predictor.footprint, predictor.surfaces(scene, POSE)
    ideal = predictor.ideal(surfaces)
    labels = predictor.labels(scene, POSE, surfaces).reshape(-1)[ideal.pixel]  # a cloud's, not nearer to the limb
    shown = (ideal.status == Status.VALID) & (labels == 0)
    pixel, point = ideal.pixel[shown], ideal.point[shown]
    rays = FootprintRays(predictor.rays, predictor.single_directions, step)
    moved = displacement(footprint, rays, scene, POSE, sensor.measuring_rig, pixel, point)

    def even(count, reach, profile):
        place = (np.arange(count) + 0.5) / count * 2 - 1
        return place * reach, profile(place) / profile(place).sum()

    one = (
        even(21, math.sqrt(3), np.ones_like)
        if footprint.square
        else even(21, 3.2, lambda x: np.exp(-((3.2 * x) ** 2) / 2))
    )
    lamp = even(15 if footprint.aperture > 0 else 1, 2 * footprint.aperture, lambda x: np.sqrt(1 - x**2))
    places, shares = (
        np.stack(np.meshgrid(*each, indexing="ij"), -1).reshape(-1, 3) for each in zip(one, one, lamp, strict=True)
    )
    nodes = np.column_stack([places, shares.prod(1)])
    width = footprint.width(sensor.rig.reference.sensor_from_camera.inverse().points(point)[:, 2])
    many = footprint_displacement(scene, rays, POSE, pixel, nodes, width, footprint.lamp, footprint.second,
                                  footprint.power)[0]  # fmt: skip
    size = math.sqrt((many**2).mean())
    assert size > 2e-3 and len(many) > 1000  # [mm]
    assert math.sqrt(((moved - many) ** 2).mean()) < 0.2 * size
    assert abs((moved - many).mean()) < 0.03 * size


def dense(sensor, predictor, axis, ideal, number):
    """Mean over 31 x 31 rays of one footprint, all in numpy, the coordinate by OpenCV's own camera models."""
    footprint, grid = predictor.footprint, predictor.grid
    flat = ideal.pixel[number]
    row, column = divmod(int(flat), grid.width)
    directions = grid.rays()
    d = directions[row, column]
    turns = (directions[row, column + 1] - directions[row, column - 1]) / 2, (
        directions[row + 1, column] - directions[row - 1, column]) / 2  # fmt: skip
    reference = sensor.rig.reference
    depth = reference.sensor_from_camera.inverse().points(ideal.point[number][None])[0, 2]
    sigma = footprint.width(np.array([depth]))[0]
    line = np.linspace(-1, 1, 31) * (math.sqrt(3) if footprint.square else 3.5)
    profile = np.ones(31) if footprint.square else np.exp(-(line**2) / 2)
    eye, lights = POSE.points(grid.origin), aperture(sensor)
    code, here = coordinate(sensor), POSE.inverse().points(on_pillar(eye, POSE.rotation @ d, axis)[0])
    total = mean = 0.0
    for x, along in zip(line, profile, strict=True):
        for y, across in zip(line, profile, strict=True):
            ray = d + sigma * (x * turns[0] + y * turns[1])
            hit = on_pillar(eye, POSE.rotation @ (ray / np.linalg.norm(ray)), axis)
            if hit is None:
                continue
            point, normal = hit
            for place, share, moved in lights:
                toward = place - point
                cosine = max(float(normal @ toward), 0.0) / np.linalg.norm(toward)
                weight = share * along * across * (cosine / (toward @ toward)) ** footprint.power
                total += weight
                mean += weight * (code(POSE.inverse().points(point)) + moved(POSE.inverse().points(point)))
    mean /= total
    # a block's disparity is that of its middle's own column: the ray stays, and the answer is looked for along it
    return brentq(lambda t: code(here + t * d) - mean, -8.0, 8.0, xtol=1e-9)


def aperture(sensor):
    """Eleven strips of the projector's aperture: place in the world, area, and shift of its code [px] at a point.

    One place in the middle for a matcher, which reads no code.
    """
    optics = sensor.projector.optics
    if sensor.technology != "structured_light":
        return [(POSE.points(optics.centre), 1.0, lambda point: 0.0)]
    lights = []
    for part in (np.arange(11) + 0.5) / 11 * 2 - 1:
        aside = part * sensor.projector.aperture_mm / 2
        place = optics.sensor_from_camera.points(np.array([aside, 0.0, 0.0]))

        def shifted(point, aside=aside):
            depth = optics.sensor_from_camera.inverse().points(point)[2]
            # the ray from aside meets the plane of focus there, whose column it is
            return optics.matrix[0, 0] * aside * (1 / sensor.projector.focus_mm - 1 / depth)

        lights.append((POSE.points(place), math.sqrt(1 - part**2), shifted))
    return lights


def coordinate(sensor):
    """What is averaged, of a point of the sensor frame: the projector's column, or the disparity."""
    if sensor.technology == "structured_light":
        return lambda point: sensor.rig.projector.project(point[None])[0, 0]
    left, right = list(sensor.rig.cameras.values())[:2]
    rectified = sensor.rig.rectification or stereo_rectification(left, right)

    def column(camera, turn, matrix, point):
        local = matrix @ turn @ camera.sensor_from_camera.inverse().points(point)
        return local[0] / local[2]

    return lambda point: column(left, rectified.rotation_left, rectified.matrix_left, point) - column(
        right, rectified.rotation_right, rectified.matrix_right, point)  # fmt: skip


def on_pillar(eye, ray, axis):
    along = 0 if axis == "x" else 1
    d, e = np.delete(ray, along), np.delete(eye, along)
    inside = (d @ e) ** 2 - d @ d * (e @ e - RADIUS**2)
    if inside <= 0:
        return None
    point = eye - (d @ e + math.sqrt(inside)) / (d @ d) * ray
    normal = point / RADIUS
    normal[along] = 0.0
    return point, normal


def test_a_rendered_pillar_is_measured_where_the_footprint_says():
    """Phase codes without noise; nothing was tuned. By normal, because there is much at one limb and little elsewhere.

    The 16 rays of a validation are enough: places in the projector's lens have nothing to do with those in the pixel.
    """
    sensor = load_sensor("david-sls-3")
    scene = pillar(sensor, "y")
    predictor, ideal, moved = seen(sensor, scene)
    capture = SimulatedSensor(sensor).capture(scene, POSE, seed=1, samples=16, noise=Noise.none())
    cloud = capture_cloud(capture, sensor.settings, sensor_geometry(sensor), imager=sensor.imager)
    found = cloud.points.reshape(-1, 3)[ideal.pixel].astype(float)
    off = ((found - predictor.grid.origin) * ideal.ray).sum(1) - ideal.distance
    labels = predictor.labels(scene, POSE, predictor.surfaces(scene, POSE)).ravel()[ideal.pixel]
    use = np.isfinite(off) & (labels == 0) & (ideal.status == Status.VALID) & (np.abs(off) < 1)
    number = np.digitize(ideal.normal[use, 0], np.linspace(-0.85, 0.85, 18))
    said, came = (np.array([one[use][number == n].mean() for n in range(1, 18)]) for one in (moved, off))
    assert came.min() < -0.01 and said.min() < -0.01  # [mm]
    np.testing.assert_allclose(came, said, rtol=0.1, atol=7e-4)


def test_a_lens_is_sharpest_where_it_is_focused():
    sensor = load_sensor("david-sls-3")
    footprint = footprint_of(sensor)
    assert footprint.width(np.array([sensor.focus_mm]))[0] == pytest.approx(
        math.sqrt(1 / 12 + sensor.imager.blur_px**2)
    )
    focal_px = sensor.rig.reference.matrix[0, 0]
    disc = (
        focal_px * sensor.imager.pixel_um * 1e-3 / sensor.imager.f_number * focal_px * (1 / 380 - 1 / sensor.focus_mm)
    )
    expected = math.sqrt(1 / 12 + sensor.imager.blur_px**2 + disc**2 / 16)  # of an even disc, along one axis
    assert footprint.width(np.array([380.0]))[0] == pytest.approx(expected)


def test_what_is_not_known_moves_nothing():
    assert footprint_of(load_sensor("kinect-v2")) is None
    sensor = load_sensor("kinect-v2")
    _, ideal, moved = seen(sensor, pillar(sensor, "y"))
    assert len(ideal.pixel) and not moved.any()


def test_blocks_are_as_wide_as_the_matcher_has_them():
    sgbm, correlation = footprint_of(load_sensor("ensenso-n10")), load_sensor("realsense-d435")
    assert sgbm.fixed_px == pytest.approx(2.0)  # 5 and one on either side for its gradients: sqrt((49 - 1) / 12)
    assert sgbm.power == EQUALISED
    block = correlation.settings.block_size
    assert footprint_of(correlation).fixed_px == pytest.approx(math.sqrt((block**2 - 1) / 12))
