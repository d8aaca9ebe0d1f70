"""Faces of STEP files: every kind of surface, names, colours, assemblies; the names that other faces get."""

from __future__ import annotations

import math
import random
import re
from dataclasses import replace

import numpy as np
import pytest

from characterisation.files.documents import checked_name
from characterisation.files.errors import InputError
from mitsim.scene.authoring.check_task import read_features
from mitsim.scene.authoring.fineness import fineness_for, sensor_sigma_mm
from mitsim.scene.authoring.naming import identifier, size, with_names
from mitsim.scene.authoring.part_folder import Finishing, described, finish_names, scene_xml
from mitsim.scene.authoring.read_step import Fineness, read_step, step_installed
from mitsim.scene.inspect import inspect
from mitsim.scene.load import load_scene
from tests.scene.authoring.bracket import bracket, write_step

pytestmark = [
    pytest.mark.skipif(not step_installed(), reason="OpenCASCADE, which reads STEP, is not installed"),
    pytest.mark.usefixtures("step_here"),
]

NAMES = [
    "back",
    "bore_12mm_left",
    "bore_12mm_right",
    "boss_20mm",
    "bottom",
    "chamfer_45deg",
    "fillet_r4mm",
    "front",
    "front_at_y18mm",
    "left",
    "right",
    "seat_18mm",
    "top",
    "top_at_z12mm",
    "top_at_z32mm",
]


def solid(kind, *values, at=(0.0, 0.0, 0.0)):
    """One of OpenCASCADE's primitives about an axis along z through a place [mm]."""
    import OCP.BRepPrimAPI as Primitives
    from OCP.gp import gp_Ax2, gp_Dir, gp_Pnt

    return getattr(Primitives, f"BRepPrimAPI_Make{kind}")(gp_Ax2(gp_Pnt(*at), gp_Dir(0, 0, 1)), *values).Shape()


def freeform():
    """A solid between three ellipses that turn: its side is a spline and none of the simple surfaces."""
    from OCP.BRepBuilderAPI import BRepBuilderAPI_MakeEdge, BRepBuilderAPI_MakeWire
    from OCP.BRepOffsetAPI import BRepOffsetAPI_ThruSections
    from OCP.gp import gp_Ax2, gp_Dir, gp_Elips, gp_Pnt

    loft = BRepOffsetAPI_ThruSections(True)
    for number in range(3):
        angle = 0.4 * number
        frame = gp_Ax2(gp_Pnt(0, 0, 20 * number), gp_Dir(0, 0, 1), gp_Dir(np.cos(angle), np.sin(angle), 0))
        edge = BRepBuilderAPI_MakeEdge(gp_Elips(frame, 20, 12)).Edge()
        loft.AddWire(BRepBuilderAPI_MakeWire(edge).Wire())
    return loft.Shape()


@pytest.fixture(scope="module")
def faces(tmp_path_factory):
    path = tmp_path_factory.mktemp("step") / "bracket.step"
    return with_names(read_step(write_step([("bracket", bracket(), (0.2, 0.4, 0.6))], path)).faces)


def test_faces_get_names_that_say_what_they_are(faces):
    assert sorted(face.name for face in faces) == NAMES
    assert {face.colour for face in faces} == {(0.2, 0.4, 0.6)}


def test_names_do_not_hang_on_the_order_of_the_file(faces):
    mixed = [replace(face, name="") for face in faces]
    random.Random(5).shuffle(mixed)
    assert {face.name: face.entities for face in with_names(mixed)} == {face.name: face.entities for face in faces}


def test_names_hang_on_geometry_alone_where_noise_puts_equal_places_apart(tmp_path):
    """Four bores on the axes, drawn at their coordinates or by rotation, about which 30 sin(pi) = 4e-15 mm is noise."""
    from OCP.BRepAlgoAPI import BRepAlgoAPI_Cut

    def places(at):
        plate = solid("Cylinder", 40.0, 8.0)
        for x, y in at:
            plate = BRepAlgoAPI_Cut(plate, solid("Cylinder", 3.0, 20.0, at=(x, y, -1.0))).Shape()
        faces = with_names(read_step(write_step([("flange", plate, None)], tmp_path / "flange.step")).faces)
        return {f.name: f.surface.point.round(6).tolist() for f in faces if f.name.startswith("bore")}

    exact = places([(30.0, 0.0), (0.0, 30.0), (-30.0, 0.0), (0.0, -30.0)])
    turned = [math.pi / 2 * number for number in range(4)]
    assert exact == places([(30 * math.cos(angle), 30 * math.sin(angle)) for angle in turned])
    assert list(exact) == [f"bore_6mm_{number}" for number in range(1, 5)], "none is left or right of the others"


def test_concentric_faces_of_one_height_are_numbered_by_area(tmp_path):
    from OCP.BRepAlgoAPI import BRepAlgoAPI_Cut

    groove = BRepAlgoAPI_Cut(solid("Cylinder", 34.0, 10.0, at=(0, 0, 7)), solid("Cylinder", 28.0, 20.0)).Shape()
    ring = BRepAlgoAPI_Cut(solid("Cylinder", 40.0, 10.0), groove).Shape()
    faces = read_step(write_step([("ring", ring, None)], tmp_path / "ring.step")).faces
    for order in (faces, faces[::-1]):
        areas = {face.name: face.area for face in with_names(order)}
        assert areas["top_1"] == pytest.approx(math.pi * (40**2 - 34**2), rel=1e-3)
        assert areas["top_2"] == pytest.approx(math.pi * 28**2, rel=1e-3)


def test_upright_faces_between_the_axes_are_sides_and_inclined_ones_are_slopes(tmp_path):
    from OCP.BRepBuilderAPI import BRepBuilderAPI_Transform
    from OCP.BRepPrimAPI import BRepPrimAPI_MakeBox
    from OCP.gp import gp_Ax1, gp_Dir, gp_Pnt, gp_Trsf

    def turned(axis):
        motion = gp_Trsf()
        motion.SetRotation(gp_Ax1(gp_Pnt(0, 0, 0), gp_Dir(*axis)), math.radians(30))
        return BRepBuilderAPI_Transform(BRepPrimAPI_MakeBox(30, 40, 50).Shape(), motion).Shape()

    for axis, kinds in (((0, 0, 1), {"side_30deg": 4}), ((1, 0, 0), {"slope_30deg": 2, "slope_60deg": 2})):
        path = write_step([("box", turned(axis), None)], tmp_path / "box.step")
        names = [face.name for face in with_names(read_step(path).faces)]
        assert {kind: sum(name.startswith(kind) for name in names) for kind in kinds} == kinds, names


def test_a_rounded_corner_is_described_as_it_is_named(tmp_path):
    from OCP.BRepAlgoAPI import BRepAlgoAPI_Fuse
    from OCP.BRepPrimAPI import BRepPrimAPI_MakeBox
    from OCP.gp import gp_Pnt

    # a plate whose one end is a quarter of a cylinder of radius 12 mm
    plate = BRepPrimAPI_MakeBox(gp_Pnt(-30, 0, 0), gp_Pnt(0, 12, 8)).Shape()
    corner = BRepAlgoAPI_Fuse(plate, solid("Cylinder", 12.0, 8.0, math.pi / 2)).Shape()
    faces = {
        face.name: face for face in with_names(read_step(write_step([("p", corner, None)], tmp_path / "p.step")).faces)
    }
    assert described(faces["round_r12mm"]).startswith("round, radius 12.0")


def test_the_ends_of_a_slot_are_no_fillets(tmp_path):
    from OCP.BRepAlgoAPI import BRepAlgoAPI_Cut, BRepAlgoAPI_Fuse
    from OCP.BRepPrimAPI import BRepPrimAPI_MakeBox
    from OCP.gp import gp_Pnt

    slot = BRepPrimAPI_MakeBox(gp_Pnt(-15, -4, -1), gp_Pnt(15, 4, 11)).Shape()
    for x in (-15, 15):
        slot = BRepAlgoAPI_Fuse(slot, solid("Cylinder", 4.0, 12.0, at=(x, 0, -1))).Shape()
    plate = BRepAlgoAPI_Cut(BRepPrimAPI_MakeBox(gp_Pnt(-30, -12, 0), gp_Pnt(30, 12, 10)).Shape(), slot).Shape()
    faces = with_names(read_step(write_step([("plate", plate, None)], tmp_path / "plate.step")).faces)
    assert sorted(face.name for face in faces if face.kind == "cylinder") == [
        "slot_end_r4mm_left",
        "slot_end_r4mm_right",
    ]


def test_a_bore_in_two_halves_is_one_face(tmp_path):
    """A cylinder cut through its axis and glued again has two half shells, as some CAD programs write all."""
    from OCP.BRepAlgoAPI import BRepAlgoAPI_Common, BRepAlgoAPI_Fuse
    from OCP.BRepPrimAPI import BRepPrimAPI_MakeBox
    from OCP.gp import gp_Pnt

    cylinder = solid("Cylinder", 10.0, 30.0)
    halves = [
        BRepAlgoAPI_Common(cylinder, BRepPrimAPI_MakeBox(gp_Pnt(x, -20, 0), gp_Pnt(x + 20, 20, 30)).Shape()).Shape()
        for x in (-20, 0)
    ]
    glued = BRepAlgoAPI_Fuse(*halves).Shape()
    drawn = read_step(write_step([("pin", glued, None)], tmp_path / "pin.step"))
    assert sorted(face.name for face in with_names(drawn.faces)) == ["boss_20mm", "bottom", "top"]
    assert "were joined" in drawn.remarks[0]
    side = next(face for face in drawn.faces if face.kind == "cylinder")
    assert side.area == pytest.approx(2 * np.pi * 10 * 30, rel=2e-3)


@pytest.mark.parametrize(
    ("shape", "kind", "name"),
    [
        (lambda: solid("Cone", 20.0, 8.0, 30.0), "cone", "cone_44deg"),
        (lambda: solid("Torus", 30.0, 6.0), "torus", "round_r6mm"),
        (lambda: solid("Sphere", 15.0), "sphere", "ball_30mm"),
        (freeform, "face", "freeform"),
    ],
)
def test_every_kind_of_surface_comes_with_the_normals_of_the_drawing(tmp_path, shape, kind, name):
    chord = 0.01
    drawn = read_step(write_step([("one", shape(), None)], tmp_path / "one.step"), Fineness(chord))
    face = next(face for face in with_names(drawn.faces) if face.kind == kind)
    assert face.name == name
    normals, corners = face.corner_normals(), face.vertices[face.triangles]
    assert np.allclose(np.linalg.norm(normals, axis=-1), 1, atol=1e-6)
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(flat, axis=1)
    sound = area > 1e-6 * area.max()  # at a pole and at a tip a triangle has no area, and no normal
    flat = flat[sound] / area[sound, None]
    assert np.einsum("ijk,ik->ij", normals[sound], flat).min() > np.cos(0.21)  # half of two facets' bend of 0.2 rad
    if kind == "face":
        assert face.surface is None
    else:
        assert face.deviation < 1e-4
        assert face.sag < chord


def test_a_part_keeps_the_bodies_and_names_of_an_assembly(tmp_path):
    shapes = [
        ("lid", solid("Cylinder", 20.0, 5.0, at=(0, 0, 10)), (0.8, 0.1, 0.1)),
        ("base plate", solid("Cylinder", 20.0, 10.0), None),
    ]
    drawn = read_step(write_step(shapes, tmp_path / "two.step"))
    faces = with_names(drawn.faces)
    assert sorted(face.name for face in faces) == [
        "base_plate_boss_40mm",
        "base_plate_bottom",
        "base_plate_top_at_z10mm",
        "lid_boss_40mm",
        "lid_bottom_at_z10mm",
        "lid_top",
    ]
    assert {face.part: face.colour for face in faces} == {"lid": (0.8, 0.1, 0.1), "base plate": None}
    assert finish_names(faces) == {None: "finish", (0.8, 0.1, 0.1): "finish_cc1a1a"}
    text = scene_xml(faces, Finishing(), "two.step")
    assert "<!-- part lid -->" in text
    assert text.count('<ref id="finish_cc1a1a"/>') == 3


def test_a_name_that_a_person_gave_is_kept_and_a_programs_counter_is_not(tmp_path):
    path = write_step([("one", solid("Cylinder", 10.0, 30.0), None)], tmp_path / "one.step")
    given = iter(["'sealing face Ø20'", "'Face12'", "'1103|2717679175'"])
    head, *rest = path.read_text().split("ADVANCED_FACE('',")
    path.write_text(head + "".join(f"ADVANCED_FACE({next(given)},{one}" for one in rest))
    names = {face.name for face in with_names(read_step(path).faces)}
    assert len(names & {"boss_20mm", "bottom", "top"}) == 2
    assert "sealing_face_Ø20" in names
    assert identifier("3 Löcher") == "face_3_Löcher"


def test_names_differ_from_ids_of_finishes_and_in_more_than_capital_letters(tmp_path):
    """Mitsuba has one name for shapes and finishes, and some file systems one for Seal.ply and SEAL.ply."""
    from mitsim.scene.authoring.part_folder import write_part

    path = write_step([("one", solid("Cylinder", 10.0, 30.0), None)], tmp_path / "one.step")
    given = iter(["finish", "Seal", "SEAL"])
    head, *rest = path.read_text().split("ADVANCED_FACE('',")
    path.write_text(head + "".join(f"ADVANCED_FACE('{next(given)}',{one}" for one in rest))
    write_part(path, tmp_path / "made")
    names = load_scene(tmp_path / "made/made.xml", 850).names
    assert sorted(name.casefold() for name in names) == ["face_finish", "seal", "seal_2"]


AXES = {1: "1.,0.,0.", 2: "0.,1.,0.", 3: "0.,0.,1."}


def component(path, scale="1.", **axes):
    """A part placed 100 mm along x by an operator with these axes and this scale."""
    text = write_step([("one", solid("Box", 40.0, 30.0, 20.0), None)], path).read_text()
    brep = re.search(r"#\d+ = ADVANCED_BREP_SHAPE_REPRESENTATION\('',\((#\d+),(#\d+)\),(#\d+)\);", text)
    origin, body, context = brep.groups()
    ways = {number: axes.get(f"axis{number}", way) for number, way in AXES.items()}
    lines = [f"#900{number}=DIRECTION('',({way}));" for number, way in ways.items()]
    lines += [
        "#9004=CARTESIAN_POINT('',(100.,0.,0.));",
        f"#9005=CARTESIAN_TRANSFORMATION_OPERATOR_3D('','',$,#9001,#9002,#9004,{scale},#9003);",
        f"#9006=SHAPE_REPRESENTATION('',({body},{origin}),{context});",
        f"#9007=REPRESENTATION_MAP({origin},#9006);",
        "#9008=MAPPED_ITEM('',#9007,#9005);",
    ]
    text = text.replace(f"({origin},{body})", f"({origin},#9008)", 1)
    path.write_text(text.replace("ENDSEC;\nEND-ISO", "\n".join([*lines, "ENDSEC;\nEND-ISO"])))
    return path


def test_components_are_placed_or_refused_where_opencascade_misplaces_them(tmp_path):
    """It turns a mirrored component by half a turn, and leaves a scaled one at its size."""
    for scale, axes, low in (("1.", {}, (100, 0, 0)), ("$", {"axis1": AXES[2], "axis2": "-1.,0.,0."}, (70, 0, 0))):
        faces = read_step(component(tmp_path / "placed.step", scale, **axes)).faces
        assert np.concatenate([face.vertices for face in faces]).min(axis=0) == pytest.approx(low, abs=1e-9)
    for scale, axes, says in (("1.", {"axis1": "-1.,0.,0."}, "mirrored"), ("2.", {}, "scaled by 2")):
        with pytest.raises(InputError, match=f"#9005.*placed {says}"):
            read_step(component(tmp_path / "other.step", scale, **axes))


FOREIGN = ("Dichtfläche", "поверхность", "シール面", "พื้นผิว", "סגר")


def test_names_in_any_script_keep_their_letters_in_the_scene_and_the_task(tmp_path):
    """Plain UTF-8, and the escapes of the standard: \\X2\\, and \\S\\ in a part of ISO 8859."""
    from OCP.BRepPrimAPI import BRepPrimAPI_MakeBox

    from mitsim.scene.authoring.part_folder import write_part

    path = write_step([("one", BRepPrimAPI_MakeBox(30, 40, 50).Shape(), None)], tmp_path / "one.step")
    escaped = "\\X2\\" + "シール面".encode("utf-16-be").hex().upper() + "\\X0\\"
    cyrillic = "\\PE\\" + "".join(f"\\S\\{chr(one & 0x7F)}" for one in "поверхность".encode("iso8859-5"))
    written = ["Dichtfläche", cyrillic, escaped, "พื้นผิว", "סגר", "孔"]
    head, *rest = path.read_text().split("ADVANCED_FACE('',")
    path.write_text(
        head + "".join(f"ADVANCED_FACE('{name}',{one}" for name, one in zip(written, rest, strict=True)), "utf-8"
    )
    write_part(path, tmp_path / "made", None, Finishing())
    scene = load_scene(tmp_path / "made/made.xml", 850)
    features = read_features(tmp_path / "made/task.toml").features
    for name in (*FOREIGN, "孔"):
        assert name in scene.names
        assert (tmp_path / "made" / f"{name}.ply").exists()
        assert checked_name(name) == name
    assert set(features) == set(scene.names)


def test_a_file_in_the_encoding_of_an_older_program_keeps_its_letters(tmp_path):
    path = write_step([("one", solid("Sphere", 10.0), None)], tmp_path / "one.step")
    path.write_bytes(path.read_text().replace("ADVANCED_FACE('',", "ADVANCED_FACE('Kugelfläche',").encode("latin-1"))
    assert [face.name for face in with_names(read_step(path).faces)] == ["Kugelfläche"]


@pytest.mark.parametrize("name", ["面" * 50, "ä" * 80, "é" * 61, "พื้" * 40])
def test_a_long_name_is_cut_between_letters_and_stays_a_name(name):
    short = identifier(name)
    assert name.startswith(short)
    assert checked_name(short) == short


@pytest.mark.parametrize(
    ("length", "text"),
    [(9.525, "9_53"), (2.675, "2_68"), (1.005, "1_01"), (12.0, "12"), (-0.001, "0"), (-9.525, "-9_53")],
)
def test_noise_of_a_file_does_not_decide_the_name_of_a_size(length, text):
    """3/8 inch is 9.525 mm; a file in inches gives the number before or after it."""
    assert {size(length + noise) for noise in (-2e-6, -1e-12, 0.0, 1e-12, 2e-6)} == {text}


def test_the_sensor_chooses_how_fine_the_mesh_is(tmp_path):
    assert sensor_sigma_mm("photoneo-phoxi-s") < sensor_sigma_mm("ensenso-n10")
    path = write_step([("one", solid("Cylinder", 10.0, 30.0), None)], tmp_path / "one.step")
    fine = {}
    for name in ("photoneo-phoxi-s", "ensenso-n10"):
        asked = fineness_for(name)
        assert asked.chord_mm < sensor_sigma_mm(name) / 20
        fine[name] = max(face.sag for face in read_step(path, asked).faces)
        assert fine[name] <= asked.chord_mm
    assert fine["photoneo-phoxi-s"] < fine["ensenso-n10"]


def test_nothing_is_wrong_with_a_bracket_and_its_seat(tmp_path, n10):
    from mitsim.scene.authoring.check import findings
    from mitsim.scene.authoring.part_folder import write_part
    from mitsim.scene.visible_surfaces import visible_surfaces
    from mitsim.sensor.working_volume import pose_at, usual_place

    write_part(write_step([("b", bracket(), None)], tmp_path / "b.step"), tmp_path / "made", None, Finishing())
    scene = load_scene(tmp_path / "made/made.xml", n10.wavelength_nm)
    facts, pose = inspect(scene), pose_at(n10, usual_place(n10, scene.centre), scene.centre)
    task = read_features(tmp_path / "made/task.toml")
    found = findings(facts, n10, pose, visible_surfaces(scene, n10.rig, pose), False, task)
    assert [str(one) for one in found if one.severity != "note"] == []
    assert not any("closed" in one.what for one in found)
