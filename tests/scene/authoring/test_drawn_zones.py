"""Zones and dimensions of a drawing on the right features: mid-planes, axes and planes of the bracket."""

import math
import re

import pytest

from characterisation.tasks.task_reading import check_nominal_values, read_task
from mitsim.scene.authoring.part_folder import read_part, write_part
from mitsim.scene.authoring.read_step import step_installed
from tests.scene.authoring.bracket import bracket, slotted, write_step
from tests.scene.authoring.drawing import Drawing

pytestmark = [
    pytest.mark.skipif(not step_installed(), reason="OpenCASCADE, which reads STEP, is not installed"),
    pytest.mark.usefixtures("step_here"),
]


@pytest.fixture
def drawn(tmp_path):
    """The bracket's file, its drawing without entities, and the numbers of its faces by name."""
    path = write_step([("bracket", bracket(), None)], tmp_path / "bracket.step", "AP242DIS")
    face = {one.name: one.entities[0] for one in read_part(path).faces}
    return path, Drawing(path.read_text()), face


def task_of(path, drawing):
    path.write_text(drawing.whole())
    write_part(path, path.parent / "made")
    return read_task(path.parent / "made/task.toml")


def test_mid_planes_that_share_a_face_are_different_features(drawn):
    """The back is at y = 30 mm, the front at -30 mm, and the front of the wall at 18 mm."""
    path, drawing, face = drawn
    for zone, other in ((0.1, "front"), (0.2, "front_at_y18mm"), (0.3, "front")):
        drawing.tolerance("POSITION", drawing.measure(zone), drawing.aspect(face["back"], face[other]))
    task = task_of(path, drawing)
    places = {one.tolerance: task.nominal(one.features[0]).point[1] for one in task.measurements.values()}
    assert places == pytest.approx({0.1: 0.0, 0.2: 24.0, 0.3: 0.0})
    assert sum(feature.kind == "mid_plane" for feature in task.features.values()) == 2


def test_an_angle_of_a_face_and_an_axis_is_that_of_the_face_not_of_its_normal(drawn):
    """Drawings state 90 deg for a face across a bore; a task has the angle of its normal, 0 deg."""
    path, drawing, face = drawn
    mm = drawing.measure
    for name, value, low, high in (
        ("top_at_z12mm", 90.0, -0.5, 0.5),
        ("left", 0.0, -0.4, 0.4),
        ("chamfer_45deg", 45.0, -0.1, 0.3),
        ("front_at_y18mm", 180.0, -0.2, 0.2),
    ):
        ends = (drawing.aspect(face[name]), drawing.aspect(face["bore_12mm_left"]))
        made = drawing.add(f"ANGULAR_LOCATION('angle',$,#{ends[0]},#{ends[1]},.SMALL.)")
        nominal, lower, upper = (mm(math.radians(one), "nominal value", angle=True) for one in (value, low, high))
        drawing.values(made, nominal)
        drawing.plus_minus(made, lower, upper)
    axes = (drawing.aspect(face["bore_12mm_left"]), drawing.aspect(face["bore_12mm_right"]))
    made = drawing.add(f"ANGULAR_LOCATION('angle',$,#{axes[0]},#{axes[1]},.SMALL.)")
    drawing.values(made, mm(0.0, "nominal value", angle=True))
    task = task_of(path, drawing)
    check_nominal_values(task, "task.toml")
    found = {one.features[0]: (one.kind, one.nominal, one.deviations) for one in task.measurements.values()}
    assert found == {
        "top_at_z12mm": ("plane_axis_angle", 0, pytest.approx((-0.5, 0.5))),
        "left": ("plane_axis_angle", 90, pytest.approx((-0.4, 0.4))),
        "chamfer_45deg": ("plane_axis_angle", 45, pytest.approx((-0.3, 0.1))),
        "front_at_y18mm": ("plane_axis_angle", 90, pytest.approx((-0.2, 0.2))),
        "bore_12mm_left": ("axis_angle", 0, None),
    }


@pytest.fixture
def plate(tmp_path):
    """The file of the plate with slots, its drawing without entities, and the numbers of its faces by name."""
    path = write_step([("plate", slotted(), None)], tmp_path / "plate.step", "AP242DIS")
    face = {one.name: one.entities[0] for one in read_part(path).faces}
    return path, Drawing(path.read_text()), face


def test_a_tolerance_of_several_slots_holds_for_the_mid_plane_of_each(plate):
    """ISO 1101: before, each side had it. The web between the slots at 30 and 39 mm is narrower, 3 mm."""
    path, drawing, face = plate
    mm = drawing.measure
    datums = [
        drawing.datum(letter, face[name]) for letter, name in zip("ABC", ("bottom", "front", "left"), strict=True)
    ]
    frame, base = drawing.system(*datums), drawing.system(datums[0])
    sides = [face[f"{side}_at_x{x}mm"] for side, x in (("right", 27), ("right", 36), ("left", 33), ("left", 42))]
    size = drawing.size("width", *sides, items=(mm(6.0, "nominal value"),))
    drawing.plus_minus(size, mm(-0.1), mm(0.2))
    ends = [face[name] for name in face if name.startswith("slot_end")]
    long = drawing.aspect(face["back_at_y11mm"], face["front_at_y19mm"], *ends)
    drawing.tolerance("POSITION", mm(0.11), size, frame)
    drawing.tolerance("PERPENDICULARITY", mm(0.12), size, base)
    drawing.tolerance("PERPENDICULARITY", mm(0.13), drawing.aspect(*sides[:2]), base)
    drawing.tolerance("POSITION", mm(0.14), long, frame)
    backs = drawing.aspect(*(face[name] for name in face if name.startswith("back_left")))
    drawing.add(
        f"( FLATNESS_TOLERANCE() GEOMETRIC_TOLERANCE('',$,#{mm(0.15)},#{backs}) "
        "GEOMETRIC_TOLERANCE_WITH_MODIFIERS((.COMMON_ZONE.)) )"
    )
    drawing.tolerance("FLATNESS", mm(0.16), backs)
    task = task_of(path, drawing)
    found = {}
    for one in task.measurements.values():
        at = task.nominal(one.features[0]).point
        found.setdefault((one.kind, one.tolerance), []).append(round(at[1] if one.tolerance == 0.14 else at[0], 3))
    assert {key: sorted(places) for key, places in found.items() if key[0] != "flatness"} == {
        ("plane_distance", (-0.1, 0.2)): [27, 36],
        ("position", 0.11): [30, 39],
        ("perpendicularity", 0.12): [30, 39],
        ("perpendicularity", 0.13): [27, 36],
        ("position", 0.14): [15],
    }
    assert {kind: len(places) for kind, places in found.items() if kind[0] == "flatness"} == {("flatness", 0.16): 2}
    assert any("0.15" in one and "common to its faces" in one for one in read_part(path).drawing.left_out)


#: kind, face, datums, form of the zone in the file, and whether a task has a zone of this form (ISO 1101)
FORMS = [
    ("POSITION", "seat_18mm", "ABC", "within a sphere", True),
    ("POSITION", "seat_18mm", "ABC", "within two parallel planes", False),
    ("POSITION", "seat_18mm", "ABC", "cylindrical or circular", False),
    ("POSITION", "bore_12mm_left", "ABC", "cylindrical or circular", True),
    ("POSITION", "bore_12mm_left", "ABC", "within two parallel planes", False),
    ("POSITION", "bore_12mm_left", "ABC", "spherical", False),
    ("POSITION", "front", "ABC", "within two parallel planes", True),
    ("POSITION", "front", "ABC", "cylindrical or circular", False),
    ("PARALLELISM", "bore_12mm_left", "B", "within two parallel planes", True),
    ("PARALLELISM", "bore_12mm_left", "B", "cylindrical or circular", False),
    ("PARALLELISM", "bore_12mm_left", "D", "cylindrical or circular", True),
    ("PARALLELISM", "bore_12mm_left", "D", "within two parallel planes", False),
    ("PERPENDICULARITY", "bore_12mm_left", "A", "cylindrical or circular", True),
    ("PERPENDICULARITY", "bore_12mm_left", "A", "within two parallel planes", False),
    ("COAXIALITY", "bore_12mm_left", "D", "within two parallel planes", False),
    ("SYMMETRY", "boss_20mm", "C", "within two parallel planes", True),
]


def test_a_zone_has_the_form_that_the_file_states_or_is_left_out(drawn):
    """Before, planes had zones of cylinders, spheres those of planes, and axes parallel to a plane had none."""
    path, drawing, face = drawn
    named = zip("ABCD", ("bottom", "back", "left", "bore_12mm_right"), strict=True)
    datums = {letter: drawing.datum(letter, face[name]) for letter, name in named}
    expected = {}
    for number, (kind, name, letters, form, known) in enumerate(FORMS, 1):
        system = drawing.system(*(datums[letter] for letter in letters))
        made = drawing.tolerance(kind, drawing.measure(number / 100), drawing.aspect(face[name]), system)
        zone = drawing.add(f"TOLERANCE_ZONE_FORM('{form}')")
        drawing.add(f"TOLERANCE_ZONE('',$,#{drawing.shape},.F.,(#{made}),#{zone})")
        if known:
            expected[number / 100] = (kind.lower(), name)
    task = task_of(path, drawing)
    assert {one.tolerance: (one.kind, one.features[0]) for one in task.measurements.values()} == expected


def test_a_projected_zone_is_left_out_and_a_form_that_is_not_stated_is_told(drawn):
    path, drawing, face = drawn
    datums = [drawing.datum(letter, face[n]) for letter, n in zip("ABC", ("bottom", "back", "left"), strict=True)]
    bores = [drawing.aspect(face[f"bore_12mm_{side}"]) for side in ("left", "right")]
    made, _ = (drawing.tolerance("POSITION", drawing.measure(0.1), one, drawing.system(*datums)) for one in bores)
    form = drawing.add("TOLERANCE_ZONE_FORM('cylindrical or circular')")
    zone = drawing.add(f"TOLERANCE_ZONE('',$,#{drawing.shape},.F.,(#{made}),#{form})")
    ends = drawing.aspect(face["top_at_z12mm"])
    drawing.add(f"PROJECTED_ZONE_DEFINITION(#{zone},(#{ends}),#{ends},#{drawing.measure(30.0)})")
    path.write_text(drawing.whole())
    found = read_part(path).drawing
    assert set(found.measurements) == {"bore_12mm_right_position"}
    assert any("bore_12mm_left: its zone is projected" in one for one in found.left_out)
    assert any("bore_12mm_right: the file states no form" in one for one in found.in_part)


@pytest.mark.parametrize(
    "record",
    [
        "DIRECTED_TOLERANCE_ZONE('',$,#{shape},.F.,(#{of}),#{form},#{plane},.PERPENDICULAR.)",
        "ORIENTED_TOLERANCE_ZONE('',$,#{shape},.F.,(#{of}),#{form},#{plane},.PARALLEL.,$)",
        "( DIRECTED_TOLERANCE_ZONE(.PARALLEL.) SHAPE_ASPECT('',$,#{shape},.F.) TOLERANCE_ZONE((#{of}),#{form}) "
        "TOLERANCE_ZONE_WITH_DATUM(#{plane}) )",
    ],
)
def test_a_zone_with_a_direction_of_its_own_is_left_out_with_the_reason(drawn, record):
    """A symmetry across B in the direction of C: before, the direction was ignored, without a remark."""
    path, drawing, face = drawn
    across, along = (drawing.system(drawing.datum(one, face[name])) for one, name in (("B", "back"), ("C", "left")))
    made = drawing.tolerance("SYMMETRY", drawing.measure(0.1), drawing.aspect(face["boss_20mm"]), across)
    form = drawing.add("TOLERANCE_ZONE_FORM('within two parallel planes')")
    drawing.add(record.format(shape=drawing.shape, of=made, form=form, plane=along))
    path.write_text(drawing.whole())
    found = read_part(path).drawing
    assert not found.measurements
    assert any("symmetry 0.1" in one and "a direction of its own" in one for one in found.left_out)


@pytest.mark.parametrize(
    "written", ["Functional surface of the {} for the sealing ring", "シール面シール面シール面シール面{}"]
)
def test_measurements_of_faces_with_long_names_have_names_that_a_task_allows(drawn, written):
    """Two names of 60 bytes with a word between them made a task that no command read."""
    path, drawing, face = drawn
    for name in ("bore_12mm_left", "bore_12mm_right", "back", "front"):
        record = rf"(#{face[name]}\s*=\s*ADVANCED_FACE\()''"
        drawing.text = re.sub(record, rf"\1'{written.format(name)}'", drawing.text)
    sides = (face["back"], face["front"])
    drawing.tolerance("POSITION", drawing.measure(0.1), drawing.aspect(*sides))
    for one, other in (("left", "right"), ("right", "left")):
        ends = [drawing.aspect(face[f"bore_12mm_{side}"]) for side in (one, other)]
        made = drawing.add(f"DIMENSIONAL_LOCATION('linear distance',$,#{ends[0]},#{ends[1]})")
        drawing.values(made, drawing.measure(70.0, "nominal value"))
    task = task_of(path, drawing)
    assert sorted(one.kind for one in task.measurements.values()) == ["axis_distance", "axis_distance", "position"]
