"""Load a part into a stock Mitsuba scene: the shapes of its XML, with the laboratory's materials.

Signal chain: scene XML, with its parameters and included files -> shapes without their materials -> stock shapes with
stock BSDFs -> scene with a stock ``projector``, and one with a stock ``constant`` emitter for the light of a room.

mitsim's loader is not used, because it adds materials to Mitsuba.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from characterisation.files.errors import InputError
from tests.proofs.laboratory.finishes import Surface, bsdf, parameters

Element = ElementTree.Element


def shape_elements(path: Path, given: Mapping[str, Any]) -> dict[str, Element]:
    """Return the ``<shape>`` elements of a scene XML by id, without materials and with absolute file names.

    Raises
    ------
    InputError
        If a shape has no id.
    """
    root = ElementTree.parse(path).getroot()
    values = {str(one.get("name")): str(one.get("value")) for one in root.iter("default")}
    values |= {name: str(value) for name, value in given.items() if name in values}
    shapes: dict[str, Element] = {}
    for element in root:
        if element.tag == "include":
            shapes |= shape_elements(path.parent / _filled(str(element.get("filename")), values), given)
        if element.tag != "shape":
            continue
        shape = copy.deepcopy(element)
        for child in [child for child in shape if child.tag in ("bsdf", "ref")]:
            shape.remove(child)
        for one in shape.iter():
            for key, text in one.attrib.items():
                one.set(key, _filled(text, values))
            if one.tag == "string" and one.get("name") == "filename":
                one.set("value", str((path.parent / str(one.get("value"))).absolute()))
        if shape.get("id") is None:
            raise InputError(path, "shape", "a shape without an id", "an id for every shape")
        shapes[str(shape.get("id"))] = shape
    return shapes


def _filled(text: str, values: Mapping[str, str]) -> str:
    for name in sorted(values, key=len, reverse=True):
        text = text.replace(f"${name}", values[name])
    return text


def _written(description: Mapping[str, Any], tag: str = "bsdf", name: str = "") -> Element:
    """Return a dictionary of a BSDF as an XML element."""
    out = Element(tag, {"type": str(description["type"])} | ({"name": name} if name else {}))
    for key, value in description.items():
        if key == "type":
            continue
        if isinstance(value, Mapping):
            inner = "spectrum" if value["type"] == "uniform" else "bsdf"
            out.append(_written(value, inner, key))
        else:
            kind = "string" if isinstance(value, str) else "float"
            ElementTree.SubElement(out, kind, {"name": key, "value": str(value)})
    return out


class LaboratoryPart:
    """A part in stock Mitsuba, whose materials change in place from world to world.

    ``projector`` is the Mitsuba description of the light. ``lit`` is the scene with it; ``room`` has a uniform
    environment of irradiance 1 W/mm^2 in its place.
    """

    def __init__(
        self, path: Path, given: Mapping[str, Any], surfaces: Mapping[str, Surface], projector: dict[str, Any]
    ) -> None:
        import mitsuba as mi

        root = Element("scene", {"version": "3.0.0"})
        for name, shape in shape_elements(path, given).items():
            if name not in surfaces:
                raise InputError(path, "shape", repr(name), f"a shape with a finish: {', '.join(surfaces)}")
            shape.append(_written(bsdf(surfaces[name])))
            root.append(shape)
        loaded = mi.load_string(ElementTree.tostring(root, encoding="unicode"), parallel=False, optimize=False)
        shapes = {shape.id(): shape for shape in loaded.shapes()}
        room = {"type": "constant", "radiance": {"type": "uniform", "value": float(1 / np.pi)}}
        self.lit = mi.load_dict({"type": "scene", **shapes, "projector": projector}, parallel=False, optimize=False)
        self.room = mi.load_dict({"type": "scene", **shapes, "room": room}, parallel=False, optimize=False)
        self.light = mi.traverse(self.lit)
        self.names, self._shapes = tuple(shapes), tuple(shapes.values())
        self.finish(surfaces)

    def shapes_met(self, origin: NDArray[np.float64], directions: NDArray[np.float32]) -> NDArray[np.intp]:
        """Return the index in ``names`` of the shape that each ray (n, 3) meets, -1 for none."""
        import drjit as dr
        import mitsuba as mi

        met = self.lit.ray_intersect_preliminary(mi.Ray3f(mi.Point3f(*map(float, origin)), mi.Vector3f(directions.T)))
        number = np.array(dr.reinterpret_array(mi.UInt32, met.shape))
        valid, out = np.array(met.is_valid()), np.full(len(directions), -1, np.intp)
        for index, shape in enumerate(self._shapes):
            own = np.array(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape)))
            out[valid & (number == own)] = index
        return out

    def finish(self, surfaces: Mapping[str, Surface]) -> None:
        """Give every shape the material of a world; the kind of the materials stays as it was."""
        import drjit as dr
        import mitsuba as mi

        for name in self.names:
            for key, value in parameters(surfaces[name]).items():
                self.light[f"{name}.bsdf.{key}"] = dr.opaque(mi.Float, value)
        self.light.update()
