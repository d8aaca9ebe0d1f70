"""Where two eyes see the mirror image: closed forms, and an exact search for the rays of both; and what that does."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from mitsim.capture.cloud import sensor_geometry
from mitsim.predict import Predictor
from mitsim.predict.mirror_image import (
    GLINT,
    HALF_PULLED,
    MOST,
    RUN_PX,
    Images,
    displacement,
    glint_share,
    mirror_images,
)
from mitsim.scene.backend import activate
from mitsim.scene.load import scene_from_dict
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
    return loaded, ideal, mirror_images(predictor, loaded, pose, ideal)


def test_a_flat_mirror_shows_what_stands_before_it_as_far_behind_itself(n10, predictor):
    """A floor and a wall at right angles: the wall stands in the floor, from whichever side it is looked at."""
    activate()
    from mitsim.scene.backend import mi

    wall = mi.ScalarTransform4f().look_at([0, 60, 0], [0, 0, 0], [0, 0, 1]) @ mi.ScalarTransform4f().scale(200)
    scene = {"floor": {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(200), "bsdf": WHITE},
             "wall": {"type": "rectangle", "to_world": wall, "bsdf": WHITE}}  # fmt: skip
    pose = look_at([30, -350, 420], [0, 0, 0], [0, 0, 1])
    loaded, ideal, images = seen(n10, predictor, scene, pose)
    floor = np.isfinite(images.surface) & (ideal.shape == loaded.names.index("floor"))
    assert floor.sum() > 1000
    ray = ideal.ray[floor] @ pose.rotation.T
    expected = (60 - pose.points(ideal.point[floor])[:, 1]) / ray[:, 1]  # the mirrored ray goes on toward the wall
    np.testing.assert_allclose(images.surface[floor], expected, rtol=2e-3)


@pytest.mark.parametrize("axis", ["x", "y"])
def test_in_a_pillar_two_eyes_triangulate_what_an_exact_search_finds(n10, predictor, axis):
    """Of each point: what it mirrors, where an eye a little aside sees the same, and where the two rays meet."""
    pose = look_at([60, 50, 520], [0, 0, 0], [0, 1, 0])
    loaded, ideal, images = seen(n10, predictor, pillar_and_wall(axis), pose)
    here = np.isfinite(images.surface) & (ideal.shape == loaded.names.index("pillar"))
    by_incidence = np.flatnonzero(here)[np.argsort(ideal.normal[here, 2])]
    chosen = by_incidence[:: max(1, len(by_incidence) // 12)]
    assert len(chosen) >= 10
    eye = pose.points(predictor.grid.origin)
    baseline = pose.rotation @ np.asarray(predictor.rig.baseline_direction)
    exact = [triangulated(axis, pose.rotation @ ideal.ray[number], eye, baseline) for number in chosen]
    np.testing.assert_allclose(images.surface[chosen], exact, rtol=1e-3)


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
    _, ideal, images = seen(n10, predictor, scene, look_at([0, 0, 560], [0, 0, 0], [0, 1, 0]))
    square = np.argsort(-ideal.normal[:, 2])[:20]  # those that face the sensor
    distance = np.linalg.norm(ideal.point[square] - n10.rig.projector.centre, axis=1)
    np.testing.assert_allclose(images.lamp[square], 1 / (1 / distance + 2 / 40.0), rtol=0.02)
    assert np.isnan(images.surface).all()  # there is nothing else


def test_without_other_light_nothing_is_displaced_and_with_much_all_is():
    images = Images(np.array([8.0, 8, 8, np.nan, 8]), np.array([10.0, 10, 10, 10, 10]))
    alpha, pixel, none = np.full(5, 1e-6), np.full(5, 0.8), np.zeros(5)
    rho = np.array([0.0, HALF_PULLED, np.inf, np.inf, np.nan])
    found = displacement(images, rho, alpha, pixel, none)
    np.testing.assert_allclose(found, [0, 8 * MOST / 2, 8 * MOST, 0, 0], atol=1e-9)
    # blurred by as much as the pattern's runs are long, it takes twice the light
    blurred = np.full(5, RUN_PX * 0.8 / (math.sqrt(2) * 8))
    np.testing.assert_allclose(displacement(images, 2 * rho, blurred, pixel, none), found, atol=1e-9)
    np.testing.assert_allclose(displacement(images, none, alpha, pixel, none + 1), 10)
    assert displacement(images, rho, np.full(5, np.nan), pixel, none).tolist() == [0] * 5


def test_the_glint_takes_the_points_about_it_in_the_share_that_it_fills(n10, predictor):
    scene = {"ball": {"type": "sphere", "radius": 30.0, "bsdf": WHITE}}
    _, ideal, images = seen(n10, predictor, scene, look_at([0, 0, 560], [0, 0, 0], [0, 1, 0]))
    size = (predictor.grid.height, predictor.grid.width)
    row, column = np.divmod(ideal.pixel, size[1])
    pixel_mm = ideal.distance * 1.6e-3
    middle = (int(np.median(row)), int(np.median(column)))
    stripe = np.where(np.abs(column - middle[1]) <= 1, np.inf, 0.0)
    share = glint_share(images, stripe, ideal, size, pixel_mm, step=3)
    there = share[(row == middle[0]) & (column == middle[1])]
    assert there == pytest.approx(min(3 / 5 / GLINT, 1.0))  # three of the window's five columns
    assert share[np.abs(column - middle[1]) > 3].max() == 0
    flat = replace(images, lamp=np.full(len(images.lamp), 500.0))
    assert glint_share(flat, stripe, ideal, size, pixel_mm, step=3).max() == 0
