"""Units of length that a part's file states, in each format; files without one; options that contradict it."""

from __future__ import annotations

import re
import zipfile

import numpy as np
import pytest
import trimesh

from characterisation.files.errors import InputError
from mitsim.scene.authoring.part_folder import read_part
from mitsim.scene.authoring.read_mesh import read_mesh
from mitsim.scene.authoring.read_step import Fineness, step_installed
from tests.scene.authoring.bracket import write_step

needs_step = pytest.mark.skipif(not step_installed(), reason="OpenCASCADE, which reads STEP, is not installed")

_TYPES = (
    '<?xml version="1.0"?><Types xmlns="http://schemas.openxmlformats.org/package/2006/content-types">'
    '<Default Extension="model" ContentType="application/vnd.ms-package.3dmanufacturing-3dmodel+xml"/></Types>'
)


def across(vertices):
    return np.ptp(vertices, axis=0).max()


def box_3mf(path, unit):
    box = trimesh.creation.box((1.0, 2.0, 3.0))
    vertices = "".join(f'<vertex x="{x}" y="{y}" z="{z}"/>' for x, y, z in box.vertices)
    triangles = "".join(f'<triangle v1="{a}" v2="{b}" v3="{c}"/>' for a, b, c in box.faces)
    with zipfile.ZipFile(path, "w") as packed:
        packed.writestr("[Content_Types].xml", _TYPES)
        packed.writestr(
            "3D/3dmodel.model",
            f'<model {unit} xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02"><resources>'
            f'<object id="1" type="model"><mesh><vertices>{vertices}</vertices>'
            f"<triangles>{triangles}</triangles></mesh></object></resources>"
            '<build><item objectid="1"/></build></model>',
        )
    return path


@pytest.mark.parametrize(
    ("unit", "length_mm"),
    [
        ('unit="inch"', 25.4),
        ('unit="centimeter"', 10.0),
        ('unit="foot"', 304.8),
        ('unit="meter"', 1000.0),
        ('unit="millimeter"', 1.0),
        ("", 1.0),
    ],
)
def test_a_3mf_file_is_in_the_unit_that_it_states(tmp_path, unit, length_mm):
    mesh = read_mesh(box_3mf(tmp_path / "box.3mf", unit))
    assert across(mesh.vertices) == pytest.approx(3 * length_mm, rel=1e-6)
    assert mesh.remarks == ()


def test_an_unknown_unit_of_a_3mf_file_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"'furlong'.*micron"):
        read_mesh(box_3mf(tmp_path / "box.3mf", 'unit="furlong"'))


@pytest.mark.parametrize(
    ("suffix", "comment", "length_mm"),
    [
        (".obj", "# File units = inches\n", 25.4),
        (".obj", "# This file uses centimeters as units for non-parametric coordinates.\n", 10.0),
        (".obj", "# units in metres\n", 1000.0),
        (".ply", "comment units cm\n", 10.0),
        (".stl", " unit: inch", 25.4),
    ],
)
def test_a_comment_that_states_the_unit_is_followed(tmp_path, suffix, comment, length_mm):
    path = tmp_path / f"box{suffix}"
    options = {"file_type": "stl_ascii"} if suffix == ".stl" else {}
    data = trimesh.creation.box((1.0, 2.0, 3.0)).export(**({"file_type": suffix[1:]} | options))
    data = data.encode() if isinstance(data, str) else data
    place = {".obj": 0, ".ply": data.find(b"element"), ".stl": len("solid")}[suffix]
    path.write_bytes(data[:place] + comment.encode() + data[place:])
    mesh = read_mesh(path)
    assert across(mesh.vertices) == pytest.approx(3 * length_mm, rel=1e-6)
    assert mesh.remarks == ()


@pytest.mark.parametrize("suffix", [".stl", ".obj", ".ply", ".off"])
def test_a_mesh_without_a_unit_is_in_mm_and_says_so(tmp_path, suffix):
    path = tmp_path / f"box{suffix}"
    trimesh.creation.box((1.0, 2.0, 3.0)).export(path)
    mesh = read_mesh(path)
    assert across(mesh.vertices) == pytest.approx(3)
    assert len(mesh.remarks) == 1
    assert "no unit" in mesh.remarks[0]
    assert read_part(path).remarks[0] == mesh.remarks[0]
    assert read_mesh(path, "inch").remarks == ()


def test_an_option_that_contradicts_the_mesh_says_so(tmp_path):
    path = box_3mf(tmp_path / "box.3mf", 'unit="inch"')
    assert read_mesh(path, "inch").remarks == ()
    mesh = read_mesh(path, "mm")
    assert across(mesh.vertices) == pytest.approx(3)
    assert "states inch" in mesh.remarks[0]
    trimesh.creation.box((1.0, 2.0, 3.0)).export(tmp_path / "box.glb")
    assert "states m as its unit" in read_mesh(tmp_path / "box.glb", "mm").remarks[0]


def pin(path, unit="MM"):
    """A pin of radius 2 and length 5 in a unit, whose side is a cylinder."""
    from OCP.BRepPrimAPI import BRepPrimAPI_MakeCylinder
    from OCP.Interface import Interface_Static

    scale = {"MM": 1.0, "INCH": 25.4}[unit]
    Interface_Static.SetCVal_s("write.step.unit", unit)
    try:
        return write_step([("pin", BRepPrimAPI_MakeCylinder(2.0 * scale, 5.0 * scale).Shape(), None)], path)
    finally:
        Interface_Static.SetCVal_s("write.step.unit", "MM")


def without_units(path):
    """The same file whose contexts assign no unit."""
    text = path.read_text()
    text, count = re.subn(r"GLOBAL_UNIT_ASSIGNED_CONTEXT\s*\(\s*\([^)]*\)\s*\)", "", text)
    assert count
    path.write_text(text)
    return path


def radius(part):
    return next(face for face in part.faces if face.kind == "cylinder").surface.radius


@needs_step
@pytest.mark.usefixtures("step_here")
@pytest.mark.parametrize(("units", "length_mm"), [(None, 1.0), ("mm", 1.0), ("inch", 25.4), ("m", 1000.0)])
def test_a_step_file_without_units_takes_the_option(tmp_path, units, length_mm):
    part = read_part(without_units(pin(tmp_path / "pin.step")), units, fineness=Fineness(0.01 * length_mm))
    assert radius(part) == pytest.approx(2 * length_mm)
    every = np.concatenate([face.vertices for face in part.faces])
    assert np.ptp(every[:, 2]) == pytest.approx(5 * length_mm)
    assert max(face.sag for face in part.faces) <= 0.01 * length_mm
    assert any("no unit" in one for one in part.remarks) is (units is None)
    assert {face.name for face in part.faces} >= {"top", "bottom"}


@needs_step
@pytest.mark.usefixtures("step_here")
def test_a_step_file_that_states_its_unit_refuses_another(tmp_path):
    path = pin(tmp_path / "pin.step", "INCH")
    for units in (None, "inch"):
        part = read_part(path, units)
        assert radius(part) == pytest.approx(2 * 25.4)
        assert not any("unit" in one for one in part.remarks)
    with pytest.raises(InputError, match=r"inch, the unit that pin\.step states"):
        read_part(path, "mm")


@needs_step
@pytest.mark.usefixtures("step_here")
def test_a_spline_of_a_file_in_metres_is_meshed_as_the_free_form_that_it_is(tmp_path):
    """Its distance from a plane, 0.02 mm, is over the limit in mm, and would be under it in the numbers of the file."""
    from OCP.BRepBuilderAPI import BRepBuilderAPI_MakeFace
    from OCP.GeomAPI import GeomAPI_PointsToBSplineSurface
    from OCP.gp import gp_Pnt
    from OCP.TColgp import TColgp_Array2OfPnt

    points = TColgp_Array2OfPnt(1, 9, 1, 9)
    for row in range(9):
        for column in range(9):
            height = 2e-5 * np.sin(np.pi * row / 4) * np.sin(np.pi * column / 4)
            points.SetValue(row + 1, column + 1, gp_Pnt(0.1 * row / 8, 0.1 * column / 8, height))
    sheet = BRepBuilderAPI_MakeFace(GeomAPI_PointsToBSplineSurface(points).Surface(), 1e-7).Face()
    path = without_units(write_step([("sheet", sheet, None)], tmp_path / "sheet.step"))
    (fine,) = read_part(path, "m", fineness=Fineness(1e-3, 1e-3)).faces
    (coarse,) = read_part(path, "m", fineness=Fineness(1e-3, 1.0)).faces
    assert fine.surface is None
    assert len(coarse.triangles) < len(fine.triangles) / 4
