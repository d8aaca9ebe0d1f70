"""Facts about scenes against closed forms, and Mitsuba's complaints in our words."""

from __future__ import annotations

import os

import numpy as np
import pytest
import trimesh

from characterisation.files.errors import InputError
from mitsim.report.author_page import page_data
from mitsim.report.scene_preview import preview_figure
from mitsim.report.scene_table import as_data, as_text
from mitsim.scene.authoring.check import Authored, findings
from mitsim.scene.first_hits import first_hits
from mitsim.scene.inspect import inspect
from mitsim.scene.load import load_scene
from mitsim.scene.mesh_facts import mesh_facts
from mitsim.scene.ray_casting.raycast import PixelRays, cast, shapes_met
from mitsim.scene.visible_surfaces import visible_surfaces
from mitsim.sensor.transforms import look_at

WHITE = '<bsdf type="matt_white"/>'
SKEW = '<rotate x="3" y="3" angle="90"/><scale value="10"/>'
TEN = '<transform name="to_world"><scale value="10"/></transform>'


def scene_of(tmp_path, body):
    file = tmp_path / "mine.xml"
    file.write_text(f'<scene version="3.0.0">\n{body}\n</scene>')
    return load_scene(file, 850)


def facts_of(tmp_path, body):
    facts = inspect(scene_of(tmp_path, body))
    return facts, {shape.name: shape for shape in facts.shapes}


def test_areas_boxes_and_materials_of_the_artefact(scenes):
    facts = inspect(load_scene(scenes / "two_pillars/two_pillars.xml", 850))
    shapes = {shape.name: shape for shape in facts.shapes}
    assert np.isclose(shapes["plane"].area, 180 * 120)
    assert np.isclose(shapes["pillar1"].area, 2 * np.pi * 20 * 60)
    assert np.isclose(shapes["pillar1_top"].area, np.pi * 20**2)
    assert np.allclose(shapes["pillar2"].bounds, [[15, -20, 0], [55, 20, 60]])
    assert (shapes["pillar1"].kind, shapes["pillar1"].bsdf) == ("cylinder", "machined_metal")
    assert shapes["pillar1"].alpha[0] < shapes["plane"].alpha[0]  # Ra 0.37 against 0.74 um
    assert all("prior" in shape.provenance and shape.alpha_factor > 1 for shape in facts.shapes)
    assert not any(shape.delta or shape.two_sided or shape.emitter for shape in facts.shapes)


GROUP = f'<shape type="shapegroup" id="g"><shape type="sphere">{TEN}{WHITE}</shape></shape>'


def test_an_instance_is_seen_and_its_area_is_not_known(tmp_path, n10):
    """Two balls of one group on a plate; a ray that meets a ball counts for the instance, not for the shape in it."""
    aside, wide = (
        f'<transform name="to_world"><{how}/></transform>' for how in ('translate x="30"', 'scale value="60"')
    )
    body = (
        f'<shape type="disk" id="plate">{wide}{WHITE}</shape>{GROUP}'
        f'<shape type="instance" id="one"><ref id="g"/></shape>'
        f'<shape type="instance" id="two">{aside}<ref id="g"/></shape>'
    )
    scene = scene_of(tmp_path, body)
    shapes = {shape.name: shape for shape in inspect(scene).shapes}
    assert set(shapes) == {"plate", "one", "two"}
    assert np.isclose(shapes["plate"].area, np.pi * 60**2)
    for name in ("one", "two"):
        assert np.isnan(shapes[name].area)
        assert shapes[name].front_hits > 100
        assert shapes[name].back_hits == 0
    down = first_hits(scene.mitsuba, np.array([[0.0, 0, 50], [30, 0, 50], [-30, 0, 50]]), np.tile([0.0, 0, -1], (3, 1)))
    assert [scene.names[number] for number in down.shape] == ["one", "two", "plate"]
    assert np.allclose(down.distance, [40, 40, 50], atol=1e-3)
    rays = PixelRays(np.zeros(3), np.array([[[0.0, 0, 1]]]))
    for shift, name in ((0, "one"), (30, "two"), (-30, "plate")):
        moved = look_at([shift, 0, 50], [shift, 0, 0], [0, 1, 0])
        for shape in (cast(scene, rays, moved, np.empty((0, 3))).shape, shapes_met(scene, rays, moved)):
            assert scene.names[shape.item()] == name and shape.item() >= 0


def test_curves_are_checked_and_put_on_the_page(tmp_path, n10):
    (tmp_path / "wire.txt").write_text("0 0 0 1\n10 0 0 1\n20 5 0 1\n30 5 5 1\n40 0 5 1\n")
    wires = "".join(
        f'<shape type="{kind}" id="{kind}"><string name="filename" value="wire.txt"/>{WHITE}</shape>'
        for kind in ("bsplinecurve", "linearcurve")
    )
    scene = scene_of(tmp_path, f'<shape type="cube" id="block">{TEN}{WHITE}</shape>{wires}')
    facts, pose = inspect(scene), look_at((0, -300, 300), (0, 0, 0), (0, 1, 0))
    seen = visible_surfaces(scene, n10.rig, pose)
    found = findings(facts, n10, pose, seen, True)
    rows = {line.split()[0]: line for line in as_text(facts, seen, found).splitlines() if line}
    data = {one["name"]: one for one in as_data(facts, seen, found)["features"]}
    faces = {
        one["name"]: one for one in page_data(Authored(scene, facts, n10, found, None, None), "")["solid"]["faces"]
    }
    for kind in ("bsplinecurve", "linearcurve"):
        assert "not known" in rows[kind]
        assert data[kind]["area_mm2"] is None
        assert data[kind]["pixels"] > 0
        assert faces[kind]["area"] is None
    assert faces["block"]["area"] == pytest.approx(6 * 20**2)
    assert preview_figure(scene, facts, n10, pose, seen, []) is not None


def test_points_spread_over_a_shape_lie_on_it_evenly(tmp_path):
    _, shapes = facts_of(tmp_path, f'<shape type="sphere" id="s"><float name="radius" value="7"/>{WHITE}</shape>')
    sphere = shapes["s"]
    assert np.allclose(np.linalg.norm(sphere.points, axis=1), 7, atol=1e-4)
    assert np.allclose(sphere.normals, sphere.points / 7, atol=1e-4)
    # a random set of n = 2048 has a centroid within 7 / sqrt(3 n) = 0.09 mm (1 sigma) of the centre
    assert np.linalg.norm(sphere.points.mean(axis=0)) < 0.09


def test_a_box_is_closed_and_each_fault_of_a_mesh_is_counted():
    box = trimesh.creation.box((2, 3, 4))
    vertices, triangles = np.asarray(box.vertices), np.asarray(box.faces, np.int64)
    sound = mesh_facts(vertices, triangles, 1e-6)
    assert sound.closed
    assert np.isclose(sound.volume, 24)
    assert np.isclose(mesh_facts(vertices, triangles[:, ::-1], 1e-6).volume, -24)
    separate = mesh_facts(vertices[triangles].reshape(-1, 3), np.arange(36).reshape(-1, 3), 1e-6)
    assert separate.closed  # vertices at one place are one
    open_box = mesh_facts(vertices, triangles[1:], 1e-6)
    assert (open_box.closed, open_box.open_edges, open_box.volume) == (False, 3, 0)
    twice = mesh_facts(vertices, np.vstack([triangles, triangles[:1]]), 1e-6)
    assert (twice.duplicate, twice.nonmanifold_edges, twice.closed) == (1, 3, False)
    line = mesh_facts(vertices, np.vstack([triangles, [[0, 1, 1]]]), 1e-6)
    assert (line.degenerate, line.closed) == (1, True)


def test_rays_tell_front_from_back(tmp_path):
    scene = scene_of(
        tmp_path,
        f'<shape type="rectangle" id="r">{TEN}{WHITE}</shape>'
        f'<shape type="rectangle" id="both"><transform name="to_world"><scale value="10"/>'
        f'<translate x="30"/></transform><bsdf type="twosided">{WHITE}</bsdf></shape>',
    )
    origins = np.array([[0, 0, 5], [0, 0, -5], [30, 0, -7], [60, 0, 5]], float)
    hits = first_hits(scene.mitsuba, origins, -np.sign(origins[:, 2:]) * [0, 0, 1.0])
    assert hits.shape.tolist() == [0, 0, 1, -1]
    assert hits.front.tolist() == [True, False, True, False]
    assert np.allclose(hits.distance[:3], [5, 5, 7])
    assert np.allclose(hits.normal[:3], [[0, 0, 1], [0, 0, -1], [0, 0, -1]])
    assert np.isnan(hits.distance[3])


def test_inward_cubes_show_their_backs_only(tmp_path):
    flipped = '<boolean name="flip_normals" value="true"/>'
    _, shapes = facts_of(tmp_path, f'<shape type="cube" id="in">{flipped}{TEN}{WHITE}</shape>')
    assert np.isclose(shapes["in"].mesh.volume, -8000)
    assert shapes["in"].back_hits > 100000
    assert shapes["in"].front_hits < 0.001 * shapes["in"].back_hits
    _, shapes = facts_of(tmp_path, f'<shape type="cube" id="out">{TEN}{WHITE}</shape>')
    assert np.isclose(shapes["out"].mesh.volume, 8000)
    assert shapes["out"].back_hits < 0.001 * shapes["out"].front_hits


def test_what_a_camera_sees_stands_where_the_shape_is(tmp_path, n10):
    scene = scene_of(tmp_path, f'<shape type="rectangle" id="r">{TEN}{WHITE}</shape>')
    pose = look_at((0, -300, 400), (0, 0, 0), (0, 0, 1))
    visible = visible_surfaces(scene, n10.rig, pose)
    mine = visible.shape == 0
    assert mine.sum() > 300
    assert (visible.front[mine] & visible.seen_by_all[mine]).all()
    world = pose.points(visible.point[mine])
    assert np.abs(world[:, 2]).max() < 1e-3
    assert np.abs(world[:, :2]).max() < 10.01
    assert np.allclose(pose.directions(visible.normal[mine]), [0, 0, 1], atol=1e-5)


def test_lamps_have_their_flux_and_delta_materials_are_known(tmp_path):
    facts, shapes = facts_of(
        tmp_path,
        f"""
        <shape type="rectangle" id="lamp">{TEN}
            <emitter type="area"><rgb name="radiance" value="0.01"/></emitter></shape>
        <emitter type="point"><rgb name="intensity" value="2"/></emitter> <emitter type="constant"/>
        <shape type="sphere"><float name="radius" value="5"/><bsdf type="conductor"/></shape>
        <shape type="sphere" id="rough"><bsdf type="roughconductor"><float name="alpha" value="0.2"/></bsdf></shape>
    """,
    )
    flux = dict(facts.emitters)
    assert np.isclose(flux.pop("area"), np.pi * 0.01 * 400)
    assert np.isclose(flux.pop("PointLight"), 4 * np.pi * 2)
    assert np.isnan(list(flux.values())).all()
    assert shapes["lamp"].emitter
    unnamed = next(shape for shape in facts.shapes if not shape.named)
    assert unnamed.delta
    assert not shapes["rough"].delta
    assert shapes["rough"].alpha == pytest.approx((0.2, 0.2))
    assert shapes["rough"].bsdf == "roughconductor"


@pytest.mark.parametrize(("beam", "cutoff"), [(20.0, 30.0), (0.0, 80.0), (15.0, 15.0)])
def test_a_spot_emits_within_its_cone(tmp_path, beam, cutoff):
    """The intensity over the sphere, by the midpoint rule; it was taken for that of a point: 15 times as much."""
    spot = (
        f'<shape type="sphere"><float name="radius" value="9"/></shape><emitter type="spot">'
        f'<float name="cutoff_angle" value="{cutoff}"/><float name="beam_width" value="{beam}"/>'
        '<rgb name="intensity" value="0.5"/></emitter>'
    )
    facts, _ = facts_of(tmp_path, spot)
    angle = (np.arange(200_000) + 0.5) * np.radians(cutoff) / 200_000
    share = np.clip((cutoff - np.degrees(angle)) / max(cutoff - beam, 1e-9), 0, 1)
    flux = 2 * np.pi * 0.5 * np.mean(share * np.sin(angle)) * np.radians(cutoff)
    assert dict(facts.emitters)["SpotLight"] == pytest.approx(flux, rel=1e-3)


@pytest.mark.parametrize(
    ("body", "field", "says"),
    [
        ('<shape type="sphere" id="a"><float name="radios" value="20"/></shape>', "shape sphere: radios", "'radius'"),
        (
            '<shape type="sphere" id="a"><bsdf type="roughconductor"><float name="alfa" value="1"/></bsdf></shape>',
            "bsdf roughconductor: alfa",
            "'alpha'",
        ),
        ('<shape type="sphere" id="a"/><shape type="sphere" id="a"/>', "id", "second object of the id 'a'"),
        ('<shape type="ply" id="a"><string name="filename" value="parts/bos.ply"/></shape>', "filename", "'boss.ply'"),
        ('<shape type="obj" id="a"><string name="filename" value="no.obj"/></shape>', "filename", "does not exist"),
        ('<shape type="stl" id="a"><string name="filename" value="a.stl"/></shape>', "type", "mitsim part"),
        ('<shape type="cylindre" id="a"/>', "type", "'cylinder'"),
        (
            '<bsdf type="machined_metals" id="f"/><shape type="sphere" id="a"><ref id="f"/></shape>',
            "type",
            "'machined_metal'",
        ),
        (f'<shape type="cube" id="a"><transform name="to_world">{SKEW}</transform></shape>', "rotate", 'y="0.7071068"'),
        ('<bsdf type="diffuse" id="finish"/><shape type="sphere" id="a"><ref id="finsh"/></shape>', "ref", "'finish'"),
        (
            '<bsdf type="machined_metal" id="f"><float name="Raa" value="1"/></bsdf><shape type="sphere" id="a"/>',
            "Raa",
            "'Ra'",
        ),
    ],
)
def test_complaints_name_the_place_and_the_nearest_right_name(tmp_path, body, field, says):
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "boss.ply").write_bytes(b"")
    with pytest.raises(InputError) as caught:
        scene_of(tmp_path, body)
    assert caught.value.field == field
    assert says in str(caught.value)
    assert "mine.xml" in caught.value.where
    assert ".cpp" not in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


def test_the_bottom_of_a_deep_bore_is_seen_and_what_is_inside_is_not(tmp_path):
    """A bore of 4 mm in a wide plate: 10,000 rays from all around miss its bottom, which looks out through it."""
    ends = '<point name="p0" x="0.3" y="0.2" z="-40"/><point name="p1" x="0.3" y="0.2" z="0"/>'
    bore = f'<shape type="cylinder" id="bore">{ends}'
    place = '<transform name="to_world"><scale value="2"/><translate x="{}" y="0.2" z="{}"/></transform>'
    disk = f'<shape type="disk" id="{{}}">{place}'
    under = disk.format("under", 0.3, -40.01).replace('scale value="2"', 'scale value="3"')
    _, shapes = facts_of(
        tmp_path,
        f'{bore}<float name="radius" value="2"/><boolean name="flip_normals" value="true"/>{WHITE}</shape>'
        f"{disk.format('bottom', 0.3, -40)}{WHITE}</shape>{disk.format('buried', 100, 0)}{WHITE}</shape>"
        f"{under}{WHITE}</shape>"
        '<shape type="cube" id="box"><transform name="to_world"><scale x="20" y="20" z="20"/>'
        f'<translate x="100"/></transform>{WHITE}</shape>'
        '<shape type="cube" id="far"><transform name="to_world"><scale value="20"/><translate x="-900"/></transform>'
        f"{WHITE}</shape>",
    )
    assert shapes["bottom"].front_hits > 0
    assert shapes["buried"].front_hits + shapes["buried"].back_hits == 0


def test_a_part_far_from_the_origin_is_reported(tmp_path, n10):
    """Single precision has steps of 2^-23 of a power of two: 0.0156 mm at 200 m."""
    for metres, told in ((5, False), (200, True)):
        place = f'<transform name="to_world"><scale value="40"/><translate x="{1000 * metres}"/></transform>'
        scene = scene_of(tmp_path, f'<shape type="cube" id="block">{place}{WHITE}</shape>')
        pose = look_at(scene.centre + np.array([0, 0, 500]), scene.centre, (0, 1, 0))
        found = findings(inspect(scene), n10, pose, visible_surfaces(scene, n10.rig, pose), False)
        assert any("rounded to 0.016 mm" in one.what for one in found) is told


@pytest.mark.parametrize(
    ("kind", "scale", "right"),
    [
        ("sphere", 'x="2"', False),
        ("sphere", 'z="2"', False),
        ("sphere", 'value="2"', True),
        ("cylinder", 'y="2"', False),
        ("cylinder", 'z="2"', True),
    ],
)
def test_spheres_and_cylinders_of_elliptical_section_are_refused(tmp_path, kind, scale, right):
    """Mitsuba draws circles with the scale along x, and samples points of ellipses."""
    turned = f'<transform name="to_world"><scale {scale}/><rotate x="0.6" y="0.8" angle="40"/></transform>'
    body = f'<shape type="{kind}" id="a">{WHITE}<float name="radius" value="20"/>{turned}</shape>'
    if right:
        assert scene_of(tmp_path, body).names == ("a",)
    else:
        with pytest.raises(InputError, match=f"shape a: found a {kind} that to_world scales unequally"):
            scene_of(tmp_path, body)


def test_a_finish_of_an_included_file_has_its_type(tmp_path):
    (tmp_path / "finish.xml").write_text('<scene version="3.0.0"><bsdf type="roughconductor" id="f"/></scene>')
    _, shapes = facts_of(
        tmp_path, f'<include filename="finish.xml"/><shape type="cube" id="a">{TEN}<ref id="f"/></shape>'
    )
    assert shapes["a"].bsdf == "roughconductor"


def test_names_of_files_may_consist_of_parameters(tmp_path):
    for name in ("ball", "cube"):
        kind = f'<shape type="{"sphere" if name == "ball" else name}" id="{name}">{TEN}{WHITE}</shape>'
        (tmp_path / f"{name}.xml").write_text(f'<scene version="3.0.0">{kind}</scene>')
    (tmp_path / "scene.xml").write_text(
        '<scene version="3.0.0"><default name="part" value="ball"/><include filename="$part.xml"/></scene>'
    )
    assert load_scene(tmp_path / "scene.xml", 850).names == ("ball",)
    assert load_scene(tmp_path / "scene.xml", 850, {"part": "cube"}).names == ("cube",)
    (tmp_path / "mesh.xml").write_text(
        '<scene version="3.0.0"><default name="part" value="no"/><shape type="ply">'
        '<string name="filename" value="$part.ply"/></shape></scene>'
    )
    os.mkfifo(tmp_path / "pipe.ply")
    with pytest.raises(InputError, match="not a regular file"):
        load_scene(tmp_path / "mesh.xml", 850, {"part": "pipe"})


def test_a_rotation_about_a_unit_vector_keeps_sizes_and_others_are_refused(tmp_path):
    """Mitsuba 3.9.1 makes a cube of 90 x 90 x 70 mm of a box of 40 x 30 x 20 mm that is turned about (1, 1, 0)."""
    for axis in ('x="0.7071" y="0.7071"', 'value="0.70710678, 0.70710678, 0"', 'x="$along" y="$along"'):
        turn = f'<rotate {axis} angle="90"/>'
        box = f'<transform name="to_world"><scale x="20" y="15" z="10"/>{turn}</transform>'
        body = f'<default name="along" value="0.70710678"/><shape type="cube" id="a">{box}</shape>'
        assert inspect(scene_of(tmp_path, body)).shapes[0].area == pytest.approx(5200, rel=1e-4)
        with pytest.raises(InputError, match=r'a unit vector: x="0\.7071068" y="0\.7071068" z="0"'):
            scene_of(tmp_path, body.replace("0.7071", "0.8071"))
