"""Names of faces and bodies that a file does not give, or that a CAD program wrote without meaning."""

from __future__ import annotations

import numpy as np
import pytest

from mitsim.scene.authoring.naming import with_names
from mitsim.scene.authoring.part_folder import read_part
from mitsim.scene.authoring.read_step import step_installed
from mitsim.scene.authoring.segment_mesh import segment_mesh
from tests.scene.authoring.bracket import edge_at, write_step

pytestmark = [
    pytest.mark.skipif(not step_installed(), reason="OpenCASCADE, which reads STEP, is not installed"),
    pytest.mark.usefixtures("step_here"),
]


def test_the_floor_of_an_oblique_blind_bore_is_no_chamfer(tmp_path):
    from OCP.BRepAlgoAPI import BRepAlgoAPI_Cut
    from OCP.BRepFilletAPI import BRepFilletAPI_MakeChamfer
    from OCP.BRepPrimAPI import BRepPrimAPI_MakeBox, BRepPrimAPI_MakeCylinder
    from OCP.gp import gp_Ax2, gp_Dir, gp_Pnt

    box = BRepPrimAPI_MakeBox(80.0, 60.0, 40.0).Shape()
    chamfer = BRepFilletAPI_MakeChamfer(box)
    chamfer.Add(3.0, edge_at(box, (80, 30, 40), (0, 1, 0)))
    along = gp_Dir(np.sin(np.deg2rad(20)), 0, np.cos(np.deg2rad(20)))
    bore = BRepPrimAPI_MakeCylinder(gp_Ax2(gp_Pnt(40, 30, 25), along), 4.0, 60.0).Shape()
    solid = BRepAlgoAPI_Cut(chamfer.Shape(), bore).Shape()
    drawn = read_part(write_step([("block", solid, None)], tmp_path / "block.step")).faces
    oblique = {face.name: face for face in drawn if face.kind == "plane" and "deg" in face.name}
    assert set(oblique) == {"chamfer_45deg", "slope_20deg"}
    assert np.allclose(oblique["slope_20deg"].surface.point, [40, 30, 25], atol=1e-3)
    start = np.cumsum([0, *(len(face.vertices) for face in drawn)])
    triangles = np.concatenate([face.triangles + at for face, at in zip(drawn, start, strict=False)])
    meshed = with_names(segment_mesh(np.concatenate([face.vertices for face in drawn]), triangles).faces)
    assert set(oblique) == {face.name for face in meshed if face.kind == "plane" and "deg" in face.name}


def test_the_tip_of_a_drilled_bore_is_no_countersink(tmp_path):
    from OCP.BRepAlgoAPI import BRepAlgoAPI_Cut
    from OCP.BRepPrimAPI import BRepPrimAPI_MakeBox, BRepPrimAPI_MakeCone, BRepPrimAPI_MakeCylinder
    from OCP.gp import gp_Ax2, gp_Dir, gp_Pnt

    tip = 5 / np.tan(np.deg2rad(59))
    up = gp_Dir(0, 0, 1)
    solid = BRepPrimAPI_MakeBox(80.0, 60.0, 20.0).Shape()
    for tool in (
        BRepPrimAPI_MakeCylinder(gp_Ax2(gp_Pnt(20, 30, 8), up), 5.0, 20.0),
        BRepPrimAPI_MakeCone(gp_Ax2(gp_Pnt(20, 30, 8 - tip), up), 0.0, 5.0, tip),
        BRepPrimAPI_MakeCylinder(gp_Ax2(gp_Pnt(60, 30, -1), up), 3.0, 30.0),
        BRepPrimAPI_MakeCone(gp_Ax2(gp_Pnt(60, 30, 16), up), 3.0, 7.0, 4.0),
    ):
        solid = BRepAlgoAPI_Cut(solid, tool.Shape()).Shape()
    faces = read_part(write_step([("block", solid, None)], tmp_path / "block.step")).faces
    assert {face.name for face in faces if face.kind == "cone"} == {"cone_118deg", "countersink_90deg"}


@pytest.mark.parametrize(
    ("written", "prefixes"),
    [
        (("Open CASCADE STEP translator 7.9 10", "Open CASCADE STEP translator 7.9 9"), ("part_1_", "part_2_")),
        (("{3F2504E0-4F89-11D3-9A0C-0305E82C3301}", "lid"), ("part_", "lid_")),
        (("=>[0:1:1:2]", "SOLID"), ("part_1_", "part_2_")),
        (("COMPOUND", "Solid 2"), ("part_", "Solid_2_")),
        (("Part1", "Body 2"), ("Part1_", "Body_2_")),
        (("lid", "lid"), ("lid_1_", "lid_2_")),
        (("a/b", "it''s \\X2\\00F6\\X0\\l"), ("a_b_", "it_s_öl_")),
    ],
)
def test_a_body_without_a_name_of_its_own_is_a_numbered_part(tmp_path, written, prefixes):
    from OCP.BRepPrimAPI import BRepPrimAPI_MakeBox
    from OCP.gp import gp_Pnt

    boxes = [BRepPrimAPI_MakeBox(gp_Pnt(30.0 * at, 0, 0), 10.0, 10.0, 10.0).Shape() for at in range(2)]
    path = write_step([("FIRST", boxes[0], None), ("SECOND", boxes[1], None)], tmp_path / "two.step")
    text = path.read_text()
    for placeholder, name in zip(("FIRST", "SECOND"), written, strict=True):
        assert f"'{placeholder}'" in text
        text = text.replace(f"'{placeholder}'", f"'{name}'")
    path.write_text(text)
    for prefix, at in zip(prefixes, range(2), strict=True):
        names = {face.name for face in read_part(path).faces if abs(face.vertices[:, 0].mean() - 30 * at - 5) < 10}
        assert len(names) == 6
        assert all(name.startswith(prefix) for name in names)
