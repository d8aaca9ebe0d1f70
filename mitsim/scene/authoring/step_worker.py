"""Read a STEP file with OpenCASCADE, in a separate process because a file can crash the library.

Signal chain: STEP -> bodies of the assembly, each in its place -> faces meshed to a chord error [mm] -> for each face
its triangles, the normals of its surface at the vertices, its surface if it is a plane, cylinder, cone, sphere or
torus, its colour, its edges, and the number of its entity in the file.

B-splines, extrusions and revolutions within :data:`SAME_MM` of a simple surface are converted to it.

::

    python -m mitsim.scene.authoring.step_worker PART.step OUT.npz CHORD_MM BEND_RAD UNIT_MM OTHERS_MM MOST FITTED_MM2

UNIT_MM is the size of the unit that OpenCASCADE takes for mm: 1, except in a file that states no unit. Tori and free
forms are meshed to OTHERS_MM. The largest faces become coarser where all would have over MOST triangles; 0 is no limit
(:mod:`mitsim.scene.authoring.step_mesh`). The chord of a part of over 10 m is at least 1e-5 of its diagonal.

It imports no other module of ``mitsim``, so that it starts quickly.
"""

from __future__ import annotations

import json
import re
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mitsim.scene.authoring.step_mesh import LARGE_MM, LARGE_SHARE, diagonal, mesh, triangles_of

#: a spline within this of a plane, cylinder, cone or sphere is written as such [mm]
SAME_MM = 1e-4


def numbered(text: bytes) -> bytes:
    """Return the file with each face named by the number of its entity; OpenCASCADE keeps names but not numbers."""
    return re.sub(
        rb"(#(\d+)\s*=\s*(?:ADVANCED_FACE|FACE_SURFACE)\s*\(\s*)(?:'(?:[^']|''){0,500}'|\$)", rb"\1'#\2'", text
    )


def bodies(document: Any) -> list[tuple[str, Any, tuple[float, float, float] | None]]:
    """Return every body of a document in its place, with the name and the colour of its part."""
    from OCP.TDF import TDF_Label, TDF_LabelSequence
    from OCP.TopLoc import TopLoc_Location
    from OCP.XCAFDoc import XCAFDoc_ColorTool, XCAFDoc_DocumentTool, XCAFDoc_ShapeTool

    tool = XCAFDoc_DocumentTool.ShapeTool_s(document.Main())
    shapes: list[tuple[str, Any, tuple[float, float, float] | None]] = []

    def walk(label: Any, name: str, location: Any, colour: tuple[float, float, float] | None) -> None:
        colour = first_colour(partial(XCAFDoc_ColorTool.GetColor_s, label)) or colour
        if XCAFDoc_ShapeTool.IsReference_s(label):
            location = location.Multiplied(XCAFDoc_ShapeTool.GetLocation_s(label))
            referred = TDF_Label()
            XCAFDoc_ShapeTool.GetReferredShape_s(label, referred)
            walk(referred, label_name(referred) or name, location, colour)
            return
        if XCAFDoc_ShapeTool.IsAssembly_s(label):
            parts = TDF_LabelSequence()
            XCAFDoc_ShapeTool.GetComponents_s(label, parts, False)
            for number in range(1, parts.Length() + 1):
                part = parts.Value(number)
                walk(part, label_name(part) or name, location, colour)
            return
        shape = XCAFDoc_ShapeTool.GetShape_s(label)
        shapes.append((name or label_name(label), shape.Moved(location), colour))

    free = TDF_LabelSequence()
    tool.GetFreeShapes(free)
    for number in range(1, free.Length() + 1):
        walk(free.Value(number), label_name(free.Value(number)), TopLoc_Location(), None)
    return shapes


def label_name(label: Any) -> str:
    """Return the name of a label, or an empty text."""
    from OCP.TDataStd import TDataStd_Name

    name = TDataStd_Name()
    return str(name.Get().ToExtString()) if label.FindAttribute(TDataStd_Name.GetID_s(), name) else ""


def first_colour(written: Callable[[Any, Any], bool]) -> tuple[float, float, float] | None:
    """Return the colour of a surface, else the general one, as sRGB 0 to 1; ``written`` sets a colour of a kind."""
    from OCP.Quantity import Quantity_Color
    from OCP.XCAFDoc import XCAFDoc_ColorGen, XCAFDoc_ColorSurf

    colour = Quantity_Color()
    return srgb(colour) if written(XCAFDoc_ColorSurf, colour) or written(XCAFDoc_ColorGen, colour) else None


def srgb(colour: Any) -> tuple[float, float, float]:
    """Convert OpenCASCADE's linear colour to sRGB, as in the file."""
    linear = np.array([colour.Red(), colour.Green(), colour.Blue()])
    curved = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)
    red, green, blue = np.round(np.clip(curved, 0, 1), 4).tolist()
    return red, green, blue


def surface_of(face: Any, tolerance: float) -> dict[str, Any]:
    """Return the surface of a face as kind and numbers; ``freeform`` if none is simple within ``tolerance``."""
    from OCP.BRep import BRep_Tool
    from OCP.BRepAdaptor import BRepAdaptor_Surface
    from OCP.GeomAbs import GeomAbs_SurfaceType as Kinds
    from OCP.gp import gp_Cone, gp_Cylinder, gp_Pln, gp_Sphere
    from OCP.ShapeAnalysis import ShapeAnalysis_CanonicalRecognition

    if BRep_Tool.Surface_s(face) is None:
        return {"kind": "freeform"}
    adaptor = BRepAdaptor_Surface(face)
    for name in ("Plane", "Cylinder", "Cone", "Sphere", "Torus"):
        if adaptor.GetType() == getattr(Kinds, f"GeomAbs_{name}"):
            return simple(name.lower(), getattr(adaptor, name)())
    recognition = ShapeAnalysis_CanonicalRecognition(face)
    for name, surface, asked in (
        ("plane", gp_Pln(), recognition.IsPlane),
        ("cylinder", gp_Cylinder(), recognition.IsCylinder),
        ("cone", gp_Cone(), recognition.IsCone),
        ("sphere", gp_Sphere(), recognition.IsSphere),
    ):
        try:
            matches = asked(tolerance, surface)
        except Exception:  # OpenCASCADE fails for some splines
            continue
        if matches:
            return simple(name, surface)
    return {"kind": "freeform"}


def in_mm(surface: dict[str, Any], unit_mm: float) -> dict[str, Any]:
    """Return the numbers of a surface in mm."""
    lengths: dict[str, Any] = {key: surface[key] * unit_mm for key in ("radius", "tube") if key in surface}
    if "point" in surface:
        lengths["point"] = [unit_mm * coordinate for coordinate in surface["point"]]
    return surface | lengths


def simple(kind: str, surface: Any) -> dict[str, Any]:
    """Return the numbers of a simple surface."""
    frame = surface.Position()
    at, along = frame.Location(), frame.Axis().Direction()
    out: dict[str, Any] = {"kind": kind, "point": [at.X(), at.Y(), at.Z()], "axis": [along.X(), along.Y(), along.Z()]}
    if kind in ("cylinder", "sphere"):
        out["radius"] = surface.Radius()
    if kind == "cone":
        out |= {"radius": surface.RefRadius(), "half_angle": surface.SemiAngle()}
    if kind == "torus":
        out |= {"radius": surface.MajorRadius(), "tube": surface.MinorRadius()}
    return out


def subshapes(shape: Any, kind: Any, avoid: Any = None) -> list[Any]:
    """Return the shapes of a kind that a shape has, without those inside shapes of the kind ``avoid``."""
    from OCP.TopAbs import TopAbs_FACE
    from OCP.TopExp import TopExp_Explorer
    from OCP.TopoDS import TopoDS

    explorer = TopExp_Explorer(shape, kind) if avoid is None else TopExp_Explorer(shape, kind, avoid)
    out = []
    while explorer.More():
        out.append(TopoDS.Face_s(explorer.Current()) if kind == TopAbs_FACE else explorer.Current())
        explorer.Next()
    return out


class FaceSurfaces:
    """The surface of each face of some shapes, as :func:`surface_of` returns it, computed once."""

    def __init__(self, shapes: list[Any], tolerance: float) -> None:
        from OCP.TopAbs import TopAbs_FACE
        from OCP.TopTools import TopTools_IndexedMapOfShape

        self.faces = [face for shape in shapes for face in subshapes(shape, TopAbs_FACE)]
        self._numbers = TopTools_IndexedMapOfShape()
        self._surfaces: list[dict[str, Any]] = []
        for face in self.faces:
            if self._numbers.Add(face) > len(self._surfaces):
                self._surfaces.append(surface_of(face, tolerance))

    def of(self, face: Any) -> dict[str, Any]:
        """Return the surface of one of the faces."""
        surface: dict[str, Any] = self._surfaces[self._numbers.FindIndex(face) - 1]
        return surface


def convert(  # noqa: PLR0913 - the arguments of the command
    path: str,
    out: str,
    chord_mm: float,
    bend: float,
    unit_mm: float = 1.0,
    others_mm: float | None = None,
    most: float = 0,
    fitted_mm2: float = 0.0,
) -> None:
    """Write the faces of a STEP file as an NPZ of arrays and a JSON ``text``.

    Parameters
    ----------
    path, out
        The STEP file, and the NPZ.
    chord_mm, bend, others_mm, most, fitted_mm2
        As for :func:`mesh`.
    unit_mm
        Factor on all lengths.
    """
    from OCP.IFSelect import IFSelect_RetDone
    from OCP.STEPCAFControl import STEPCAFControl_Reader
    from OCP.TCollection import TCollection_ExtendedString
    from OCP.TDocStd import TDocStd_Document
    from OCP.TopAbs import TopAbs_EDGE, TopAbs_FACE, TopAbs_SHELL, TopAbs_SOLID
    from OCP.TopExp import TopExp
    from OCP.TopLoc import TopLoc_Location
    from OCP.TopTools import TopTools_IndexedMapOfShape
    from OCP.XCAFDoc import XCAFDoc_DocumentTool

    document = TDocStd_Document(TCollection_ExtendedString("part"))
    reader = STEPCAFControl_Reader()
    reader.SetNameMode(True)
    reader.SetColorMode(True)
    with tempfile.TemporaryDirectory() as folder:
        numbered_file = Path(folder) / "numbered.step"
        numbered_file.write_bytes(numbered(Path(path).read_bytes()))
        if reader.ReadFile(str(numbered_file)) != IFSelect_RetDone or not reader.Transfer(document):
            sys.exit("OpenCASCADE cannot read it")
    session = reader.Reader().WS()
    transfer = session.TransferReader()
    colours = XCAFDoc_DocumentTool.ColorTool_s(document.Main())

    def entity(face: Any) -> int:
        record = transfer.EntityFromShapeResult(face.Located(TopLoc_Location()), -1)
        name = "" if record is None or not hasattr(record, "Name") else record.Name().ToCString()
        return int(name[1:]) if name[1:].isdigit() else 0

    faces: list[dict[str, Any]] = []
    arrays: dict[str, list[np.ndarray]] = {"vertices": [], "normals": [], "triangles": []}
    lost = body = 0
    there = bodies(document)
    other_chord = chord_mm if others_mm is None else others_mm
    shapes = [shape for _, shape, _ in there]
    if (size := diagonal(shapes, False) * unit_mm) > LARGE_MM:
        chord_mm, other_chord = (max(one, LARGE_SHARE * size) for one in (chord_mm, other_chord))
    surfaces = FaceSurfaces(shapes, SAME_MM / unit_mm)
    kinds = [surfaces.of(face)["kind"] for face in surfaces.faces]
    fitted = fitted_mm2 / unit_mm**2
    largest = mesh(shapes, surfaces.faces, kinds, chord_mm / unit_mm, bend, other_chord / unit_mm, int(most), fitted)
    for name, shape, part_colour in there:
        edges = TopTools_IndexedMapOfShape()
        TopExp.MapShapes_s(shape, TopAbs_EDGE, edges)
        groups = [(subshape, subshapes(subshape, TopAbs_FACE)) for subshape in subshapes(shape, TopAbs_SOLID)]
        groups += [
            (subshape, subshapes(subshape, TopAbs_FACE)) for subshape in subshapes(shape, TopAbs_SHELL, TopAbs_SOLID)
        ]
        groups.append((shape, subshapes(shape, TopAbs_FACE, TopAbs_SHELL)))
        closed = not subshapes(shape, TopAbs_FACE, TopAbs_SOLID)
        for solid, members in groups:
            for face in members:
                made = triangles_of(face)
                if made is None:
                    lost += 1
                    continue
                bare = [part.Located(TopLoc_Location()) for part in (face, solid)]
                own, of_solid = (first_colour(partial(colours.GetColor, part)) for part in bare)
                colour = own or of_solid or part_colour
                faces.append(
                    {
                        **in_mm(surfaces.of(face), unit_mm),
                        "entity": entity(face),
                        "part": name,
                        "body": body,
                        "colour": colour,
                        "edges": sorted({edges.FindIndex(edge) for edge in subshapes(face, TopAbs_EDGE)}),
                        "closed": closed,
                        "counts": [len(made[0]), len(made[2])],
                    }
                )
                for key, value in zip(arrays, made, strict=True):
                    arrays[key].append(value * unit_mm if key == "vertices" else value)
            body += bool(members)
    if not faces:
        sys.exit("it holds no faces")
    text = json.dumps({"faces": faces, "lost": lost, "chord_mm": largest * unit_mm})
    np.savez(
        out,
        text=np.frombuffer(text.encode(), np.uint8),
        **{key: np.concatenate(value) for key, value in arrays.items()},  # type: ignore[arg-type]
    )


if __name__ == "__main__":
    convert(sys.argv[1], sys.argv[2], *map(float, sys.argv[3:]))
