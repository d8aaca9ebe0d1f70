"""A task: the features of a part and what is measured on them, as a TOML file holds it.

A feature's name is the id of a shape in the scene, and its nominal geometry stands in the part frame in mm and deg.
Four kinds have no shape of their own: the circle of a hole and the point of an edge lie in a plane that is a feature,
an intersection follows from two or three others, and a middle plane from two planes; they name these with ``of``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, ValidationInfo, field_validator, model_validator
from pydantic_core import PydanticCustomError

from characterisation.documents import Document, Name
from characterisation.features.figures import Circle, EdgePoint, Point
from characterisation.features.surfaces import Cone, Cylinder, Plane, Sphere, Surface
from characterisation.tasks.decision_table import Decision
from characterisation.tasks.definitions import DEFINITIONS, MeasurementKind
from characterisation.tasks.places import intersection, mid_plane

Vector = tuple[float, float, float]
FeatureKind = Literal["plane", "cylinder", "sphere", "cone", "circle", "edge_point", "intersection", "mid_plane"]
Nominal = Surface | Circle | EdgePoint | Point

#: kinds that are shapes of the scene, and are fitted to their own points
SHAPES = ("plane", "cylinder", "sphere", "cone")

#: keys that a kind of feature must have, and those that it may have
KEYS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "plane": (("point_mm", "direction"), ("outline_mm",)),
    "cylinder": (("point_mm", "direction", "radius_mm"), ("outline_mm",)),
    "sphere": (("point_mm", "radius_mm"), ()),
    "cone": (("point_mm", "direction", "radius_mm", "half_angle_deg"), ("outline_mm",)),
    "circle": (("of", "point_mm", "radius_mm"), ()),
    "edge_point": (("of", "point_mm", "direction", "reach_mm"), ()),
    "intersection": (("of",), ()),
    "mid_plane": (("of",), ("outline_mm",)),
}

#: kinds that follow from others and are fitted to nothing
DERIVED = ("intersection", "mid_plane")


class Feature(Document):
    """Nominal geometry of one feature of the part, in the part frame.

    ``point_mm`` lies on the plane or on the axis, or is the centre, or where the edge is; ``direction`` is the normal,
    the axis (of a cone toward its wide end) or the line in the face that leads over the edge, of any length, and comes
    out as a unit vector. ``radius_mm`` of a cone is that of the section through the point. ``outline_mm`` are places
    that span the feature: three or more corners of a face, the two ends of an axis. Within ``reach_mm`` of its point an
    edge is straight. ``of`` names the features that this one follows from.
    """

    kind: FeatureKind
    of: tuple[str, ...] | None = Field(default=None, validate_default=True)
    point_mm: Vector | None = Field(default=None, validate_default=True)
    direction: Vector | None = Field(default=None, validate_default=True)
    radius_mm: Annotated[float, Field(gt=0)] | None = Field(default=None, validate_default=True)
    half_angle_deg: Annotated[float, Field(gt=0, lt=90)] | None = Field(default=None, validate_default=True)
    outline_mm: tuple[Vector, ...] | None = Field(default=None, validate_default=True)
    reach_mm: Annotated[float, Field(gt=0)] | None = Field(default=None, validate_default=True)

    @field_validator("of", "point_mm", "direction", "radius_mm", "half_angle_deg", "outline_mm", "reach_mm")
    @classmethod
    def _belongs_to_the_kind(cls, value: Any, info: ValidationInfo) -> Any:
        """A key is required for some kinds of feature and meaningless for others."""
        kind = info.data.get("kind")  # absent where the kind itself is faulty, which is then the fault to tell
        if kind is None:
            return value
        required, optional = KEYS[kind]
        if value is None and info.field_name in required:
            raise PydanticCustomError("missing", "this key is required")
        if value is not None and info.field_name not in required + optional:
            article = "an" if kind[0] in "aeiou" else "a"
            raise ValueError(f"no such key: {article} {kind.replace('_', ' ')} has none")
        return value

    @field_validator("direction")
    @classmethod
    def _unit_direction(cls, direction: Vector | None) -> Vector | None:
        if direction is None:
            return None
        length = float(np.linalg.norm(direction))
        if not 1e-9 < length < np.inf:
            raise ValueError("three numbers that are not all 0: they say which way the normal or axis points")
        x, y, z = direction
        return x / length, y / length, z / length

    @property
    def shaped(self) -> bool:
        """Whether it is a shape of the scene, fitted to its own points."""
        return self.kind in SHAPES

    def nominal(self, sensor_from_part: ArrayLike | None = None) -> Surface:
        """Surface in the part frame, or moved to the sensor frame by a (4, 4) matrix; of other kinds ask the task.

        Raises
        ------
        ValueError
            If it is no surface.
        """
        point, direction = np.array(self.point_mm or (0.0, 0.0, 0.0)), np.array(self.direction or (0.0, 0.0, 1.0))
        radius = float(self.radius_mm or 0.0)
        surface: Surface
        match self.kind:
            case "plane":
                surface = Plane(point, direction)
            case "cylinder":
                surface = Cylinder(point, direction, radius)
            case "sphere":
                surface = Sphere(point, radius)
            case "cone":
                surface = Cone(point, direction, radius, float(np.deg2rad(self.half_angle_deg or 0.0)))
            case _:
                raise ValueError(
                    f"the nominal geometry of the kind {self.kind!r} hangs on other features: ask the task"
                )
        return surface if sensor_from_part is None else surface.placed(sensor_from_part)


class Measurement(Document):
    """What is measured between features, and what it should be; angles in degrees, lengths in mm.

    ``tolerance``: of a size, distance or angle one number, the same to both sides of the nominal value, or the lower
    and the upper deviation from it, as ISO 14405-1 writes them; of a zone (position, orientation, form, pose), whose
    nominal value is 0, the width or diameter of the zone, as ISO 1101 writes it. ``decision`` is the rule for this
    one, in place of the task's. ``point_mm``, part frame, is the point whose place ``pose_position`` tells; left
    out, the mean of the features' own points.
    """

    kind: MeasurementKind
    features: tuple[str, ...]
    nominal: float = Field(ge=0)
    unit: Literal["mm", "deg"]
    tolerance: float | tuple[float, float] | None = None
    decision: Decision | None = None
    point_mm: Vector | None = None

    @field_validator("tolerance", mode="before")
    @classmethod
    def _one_width_or_two_deviations(cls, value: Any, info: ValidationInfo) -> Any:
        """A number over 0, or the lower and the upper deviation of what is no zone."""
        kind = info.data.get("kind")
        zone = kind is not None and DEFINITIONS[kind].zone
        wanted = "a number greater than 0" + ("" if zone else ", or [lower, upper] deviation in rising order")
        if value is None or (_is_number(value) and value > 0):
            return value if value is None else float(value)
        pair = isinstance(value, list | tuple) and len(value) == 2 and all(_is_number(end) for end in value)
        if not pair or zone or not value[0] < value[1]:
            raise ValueError(f"{wanted}{': it is the width of a zone' if zone else ''}")
        return float(value[0]), float(value[1])

    @property
    def zone(self) -> bool:
        """Whether its value is the width or diameter of a zone, and so never negative."""
        return DEFINITIONS[self.kind].zone

    @property
    def deviations(self) -> tuple[float, float] | None:
        """Lower and upper deviation from the nominal value; None without a tolerance."""
        if self.tolerance is None or isinstance(self.tolerance, tuple):
            return self.tolerance
        return 0.0 if self.zone else -self.tolerance, self.tolerance

    @property
    def tolerance_size(self) -> float | None:
        """Half the interval that conforms, or the width of the zone; None without a tolerance."""
        if isinstance(self.tolerance, tuple):
            return (self.tolerance[1] - self.tolerance[0]) / 2
        return self.tolerance

    @property
    def one_sided(self) -> bool:
        """Whether the tolerance has no lower end: nothing that is measured is negative, so 0 or less is no limit."""
        return self.zone or (self.deviations is not None and self.nominal + self.deviations[0] <= 0)

    @property
    def limits(self) -> tuple[float, float]:
        """Smallest and largest value that conform, in the unit of the file; infinite without a tolerance."""
        if self.deviations is None:
            return -np.inf, np.inf
        return self.nominal + self.deviations[0], self.nominal + self.deviations[1]


class Task(Document):
    """Features by name and measurements by name, both in the file's order; the rule that tolerances are judged by."""

    features: dict[Name, Feature] = Field(min_length=1)
    measurements: dict[Name, Measurement] = Field(min_length=1)
    decision: Decision = Decision()

    @model_validator(mode="after")
    def _process_is_known(self) -> Task:
        """JCGM 106 needs the distribution of the parts; one that is not given would be invented."""
        for name, asked in self.measurements.items():
            rule = self.decision_of(name)
            if asked.tolerance is None or rule.rule != "jcgm_106":
                continue
            lacking = []
            if asked.one_sided and rule.process_mean is None:
                lacking.append("process_mean")
            if rule.process_std is None and (asked.one_sided or rule.process_capability is None):
                lacking.append("process_std" if asked.one_sided else "process_std or process_capability")
            if lacking:
                raise ValueError(
                    f"measurements.{name}: the rule jcgm_106 needs {' and '.join(lacking)}, in {asked.unit}, in "
                    f"[measurements.{name}.decision]: how the values of the parts are distributed"
                )
        return self

    def decision_of(self, measurement: str) -> Decision:
        """The rule of one measurement: its own, or that of the task."""
        return self.measurements[measurement].decision or self.decision

    @property
    def shapes(self) -> tuple[str, ...]:
        """Names of the features that are shapes of the scene."""
        return shapes(self.features)

    def fitted_for(self, measurement: str) -> tuple[str, ...]:
        """Names of the features that a measurement rests on: those that are fitted, each once.

        An intersection or a middle plane is not fitted, its parents are; a circle or a point of an edge is fitted, and
        so is its plane.
        """
        named = self.measurements[measurement].features
        return tuple(dict.fromkeys(one for name in named for one in self._fitted_for(name)))

    def shapes_for(self, measurement: str) -> tuple[str, ...]:
        """Names of the shapes of the scene that a measurement rests on, each once."""
        return tuple(name for name in self.fitted_for(measurement) if self.features[name].shaped)

    def _fitted_for(self, name: str) -> tuple[str, ...]:
        feature = self.features[name]
        return (feature.of or ()) + (() if feature.kind in DERIVED else (name,))

    def nominal(self, name: str, sensor_from_part: ArrayLike | None = None) -> Nominal:
        """Nominal geometry of any feature, in the part frame, or moved to the sensor frame by a (4, 4) matrix.

        A figure's view ray is not known yet: it slides along the normal
        (:meth:`~characterisation.features.figures.Circle.seen_from`).
        """
        feature = self.features[name]
        if feature.shaped:
            return feature.nominal(sensor_from_part)
        parents = [self.features[parent].nominal(sensor_from_part) for parent in feature.of or ()]
        if feature.kind == "intersection":
            return intersection([one for one in parents if not isinstance(one, Sphere)])
        if feature.kind == "mid_plane":
            return mid_plane(*[one for one in parents if isinstance(one, Plane)])
        (plane,) = parents
        assert isinstance(plane, Plane) and feature.point_mm is not None
        motion = np.eye(4) if sensor_from_part is None else np.asarray(sensor_from_part, float)
        point = motion[:3, :3] @ np.array(feature.point_mm) + motion[:3, 3]
        if feature.kind == "circle":
            return Circle(point, plane.normal, float(feature.radius_mm or 0.0), plane.normal)
        direction = motion[:3, :3] @ np.array(feature.direction)
        return EdgePoint(point, direction, plane.normal, 0.0, plane.normal)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def shapes(features: Mapping[str, Feature]) -> tuple[str, ...]:
    """Names of those features that are shapes of the scene."""
    return tuple(name for name, feature in features.items() if feature.shaped)
