"""A bracket as STEP, made with OpenCASCADE: two bores, a pillar, a spherical seat, a chamfer and a fillet."""

from pathlib import Path


def bracket():
    """Solid of a base of 100 x 60 x 12 mm with a wall of 40 mm; two bores of 12 mm, a pillar, a seat, a chamfer."""
    from OCP.BRepAlgoAPI import BRepAlgoAPI_Cut, BRepAlgoAPI_Fuse
    from OCP.BRepFilletAPI import BRepFilletAPI_MakeChamfer, BRepFilletAPI_MakeFillet
    from OCP.BRepPrimAPI import BRepPrimAPI_MakeBox, BRepPrimAPI_MakeCylinder, BRepPrimAPI_MakeSphere
    from OCP.gp import gp_Ax2, gp_Dir, gp_Pnt

    solid = BRepPrimAPI_MakeBox(gp_Pnt(-50, -30, 0), gp_Pnt(50, 30, 12)).Shape()
    wall = BRepPrimAPI_MakeBox(gp_Pnt(-50, 18, 12), gp_Pnt(50, 30, 52)).Shape()
    solid = BRepAlgoAPI_Fuse(solid, wall).Shape()
    up = gp_Dir(0, 0, 1)
    solid = BRepAlgoAPI_Fuse(solid, BRepPrimAPI_MakeCylinder(gp_Ax2(gp_Pnt(0, -5, 12), up), 10, 20).Shape()).Shape()
    for x in (-35, 35):
        solid = BRepAlgoAPI_Cut(solid, BRepPrimAPI_MakeCylinder(gp_Ax2(gp_Pnt(x, -8, -1), up), 6, 20).Shape()).Shape()
    solid = BRepAlgoAPI_Cut(solid, BRepPrimAPI_MakeSphere(gp_Pnt(0, -5, 36), 9).Shape()).Shape()
    chamfer, fillet = BRepFilletAPI_MakeChamfer(solid), BRepFilletAPI_MakeFillet
    chamfer.Add(5.0, edge_at(solid, (0, 30, 52), (1, 0, 0)))
    solid = chamfer.Shape()
    rounded = fillet(solid)
    rounded.Add(4.0, edge_at(solid, (0, 18, 12), (1, 0, 0)))
    return rounded.Shape()


def slotted():
    """Solid of a plate of 100 x 60 x 10 mm: slots 6 mm wide at x = 30 and 39 mm, one 8 mm wide with round ends."""
    from OCP.BRepAlgoAPI import BRepAlgoAPI_Cut, BRepAlgoAPI_Fuse
    from OCP.BRepPrimAPI import BRepPrimAPI_MakeBox, BRepPrimAPI_MakeCylinder
    from OCP.gp import gp_Ax2, gp_Dir, gp_Pnt

    solid = BRepPrimAPI_MakeBox(gp_Pnt(0, 0, 0), gp_Pnt(100, 60, 10)).Shape()
    tool = BRepPrimAPI_MakeBox(gp_Pnt(20, 11, -1), gp_Pnt(40, 19, 11)).Shape()
    for x in (20, 40):
        end = BRepPrimAPI_MakeCylinder(gp_Ax2(gp_Pnt(x, 15, -1), gp_Dir(0, 0, 1)), 4, 12).Shape()
        tool = BRepAlgoAPI_Fuse(tool, end).Shape()
    solid = BRepAlgoAPI_Cut(solid, tool).Shape()
    for x in (30, 39):
        tool = BRepPrimAPI_MakeBox(gp_Pnt(x - 3, 40, -1), gp_Pnt(x + 3, 61, 11)).Shape()
        solid = BRepAlgoAPI_Cut(solid, tool).Shape()
    return solid


def edge_at(solid, place, way):
    """The edge of a solid that runs through a place along an axis."""
    from OCP.BRepAdaptor import BRepAdaptor_Curve
    from OCP.TopAbs import TopAbs_EDGE
    from OCP.TopExp import TopExp_Explorer
    from OCP.TopoDS import TopoDS

    explorer = TopExp_Explorer(solid, TopAbs_EDGE)
    while explorer.More():
        edge = TopoDS.Edge_s(explorer.Current())
        curve = BRepAdaptor_Curve(edge)
        ends = [curve.Value(u) for u in (curve.FirstParameter(), curve.LastParameter())]
        middle = [(ends[0].Coord(i) + ends[1].Coord(i)) / 2 for i in (1, 2, 3)]
        run = [abs(ends[1].Coord(i) - ends[0].Coord(i)) for i in (1, 2, 3)]
        if all(abs(a - b) < 1e-6 for a, b in zip(middle, place, strict=True)) and run.index(max(run)) == way.index(1):
            return edge
        explorer.Next()
    raise AssertionError(f"no edge at {place}")


def write_step(shapes, path: Path, schema: str = "AP214IS") -> Path:
    """Write named shapes with colours (name, shape, (red, green, blue) or None) as an assembly, or one as it is."""
    from OCP.Interface import Interface_Static
    from OCP.Quantity import Quantity_Color, Quantity_TOC_sRGB
    from OCP.STEPCAFControl import STEPCAFControl_Writer
    from OCP.TCollection import TCollection_ExtendedString
    from OCP.TDataStd import TDataStd_Name
    from OCP.TDocStd import TDocStd_Document
    from OCP.XCAFDoc import XCAFDoc_ColorSurf, XCAFDoc_DocumentTool

    document = TDocStd_Document(TCollection_ExtendedString("bracket"))
    tool, colours = XCAFDoc_DocumentTool.ShapeTool_s(document.Main()), XCAFDoc_DocumentTool.ColorTool_s(document.Main())
    for name, shape, colour in shapes:
        label = tool.AddShape(shape, False)
        TDataStd_Name.Set_s(label, TCollection_ExtendedString(name))
        if colour is not None:
            colours.SetColor(label, Quantity_Color(*colour, Quantity_TOC_sRGB), XCAFDoc_ColorSurf)
    Interface_Static.SetCVal_s("write.step.schema", schema)
    writer = STEPCAFControl_Writer()
    writer.SetColorMode(True)
    writer.SetNameMode(True)
    assert writer.Transfer(document)
    writer.Write(str(path))
    return path
