"""Build the elements of a QIF document for features and characteristics (ISO 23952:2020, QIF 3.0)."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any
from xml.etree.ElementTree import Element

from characterisation.features.figures import Circle, EdgePoint, Point
from characterisation.features.surfaces import Cone, Cylinder, Plane, Sphere
from characterisation.tasks.definitions import DEFINITIONS, MeasurementKind
from characterisation.tasks.task_file import Measurement, Nominal, Task
from mitsim.report.export.xml_text import xml_text
from mitsim.sensor.transforms import Transform

#: QIF's characteristics by kind of measurement; sizes of a sphere have other names
CHARACTERISTICS: dict[MeasurementKind, str] = {
    "intersection_distance": "DistanceBetween",
    "axis_distance": "DistanceBetween",
    "point_distance": "DistanceBetween",
    "point_plane_distance": "DistanceBetween",
    "plane_distance": "DistanceBetween",
    "plane_axis_angle": "AngleBetween",
    "axis_angle": "AngleBetween",
    "plane_angle": "AngleBetween",
    "cone_angle": "Angle",
    "radius": "Radius",
    "diameter": "Diameter",
    "position": "Position",
    "parallelism": "Parallelism",
    "perpendicularity": "Perpendicularity",
    "flatness": "Flatness",
    "angularity": "Angularity",
    "coaxiality": "Coaxiality",
    "symmetry": "Symmetry",
    "cylindricity": "Cylindricity",
    "pose_position": "UserDefinedLinear",
    "pose_rotation": "UserDefinedAngular",
}

#: zones that QIF cannot represent without a tolerance
GEOMETRIC = tuple(
    name for kind, name in CHARACTERISTICS.items() if DEFINITIONS[kind].zone and not name.startswith("UserDefined")
)

#: QIF's kinds of feature by mitsim's
FEATURES = {
    "plane": "Plane",
    "cylinder": "Cylinder",
    "sphere": "Sphere",
    "cone": "Cone",
    "circle": "Circle",
    "edge_point": "EdgePoint",
    "intersection": "Point",
    "mid_plane": "Plane",
}


#: zones of a position by the kind of feature, where they are not diametrical
_POSITION_ZONES = {
    "sphere": "SphericalZone",
    "intersection": "SphericalZone",
    "edge_point": "NonDiametricalZone",
    "plane": "NonDiametricalZone",
    "mid_plane": "NonDiametricalZone",
}


class Ids:
    """Numbers of a document's elements, by key or new."""

    def __init__(self) -> None:
        self.last = 0
        self.by_key: dict[tuple[str, str], int] = {}

    def new(self, kind: str, name: str = "") -> str:
        """Number the element of a kind and a name."""
        self.last += 1
        self.by_key[kind, name] = self.last
        return str(self.last)

    def of(self, kind: str, name: str = "") -> str:
        """Return the number of that element."""
        return str(self.by_key[kind, name])


#: content of an element: text, or a number; children by their tags; a list of elements, which QIF counts in ``n``
Content = str | float | Mapping[str, Any] | list[Element]


def element(tag: str, content: Content = "", /, **attributes: str) -> Element:
    """Build an element with its children in the order of its content; children of content None are left out.

    A bool has XML's form, a float all its digits.
    """
    out = Element(tag, {name: xml_text(value) for name, value in attributes.items()})
    match content:
        case Mapping():
            out.extend(element(name, child) for name, child in content.items() if child is not None)
        case list():
            out.set("n", str(len(content)))
            out.extend(content)
        case bool():
            out.text = "true" if content else "false"
        case float():
            out.text = decimal(content)
        case _ if content != "":
            out.text = xml_text(str(content))
    return out


def decimal(value: float) -> str:
    """Format a number as XML's decimal, without exponent."""
    written = f"{value:.12f}".rstrip("0").rstrip(".")
    return "0" if written in ("", "-0") else written


def vector(values: Iterable[float]) -> str:
    """Format numbers."""
    return " ".join(decimal(float(value)) for value in values)


def references(numbers: Iterable[str]) -> list[Element]:
    """Build a list of ids."""
    return [element("Id", number) for number in numbers]


def attributes(values: Mapping[str, str | float | int]) -> list[Element]:
    """Build mitsim's own attributes, each with the prefix ``mitsim.``."""
    kinds: dict[type, str] = {str: "AttributeStr", int: "AttributeI1", float: "AttributeD1"}
    return [element(kinds[type(value)], name=f"mitsim.{name}", value=str(value)) for name, value in values.items()]


def transform(number: str, name: str, pose: Transform) -> Element:
    """Build a transform: the directions of its axes, and its origin [mm]."""
    axes = {f"{axis}Direction": vector(pose.rotation[:, k]) for k, axis in enumerate("XYZ")}
    return element("Transform", {"Rotation": axes, "Origin": vector(pose.translation), "Name": name}, id=number)


def feature_size(nominal: Nominal) -> dict[str, Any]:
    """Return the content of a definition, which features of one size share."""
    size: dict[str, Any] = {}
    if isinstance(nominal, Cylinder | Sphere | Cone | Circle | EdgePoint):
        size["InternalExternal"] = "NOT_APPLICABLE"
    if isinstance(nominal, Cylinder | Sphere | Cone | Circle):
        size["Diameter"] = 2.0 * float(nominal.radius)
    if isinstance(nominal, Cone):
        size["HalfAngle"] = math.degrees(nominal.half_angle)
    return size


def feature_geometry(nominal: Nominal) -> dict[str, Any]:
    """Return the content for the nominal geometry of a feature [mm], part frame."""
    match nominal:
        case Cylinder() | Cone():
            return {"Axis": {"AxisPoint": vector(nominal.point), "Direction": vector(nominal.axis)}}
        case Plane():
            return {"Location": vector(nominal.point), "Normal": vector(nominal.normal)}
        case Sphere():
            return {"Location": vector(nominal.centre)}
        case Circle():
            return {"Location": vector(nominal.centre), "Normal": vector(nominal.normal)}
        case EdgePoint():
            directions = {"Normal": vector(nominal.direction), "AdjacentNormal": vector(nominal.normal)}
            return {"Location": vector(nominal.point)} | directions
        case Point():
            return {"Location": vector(nominal.place)}


def characteristic(task: Task, asked: Measurement) -> str:
    """Return the name of QIF's characteristic for a measurement."""
    name = CHARACTERISTICS[asked.kind]
    if name in GEOMETRIC and asked.tolerance is None:
        return "UserDefinedLinear"
    of_sphere = name in ("Radius", "Diameter") and task.features[asked.features[0]].kind == "sphere"
    return f"Spherical{name}" if of_sphere else name


def tolerance(name: str, asked: Measurement) -> dict[str, Any]:
    """Return the content for the tolerance of a dimension, or that it is only measured."""
    dimension = {"WhatToMeasure": asked.kind} if name.startswith("UserDefined") else {}
    if asked.deviations is None:
        return {"NonTolerance": "MEASURED"} | dimension
    (lower, upper), is_zone = asked.deviations, DEFINITIONS[asked.kind].zone
    limits = {"MaxValue": upper, "MinValue": None if is_zone else lower, "DefinedAsLimit": is_zone}
    return {"Tolerance": limits} | dimension


def zone(name: str, task: Task, asked: Measurement, frame: str | None) -> dict[str, Any]:
    """Return the content for the tolerance zone of a geometric characteristic.

    Parameters
    ----------
    name, task, asked, frame
        One of :data:`GEOMETRIC`; a measurement of the task; id of the datum reference frame, None without datums.
    """
    shape = _zone_shape(name, *(task.features[feature].kind for feature in asked.features))
    return {
        "ToleranceValue": asked.tolerance_size or 0.0,
        "DatumReferenceFrameId": frame,
        "MaterialCondition": None if shape is None or name == "Coaxiality" else "NONE",
        "ZoneShape": None if shape is None else {shape: {}},
    }


def _zone_shape(name: str, first: str, *datums: str) -> str | None:
    """Return the shape of a zone for a feature of the kind ``first``; None where QIF has only one."""
    match name:
        case "Flatness" | "Cylindricity" | "Symmetry":
            return None
        case "Coaxiality":
            return "DiametricalZone"
        case "Position":
            return _POSITION_ZONES.get(first, "DiametricalZone")
    # round for an axis parallel to a datum axis, or perpendicular to a datum plane
    round_with = ("cylinder", "cone") if name == "Parallelism" else ("plane",)
    return "DiametricalZone" if first in ("cylinder", "cone") and datums[0] in round_with else "PlanarZone"
