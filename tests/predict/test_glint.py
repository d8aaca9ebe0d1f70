"""Where two eyes see a mirror image: closed forms, and an exact search for the rays of both; and what a glint does."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import norm

from mitsim.capture.cloud import sensor_geometry
from mitsim.predict import Predictor
from mitsim.predict.glint import (
    BLUR_PX,
    BRIGHT,
    BRIGHT_SPREAD,
    CARRIED,
    CARRIED_PX,
    LEAST_BRIGHT,
    MOST_TAKEN,
    NEAR_PX,
    PULLED,
    REACH_PX,
    REACH_SPREAD_PX,
    SHARP_PX,
    blur,
    drawn_to_image,
    glint,
    image_depth,
    lamp_image,
)
from mitsim.scene.backend import activate
from mitsim.scene.load import scene_from_dict
from mitsim.scene.reflections import reflections
from mitsim.sensor.frames import look_at
from mitsim.sensor.preset import load_sensor

RADIUS, WALL = 20.0, 70.0
WHITE = {"type": "matt_white"}


@pytest.fixture(scope="module")
def n10():
    return load_sensor("ensenso-n10")


@pytest.fixture(scope="module")
def predictor(n10):
    return Predictor.of_sensor(n10, sensor_geometry(n10)).thinned_to(40_000)[0]


def pillar_and_wall(axis):
    """A pillar about the world's x or y axis, and a wall beside it, which it mirrors."""
    activate()
    ends = {"p0": [-60.0, 0, 0], "p1": [60.0, 0, 0]} if axis == "x" else {"p0": [0, -60.0, 0], "p1": [0, 60.0, 0]}
    from mitsim.scene.backend import mi

    aside = [0, WALL, 0] if axis == "x" else [WALL, 0, 0]
    place = mi.ScalarTransform4f().look_at(aside, [0, 0, 0], [0, 0, 1]) @ mi.ScalarTransform4f().scale(150)
    return {"pillar": {"type": "cylinder", "radius": RADIUS, **ends, "bsdf": WHITE},
            "wall": {"type": "rectangle", "to_world": place, "bsdf": WHITE}}  # fmt: skip


def seen(n10, predictor, scene, pose):
    loaded = scene_from_dict(scene, n10.wavelength_nm)
    surfaces = predictor.surfaces(loaded, pose)
    ideal = predictor.ideal(surfaces)
    found = reflections(loaded, predictor.rays, pose, predictor.rig.baseline_direction)
    power, length = found.power.reshape(3, -1)[:, ideal.pixel], found.distance.ravel()[ideal.pixel]
    depth = image_depth(power, np.where(np.isfinite(length), length, np.nan), ideal.distance)
    return loaded, ideal, depth, lamp_image(predictor, loaded, pose, ideal)


def test_a_flat_mirror_shows_what_stands_before_it_as_far_behind_itself(n10, predictor):
    """A floor and a wall at right angles: the wall stands in the floor, from whichever side it is looked at."""
    activate()
    from mitsim.scene.backend import mi

    wall = mi.ScalarTransform4f().look_at([0, 60, 0], [0, 0, 0], [0, 0, 1]) @ mi.ScalarTransform4f().scale(200)
    scene = {"floor": {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(200), "bsdf": WHITE},
             "wall": {"type": "rectangle", "to_world": wall, "bsdf": WHITE}}  # fmt: skip
    pose = look_at([30, -350, 420], [0, 0, 0], [0, 0, 1])
    loaded, ideal, depth, _ = seen(n10, predictor, scene, pose)
    floor = np.isfinite(depth) & (ideal.shape == loaded.names.index("floor"))
    assert floor.sum() > 1000
    ray = ideal.ray[floor] @ pose.rotation.T
    expected = (60 - pose.points(ideal.point[floor])[:, 1]) / ray[:, 1]  # the mirrored ray goes on toward the wall
    np.testing.assert_allclose(depth[floor], expected, rtol=2e-3)


@pytest.mark.parametrize("axis", ["x", "y"])
def test_in_a_pillar_two_eyes_triangulate_what_an_exact_search_finds(n10, predictor, axis):
    """Of each point: what it mirrors, where an eye a little aside sees the same, and where the two rays meet."""
    pose = look_at([60, 50, 520], [0, 0, 0], [0, 1, 0])
    loaded, ideal, depth, _ = seen(n10, predictor, pillar_and_wall(axis), pose)
    here = np.isfinite(depth) & (ideal.shape == loaded.names.index("pillar"))
    by_incidence = np.flatnonzero(here)[np.argsort(ideal.normal[here, 2])]
    chosen = by_incidence[:: max(1, len(by_incidence) // 12)]
    assert len(chosen) >= 10
    eye = pose.points(predictor.grid.origin)
    baseline = pose.rotation @ np.asarray(predictor.rig.baseline_direction)
    exact = [triangulated(axis, pose.rotation @ ideal.ray[number], eye, baseline) for number in chosen]
    np.testing.assert_allclose(depth[chosen], exact, rtol=1e-3)


def on_pillar(axis, angle, height):
    across = RADIUS * np.array([math.cos(angle), math.sin(angle)])
    return np.array([height, *across]) if axis == "x" else np.array([across[0], height, across[1]])


def triangulated(axis, ray, eye, baseline):
    """Depth behind the pillar at which a ray meets that of an eye 0.1 mm aside which sees the same thing mirrored."""
    along, side = (0, 1) if axis == "x" else (1, 0)
    d, e = np.delete(ray, along), np.delete(eye, along)
    point = eye - (d @ e + math.sqrt((d @ e) ** 2 - d @ d * (e @ e - RADIUS**2))) / (d @ d) * ray
    mirrored = reflected(along, point, ray)
    thing = point + mirrored * (WALL - point[side]) / mirrored[side]
    u = baseline - (baseline @ ray) * ray
    other = eye + 0.1 * u / np.linalg.norm(u)

    def amiss(place):
        middle = on_pillar(axis, *place)
        arriving, leaving = middle - other, thing - middle
        return reflected(along, middle, arriving / np.linalg.norm(arriving)) - leaving / np.linalg.norm(leaving)

    across = np.delete(point, along)
    start = [math.atan2(across[1], across[0]), point[along]]
    found = least_squares(amiss, start, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    second = on_pillar(axis, *found.x) - other
    # in the plane of the baseline and the ray, where the two meet
    lean = (second @ u) / np.linalg.norm(u) / (second @ ray)
    return -0.1 / lean - np.linalg.norm(point - eye)


def reflected(along, point, direction):
    normal = point / RADIUS
    normal[along] = 0.0
    return direction - 2 * (direction @ normal) * normal


def test_the_projector_stands_in_a_ball_at_half_its_radius(n10, predictor):
    scene = {"ball": {"type": "sphere", "radius": 40.0, "bsdf": WHITE}}
    _, ideal, depth, lamp = seen(n10, predictor, scene, look_at([0, 0, 560], [0, 0, 0], [0, 1, 0]))
    square = np.argsort(-ideal.normal[:, 2])[:20]  # those that face the sensor
    distance = np.linalg.norm(ideal.point[square] - n10.rig.projector.centre, axis=1)
    for depth_of_either in (lamp.depth, lamp.across):
        np.testing.assert_allclose(depth_of_either[square], 1 / (1 / distance + 2 / 40.0), rtol=0.02)
    assert np.isnan(depth).all()  # there is nothing else


@pytest.fixture(scope="module")
def ball(n10, predictor):
    """A ball, a bright stripe over its middle, and what a view of it is."""
    scene = {"ball": {"type": "sphere", "radius": 30.0, "bsdf": WHITE}}
    _, ideal, _, lamp = seen(n10, predictor, scene, look_at([0, 0, 560], [0, 0, 0], [0, 1, 0]))
    size, lamp = (predictor.grid.height, predictor.grid.width), lamp.depth
    row, column = np.divmod(ideal.pixel, size[1])
    middle = int(np.median(row)), int(np.median(column))
    return ideal, lamp, size, ideal.distance * 1.6e-3, row == middle[0], column - middle[1]


def test_in_a_pillar_the_projector_stands_near_for_eyes_across_it_alone(n10, predictor):
    """The sensor's baseline runs along x: across a pillar about y, and along one about x."""
    depths = {}
    for axis in ("x", "y"):
        scene = {"pillar": pillar_and_wall(axis)["pillar"]}
        _, ideal, _, lamp = seen(n10, predictor, scene, look_at([0, 0, 560], [0, 0, 0], [0, 1, 0]))
        square = np.argsort(-ideal.normal[:, 2])[:20]
        depths[axis] = np.median(lamp.depth[square]), np.median(lamp.across[square])
    for near, far in (depths["y"], depths["x"][::-1]):
        assert near == pytest.approx(1 / (1 / 540 + 2 / RADIUS), rel=0.03)
        assert far == pytest.approx(540, rel=0.03)


SMOOTH = 1e-3


def strength(bright):
    return norm.cdf(math.log(bright / BRIGHT) / BRIGHT_SPREAD)


@pytest.mark.parametrize("bright", [100.0, BRIGHT, 0.5])
def test_a_glint_takes_the_points_about_its_middle_in_the_share_that_its_light_asks_for(ball, bright):
    ideal, lamp, size, pixel_mm, level, aside = ball
    smooth = np.full(len(lamp), SMOOTH)
    taken, carried = glint(lamp, bright * (aside == 0), smooth, ideal, size, pixel_mm, step=3)
    for columns in (0, 2, 4):
        reach = norm.cdf((REACH_PX - 3 * columns) / REACH_SPREAD_PX)
        here = level & (np.abs(aside) == columns)
        assert taken[here] == pytest.approx(MOST_TAKEN * strength(bright) * reach, rel=1e-3)
        source = CARRIED * lamp[level & (aside == 0)].item() * strength(bright)
        assert carried[here] == pytest.approx(source * math.exp(-3 * columns / CARRIED_PX), rel=1e-3)


def test_there_is_no_glint_in_the_dark_or_far_behind_the_face_or_in_a_face_that_mirrors_nothing(ball):
    ideal, lamp, size, pixel_mm, _, aside = ball
    smooth, stripe = np.full(len(lamp), SMOOTH), 10.0 * (aside == 0)
    for nothing in (glint(lamp, np.full(len(lamp), 0.9 * LEAST_BRIGHT), smooth, ideal, size, pixel_mm, 3),
                    glint(np.full(len(lamp), 500.0), stripe, smooth, ideal, size, pixel_mm, 3),
                    glint(lamp, stripe, np.full(len(lamp), np.nan), ideal, size, pixel_mm, 3)):  # fmt: skip
        assert not np.any(nothing)


def test_a_broad_glint_takes_no_point(ball):
    """One that is as wide as half are taken at, and others."""
    ideal, lamp, size, pixel_mm, level, aside = ball
    here = level & (aside == 0)
    half = SHARP_PX * pixel_mm / (math.sqrt(2) * lamp)
    assert blur(lamp, half, pixel_mm) == pytest.approx(SHARP_PX)
    shares = [
        glint(lamp, 100.0 * (aside == 0), width * half, ideal, size, pixel_mm, 3)[0][here].item()
        for width in (0.2, 1.0, 1.6)
    ]
    whole = MOST_TAKEN * norm.cdf(REACH_PX / REACH_SPREAD_PX)
    assert shares[0] == pytest.approx(whole, rel=1e-3)
    assert shares[1] == pytest.approx(whole / 2, rel=1e-3)
    assert shares[2] < 0.01


def test_smoothing_does_not_reach_another_shape(ball):
    ideal, lamp, size, pixel_mm, level, aside = ball
    parted = replace(ideal, shape=np.where(aside > 2, 7, ideal.shape))
    _, carried = glint(lamp, 100.0 * (aside == 0), np.full(len(lamp), SMOOTH), parted, size, pixel_mm, step=3)
    assert (carried[aside > 2] == 0).all() and (carried[level & (aside == -3)] > 0).all()


def test_points_are_drawn_to_an_image_that_is_near_and_as_far_as_its_blur_and_light_let_it():
    depth, pixel_mm = np.array([10.0, 10.0, 10.0, 10.0, 10.0, 400.0, np.nan]), np.ones(7)
    alpha = BLUR_PX / (math.sqrt(2) * 10) * np.array([1e-6, 1e-6, 1.0, 1.0, np.nan, 1e-6, 1e-6])
    ratio = np.array([0.0, 1 / PULLED, math.e / PULLED, math.inf, 1.0, 1.0, 1.0])
    assert depth[5] > NEAR_PX * pixel_mm[5]
    found = drawn_to_image(depth, alpha, pixel_mm, ratio)
    np.testing.assert_allclose(found, [0, 5, 5, 10, 0, 0, 0], atol=1e-6)
