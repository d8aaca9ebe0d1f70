"""Build the elements of a QIF document for features and characteristics (ISO 23952:2020, QIF 3.0)."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from xml.etree.ElementTree import Element, SubElement

from characterisation.features.figures import Circle, EdgePoint, Point
from characterisation.features.surfaces import Cone, Cylinder, Plane, Sphere
from characterisation.tasks.definitions import DEFINITIONS
from characterisation.tasks.task_file import Measurement, Nominal, Task
from mitsim.sensor.transforms import Transform

#: QIF's characteristics by kind of measurement; sizes of a sphere have other names
CHARACTERISTICS = {
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
GEOMETRIC = (
    "Position",
    "Parallelism",
    "Perpendicularity",
    "Angularity",
    "Coaxiality",
    "Symmetry",
    "Flatness",
    "Cylindricity",
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


class Ids:
    """Numbers of a document's elements, by key or new."""

    def __init__(self) -> None:
        self.last = 0
        self.by_key: dict[tuple[str, str], int] = {}

    def new(self, kind: str, name: str) -> str:
        """Number the element of a kind and a name."""
        self.last += 1
        self.by_key[kind, name] = self.last
        return str(self.last)

    def of(self, kind: str, name: str) -> str:
        """Return the number of that element."""
        return str(self.by_key[kind, name])


def text(parent: Element, tag: str, content: object, attributes: Mapping[str, str] | None = None) -> Element:
    """Append an element of text; a bool in XML's form, a float with all its digits."""
    out = SubElement(parent, tag, dict(attributes or {}))
    if isinstance(content, bool):
        out.text = "true" if content else "false"
    elif isinstance(content, float):
        out.text = decimal(content)
    else:
        out.text = str(content)
    return out


def decimal(value: float) -> str:
    """Format a number as XML's decimal, without exponent."""
    written = f"{value:.12f}".rstrip("0").rstrip(".")
    return "0" if written in ("", "-0") else written


def vector(parent: Element, tag: str, values: Iterable[float]) -> Element:
    """Append three numbers."""
    return text(parent, tag, " ".join(decimal(float(value)) for value in values))


def references(parent: Element, tag: str, numbers: Iterable[str]) -> None:
    """Append a list of ids."""
    found = list(numbers)
    out = SubElement(parent, tag, n=str(len(found)))
    for number in found:
        text(out, "Id", number)


def attributes(parent: Element, values: Mapping[str, str | float | int]) -> None:
    """Append mitsim's own attributes, each with the prefix ``mitsim.``."""
    out = SubElement(parent, "Attributes", n=str(len(values)))
    for name, value in values.items():
        kind = {str: "AttributeStr", int: "AttributeI1", float: "AttributeD1"}[type(value)]
        SubElement(out, kind, name=f"mitsim.{name}", value=str(value))


def transform(parent: Element, number: str, name: str, pose: Transform) -> None:
    """Append a transform: the directions of its axes, and its origin [mm]."""
    out = SubElement(parent, "Transform", id=number)
    turn = SubElement(out, "Rotation")
    for k, axis in enumerate("XYZ"):
        vector(turn, f"{axis}Direction", pose.rotation[:, k])
    vector(out, "Origin", pose.translation)
    text(out, "Name", name)


def feature_definition(parent: Element, number: str, kind: str, nominal: Nominal) -> None:
    """Append the definition that features of one size share."""
    out = SubElement(parent, f"{FEATURES[kind]}FeatureDefinition", id=number)
    if isinstance(nominal, Cylinder | Sphere | Cone | Circle):
        text(out, "InternalExternal", "NOT_APPLICABLE")
        text(out, "Diameter", 2.0 * float(nominal.radius))
        if isinstance(nominal, Cone):
            text(out, "HalfAngle", math.degrees(nominal.half_angle))
    elif isinstance(nominal, EdgePoint):
        text(out, "InternalExternal", "NOT_APPLICABLE")


def feature_nominal(parent: Element, number: str, name: str, kind: str, nominal: Nominal, definition: str) -> None:
    """Append the nominal geometry of a feature, part frame."""
    out = SubElement(parent, f"{FEATURES[kind]}FeatureNominal", id=number)
    text(out, "Name", name)
    text(out, "FeatureDefinitionId", definition)
    match nominal:
        case Cylinder() | Cone():
            axis = SubElement(out, "Axis")
            vector(axis, "AxisPoint", nominal.point)
            vector(axis, "Direction", nominal.axis)
        case Plane():
            vector(out, "Location", nominal.point)
            vector(out, "Normal", nominal.normal)
        case Sphere():
            vector(out, "Location", nominal.centre)
        case Circle():
            vector(out, "Location", nominal.centre)
            vector(out, "Normal", nominal.normal)
        case EdgePoint():
            vector(out, "Location", nominal.point)
            vector(out, "Normal", nominal.direction)
            vector(out, "AdjacentNormal", nominal.normal)
        case Point():
            vector(out, "Location", nominal.place)


def characteristic(task: Task, asked: Measurement) -> str:
    """Return the name of QIF's characteristic for a measurement."""
    name = CHARACTERISTICS[asked.kind]
    if name in GEOMETRIC and asked.tolerance is None:
        return "UserDefinedLinear"
    of_sphere = name in ("Radius", "Diameter") and task.features[asked.features[0]].kind == "sphere"
    return f"Spherical{name}" if of_sphere else name


def tolerance(out: Element, name: str, asked: Measurement, what: str) -> None:
    """Append the tolerance of a dimension, or that it is only measured; ``what`` describes a user-defined one."""
    if asked.deviations is None:
        text(out, "NonTolerance", "MEASURED")
    else:
        lower, upper = asked.deviations
        limits = SubElement(out, "Tolerance")
        text(limits, "MaxValue", upper)
        if not DEFINITIONS[asked.kind].zone:
            text(limits, "MinValue", lower)
        text(limits, "DefinedAsLimit", DEFINITIONS[asked.kind].zone)
    if name.startswith("UserDefined"):
        text(out, "WhatToMeasure", what)


def zone(out: Element, name: str, task: Task, asked: Measurement, frame: str | None) -> None:
    """Append the tolerance zone of a geometric characteristic; ``frame`` is the id of its datum reference frame."""
    text(out, "ToleranceValue", asked.tolerance_size or 0.0)
    if name in ("Flatness", "Cylindricity"):
        return
    if frame is not None:
        text(out, "DatumReferenceFrameId", frame)
    if name == "Symmetry":
        return
    if name != "Coaxiality":
        text(out, "MaterialCondition", "NONE")
    shape = SubElement(out, "ZoneShape")
    first, *datums = (task.features[one].kind for one in asked.features)
    if name == "Position":
        zones = {
            "sphere": "SphericalZone",
            "intersection": "SphericalZone",
            "edge_point": "NonDiametricalZone",
            "plane": "NonDiametricalZone",
            "mid_plane": "NonDiametricalZone",
        }
        SubElement(shape, zones.get(first, "DiametricalZone"))
    elif name == "Coaxiality":
        SubElement(shape, "DiametricalZone")
    else:  # an axis parallel to a datum axis, or perpendicular to a datum plane
        round_with = ("cylinder", "cone") if name == "Parallelism" else ("plane",)
        round_zone = first in ("cylinder", "cone") and datums[0] in round_with
        SubElement(shape, "DiametricalZone" if round_zone else "PlanarZone")
