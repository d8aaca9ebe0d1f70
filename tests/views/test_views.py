"""Candidate views: what a table asks for, what a stage can show, and what keeps clear of the part."""

from __future__ import annotations

import math
import time

import numpy as np
import pytest
import trimesh
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from characterisation.files.documents import validate
from characterisation.files.errors import InputError
from mitsim.scene.load import load_scene, scene_from_dict
from mitsim.scene.ray_casting.triangles import triangles
from mitsim.sensor.preset import load_sensor
from mitsim.sensor.transforms import look_at
from mitsim.sensor.working_volume import depth
from mitsim.study import open_study
from mitsim.views import ViewsTable, candidate_views
from mitsim.views.candidates import STEP_MM
from mitsim.views.collision import sensor_box
from mitsim.views.reach import stage_from_part, stage_from_sensor

NOTHING = np.empty((0, 3, 3))
CRADLE = {"name": "cradle", "direction": [1, 0, 0], "limits_deg": [-70, 70]}
TURN = {"name": "turn", "direction": [0, 0, 1], "limits_deg": [0, 360]}
ROLL = {"name": "roll", "direction": [0, 0, 1], "limits_deg": [-180, 180]}


def table(**changes):
    return validate("views", changes, ViewsTable)


def ball(radius, place=(0.0, 0.0, 0.0)):
    return np.asarray(trimesh.creation.icosphere(subdivisions=4, radius=radius).triangles) + np.array(place)


def test_a_free_sensor_looks_at_the_target_from_every_direction_roll_and_standoff(n10):
    asked = table(subdivisions=1, rolls_deg=[0, 90], lowest_elevation_deg=20, target_mm=[5, -3, 20])
    found = candidate_views(asked, n10, [450, 600], np.zeros(3), NOTHING)
    directions = [tuple(v.direction) for v in found.views]
    assert len(found.views) == 4 * len(set(directions)) == 4 * 16
    assert [v.number for v in found.views] == list(range(64)) and not found.left_out
    assert [(v.roll_deg, v.standoff) for v in found.views[:4]] == [(0, 450), (0, 600), (90, 450), (90, 600)]
    assert all(a.elevation_deg >= b.elevation_deg - 1e-6 for a, b in zip(found.views, found.views[1:], strict=False))
    for view in found.views:
        expected = look_at(
            found.target + view.standoff * view.direction,
            found.target,
            [0, 1, 0] if view.direction[2] > 1 - 1e-6 else [0, 0, 1],
            view.roll_deg,
        )
        assert np.allclose(view.world_from_sensor.matrix(), expected.matrix(), atol=1e-9)
        assert view.stage_angles is None and view.stage_distance is None


def test_a_stage_of_three_axes_shows_what_a_free_sensor_sees(n10):
    """Pose -> angles -> pose: the sensor stands still, and the part sees it where a free one would stand."""
    asked = table(
        subdivisions=2,
        rolls_deg=[0, 37, 90],
        target_mm=[12, -7, 30],
        stage={"axes": [ROLL, CRADLE, TURN], "part_rotation_deg": [10, -20, 30]},
    )
    found = candidate_views(asked, n10, [450, 600], np.zeros(3), NOTHING)
    free = candidate_views(asked.model_copy(update={"stage": None}), n10, [450, 600], np.zeros(3), NOTHING)
    by_place = {(*view.direction.tolist(), view.roll_deg, view.standoff): view for view in free.views}
    assert len(found.views) + len(found.left_out) == len(free.views)
    assert 100 < len(found.views) < len(free.views)
    for view in found.views:
        same = by_place[(*view.direction.tolist(), view.roll_deg, view.standoff)]
        assert np.abs(view.world_from_sensor.matrix() - same.world_from_sensor.matrix()).max() < 1e-9 * view.standoff
        assert view.stage_distance == view.standoff


def test_on_two_axes_the_stage_determines_the_roll(n10):
    asked = table(subdivisions=2, lowest_elevation_deg=-90, stage={"axes": [CRADLE, TURN]})
    found = candidate_views(asked, n10, [500], np.array([0, 0, 25.0]), NOTHING)
    assert {round(view.standoff, 9) for view in found.views} == {500}
    for view in found.views:
        # the table's axis is the part's z: 70 deg of the cradle are 20 deg above the horizon
        assert view.elevation_deg >= 20 - 1e-6
        up = [0, 1, 0] if view.direction[2] > 1 - 1e-6 else [0, 0, 1]
        expected = look_at(found.target + 500 * view.direction, found.target, up, view.roll_deg)
        assert np.allclose(view.world_from_sensor.matrix(), expected.matrix(), atol=1e-6)
    assert len({round(view.roll_deg) for view in found.views}) <= 3  # upright, or upside down, or the zenith
    for one in found.left_out:
        assert one.direction[2] < math.sin(math.radians(20)) and math.isnan(one.roll_deg)
        assert one.reason.startswith("stage: cradle ") and one.reason.endswith(" deg beyond -70 to 70")
    assert len(found.views) + len(found.left_out) == 162


def test_a_target_off_the_axes_moves_and_its_standoff_is_told(n10):
    """A cradle whose axis lies 40 mm under the target."""
    stage = {"axes": [{**CRADLE, "limits_deg": [-60, 60], "point_mm": [0, 0, -40]}, {**TURN, "point_mm": [0, 0, -40]}]}
    asked = table(stage=stage, lowest_elevation_deg=30, target_mm=[0, 0, 10])
    found = candidate_views(asked, n10, [500], np.zeros(3), NOTHING)
    assert len(found.views) > 30
    for view in found.views:
        tilt = view.stage_angles[0]
        assert np.isclose(view.standoff, 540 - 40 * math.cos(tilt), atol=1e-9)
        assert np.isclose(depth(n10, view.world_from_sensor.inverse().points(found.target)), view.standoff)
        pose = stage_from_part(asked.stage, found.target, view.stage_angles).inverse() @ stage_from_sensor(n10, 500.0)
        assert np.array_equal(pose.matrix(), view.world_from_sensor.matrix())
        assert view.stage_distance == 500
    far_off = {"axes": [{**axis, "point_mm": [0, 0, -600]} for axis in stage["axes"]]}
    found = candidate_views(table(stage=far_off), n10, [500], np.zeros(3), NOTHING)
    lost = [one for one in found.left_out if "outside the image or the range" in one.reason]
    assert lost and found.views
    # 600 mm below the target: at 35 deg it has gone 344 mm sideways, of which N10 sees no more than 180 at 600 mm
    assert max(abs(view.stage_angles[0]) for view in found.views) < math.radians(35)


@settings(max_examples=30)
@given(st.floats(250, 700), st.sampled_from([0.0, 20.0, 55.0]))
def test_a_sensor_that_is_too_near_to_a_ball_goes_out_to_the_first_free_step(radius, clearance):
    """Closed form: the front of its body is a plane, 30 mm before the camera, to a ball on its axis."""
    n10 = load_sensor("ensenso-n10")
    body = {"size_mm": [200, 60, 80], "centre_mm": [20, 0, -10]}
    asked = table(subdivisions=0, lowest_elevation_deg=80, sensor_body=body, clearance_mm=clearance)
    nearest = radius + clearance + 30.0
    # corners lie on the ball 0.07 of its radius apart, so that the mesh stays at most 0.06^2 / 2 of it short of its top
    assume(nearest % STEP_MM > 1.3)
    found = candidate_views(asked, n10, [400], np.zeros(3), ball(radius))
    assert [view.standoff for view in found.views] == [max(400.0, STEP_MM * math.ceil(nearest / STEP_MM))]
    assert found.moved_out == (nearest > 400)


def test_no_view_that_is_had_comes_nearer_than_it_may(n10, rng):
    """Against a raster of all that is there, at the standoff that was chosen and at the step before it."""
    asked = table(subdivisions=1, lowest_elevation_deg=-90, rolls_deg=[0, 60], clearance_mm=35)
    bumps = np.concatenate([ball(60.0, place)[::11] for place in rng.normal(0, 220, (14, 3))])
    floor = np.array([[[-3000, -3000, -250], [3000, -3000, -250], [0, 5000, -250]]], float)
    found = candidate_views(asked, n10, [400, 480], np.zeros(3), np.concatenate([bumps, floor]))
    box = sensor_box(n10, asked.sensor_body)
    raster = np.concatenate(
        [bumps.reshape(-1, 3), bumps.mean(axis=1), (bumps + np.roll(bumps, 1, axis=1)).reshape(-1, 3) / 2]
    )
    signs = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])

    def distance(pose):
        """At least the true one, and at most 2 mm more: triangles have sides of 4.6 mm, seven places on each."""
        local = np.abs(pose.inverse().points(raster) - box.centre)
        height = pose.points(box.centre + signs * box.half)[:, 2] + 250
        over_floor = max(height.min(), -height.max(), 0.0)
        return min(np.linalg.norm(np.maximum(local - box.half, 0), axis=1).min(), over_floor)

    for view in found.views:
        assert distance(view.world_from_sensor) >= 35
        if view.standoff not in (400, 480):
            up = [0, 0, 1] if abs(view.direction[2]) < 1 - 1e-6 else [0, 1, 0]
            nearer = look_at((view.standoff - STEP_MM) * view.direction, [0, 0, 0], up, view.roll_deg)
            assert distance(nearer) < 35 + 2
    assert 20 < found.moved_out < len(found.views)
    assert found.left_out and all(one.reason.startswith("collision: ") for one in found.left_out)
    # a view that would come as far out as the next standoff is left to it
    assert {view.standoff for view in found.views} & {410, 420, 430, 440, 450, 460, 470}
    again = [(*view.direction.tolist(), view.roll_deg, view.standoff) for view in found.views]
    assert len(set(again)) == len(again)


def test_views_from_within_a_solid_are_not_had(n10):
    """A block so large that the sensor would stand inside it, touching nothing."""
    block = np.asarray(trimesh.creation.box((1100.0, 1100.0, 1100.0)).triangles)
    found = candidate_views(table(subdivisions=1), n10, [400], np.zeros(3), block)
    assert found.moved_out == len(found.views) > 0
    for view in found.views:
        assert np.abs(view.world_from_sensor.translation).max() > 550
    assert {one.reason for one in found.left_out} == {
        "collision: the body of the sensor is within 20 mm of the part or inside it, as far out as 800 mm"
    }


def test_as_many_views_as_there_are_take_seconds(n10):
    mesh = np.asarray(trimesh.creation.icosphere(subdivisions=6, radius=200.0).triangles)
    mesh = np.concatenate([mesh, mesh * 1.1])
    started = time.process_time()
    found = candidate_views(table(subdivisions=3, lowest_elevation_deg=-90), n10, [400], np.zeros(3), mesh)
    taken = time.process_time() - started
    print(f"{len(found.views)} views, {len(mesh)} triangles: {taken:.1f} s")
    assert len(found.views) == 642 and taken < 20


@pytest.mark.parametrize(
    ("changes", "field", "message"),
    [
        ({"standoff_mm": 500, "standoffs_mm": [500, 600]}, "", "not both"),
        ({"standoffs_mm": []}, "standoffs_mm", "at least 1"),
        ({"standoffs_mm": [600, 500]}, "standoffs_mm", "standoffs_mm in ascending order"),
        ({"rolls_deg": [0, 90, 0]}, "rolls_deg", "rolls_deg that differ"),
        ({"rolls_deg": [-90, 270]}, "rolls_deg", "not by whole turns"),
        ({"standoffs_mm": [500, 30]}, "standoffs_mm.1", "greater than or equal to 50"),
        ({"subdivisions": 5}, "subdivisions", "less than or equal to 4"),
        ({"up": [0, 0, 0]}, "", "not zero"),
        ({"rolls_deg": [0], "stage": {"axes": [CRADLE, TURN]}}, "", "the direction determines the roll"),
        ({"sensor_body": {"size_mm": [100, 50, 50], "margin_mm": 20}}, "sensor_body", "not both"),
        ({"sensor_body": {"centre_mm": [0, 0, 0]}}, "sensor_body", "size_mm together with centre_mm"),
        ({"sensor_body": {"size_mm": [100, 50, 5]}}, "sensor_body.size_mm.2", "greater than or equal to 10"),
        ({"clearance_mm": -1}, "clearance_mm", "greater than or equal to 0"),
        ({"clearence_mm": 5}, "clearence_mm", "did you mean 'clearance_mm'"),
        ({"flange_from_sensor": {"position_mm": [0, 0, 0]}}, "flange_from_sensor", "position_mm and quaternion_xyzw"),
        (
            {"flange_from_sensor": {"position_mm": [0, 0, 0], "quaternion_xyzw": [0, 0, 0, 2]}},
            "flange_from_sensor",
            "length 1",
        ),
        ({"flange_from_sensor": {"matrix": (2 * np.eye(4)).tolist()}}, "flange_from_sensor", "rotation"),
        ({"flange_from_sensor": {"matrix": np.diag([1.0, 1, -1, 1]).tolist()}}, "flange_from_sensor", "right-handed"),
        (
            {"flange_from_sensor": {"matrix": [*np.eye(4).tolist()[:3], [0, 0, 1, 1]]}},
            "flange_from_sensor",
            "the last row",
        ),
        (
            {"flange_from_sensor": {"matrix": np.eye(4).tolist(), "position_mm": [0, 0, 0]}},
            "flange_from_sensor",
            "either",
        ),
    ],
)
def test_an_impossible_table_is_refused(changes, field, message):
    with pytest.raises(InputError, match=message) as caught:
        table(**changes)
    assert caught.value.field == field


def test_where_no_view_is_left_the_first_reason_is_told(n10):
    stage = {"axes": [{**CRADLE, "limits_deg": [80, 81]}, TURN]}
    with pytest.raises(InputError, match=r"all of them impossible.*the first: stage: cradle 0\.0 deg beyond 80 to 81"):
        candidate_views(table(stage=stage, lowest_elevation_deg=80), n10, [500], np.zeros(3), NOTHING, where="a.toml")
    for axes in (None, [CRADLE, TURN], [CRADLE, TURN, {**CRADLE, "name": "third"}]):
        chosen = {} if axes is None else {"stage": {"axes": axes}}
        none = table(subdivisions=0, lowest_elevation_deg=80, up=(1, 1, 0.4), **chosen)
        with pytest.raises(InputError, match="no direction above it") as caught:
            candidate_views(none, n10, [500], np.zeros(3), NOTHING)
        assert caught.value.field == "views.lowest_elevation_deg"


def study(folder, scenes, views):
    text = (scenes / "two_pillars/study.toml").read_text(encoding="utf-8")
    head, _, rest = text.partition("[views]")
    tail = rest.partition("[check]")[2]
    for name in ("two_pillars.xml", "task.toml"):
        head = head.replace(f'"{name}"', f'"{(scenes / "two_pillars" / name).as_posix()}"')
    head = head.replace("# [characterisation]", "[characterisation]").replace("# campaign", "campaign")
    head = head.replace("../coupon", (scenes / "coupon").as_posix())
    path = folder / "study.toml"
    path.write_text(f"{head}[views]\n{views}\n[check]{tail}", encoding="utf-8")
    return path


def test_a_study_reads_several_standoffs_and_characterises_all_of_them(tmp_path, scenes):
    views = "subdivisions = 1\nlowest_elevation_deg = 40\nstandoffs_mm = [450, 700]\nclearance_mm = 5"
    found = open_study(study(tmp_path, scenes, views))
    assert {view.standoff for view in found.views} == {450, 700}
    assert found.campaign.distances[0] <= 450 - 100 + 60 and found.campaign.distances[-1] >= 700
    assert found.views is found.candidates.views


@pytest.mark.parametrize(
    ("views", "field", "message"),
    [
        ("standoffs_mm = [500, 900]", "views.standoffs_mm", "400 to 800 mm, the working range"),
        ("sensor_body = { size_mm = [1200, 1200, 1200] }", "views", "all of them impossible"),
        (
            '[views.stage]\naxes = [{ name = "a", direction = [0, 1, 0], limits_deg = [0, 9] }]',
            "views.stage.axes",
            "at least 2",
        ),
    ],
)
def test_a_study_refuses_views_that_cannot_be_had(tmp_path, scenes, views, field, message):
    path = study(tmp_path, scenes, views)
    with pytest.raises(InputError, match=message) as caught:
        open_study(path)
    assert (caught.value.field, caught.value.where) == (field, str(path))


def test_every_solid_shape_of_a_scene_gives_its_triangles(scenes, tmp_path):
    two_pillars = load_scene(scenes / "two_pillars/two_pillars.xml", 850.0)
    corners = triangles(two_pillars).reshape(-1, 3)
    assert np.allclose([corners.min(axis=0), corners.max(axis=0)], two_pillars.bounds, atol=1e-4)

    def sizes(**shape):
        found = triangles(scene_from_dict({"shape": shape}, 850.0))
        areas = np.cross(found[:, 1] - found[:, 0], found[:, 2] - found[:, 0]) / 2
        volume = np.einsum("ij,ij->", found.mean(axis=1) - found.mean(axis=(0, 1)), areas) / 3
        return np.linalg.norm(areas, axis=1).sum(), volume, areas.sum(axis=0)

    # inscribed in 128 corners around: sin(x)/x of pi/64 short, 4e-4, along and around each
    area, volume, _ = sizes(type="sphere", radius=10.0)
    assert np.isclose(area, 400 * math.pi, rtol=2e-3) and np.isclose(volume, 4000 / 3 * math.pi, rtol=2e-3)
    assert sizes(type="sphere", radius=10.0, flip_normals=True)[1] < 0
    area, _, _ = sizes(type="cylinder", p0=[1, 2, 3], p1=[1, 2, 53], radius=10.0)
    assert np.isclose(area, 1000 * math.pi, rtol=1e-3)
    area, _, toward = sizes(type="disk", flip_normals=True)
    assert np.isclose(area, math.pi, rtol=1e-3) and np.allclose(toward, [0, 0, -area])
    assert np.allclose(sizes(type="rectangle")[2], [0, 0, 4])
    assert np.isclose(sizes(type="cube")[1], 8)
    assert np.isclose(sizes(type="cube", bsdf={"type": "dielectric"})[1], 8)
    assert len(triangles(scene_from_dict({"air": {"type": "cube", "bsdf": {"type": "null"}}}, 850.0))) == 0
    group = {
        "group": {"type": "shapegroup", "one": {"type": "sphere", "radius": 5.0}},
        "other": {"type": "instance", "group": {"type": "ref", "id": "group"}},
    }
    boxed = triangles(scene_from_dict(group, 850.0))
    assert boxed.shape == (12, 3, 3) and np.abs(np.abs(boxed) - 5).max() < 1e-5
