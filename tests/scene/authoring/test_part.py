"""From a mesh or a STEP file to a scene folder: what is recognised, what is written, what is refused."""

from __future__ import annotations

import errno
import importlib.util
import math
import os
import tempfile
import tomllib
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import example, given, settings
from hypothesis import strategies as st

from characterisation.features.surfaces import Cylinder, Plane, Sphere
from characterisation.files.errors import InputError
from mitsim.scene.authoring.check_task import read_features
from mitsim.scene.authoring.face import surface_distance
from mitsim.scene.authoring.part_folder import Finishing, scene_xml, write_part
from mitsim.scene.authoring.read_mesh import read_mesh
from mitsim.scene.authoring.read_step import read_step, step_installed
from mitsim.scene.authoring.recognise import recognised
from mitsim.scene.authoring.segment_mesh import _joined, segment_mesh
from mitsim.scene.inspect import inspect
from mitsim.scene.load import load_scene
from mitsim.scene.surface.named_finishes import NAMED_FINISHES
from tests.shell import mitsim_here

needs_step = pytest.mark.skipif(not step_installed(), reason="OpenCASCADE, which reads STEP, is not installed")


def cut_of(mesh, **options):
    """The faces of a mesh as a file in single precision holds it, by kind and number, the largest first."""
    part = segment_mesh(np.asarray(mesh.vertices, np.float32).astype(float), np.asarray(mesh.faces), **options)
    count = {"plane": 0, "cylinder": 0, "sphere": 0, "face": 0}
    order, faces = list(count), {}
    keys = {id(one): (order.index(one.kind), -round(one.area, 6), *one.vertices.mean(0)) for one in part.faces}
    for face in sorted(part.faces, key=lambda one: keys[id(one)]):
        count[face.kind] += 1
        faces[f"{face.kind}_{count[face.kind]}"] = face
    return faces, part.remarks


def plate_with_pillar():
    """A plate of 100 x 80 x 10 mm with a pillar of radius 15 mm, 40 mm high: one closed skin, as an STL has it."""
    count, radius = 64, 15.0
    angle = 2 * np.pi * np.arange(count) / count
    ring = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    square = np.array([[50, 40], [-50, 40], [-50, -40], [50, -40]], float)
    at = [(square, 0.0), (square, 10.0), (ring, 10.0), (ring, 50.0)]
    vertices = np.concatenate([np.column_stack([xy, np.full(len(xy), z)]) for xy, z in at])
    bottom, top, low, high = 0, 4, 8, 8 + count
    triangles = [[0, 2, 1], [0, 3, 2]]
    for i in range(4):
        j = (i + 1) % 4
        triangles += [[bottom + i, bottom + j, top + j], [bottom + i, top + j, top + i]]
    corner = (np.arange(count) * 4 // count).tolist()  # the corner of each quarter of the ring
    for i in range(count):
        j = (i + 1) % count
        triangles += [[low + i, low + j, high + j], [low + i, high + j, high + i]]
        triangles += [[low + j, low + i, top + corner[i]]]
        if corner[i] != corner[j]:
            triangles += [[low + j, top + corner[i], top + corner[j]]]
    triangles += [[high, high + i, high + i + 1] for i in range(1, count - 1)]
    return trimesh.Trimesh(vertices, triangles, process=False)


def rounded_prism(radius=4.0, half=20.0, pieces=8):
    """A square prism whose edges are rounded: walls that run tangentially into fillets, as filleted STLs do."""
    angle = np.linspace(0, np.pi / 2, pieces + 1)
    outline = []
    for quarter in range(4):
        turn = quarter * np.pi / 2
        c = (half - radius) * np.sqrt(2) * np.array([np.cos(turn + np.pi / 4), np.sin(turn + np.pi / 4)])
        outline.append(c + radius * np.stack([np.cos(angle + turn), np.sin(angle + turn)], axis=1))
    outline = np.concatenate(outline)
    n = len(outline)
    vertices = np.concatenate([np.column_stack([outline, np.full(n, z)]) for z in (0.0, 30.0)])
    triangles = []
    for i in range(n):
        j = (i + 1) % n
        triangles += [[i, j, n + j], [i, n + j, n + i]]
    triangles += [[0, i + 1, i] for i in range(1, n - 1)] + [[n, n + i, n + i + 1] for i in range(1, n - 1)]
    return trimesh.Trimesh(vertices, triangles, process=False)


def step_file(stack):
    """STEP (AP214) of coaxial discs of (radius, height) [mm], each narrower than the one below, from z = 0 up."""
    lines: list[str] = []

    def add(text):
        lines.append(text)
        return f"#{len(lines)}"

    def point(*xyz):
        return add(f"CARTESIAN_POINT('',({','.join(repr(float(v)) for v in xyz)}))")

    up, down, along_x = (add(f"DIRECTION('',({x}.,0.,{z}.))") for x, z in ((0, 1), (0, -1), (1, 0)))

    def axes(z, direction=up):
        return add(f"AXIS2_PLACEMENT_3D('',{point(0, 0, z)},{direction},{along_x})")

    def circle(radius, z):
        curve, vertex = add(f"CIRCLE('',{axes(z)},{float(radius)})"), add(f"VERTEX_POINT('',{point(radius, 0, z)})")
        return vertex, add(f"EDGE_CURVE('',{vertex},{vertex},{curve},.T.)")

    def face(surface, *loops):
        bounds = []
        for number, loop in enumerate(loops):
            edges = [add(f"ORIENTED_EDGE('',*,*,{edge},{sense})") for edge, sense in loop]
            kind = "FACE_BOUND" if number else "FACE_OUTER_BOUND"
            bounds.append(add(f"{kind}('',{add(f'''EDGE_LOOP('',({','.join(edges)}))''')},.T.)"))
        faces.append(add(f"ADVANCED_FACE('',({','.join(bounds)}),{surface},.T.)"))

    faces: list[str] = []
    z, below = 0.0, None
    for radius, height in stack:
        (v0, c0), (v1, c1) = circle(radius, z), circle(radius, z + height)
        if below is None:
            face(add(f"PLANE('',{axes(z, down)})"), [(c0, ".F.")])
        else:
            face(add(f"PLANE('',{axes(z)})"), [(below, ".T.")], [(c0, ".F.")])
        vector = add(f"VECTOR('',{up},1.)")
        line = add(f"LINE('',{point(radius, 0, z)},{vector})")
        seam = add(f"EDGE_CURVE('',{v0},{v1},{line},.T.)")
        side = add(f"CYLINDRICAL_SURFACE('',{axes(z)},{float(radius)})")
        face(side, [(c0, ".T."), (seam, ".T."), (c1, ".F."), (seam, ".F.")])
        z, below = z + height, c1
    face(add(f"PLANE('',{axes(z)})"), [(below, ".T.")])
    solid = add(f"MANIFOLD_SOLID_BREP('',{add(f'''CLOSED_SHELL('',({','.join(faces)}))''')})")
    context = add("APPLICATION_CONTEXT('mechanical design')")
    product = add(f"PRODUCT('shaft','','',({add(f'''PRODUCT_CONTEXT('',{context},'mechanical')''')}))")
    formation = add(f"PRODUCT_DEFINITION_FORMATION('','',{product})")
    design = add(f"PRODUCT_DEFINITION_CONTEXT('part definition',{context},'design')")
    shape = add(f"PRODUCT_DEFINITION_SHAPE('','',{add(f'''PRODUCT_DEFINITION('','',{formation},{design})''')})")
    mm = add("(LENGTH_UNIT() NAMED_UNIT(*) SI_UNIT(.MILLI.,.METRE.))")
    rad = add("(NAMED_UNIT(*) PLANE_ANGLE_UNIT() SI_UNIT($,.RADIAN.))")
    sr = add("(NAMED_UNIT(*) SI_UNIT($,.STERADIAN.) SOLID_ANGLE_UNIT())")
    sure = add(f"UNCERTAINTY_MEASURE_WITH_UNIT(LENGTH_MEASURE(1.E-06),{mm},'distance_accuracy_value','')")
    units = add(
        f"(GEOMETRIC_REPRESENTATION_CONTEXT(3) GLOBAL_UNCERTAINTY_ASSIGNED_CONTEXT(({sure})) "
        f"GLOBAL_UNIT_ASSIGNED_CONTEXT(({mm},{rad},{sr})) REPRESENTATION_CONTEXT('',''))"
    )
    brep = add(f"ADVANCED_BREP_SHAPE_REPRESENTATION('',({solid},{axes(0)}),{units})")
    add(f"SHAPE_DEFINITION_REPRESENTATION({shape},{brep})")
    body = "\n".join(f"#{number}={line};" for number, line in enumerate(lines, 1))
    return (
        "ISO-10303-21;\nHEADER;\nFILE_DESCRIPTION((''),'2;1');\nFILE_NAME('','',(''),(''),'','','');\n"
        "FILE_SCHEMA(('AUTOMOTIVE_DESIGN { 1 0 10303 214 1 1 1 1 }'));\nENDSEC;\nDATA;\n"
        f"{body}\nENDSEC;\nEND-ISO-10303-21;\n"
    )


def test_a_box_has_six_planes_whose_normals_point_outward():
    faces, remarks = cut_of(trimesh.creation.box((10, 20, 30)))
    assert list(faces) == [f"plane_{i}" for i in range(1, 7)]
    assert remarks == []
    assert [round(face.area) for face in faces.values()] == [600, 600, 300, 300, 200, 200]
    for face in faces.values():
        assert face.surface.point @ face.surface.normal > 4.9  # the middle of the box is the origin
        assert np.allclose(face.corner_normals(), face.surface.normal)


def test_a_cylinder_is_recognised_with_exact_normals():
    faces, _ = cut_of(trimesh.creation.cylinder(20, 60, sections=64))
    assert list(faces) == ["plane_1", "plane_2", "cylinder_1"]
    side = faces["cylinder_1"]
    assert side.surface.radius == pytest.approx(20, abs=1e-5)
    assert np.allclose(side.surface.axis, [0, 0, 1], atol=1e-7)
    assert np.allclose(side.surface.point, [0, 0, -30], atol=1e-5)
    corners = side.vertices[side.triangles]
    radial = corners * [1, 1, 0] / 20
    assert np.allclose(side.corner_normals(), radial, atol=1e-6)
    # the middle of a triangle lies a third of the way between a ring's vertex and a chord's middle: its distance
    # from the axis is r |1 + 1 + exp(i 2 pi / 64)| / 3, for every triangle has two corners on one generator
    assert side.sag == pytest.approx(20 - 20 * abs(2 + np.exp(2j * np.pi / 64)) / 3, abs=1e-5)


def test_lengths_on_a_cylinder_run_round_it_without_a_seam():
    faces, _ = cut_of(trimesh.creation.cylinder(20, 60, sections=64))
    face = faces["cylinder_1"]
    places, corners = face.corner_places(), face.vertices[face.triangles]
    for i, j in ((0, 1), (1, 2), (2, 0)):
        flat = np.linalg.norm(places[:, i] - places[:, j], axis=1)
        chord = np.linalg.norm(corners[:, i] - corners[:, j], axis=1)
        assert np.allclose(flat, chord, rtol=5e-4)  # arc over chord is 1 + (2 pi / 64)^2 / 24 = 1.0004


def test_a_sphere_and_a_bore():
    faces, _ = cut_of(trimesh.creation.icosphere(3, 15))
    assert list(faces) == ["sphere_1"]
    assert faces["sphere_1"].surface.radius == pytest.approx(15, abs=1e-5)
    assert np.allclose(faces["sphere_1"].surface.centre, 0, atol=1e-5)
    faces, _ = cut_of(trimesh.creation.annulus(10, 20, 30))
    outer, inner = faces["cylinder_1"], faces["cylinder_2"]
    assert (outer.convex, inner.convex) == (True, False)
    assert (outer.corner_normals() * outer.vertices[outer.triangles]).sum(-1).min() > 0
    assert (inner.corner_normals() * inner.vertices[inner.triangles]).sum(-1).max() < 0


@pytest.mark.parametrize("reach_deg", [5.0, 8.0, 11.0])
def test_shallow_caps_and_strips_are_recognised(reach_deg):
    reach, steps = math.radians(reach_deg), np.linspace(-1, 1, 13)
    x, y = (a.ravel() for a in np.meshgrid(steps, steps))
    corners = np.arange(13 * 13).reshape(13, 13)
    a, b, c, d = (part.ravel() for part in (corners[:-1, :-1], corners[:-1, 1:], corners[1:, 1:], corners[1:, :-1]))
    triangles = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    strip = np.stack([100 * np.sin(reach * x), 40 * y, 100 * np.cos(reach * x)], axis=1)
    tilt = reach * np.stack([x, y]) / math.sqrt(2)
    cap = np.stack([tilt[0], tilt[1], np.sqrt(1 - (tilt**2).sum(axis=0))], axis=1) * 100
    for vertices, kind in ((strip, Cylinder), (cap, Sphere)):
        face = recognised(trimesh.Trimesh(vertices, triangles, process=False), np.arange(len(triangles)))
        assert isinstance(face.surface, kind) and face.surface.radius == pytest.approx(100, rel=1e-3)
    flat = trimesh.Trimesh(np.stack([x, y, np.zeros_like(x)], axis=1), triangles, process=False)
    assert isinstance(recognised(flat, np.arange(len(triangles))).surface, Plane)


def test_a_chamfer_is_no_sphere_and_a_cone_no_cylinder():
    """Two rings of vertices lie on a sphere and all of a cone's facets bend little; neither may be taken for one."""
    count = 128
    angle = 2 * np.pi * np.arange(count) / count
    rings = [(20.0, 0.0), (20.0, 30.0), (19.0, 31.0)]
    vertices = np.concatenate(
        [np.column_stack([r * np.cos(angle), r * np.sin(angle), np.full(count, z)]) for r, z in rings]
    )
    i, j = np.arange(count), (np.arange(count) + 1) % count
    walls = [np.column_stack([i, j, count + j]), np.column_stack([i, count + j, count + i])]
    sides = [wall + level * count for level in (0, 1) for wall in walls]
    fan = np.arange(1, count - 1)
    zero = np.zeros(count - 2, int)
    caps = [np.column_stack([zero, fan + 1, fan]), np.column_stack([zero, fan, fan + 1]) + 2 * count]
    faces, _ = cut_of(trimesh.Trimesh(vertices, np.concatenate([*sides, *caps]), process=False))
    assert list(faces) == ["plane_1", "plane_2", "cylinder_1", "face_1"]
    assert faces["cylinder_1"].surface.radius == pytest.approx(20, abs=1e-4)
    assert np.isnan(faces["face_1"].sag)


def test_a_plate_with_a_pillar_in_one_skin():
    mesh = plate_with_pillar()
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(100 * 80 * 10 + 32 * 225 * np.sin(2 * np.pi / 64) * 40)
    faces, remarks = cut_of(mesh)
    assert remarks == []
    assert list(faces) == [*(f"plane_{i}" for i in range(1, 8)), "cylinder_1"]
    assert faces["cylinder_1"].surface.radius == pytest.approx(15, abs=1e-5)
    assert np.allclose(faces["cylinder_1"].surface.point, [0, 0, 10], atol=1e-5)


def test_walls_that_run_into_fillets_are_still_planes():
    faces, _ = cut_of(rounded_prism())
    kinds = [face.kind for face in faces.values()]
    assert kinds == ["plane"] * 6 + ["cylinder"] * 4
    fillets = [face for face in faces.values() if face.kind == "cylinder"]
    assert all(face.surface.radius == pytest.approx(4, abs=1e-4) for face in fillets)


def test_neighbours_on_one_surface_are_joined():
    mesh = trimesh.creation.cylinder(20, 60, sections=64)
    middles, normals = mesh.triangles_center, mesh.face_normals
    number = np.where(np.abs(normals[:, 2]) > 0.5, normals[:, 2] > 0, 2 + (middles[:, 0] > 0)).astype(int)
    pieces = [np.flatnonzero(number == k) for k in range(4)]
    faces = _joined(mesh, pieces, mesh.face_adjacency)
    assert sorted(face.kind for face in faces) == ["cylinder", "plane", "plane"]
    assert max(len(face.triangles) for face in faces) == 128


def test_inward_bodies_are_turned_and_told_but_cavities_are_not():
    box = trimesh.creation.box((10, 20, 30))
    box.invert()
    faces, remarks = cut_of(box)
    assert remarks == ["1 of 1 bodies had inward normals: turned outward"]
    assert all(face.surface.point @ face.surface.normal > 0 for face in faces.values())
    hollow = trimesh.creation.box((4, 4, 4))
    hollow.invert()
    _, remarks = cut_of(trimesh.util.concatenate([trimesh.creation.box((10, 20, 30)), hollow]))
    assert remarks == []
    _, remarks = cut_of(trimesh.Trimesh(*(lambda b: (b.vertices, b.faces[2:]))(trimesh.creation.box((9, 9, 9)))))
    assert "not closed" in remarks[0]


@pytest.mark.parametrize("inverted", [False, True])
def test_a_pin_in_a_ring_is_no_cavity_and_a_cavity_turns_with_its_body(inverted):
    """A ring round a ball; a shell with a ball in its cavity: each ball is solid, whichever way the file turns them."""
    ring, ball = trimesh.creation.annulus(18.0, 20.0, 30.0, sections=64), trimesh.creation.icosphere(3, 5.0)
    cavity = trimesh.creation.box((14.0, 14.0, 14.0))
    cavity.invert()
    shell = [trimesh.creation.box((20.0, 20.0, 20.0)), cavity]
    for bodies in ([ring, ball], [*shell, ball]):
        mesh = trimesh.util.concatenate(bodies)
        if inverted:
            mesh.invert()
        faces, remarks = cut_of(mesh)
        assert [face.convex for face in faces.values() if face.kind == "sphere"] == [True]
        assert bool(remarks) == inverted
        across = {True: [], False: []}
        for face in faces.values():
            if face.kind == "plane" and len(bodies) == 3:
                across[bool(np.abs(face.surface.point).max() > 8)].append(face.surface.point @ face.surface.normal)
        assert np.allclose(across[True], 10.0) and np.allclose(across[False], -7.0)


@pytest.fixture(scope="module")
def plate(tmp_path_factory):
    folder = tmp_path_factory.mktemp("plate")
    plate_with_pillar().export(folder / "plate.stl")
    write_part(folder / "plate.stl", folder / "plate", finishing=Finishing("brass", "milled", 1.6))
    return folder


def test_the_folder_holds_a_scene_that_loads_and_a_task_that_fits_it(plate):
    names = {path.name for path in (plate / "plate").iterdir()}
    sides = {f"{side}.ply" for side in ("left", "right", "front", "back", "bottom", "top", "top_at_z10mm")}
    assert names == sides | {"boss_30mm.ply", "plate.xml", "task.toml"}
    scene = load_scene(plate / "plate/plate.xml", 850, {"Ra": "3.2"})
    assert {str(finish) for finish in scene.finishes} == {"brass/milled Ra 3.2 um"}
    task = read_features(plate / "plate/task.toml")
    assert set(task.features) == set(scene.names)
    facts = inspect(scene)
    assert facts.merged_mesh.closed
    assert facts.merged_mesh.volume == pytest.approx(plate_with_pillar().volume, rel=1e-5)
    for shape in facts.shapes:
        nominal = task.features[shape.name].nominal()
        # the task is written to 0.1 um, and single precision knows 50 mm to 4e-6 mm
        assert np.abs(surface_distance(nominal, shape.mesh.vertices)).max() < 1e-3
        assert shape.mesh.texture
        assert shape.back_hits <= 0.001 * max(shape.front_hits, 1000)
    example_lines = [line[2:] for line in (plate / "plate/task.toml").read_text().splitlines() if line.startswith("# ")]
    measured = tomllib.loads("\n".join(example_lines[example_lines.index("[measurements.boss_30mm_radius]") :]))
    assert measured["measurements"]["boss_30mm_radius"]["nominal"] == 15.0


def test_normals_in_the_files_are_those_of_the_surface(plate):
    """A faceted pillar would mirror the projector from whole facets; Mitsuba shades with the normals of the file."""
    scene = load_scene(plate / "plate/plate.xml", 850)
    pillar = scene.shapes[scene.names.index("boss_30mm")]
    normals = np.array(pillar.vertex_normals_buffer()).reshape(-1, 3)
    places = np.array(pillar.vertex_positions_buffer()).reshape(-1, 3)
    assert np.abs(normals - places * [1, 1, 0] / 15).max() < 1e-6


@pytest.mark.parametrize(
    ("units", "length_mm"), [(None, 1), ("mm", 1), ("cm", 10), ("inch", 25.4), ("foot", 304.8), ("m", 1000)]
)
def test_units_are_turned_into_mm(tmp_path, units, length_mm):
    plate_with_pillar().apply_scale(1 / length_mm).export(tmp_path / "plate.stl")
    mesh = read_mesh(tmp_path / "plate.stl", units)
    (pillar,) = (face for face in segment_mesh(mesh.vertices, mesh.triangles).faces if face.kind == "cylinder")
    assert pillar.surface.radius == pytest.approx(15, rel=1e-6)


def test_a_part_in_metres_is_noticed(tmp_path):
    plate_with_pillar().apply_scale(0.001).export(tmp_path / "plate.stl")
    with pytest.raises(InputError, match="give --units if the file has another unit"):
        read_mesh(tmp_path / "plate.stl")


@pytest.mark.parametrize("suffix", [".stl", ".obj"])
def test_vertices_that_are_not_numbers_are_refused(tmp_path, suffix):
    box = trimesh.creation.box((40, 30, 20))
    path = tmp_path / f"box{suffix}"
    if suffix == ".stl":
        data = bytearray(box.export(file_type="stl"))
        data[96:100] = np.float32(np.nan).tobytes()
        path.write_bytes(bytes(data))
    else:
        places = ["v nan 0 0", *(f"v {x} {y} {z}" for x, y, z in box.vertices[1:])]
        path.write_text("\n".join([*places, *(f"f {a} {b} {c}" for a, b, c in box.faces + 1)]))
    with pytest.raises(InputError, match="vertices that are not numbers"):
        read_mesh(path)


CHANNEL = [(0, 0), (30, 0), (30, 30), (20, 30), (20, 10), (10, 10), (10, 30), (0, 30)]


def prism(path, outline, first):
    """A prism of polygons, whose ends begin at the corner of this number."""
    count = len(outline)
    ends = [(first + one) % count for one in range(count)]
    polygons = [[count + one for one in ends], ends[::-1]]
    polygons += [[one, (one + 1) % count, (one + 1) % count + count, one + count] for one in range(count)]
    places = [(x, y, z) for z in (0, 10) for x, y in outline]
    if path.suffix == ".obj":
        lines = [f"v {x} {y} {z}" for x, y, z in places]
        lines += ["f " + " ".join(str(one + 1) for one in polygon) for polygon in polygons]
    else:
        lines = ["ply", "format ascii 1.0", f"element vertex {2 * count}"]
        lines += [f"property double {axis}" for axis in "xyz"] + [f"element face {len(polygons)}"]
        lines += ["property list uchar int vertex_indices", "end_header"]
        lines += [f"{x} {y} {z}" for x, y, z in places]
        lines += [f"{len(polygon)} {' '.join(map(str, polygon))}" for polygon in polygons]
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize("suffix", [".obj", ".ply"])
def test_polygons_that_are_not_convex_are_refused_and_convex_ones_are_read(tmp_path, suffix):
    """The reader divides them into fans, which cover a channel and what is outside it, from whatever corner."""
    square = prism(tmp_path / f"square{suffix}", [(0, 0), (30, 0), (30, 15), (30, 30), (0, 30)], 2)
    assert trimesh.Trimesh(*(lambda mesh: (mesh.vertices, mesh.triangles))(read_mesh(square))).volume == pytest.approx(
        9e3
    )
    for first in range(len(CHANNEL)):
        with pytest.raises(InputError, match="fold back on a neighbour"):
            read_mesh(prism(tmp_path / f"channel{suffix}", CHANNEL, first))


def test_mixed_winding_is_no_fold(tmp_path):
    box = trimesh.creation.box((40, 30, 20))
    box.faces[::3] = box.faces[::3, ::-1]
    box.export(tmp_path / "box.obj")
    assert len(read_mesh(tmp_path / "box.obj").triangles) == 12


def test_gltf_is_in_metres_and_its_nodes_are_placed(tmp_path):
    scene = trimesh.Scene()
    for x in (0.0, 0.1):
        place = trimesh.transformations.translation_matrix([x, 0, 0])
        scene.add_geometry(trimesh.creation.icosphere(2, 0.02), transform=place)
    scene.export(tmp_path / "balls.glb")
    mesh = read_mesh(tmp_path / "balls.glb")
    centres = sorted(face.surface.centre[0] for face in segment_mesh(mesh.vertices, mesh.triangles).faces)
    assert centres == pytest.approx([0, 100], abs=1e-3)


@needs_step
def test_step_is_meshed_finely_and_keeps_the_faces_that_were_drawn(tmp_path):
    (tmp_path / "shaft.step").write_text(step_file([(40, 10), (15, 40)]))
    part = write_part(tmp_path / "shaft.step", tmp_path / "shaft")
    assert [face.name for face in part.faces] == ["bottom", "top_at_z10mm", "top", "boss_30mm", "boss_80mm"]
    assert part.remarks == []
    pillar = part.faces[3].surface
    assert isinstance(pillar, Cylinder)
    assert pillar.radius == pytest.approx(15, abs=1e-4)
    assert np.allclose(pillar.point, [0, 0, 10], atol=1e-4)
    assert max(face.sag for face in part.faces) < 0.01  # the tolerance that OpenCASCADE was asked for
    assert sum(face.area for face in part.faces) == pytest.approx(2 * np.pi * (40**2 + 40 * 10 + 15 * 40), rel=2e-3)
    with pytest.raises(InputError, match=r"mm, the unit that shaft\.step states"):
        write_part(tmp_path / "shaft.step", tmp_path / "other", "m")


@needs_step
def test_garbage_in_a_step_file_is_told(tmp_path):
    (tmp_path / "bad.stp").write_bytes(b"ISO-10303-21;\nHEADER;\n\x00\xff")
    with pytest.raises(InputError, match="OpenCASCADE"):
        read_step(tmp_path / "bad.stp")


def test_without_opencascade_the_message_says_what_to_install(tmp_path, monkeypatch):
    (tmp_path / "part.step").write_text("ISO-10303-21;")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"OBJ, PLY, OFF, 3MF or glTF file\. pip install .*cadquery-ocp"):
        read_step(tmp_path / "part.step")


HEADS = [
    b"",
    b"solid \n",
    b"\0" * 80 + b"\x02\0\0\0",
    b"ply\nformat ascii 1.0\n",
    b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 ",
    b"OFF\n3 1 0\n",
    b"glTF\x02\0\0\0",
    b"PK\x03\x04",
]


@settings(max_examples=100)
@given(
    st.sampled_from([".stl", ".obj", ".ply", ".off", ".glb", ".gltf", ".3mf"]),
    st.sampled_from(HEADS),
    st.binary(max_size=300),
)
@example(".obj", b"", b"v 0 0 0\nv 9 0 0\nv 0 nan 0\nf 1 2 3\n")
@example(".stl", b"", b"")
@example(".obj", b"", b"v 0 0 0\nv 9 0 0\nv 0 9 0\nf 1 2 7\n")
def test_whatever_a_file_holds_is_a_mesh_or_a_message(suffix, head, data):
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / f"part{suffix}"
        file.write_bytes(head + data)
        try:
            mesh = read_mesh(file)
        except InputError as error:
            assert file.name in str(error)
            return
        assert len(mesh.triangles) > 0
        assert np.isfinite(mesh.vertices).all()


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"path": "plat.stl"}, "did you mean 'plate.stl'"),
        ({"path": "plate.dxf"}, "'.dxf'"),
        ({"units": "furlong"}, "um, mm, cm, m, inch, foot"),
        ({"finishing": ("aluminum", "ground", 0.8)}, "did you mean 'aluminium'"),
        ({"finishing": ("aluminium", "grund", 0.8)}, "did you mean 'ground'"),
        ({"finishing": ("aluminium", "ground", 80)}, "0.005 to 10 um"),
        ({"angle_deg": 0}, "over 0 to 90 deg"),
        ({"folder": "plate"}, "a folder that exists"),
        ({"folder": "-new"}, "a folder name"),
    ],
)
def test_bad_arguments_are_told_and_leave_nothing(plate, arguments, says):
    (plate / "plate.dxf").write_text("0\nEOF\n")
    before = sorted(plate.iterdir())
    given_ = {"path": "plate.stl", "folder": "new", **arguments}
    with pytest.raises(InputError) as caught:
        write_part(
            plate / given_["path"],
            plate / given_["folder"],
            arguments.get("units"),
            Finishing(*given_["finishing"]) if "finishing" in given_ else None,
            arguments.get("angle_deg", 20.0),
        )
    assert says in str(caught.value)
    assert sorted(plate.iterdir()) == before


def test_a_scan_is_refused_and_a_failed_write_leaves_nothing(tmp_path, monkeypatch):
    rng = np.random.default_rng(3)
    rough = trimesh.creation.icosphere(4, 15)
    rough.vertices += rng.normal(0, 1.0, rough.vertices.shape)
    rough.export(tmp_path / "scan.stl")
    with pytest.raises(InputError, match="raise --angle"):
        write_part(tmp_path / "scan.stl", tmp_path / "scan")
    trimesh.creation.box((10, 20, 30)).export(tmp_path / "box.stl")

    def broken(handle):
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(os, "fsync", broken)
    with pytest.raises(InputError, match="Input/output error"):
        write_part(tmp_path / "box.stl", tmp_path / "box")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["box.stl", "scan.stl"]


def test_a_file_name_cannot_break_the_scene():
    text = scene_xml([], Finishing(), "a--b-->.stl--")
    assert text.count("-->") == 1
    assert text.splitlines()[0].count("--") == 1


def test_the_command_makes_what_check_and_render_take(plate):
    target = plate / "made"
    command = ("part", plate / "plate.stl", "-o", target, "--Ra", "0.4")
    done = mitsim_here(*command)
    table = dict(line.split("\t") for line in done.stdout.splitlines())
    assert table["boss_30mm"].startswith("boss, radius 15.0")
    assert "made.xml" in done.stderr
    again = mitsim_here(*command, code=2)
    assert "a folder that exists" in again.stderr


@pytest.mark.parametrize("name", sorted(NAMED_FINISHES))
def test_plastics_castings_and_paints_are_written_from_the_start(tmp_path, name):
    trimesh.creation.box((60, 40, 10)).export(tmp_path / "plate.stl")
    write_part(tmp_path / "plate.stl", tmp_path / "plate", finishing=Finishing(named=name))
    finish = load_scene(tmp_path / "plate/plate.xml", 850).finishes[0]
    told = NAMED_FINISHES[name]
    assert finish.name.split("/")[0] == told.properties.get("metal", told.kind)
    assert finish.light.reflectance == pytest.approx(told.properties.get("reflectance", finish.light.reflectance))


def test_reflectance_and_gloss_replace_the_assumed_ones_where_a_finish_has_them(tmp_path):
    trimesh.creation.box((60, 40, 10)).export(tmp_path / "plate.stl")
    given = Finishing(named="black_plastic", reflectance=0.06, gloss=20.0)
    write_part(tmp_path / "plate.stl", tmp_path / "plate", finishing=given)
    light = load_scene(tmp_path / "plate/plate.xml", 850).finishes[0].light
    usual = load_scene(tmp_path / "plate/plate.xml", 850, {"reflectance": "0.04", "gloss": "10"}).finishes[0].light
    assert light.reflectance == pytest.approx(0.06)
    assert light.alpha_u < usual.alpha_u  # glossier is narrower
    for wrong in (
        {"gloss": 5.0},
        {"named": "iron_casting", "reflectance": 0.3},
        {"named": "blak_plastic"},
        {"named": "black_plastic", "reflectance": 0.99},
    ):
        with pytest.raises(InputError):
            Finishing(**wrong)
