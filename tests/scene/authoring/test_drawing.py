"""Dimensions, tolerances and datums of STEP files: a small file of our own, and NIST's CTC-01 against its QIF."""

from __future__ import annotations

import os
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

from characterisation.files.errors import InputError
from characterisation.tasks.measurement_model import measurement_model
from characterisation.tasks.task_reading import check_nominal_values, read_task
from mitsim.scene.authoring.part21 import Enumeration, Reference, Typed, read_step_text
from mitsim.scene.authoring.part_folder import read_part, write_part
from mitsim.scene.authoring.product_information import read_product_information
from mitsim.scene.authoring.read_step import step_installed
from tests.scene.authoring.bracket import bracket, write_step
from tests.scene.authoring.drawing import Drawing

REAL = Path(os.environ.get("MITSIM_REAL_DATA") or Path(__file__).resolve().parents[3].parent / "shared" / "real")
needs_step = pytest.mark.skipif(not step_installed(), reason="OpenCASCADE, which reads STEP, is not installed")


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    """The bracket's AP242 file with a drawing in it."""
    folder = tmp_path_factory.mktemp("drawing")
    path = write_step([("bracket", bracket(), None)], folder / "bracket.step", "AP242DIS")
    face = {one.name: one.entities[0] for one in read_part(path).faces}
    drawing = Drawing(path.read_text())
    add, mm = drawing.add, drawing.measure
    left, right = face["bore_12mm_left"], face["bore_12mm_right"]
    a, b, c = (
        drawing.datum(letter, face[name]) for letter, name in zip("ABC", ("bottom", "back", "left"), strict=True)
    )
    bore = drawing.size("diameter", left, items=(mm(12.0, "nominal value"),))
    drawing.plus_minus(bore, mm(-0.1), mm(0.1))
    other = drawing.size("diameter", right, items=(mm(12.0 / 25.4, "nominal value", drawing.inch),))
    drawing.plus_minus(other, mm(0.0), mm(0.05))
    limits = (mm(9.0, "nominal value"), mm(9.2, "upper limit"), mm(8.8, "lower limit"))
    drawing.size("spherical radius", face["seat_18mm"], items=limits)
    apart = add(f"DIMENSIONAL_LOCATION('linear distance',$,#{drawing.aspect(left)},#{drawing.aspect(right)})")
    drawing.values(apart, mm(70.0, "nominal value"))
    leaning = add(
        f"ANGULAR_LOCATION('angle',$,#{drawing.aspect(face['chamfer_45deg'])},#{drawing.aspect(face['top'])},.EQUAL.)"
    )
    drawing.values(leaning, mm(2.356194490192345, "nominal value", angle=True))  # 135 deg about the edge
    drawing.tolerance("FLATNESS", mm(0.05), drawing.aspect(face["bottom"]))
    upright = drawing.aspect(face["front_at_y18mm"])
    drawing.tolerance("PERPENDICULARITY", mm(0.2), upright, drawing.system(a))
    modified = "GEOMETRIC_TOLERANCE_WITH_MODIFIERS((.MAXIMUM_MATERIAL_REQUIREMENT.))"
    drawing.tolerance("POSITION", mm(0.3), bore, drawing.system(a, b, c), modified)
    drawing.tolerance("CYLINDRICITY", mm(0.02), drawing.aspect(face["boss_20mm"]))
    drawing.tolerance("TOTAL_RUNOUT", mm(0.02), drawing.aspect(face["boss_20mm"]), drawing.system(a))
    drawing.tolerance("SURFACE_PROFILE", mm(0.4), drawing.aspect(face["top"]))
    drawing.size("diameter", face["boss_20mm"], items=())
    drawing.tolerance("ANGULARITY", mm(0.15), drawing.aspect(face["chamfer_45deg"]), drawing.system(a))
    drawing.tolerance("COAXIALITY", mm(0.1), drawing.aspect(right), drawing.system(drawing.datum("D", left)))
    drawing.tolerance("POSITION", mm(0.25), drawing.aspect(face["left"], face["right"]), drawing.system(a, b, c))
    drawing.tolerance("SYMMETRY", mm(0.35), drawing.aspect(face["left"], face["right"]), drawing.system(b))
    drawing.tolerance("SURFACE_PROFILE", mm(0.45), drawing.aspect(face["front"]), drawing.system(a, c, b))
    path.write_text(drawing.whole())
    return path


@needs_step
def test_what_a_task_knows_becomes_measurements_and_the_rest_is_listed(drawn, tmp_path, step_here):
    part = write_part(drawn, tmp_path / "made")
    task = read_task(tmp_path / "made/task.toml")
    found = {name: (one.kind, one.features, one.nominal, one.tolerance) for name, one in task.measurements.items()}
    assert found == {
        "bore_12mm_left_diameter": ("diameter", ("bore_12mm_left",), 12.0, 0.1),
        "bore_12mm_right_diameter": ("diameter", ("bore_12mm_right",), 12.0, (0.0, 0.05)),
        "seat_18mm_radius": ("radius", ("seat_18mm",), 9.0, 0.2),
        "bore_12mm_left_to_bore_12mm_right_distance": (
            "axis_distance",
            ("bore_12mm_left", "bore_12mm_right"),
            70.0,
            None,
        ),
        "chamfer_45deg_to_top_angle": ("plane_angle", ("chamfer_45deg", "top"), 45.0, None),
        "bottom_flatness": ("flatness", ("bottom",), 0.0, 0.05),
        "front_at_y18mm_perpendicularity": ("perpendicularity", ("front_at_y18mm", "bottom"), 0.0, 0.2),
        "bore_12mm_left_position": ("position", ("bore_12mm_left", "bottom", "back", "left"), 0.0, 0.3),
        "boss_20mm_cylindricity": ("cylindricity", ("boss_20mm",), 0.0, 0.02),
        "top_flatness": ("flatness", ("top",), 0.0, 0.4),
        "chamfer_45deg_angularity": ("angularity", ("chamfer_45deg", "bottom"), 0.0, 0.15),
        "bore_12mm_right_coaxiality": ("coaxiality", ("bore_12mm_right", "bore_12mm_left"), 0.0, 0.1),
        "middle_of_left_position": ("position", ("middle_of_left", "bottom", "back", "left"), 0.0, 0.25),
        "middle_of_left_symmetry": ("symmetry", ("middle_of_left", "back"), 0.0, 0.35),
        "front_position": ("position", ("front", "bottom", "left", "back"), 0.0, 0.45),
    }
    assert part.drawing.datums == {"A": ("bottom",), "B": ("back",), "C": ("left",), "D": ("bore_12mm_left",)}
    text = (tmp_path / "made/task.toml").read_text()
    for told in (
        "total runout 0.02 |A of boss_20mm: a task has no such tolerance",
        "tolerance = [0.0, 0.05]",
        "diameter of boss_20mm: it has no value in the file",
        "maximum material requirement",
    ):
        assert told in text
    assert "[features.bottom]  # datum A" in text


@needs_step
def test_zones_that_a_task_does_not_have_are_left_out_with_the_reason(tmp_path, step_here):
    """A zone of an axis between two planes, a profile with an offset zone, and limits in the wrong order."""
    path = write_step([("bracket", bracket(), None)], tmp_path / "bracket.step", "AP242DIS")
    face = {one.name: one.entities[0] for one in read_part(path).faces}
    drawing = Drawing(path.read_text())
    add, mm = drawing.add, drawing.measure
    system = drawing.system(
        *(drawing.datum(one, face[n]) for one, n in zip("ABC", ("bottom", "back", "left"), strict=True))
    )
    for name, form in (
        ("bore_12mm_left", "within two parallel planes"),
        ("bore_12mm_right", "cylindrical or circular"),
    ):
        made = drawing.tolerance("POSITION", mm(0.3), drawing.aspect(face[name]), system)
        shape = add(f"TOLERANCE_ZONE_FORM('{form}')")
        add(f"TOLERANCE_ZONE('',$,#{drawing.shape},.F.,(#{made}),#{shape})")
    offset = f"UNEQUALLY_DISPOSED_GEOMETRIC_TOLERANCE(#{mm(0.15)})"
    drawing.tolerance("SURFACE_PROFILE", mm(0.2), drawing.aspect(face["front"]), system, offset)
    drawing.plus_minus(
        drawing.size("diameter", face["boss_20mm"], items=(mm(20.0, "nominal value"),)), mm(0.2), mm(-0.1)
    )
    path.write_text(drawing.whole())
    made = read_part(path).drawing
    assert set(made.measurements) == {"bore_12mm_right_position", "boss_20mm_diameter"}
    assert made.measurements["boss_20mm_diameter"].tolerance is None
    assert any("20.2 and 19.9 are not in increasing order" in one for one in made.in_part)
    assert any("of bore_12mm_left: its zone lies between two planes" in one for one in made.left_out)
    assert any("of front: its zone lies unequally about the surface" in one for one in made.left_out)


RANGES = ("VALUE_RANGE('',{})", "VALUE_RANGE('',SET_REPRESENTATION_ITEM({}))")
COMPLEX = "( COMPOUND_REPRESENTATION_ITEM({}) REPRESENTATION_ITEM('') VALUE_RANGE() )"


@pytest.mark.parametrize("form", [*RANGES, COMPLEX])
def test_a_range_of_values_has_its_limits_however_it_is_written(tmp_path, form):
    path = tmp_path / "range.step"
    path.write_text(
        "ISO-10303-21;\nDATA;\n#1=PRODUCT_DEFINITION_SHAPE('',$,$);\n#2=ADVANCED_BREP_SHAPE_REPRESENTATION('',(),$);\n"
        "ENDSEC;\nEND-ISO-10303-21;\n"
    )
    drawing = Drawing(path.read_text())
    low, high = drawing.measure(19.9, "lower limit"), drawing.measure(20.1, "upper limit")
    drawing.size("diameter", items=(drawing.add(form.format(f"(#{low},#{high})")),))
    path.write_text(drawing.whole())
    (dimension,) = read_product_information(read_step_text(path)).dimensions
    assert (dimension.nominal, dimension.limits) == (20.0, (19.9, 20.1))


@needs_step
def test_limits_of_a_drawing_count_from_the_model(tmp_path, step_here):
    """Both bores are 12 mm: a drawing that states 12.1 with limits about the model keeps these; 14 is a fault."""
    path = write_step([("bracket", bracket(), None)], tmp_path / "bracket.step", "AP242DIS")
    face = {one.name: one.entities[0] for one in read_part(path).faces}
    drawing = Drawing(path.read_text())
    mm = drawing.measure
    within = drawing.size("diameter", face["bore_12mm_left"], items=(mm(12.1, "nominal value"),))
    drawing.plus_minus(within, mm(-0.2), mm(0.05))
    beside = drawing.size("diameter", face["bore_12mm_right"], items=(mm(14.0, "nominal value"),))
    drawing.plus_minus(beside, mm(-0.1), mm(0.1))
    drawing.size("radius", face["boss_20mm"], items=(mm(9.0, "nominal value"),))
    path.write_text(drawing.whole())
    write_part(path, tmp_path / "made")
    task = read_task(tmp_path / "made/task.toml")
    left, right = task.measurements["bore_12mm_left_diameter"], task.measurements["bore_12mm_right_diameter"]
    assert (left.nominal, left.limits) == (12.0, pytest.approx((11.9, 12.15)))
    assert (right.nominal, right.tolerance) == (14.0, 0.1)
    assert task.measurements["boss_20mm_radius"].nominal == 10.0
    text = (tmp_path / "made/task.toml").read_text()
    assert "the drawing states 12.1, the model has 12" in text
    with pytest.raises(InputError, match=r"bore_12mm_right_diameter.nominal: found 14; allowed: 12 mm"):
        check_nominal_values(task, "task.toml")


@needs_step
def test_what_was_converted_is_not_listed_as_left_out(drawn, tmp_path, step_here):
    """A profile of a plane in a datum frame is measured as its position: a remark, but no loss."""
    part = write_part(drawn, tmp_path / "made")
    remarks = part.drawing.remarks()
    at = remarks.index("Not converted:")
    lost, remarked = remarks[at + 1 :], remarks[remarks.index("Converted, with a remark:") + 1 : at]
    made = {one.number for one in part.drawing.measurements.values()}
    assert any("surface profile 0.45" in one and "front" in one for one in remarked)
    for line in remarked:
        assert int(line.split()[0].removeprefix("#")) in made
    for line in lost:
        number = line.split()[0]
        assert not number.startswith("#") or int(number[1:]) not in made, line


def numbers(path):
    """Characteristics of a QIF file: (kind, nominal, limits or zone, designator of its datums)."""
    q = "{http://qifstandards.org/xsd/qif3}"
    root = ElementTree.parse(path).getroot()
    value = lambda one, tag: None if (at := one.find(f".//{q}{tag}")) is None else float(at.text)  # noqa: E731
    letters = {
        one.get("id"): "".join(label.text for label in one.iter(f"{q}DatumLabel"))
        for one in root.iter(f"{q}DatumDefinition")
    }
    frames = {
        one.get("id"): tuple(letters[at.text] for at in one.iter(f"{q}DatumDefinitionId"))
        for one in root.iter(f"{q}DatumReferenceFrame")
    }
    definitions = {one.get("id"): one for one in root.iter() if one.tag.endswith("CharacteristicDefinition")}
    out = []
    for nominal in (one for one in root.iter() if one.tag.endswith("CharacteristicNominal")):
        definition = definitions[nominal.find(f"{q}CharacteristicDefinitionId").text]
        kind = definition.tag.removeprefix(q).removesuffix("CharacteristicDefinition").lower()
        target, low, high = value(nominal, "TargetValue"), value(definition, "MinValue"), value(definition, "MaxValue")
        if target is not None and definition.find(f".//{q}DefinedAsLimit").text == "false":
            low, high = target + low, target + high
        frame = definition.find(f"{q}DatumReferenceFrameId")
        zone = value(definition, "ToleranceValue")
        datums = frames[frame.text] if frame is not None else ()
        out.append((kind, target, zone if target is None else (round(low, 9), round(high, 9)), datums))
    return sorted(out, key=str)


@pytest.fixture(scope="module")
def ctc():
    path = REAL / "nist/nist_ctc_01_asme1_ap242.stp"
    if not path.exists():
        pytest.skip(f"no parts of NIST in {REAL}: set MITSIM_REAL_DATA, see docs/how-to/real-captures.md")
    return path


@pytest.mark.real
def test_every_characteristic_of_nists_part_is_read_with_its_value_and_datums(ctc):
    """XCAF readers have returned 0.0 for all of these tolerances."""
    information = read_product_information(read_step_text(ctc))
    found = [
        (one.kind, round(one.nominal, 9), tuple(round(end, 9) for end in one.limits), ())
        for one in information.dimensions
        if one.limits is not None
    ] + [(one.kind.replace(" ", ""), None, one.zone, one.datums) for one in information.tolerances]
    truth = numbers(REAL / "qif/nist_ctc_01_asme1_ap242.qif")
    assert len(truth) == 14
    assert sorted(found, key=str) == truth


@needs_step
@pytest.mark.real
def test_nists_part_becomes_a_task(ctc, tmp_path, step_here):
    part = write_part(ctc, tmp_path / "made")
    task = read_task(tmp_path / "made/task.toml")
    kinds = sorted(one.kind for one in task.measurements.values())
    assert kinds == ["diameter"] * 7 + ["flatness", "perpendicularity", "plane_angle"] + ["position"] * 3
    listed = "\n".join(part.drawing.left_out)
    assert "position 0.75" not in listed
    assert [line.split(":")[0].partition(" of ")[0] for line in part.drawing.left_out if "profile" in line] == [
        "#26 surface profile 1.25 |A|B|C",
        "#27 surface profile 0.5 |A",
    ]
    # every characteristic of the QIF has a measurement with its limits, but the profile all around
    wanted = [limits for _, _, limits, _ in numbers(REAL / "qif/nist_ctc_01_asme1_ap242.qif")]
    found = [
        one.tolerance if one.zone else tuple(round(end, 9) for end in one.limits) for one in task.measurements.values()
    ]
    wanted.remove(0.5)
    assert sorted(map(str, found)) == sorted(map(str, wanted))
    slots = [one for one in task.measurements.values() if task.features[one.features[0]].kind == "mid_plane"]
    assert [one.features[1:] for one in slots] == [("top_at_z0mm", "bore_35mm_front_left", "bore_35mm_front_right")] * 2
    for name, one in task.measurements.items():  # on the model every zone is 0, and every size that of the drawing
        model = measurement_model(task, name)
        if all(quantity.kind == "feature" for quantity in model.inputs):
            value = model.value(*(task.nominal(each) for each in task.fitted_for(name)))
            scale = 57.29577951308232 if one.unit == "deg" else 1.0
            assert value * scale == pytest.approx(one.nominal, abs=2e-3), name
    assert {letter: len(faces) for letter, faces in part.drawing.datums.items()} == {"A": 1, "B": 1, "C": 1}


@pytest.mark.parametrize("name", ["#9=NOT(1);", "MY DATA; IT'S", "a DATABASE /* of parts"])
def test_entities_of_a_file_are_read_as_they_are_written(tmp_path, name):
    """Before, DATA in the name of a file hid all of its entities."""
    path = tmp_path / "some.stp"
    written = name.replace("'", "''")
    path.write_text(
        f"ISO-10303-21;\nHEADER;\nFILE_NAME('{written}','',(''),(''),'','','');\nENDSEC;\nDATA;\n"
        "#1=A('it''s; /* no comment */ \\X2\\00E4\\X0\\',$,*,.T.,(#2,(1.5E-3,-2)));/* #7=B(); */\n"
        "#2 = ( X_1(LENGTH_MEASURE(3.)) Y() );\n#3=BROKEN((1,);\nENDSEC;\nEND-ISO-10303-21;\n"
    )
    text = read_step_text(path)
    assert set(text.record) == {1, 2, 3}
    assert text.entity(1).parts == (
        Typed("A", ("it's; /* no comment */ ä", None, None, Enumeration("T"), (Reference(2), (0.0015, -2.0)))),
    )
    assert text.entity(2).of("X_1") == (Typed("LENGTH_MEASURE", (3.0,)),)
    assert [one.number for one in text.all("Y")] == [2]
    assert text.entity(3) is None
    assert text.entity(4) is None
    (tmp_path / "other.stp").write_text("solid cube")
    with pytest.raises(InputError, match="Part 21"):
        read_step_text(tmp_path / "other.stp")


@pytest.mark.parametrize("before", ["", " /* 1 */ ", " /* of the DATA; */\n"])
@pytest.mark.parametrize("name", ["DATA of the pump", "METADATA; it''s", "two;\nDATA"])
def test_a_header_that_says_data_hides_no_record(tmp_path, name, before):
    path = tmp_path / "some.stp"
    header = f"ISO-10303-21;\nHEADER;\nFILE_NAME('{name}','');\nENDSEC;"
    path.write_text(f"{header}{before}DATA;\n#1=A('one');\n#2=B('two');\nENDSEC;\n")
    assert set(read_step_text(path).record) == {1, 2}


def test_a_text_with_open_strings_and_comments_is_read_in_one_pass(tmp_path):
    """Alternatives within alternatives made a regular expression take for ever on a missing quotation mark."""
    path = tmp_path / "open.stp"
    record = "#{0}=A('it''s',(''));\n"
    path.write_text(
        "ISO-10303-21;\nDATA;\n#1=B('never closed;\n" + "".join(map(record.format, range(2, 20000))) + "/*" * 20000
    )
    text = read_step_text(path)
    assert set(text.record) <= set(range(1, 20000))
    assert read_product_information(text).found is False
