"""Boxes and triangles: distances against sampling, bodies of sensors against closed forms, places inside solids."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mitsim.sensor.transforms import Transform
from mitsim.views.collision import BodyBox, box_distance, is_inside, is_near, obstacle, sensor_box
from mitsim.views.table import MARGIN_MM, SensorBody

HALF = np.array([40.0, 15.0, 20.0])


def sampled_distance(triangle, half, pieces=80):
    """Least distance of a raster of points of a triangle (3, 3) from a box; independent of faces and edges."""
    i, j = np.meshgrid(np.arange(pieces + 1), np.arange(pieces + 1))
    weights = np.stack([i, j, pieces - i - j], axis=-1)[i + j <= pieces] / pieces
    points = weights @ triangle
    return np.linalg.norm(np.maximum(np.abs(points) - half, 0), axis=1).min()


def triangles_about(rng, count, spread, size):
    return rng.normal(0, spread, (count, 1, 3)) + rng.normal(0, size, (count, 3, 3))


@pytest.mark.parametrize(("spread", "size"), [(40, 10), (60, 80), (30, 300), (100, 30)])
def test_the_distance_of_a_triangle_is_the_least_of_its_points(rng, spread, size):
    triangles = triangles_about(rng, 200, spread, size)
    found = box_distance(triangles, HALF)
    sampled = np.array([sampled_distance(one, HALF) for one in triangles])
    longest = np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=2).max(axis=1)
    # any place of a triangle lies within an eightieth of its longest side of a place of the raster
    assert (found <= sampled + 1e-9).all()
    assert (sampled <= found + longest / 80).all()
    assert (found == 0).any() and (found > 0).any()


coordinate = st.one_of(st.integers(-4, 4).map(lambda n: 10.0 * n), st.floats(-100, 100))
triangle = st.lists(st.tuples(coordinate, coordinate, coordinate), min_size=3, max_size=3).map(np.array)


@given(triangle)
def test_triangles_along_the_faces_and_without_area_have_distances_too(one):
    """Corners on a raster that the box shares: parallel edges, flat and needle-like triangles, corners that touch."""
    found = box_distance(one[None].astype(float), np.array([20.0, 10.0, 30.0]))[0]
    sampled = sampled_distance(one, np.array([20.0, 10.0, 30.0]))
    longest = np.linalg.norm(one - np.roll(one, 1, axis=0), axis=1).max()
    assert found <= sampled + 1e-9
    assert sampled <= found + longest / 80 + 1e-9


def test_a_corner_pointing_at_an_edge_is_as_far_as_it_is():
    """No over-estimate at the corners of the box: the grown box would say 0 here."""
    away = np.array([3.0, 4.0, 12.0])  # 13 mm from the corner
    one = (HALF + away + np.array([[0, 0, 0], [50.0, 1, 0], [1, 50, 0]]))[None]
    assert np.isclose(box_distance(one, HALF)[0], 13.0, atol=1e-12)


def test_the_trees_miss_no_triangle_whatever_its_size(rng):
    """Small and large triangles together, against the distances of all of them."""
    triangles = np.concatenate([triangles_about(rng, 400, 300, 8), triangles_about(rng, 12, 300, 400)])
    part, box = obstacle(triangles), BodyBox(np.array([30.0, -5, -10]), HALF)
    near = 0
    for turn, place in zip(Rotation.random(60, rng=rng), rng.normal(0, 250, (60, 3)), strict=True):
        pose = Transform(turn.as_matrix(), place)
        distance = box_distance(pose.inverse().points(triangles) - box.centre, HALF).min()
        for clearance in (0.0, 7.5, 40.0):
            expected = distance < clearance or distance == 0
            assert is_near(part, box, pose, clearance) == expected
            near += expected
    assert 20 < near < 160


def test_nothing_is_in_the_way_of_a_part_without_triangles():
    part = obstacle(np.empty((0, 3, 3)))
    assert not is_near(part, BodyBox(np.zeros(3), HALF), Transform.identity(), 100.0)
    assert not is_inside(part, np.zeros(3))


def test_a_place_is_inside_a_solid_and_not_in_its_hollow_nor_behind_a_plane(rng):
    ball, wall = (trimesh.creation.icosphere(subdivisions=4, radius=radius).triangles for radius in (200.0, 120.0))
    floor = np.array([[[-900, -900, -210], [900, -900, -210], [0, 900, -210]]], float)
    hollow = obstacle(np.concatenate([ball, wall[:, ::-1], floor]))
    directions = rng.normal(size=(100, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for direction in directions:
        assert is_inside(hollow, 160 * direction)
        assert not is_inside(hollow, 60 * direction)
        assert not is_inside(hollow, 240 * direction)
    room = obstacle(np.asarray(ball)[:, ::-1])
    assert not any(is_inside(room, 150 * direction) for direction in directions)


def test_the_body_encloses_every_aperture_by_its_margin(n10):
    box = sensor_box(n10, SensorBody())
    for camera in n10.rig.cameras.values():
        radius = 3.757 / 1.8 / 2  # focal length over f-number
        assert (np.abs(camera.centre - box.centre) + radius <= box.half - MARGIN_MM + 1e-2).all()
    # the baseline of 100.775 mm along x, and a lens's radius and the margin at either end
    assert np.isclose(box.half[0], 100.775 / 2 + 3.757 / 1.8 / 2 + MARGIN_MM, atol=2e-3)
    assert np.isclose(sensor_box(n10, SensorBody(margin_mm=10)).half[0], box.half[0] - MARGIN_MM + 10)
    written = sensor_box(n10, SensorBody(size_mm=(150, 45, 45), centre_mm=(50, 0, -5)))
    assert np.array_equal(written.centre, [50, 0, -5]) and np.array_equal(written.half, [75, 22.5, 22.5])
    assert np.allclose(sensor_box(n10, SensorBody(size_mm=(150, 45, 45))).centre, box.centre)
