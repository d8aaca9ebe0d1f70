"""Ray-cast truth against closed forms."""

from __future__ import annotations

import numpy as np

from characterisation.point_cloud import ViewGrid
from mitsim.scene.backend import mi
from mitsim.scene.load import load_scene, scene_from_dict
from mitsim.scene.ray_casting.raycast import PixelRays, cast, cast_together
from mitsim.sensor.transforms import Transform, look_at
from tests.seen_shapes import points_of

GRID = ViewGrid(300.0, 300.0, 119.5, 79.5, 240, 160)


def test_a_sphere_is_where_it_is():
    scene = scene_from_dict({"ball": {"type": "sphere", "radius": 100.0, "bsdf": {"type": "matt_white"}}}, 850)
    pose = look_at([30, -580, 120], [0, 0, 0], [0, 0, 1], 20)
    surfaces = cast(scene, PixelRays.of_grid(GRID), pose, np.array([[0.0, 0.0, 0.0]]))
    centre = pose.inverse().points(np.zeros(3))
    points = points_of(surfaces, GRID)
    hit = surfaces.shape == 0
    rays = GRID.rays()
    # |t d - c| = r, nearer root
    b = rays @ centre
    inside = b**2 - (centre @ centre - 100.0**2)
    assert np.array_equal(hit, inside > 0)
    expected = b - np.sqrt(np.maximum(inside, 0))
    away = hit & (inside > 10.0)  # at the very limb single precision shows
    assert np.abs(surfaces.distance - expected)[away].max() < 0.01
    normal = (points - centre) / 100.0
    assert np.abs(surfaces.normal - normal)[away].max() < 1e-3
    assert surfaces.seen[0][away].all()  # an eye at the sensor itself sees all that the sensor sees
    assert np.isnan(surfaces.distance[~hit]).all()


def test_groups_of_rays_in_one_launch_meet_what_each_meets_alone():
    ball = {"type": "sphere", "radius": 100.0, "bsdf": {"type": "matt_white"}}
    scene, pose = scene_from_dict({"ball": ball}, 850), look_at([30, -580, 120], [0, 0, 0], [0, 0, 1], 20)
    lost = GRID.rays()[40:100, 60:200]
    lost[10:20] = np.nan  # pixels without a ray
    groups = [PixelRays.of_grid(GRID), PixelRays(GRID.origin, lost)]
    eyes = np.array([[0.0, 0.0, 0.0], [200.0, 0.0, 0.0]])
    every, part = cast_together(scene, groups, pose, eyes)
    for name, value in vars(cast(scene, groups[0], pose, eyes)).items():
        np.testing.assert_array_equal(getattr(every, name), value)
    assert part.shape.shape == (60, 140)
    assert (part.shape[10:20] == -1).all()
    shown = every.shape[40:100, 60:200].copy()
    shown[10:20] = -1
    np.testing.assert_array_equal(part.shape, shown)
    np.testing.assert_array_equal(part.seen[1][shown == 0], every.seen[1, 40:100, 60:200][shown == 0])


def test_an_obstacle_hides_a_point_from_one_eye_only():
    plate = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().scale([200, 200, 1]),
        "bsdf": {"type": "matt_white"},
    }
    wall = {
        "type": "cube",
        "to_world": mi.ScalarTransform4f().translate([10, 0, 25]).scale([1, 200, 25]),
        "bsdf": {"type": "matt_white"},
    }
    scene = scene_from_dict({"plate": plate, "wall": wall}, 850)
    pose = look_at([0, 0, 500], [0, 0, 0], [0, 1, 0])
    right = pose.inverse().points(np.array([300.0, 0.0, 500.0]))
    left = pose.inverse().points(np.array([-300.0, 0.0, 500.0]))
    surfaces = cast(scene, PixelRays.of_grid(GRID), pose, np.stack([right, left]))
    points = pose.points(points_of(surfaces, GRID))
    plane = surfaces.shape == 0
    # a wall 50 mm high at x = 9 to 11 hides from (300, 500) what lies behind it, by similar triangles down to
    # x0 = 9 - 50 (291 / 450) = -23.3
    behind = plane & (points[..., 0] > -22.5) & (points[..., 0] < 8.5)
    beyond = plane & (points[..., 0] < -24.5)
    assert behind.sum() > 100
    assert not surfaces.seen[0][behind].any()
    assert surfaces.seen[0][beyond].all()
    assert surfaces.seen[1][behind].all()


def test_labels_are_the_shapes(scenes):
    scene = load_scene(scenes / "two_pillars/two_pillars.xml", 850)
    pose = look_at([0, 0, 500], [0, 0, 0], [0, 1, 0])
    surfaces = cast(scene, PixelRays.of_grid(GRID), pose, np.empty((0, 3)))
    names = {scene.names[i] for i in np.unique(surfaces.shape) if i >= 0}
    assert {"plane", "pillar1_top", "pillar2_top"} <= names
    assert surfaces.seen.shape == (0, 160, 240)
    middle = surfaces.shape[79, 119]
    assert scene.names[middle] == "plane"


def test_the_grid_may_be_turned_and_moved():
    plate = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().scale([900, 900, 1]),
        "bsdf": {"type": "matt_white"},
    }
    scene = scene_from_dict({"plate": plate}, 850)
    turn = Transform.from_degrees([3, -5, 10], [7, -4, 2])
    grid = ViewGrid(300.0, 310.0, 100.0, 70.0, 240, 160, turn.rotation, turn.translation)
    pose = look_at([50, 20, 500], [0, 0, 0], [0, 1, 0])
    surfaces = cast(scene, PixelRays.of_grid(grid), pose, np.empty((0, 3)))
    points = pose.points(points_of(surfaces, grid))
    assert np.abs(points[..., 2]).max() < 2e-3


def test_the_back_of_a_face_is_no_surface_but_hides_what_is_behind():
    """A one-sided face seen from behind renders black, so it gives no point; a two-sided one does."""
    upside_down = mi.ScalarTransform4f().translate([0, 0, 20]).rotate([1, 0, 0], 180).scale([30, 30, 1])
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale([200, 200, 1])}
    for wrapped, expected in ((False, -1), (True, 1)):
        bsdf = {"type": "twosided", "bsdf": {"type": "diffuse"}} if wrapped else {"type": "matt_white"}
        scene = scene_from_dict(
            {
                "floor": {**floor, "bsdf": {"type": "matt_white"}},
                "lid": {"type": "rectangle", "to_world": upside_down, "bsdf": bsdf},
            },
            850,
        )
        pose = look_at([0, 0, 500], [0, 0, 0], [0, 1, 0])
        surfaces = cast(scene, PixelRays.of_grid(GRID), pose, np.array([[0.0, 0.0, 0.0]]))
        assert surfaces.shape[79, 119] == expected
        assert np.isnan(surfaces.distance[79, 119]) == (expected == -1)
        assert surfaces.shape[5, 5] == 0
