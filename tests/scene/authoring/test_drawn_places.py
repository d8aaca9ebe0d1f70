"""Places of the faces of a STEP file to which distances refer, for every mesh of the faces."""

import numpy as np
import pytest

from characterisation.tasks.definitions import plane_distance
from mitsim.scene.authoring.read_step import Fineness, read_step, step_installed
from tests.scene.authoring.bracket import write_step

pytestmark = [
    pytest.mark.skipif(not step_installed(), reason="OpenCASCADE, which reads STEP, is not installed"),
    pytest.mark.usefixtures("step_here"),
]


@pytest.mark.parametrize("chord_mm", [0.5, 0.01])
def test_the_distance_of_tilted_planes_is_that_between_the_centroids_of_their_areas(tmp_path, chord_mm):
    """A wedge of 5 deg with a hole near its thin end, where most vertices of the mesh lie."""
    from OCP.BRepAlgoAPI import BRepAlgoAPI_Cut
    from OCP.BRepBuilderAPI import BRepBuilderAPI_MakeFace, BRepBuilderAPI_MakePolygon
    from OCP.BRepPrimAPI import BRepPrimAPI_MakeCylinder, BRepPrimAPI_MakePrism
    from OCP.gp import gp_Ax2, gp_Dir, gp_Pnt, gp_Vec

    slope, side = np.tan(np.deg2rad(5)), BRepBuilderAPI_MakePolygon()
    for x, z in ((0, 0), (200, 0), (200, 20 + 200 * slope), (0, 20)):
        side.Add(gp_Pnt(x, 0, z))
    side.Close()
    wedge = BRepPrimAPI_MakePrism(BRepBuilderAPI_MakeFace(side.Wire()).Face(), gp_Vec(0, 60, 0)).Shape()
    hole = BRepPrimAPI_MakeCylinder(gp_Ax2(gp_Pnt(30, 30, -1), gp_Dir(0, 0, 1)), 15.0, 60.0).Shape()
    path = write_step([("wedge", BRepAlgoAPI_Cut(wedge, hole).Shape(), None)], tmp_path / "wedge.step")
    planes = [face.surface for face in read_step(path, Fineness(chord_mm)).faces if face.kind == "plane"]
    bottom, top = sorted((one for one in planes if abs(one.normal[2]) > 0.9), key=lambda one: one.normal[2])

    hole_area = np.pi * 15**2
    x = (200 * 60 * 100 - hole_area * 30) / (200 * 60 - hole_area)
    edge, middle = np.array([-20 / slope, 0]), np.array([x, (20 + x * slope) / 2])
    along = (middle - edge) @ [np.cos(np.deg2rad(2.5)), np.sin(np.deg2rad(2.5))]
    truth = 2 * along * np.tan(np.deg2rad(2.5))
    assert bottom.point[:2] == pytest.approx([x, 30], abs=0.05)
    assert plane_distance(bottom, top, nominal=(bottom, top)) == pytest.approx(truth, abs=2e-3)
