"""Define a task, as stored in a TOML file: the features of a part and the measurements on them.

The name of a feature is the id of a shape in the scene. Its nominal geometry is given in the part frame in mm and deg.
Four kinds have no shape of their own, and name other features with ``of``. The circle of a hole and the point of an
edge lie in a plane that is a feature. An intersection is derived from two or three features, and a middle plane from
two planes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, ValidationInfo, field_validator, model_validator
from pydantic_core import PydanticCustomError

from characterisation.features.figures import Circle, EdgePoint, Point
from characterisation.features.surfaces import Cone, Cylinder, Plane, Sphere, Surface
from characterisation.files.documents import Document, Name
from characterisation.tasks.decision_table import Decision
from characterisation.tasks.definitions import DEFINITIONS, MeasurementKind
from characterisation.tasks.places import intersection, mid_plane

Vector = tuple[float, float, float]

#: angles that fold at 90 deg
LINE_ANGLES = ("plane_axis_angle", "axis_angle", "plane_angle")

#: nominal values and limits this near to 0 or 90 deg lie there [mm or deg]; chosen: coordinates are rounded to 1e-4 mm,
#: which turns a face of 10 mm by up to 1e-3 deg
AT_FOLD = 1e-3

FeatureKind = Literal["plane", "cylinder", "sphere", "cone", "circle", "edge_point", "intersection", "mid_plane"]
Nominal = Surface | Circle | EdgePoint | Point

#: kinds that are shapes of the scene, fitted to their own points
SHAPES = ("plane", "cylinder", "sphere", "cone")

#: required and optional keys of each kind of feature
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

#: kinds that are derived from others, not fitted
DERIVED = ("intersection", "mid_plane")


class Feature(Document):
    """Nominal geometry of one feature of the part, in the part frame.

    - ``point_mm`` lies on the plane, on the axis or on the edge, or is the centre.
    - ``direction``, of any length, is normalised. It is the normal, the axis (of a cone toward its wide end), or the
      line in the face that crosses the edge.
    - ``radius_mm`` of a cone is that of the section through the point.
    - ``outline_mm`` are places that span the feature: three or more corners of a face, or the two ends of an axis.
    - ``reach_mm`` is the distance from its point within which an edge is straight.
    - ``of`` names the features from which this one is derived.
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
        """Check that a key belongs to the kind of feature, and that a required key is present."""
        kind = info.data.get("kind")  # absent where the kind is invalid, which is then the error to report
        if kind is None:
            return value
        required, optional = KEYS[kind]
        if value is None and info.field_name in required:
            raise PydanticCustomError("missing", "this key is required")
        if value is not None and info.field_name not in required + optional:
            article = "an" if kind[0] in "aeiou" else "a"
            raise ValueError(f"no such key for {article} {kind.replace('_', ' ')}")
        return value

    @field_validator("direction")
    @classmethod
    def _unit_direction(cls, direction: Vector | None) -> Vector | None:
        if direction is None:
            return None
        length = float(np.linalg.norm(direction))
        if not 1e-9 < length < np.inf:
            raise ValueError("three numbers that are not all 0: the direction of the normal or axis")
        x, y, z = direction
        return x / length, y / length, z / length

    @property
    def shaped(self) -> bool:
        """Return whether the feature is a shape of the scene, fitted to its own points."""
        return self.kind in SHAPES

    def nominal(self, sensor_from_part: ArrayLike | None = None) -> Surface:
        """Return the surface in the part frame, or moved to the sensor frame by a (4, 4) matrix.

        :meth:`Task.nominal` returns the geometry of other kinds. Raises ValueError if the feature is not a surface.
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
                    f"the nominal geometry of the kind {self.kind!r} depends on other features: use Task.nominal"
                )
        return surface if sensor_from_part is None else surface.placed(sensor_from_part)


class Measurement(Document):
    """A measurement on features, and its nominal value; angles in degrees, lengths in mm.

    ``tolerance`` of a size, distance or angle is one number for both sides of the nominal value, or the lower and the
    upper deviation (ISO 14405-1). The nominal value of a zone (position, orientation, form, pose) is 0, and its
    tolerance is the width or diameter of the zone, as in ISO 1101. ``decision`` is the rule for this measurement, in
    place of the task's. ``point_mm``, part frame, is the point whose position ``pose_position`` evaluates; by default,
    the mean of the features' own points.
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
        """Check for a number above 0, or the lower and the upper deviation if the kind is not a zone."""
        kind = info.data.get("kind")
        zone = kind is not None and DEFINITIONS[kind].zone
        wanted = "a number greater than 0" + ("" if zone else ", or [lower, upper] deviation in increasing order")
        if isinstance(value, str):
            wanted += " (±0.1 is 0.1)" if "±" in value else "" if zone else "; a class such as H7 is its two deviations"
        if value is None or (_is_number(value) and value > 0):
            return value if value is None else float(value)
        pair = isinstance(value, list | tuple) and len(value) == 2 and all(_is_number(end) for end in value)
        if not pair or zone or not value[0] < value[1]:
            raise ValueError(f"{wanted}{': it is the width of a zone' if zone else ''}")
        lower, upper = float(value[0]), float(value[1])
        nominal = info.data.get("nominal") or 0.0
        if lower > nominal / 2 > 0 and upper - lower < lower:
            shown = ", ".join(f"{end - nominal:.6g}" for end in (lower, upper))
            raise ValueError(f"deviations from nominal: as the limits of the value, they are [{shown}]")
        return lower, upper

    @model_validator(mode="after")
    def _limits_that_a_value_can_keep(self) -> Measurement:
        """Check that some value conforms: lengths and angles are not negative, and angles have a largest value."""
        lowest, highest = self.limits
        most = math.inf if self.unit == "mm" else 90.0 if self.kind in LINE_ANGLES else 180.0
        if highest <= 0 or lowest >= most:
            range_of_values = "at least 0" + ("" if math.isinf(most) else f" and at most {most:g} deg")
            raise ValueError(
                f"no value of a {self.kind} keeps its limits, {lowest:.6g} and {highest:.6g} {self.unit}: a value is "
                f"{range_of_values}; correct nominal or tolerance, which is the deviation from it"
            )
        return self

    @property
    def zone(self) -> bool:
        """Return whether the value is the width or diameter of a zone, and so never negative."""
        return DEFINITIONS[self.kind].zone

    @property
    def deviations(self) -> tuple[float, float] | None:
        """Return the lower and upper deviation from the nominal value; None without a tolerance."""
        if self.tolerance is None or isinstance(self.tolerance, tuple):
            return self.tolerance
        return 0.0 if self.zone else -self.tolerance, self.tolerance

    @property
    def tolerance_size(self) -> float | None:
        """Return the size of the tolerance (:func:`tolerance_size`); None without one."""
        return tolerance_size(self.kind, self.nominal, self.tolerance)

    @property
    def folds_at_90(self) -> bool:
        """Return whether the upper limit has no effect, since the angle of the lines is at most 90 deg."""
        return self.kind in LINE_ANGLES and self.tolerance is not None and self.limits[1] >= 90 - AT_FOLD

    @property
    def one_sided(self) -> bool:
        """Return whether the tolerance has no lower limit (:func:`effective_deviations`)."""
        found = effective_deviations(self.nominal, self.tolerance)
        return self.zone or (found is not None and found[0] is None)

    @property
    def limits(self) -> tuple[float, float]:
        """Return the smallest and largest value that conform, in the unit of the file; infinite without a tolerance."""
        if self.deviations is None:
            return -np.inf, np.inf
        return self.nominal + self.deviations[0], self.nominal + self.deviations[1]


def _ends(tolerance: float | tuple[float, float]) -> tuple[float, float]:
    """Return the lower and the upper deviation of a tolerance."""
    return tolerance if isinstance(tolerance, tuple) else (-tolerance, tolerance)


def effective_deviations(
    nominal: float, tolerance: float | tuple[float, float] | None
) -> tuple[float | None, float] | None:
    """Return the lower and upper deviation of a tolerance; the lower is None where it has no effect.

    Measured values are never negative, so a lower limit of 0 or less has no effect; None without a tolerance.
    """
    if tolerance is None:
        return None
    lower, upper = _ends(tolerance)
    return (lower if nominal + lower > AT_FOLD else None), upper


def tolerance_size(kind: str, nominal: float, tolerance: float | tuple[float, float] | None) -> float | None:
    """Return half the interval that conforms, or the width of the zone; None without a tolerance.

    Where a limit has no effect, since values fold at 0 or 90 deg, it is the distance of the other from there.
    """
    if tolerance is None:
        return None
    lower, upper = _ends(tolerance)
    lowest, highest = nominal + lower, nominal + upper
    if lowest <= AT_FOLD < highest:
        return highest
    folds = kind in LINE_ANGLES and lowest < 90 - AT_FOLD <= highest
    return 90.0 - lowest if folds else (upper - lower) / 2


class Task(Document):
    """Features and measurements by name, both in the order of the file, and the rule for tolerances."""

    features: dict[Name, Feature] = Field(min_length=1)
    measurements: dict[Name, Measurement] = Field(min_length=1)
    decision: Decision = Decision()

    @model_validator(mode="after")
    def _process_is_known(self) -> Task:
        """Check that JCGM 106 has the distribution of the parts, for which there is no default."""
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
                    f"[measurements.{name}.decision]: the distribution of the values of the parts"
                )
        return self

    def decision_of(self, measurement: str) -> Decision:
        """Return the rule of one measurement: its own, or that of the task."""
        return self.measurements[measurement].decision or self.decision

    @property
    def shapes(self) -> tuple[str, ...]:
        """Return the names of the features that are shapes of the scene."""
        return shapes(self.features)

    def fitted_for(self, measurement: str) -> tuple[str, ...]:
        """Return the names of the fitted features of a measurement, each once.

        For an intersection or a middle plane these are its parents. For a circle or a point of an edge, they are the
        figure itself and its plane.
        """
        named = self.measurements[measurement].features
        return tuple(dict.fromkeys(fitted_name for name in named for fitted_name in self._fitted_for(name)))

    def shapes_for(self, measurement: str) -> tuple[str, ...]:
        """Return the names of the shapes of the scene that a measurement depends on, each once."""
        return tuple(name for name in self.fitted_for(measurement) if self.features[name].shaped)

    def with_measured_features(self) -> Task:
        """Return the task without the features on which no measurement depends; a drawing may state many."""
        named = {name for measurement in self.measurements.values() for name in measurement.features}
        fitted = {name for measurement in self.measurements for name in self.fitted_for(measurement)}
        kept = {name: feature for name, feature in self.features.items() if name in named | fitted}
        return self.model_copy(update={"features": kept})

    def _fitted_for(self, name: str) -> tuple[str, ...]:
        feature = self.features[name]
        return (feature.of or ()) + (() if feature.kind in DERIVED else (name,))

    def nominal(self, name: str, sensor_from_part: ArrayLike | None = None) -> Nominal:
        """Return the nominal geometry of a feature in the part frame, or moved to the sensor frame by a (4, 4) matrix.

        A figure slides along the normal, because its view ray is not known yet
        (:meth:`~characterisation.features.figures.Circle.seen_from`).
        """
        feature = self.features[name]
        if feature.shaped:
            return feature.nominal(sensor_from_part)
        parents = [self.features[parent].nominal(sensor_from_part) for parent in feature.of or ()]
        if feature.kind == "intersection":
            return intersection([surface for surface in parents if not isinstance(surface, Sphere)])
        if feature.kind == "mid_plane":
            return mid_plane(*[surface for surface in parents if isinstance(surface, Plane)])
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
    """Return the names of the features that are shapes of the scene."""
    return tuple(name for name, feature in features.items() if feature.shaped)
