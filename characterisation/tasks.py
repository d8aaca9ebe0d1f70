"""A measurement task: the features of a part, what is measured on them, and the measuring.

Signal chain: labelled cloud -> points per feature -> fit from the nominal geometry (once per feature) -> measurement
-> error against the nominal value, and the standard uncertainty that the fits' covariances give it.

A task is a TOML file. A feature's name is the id of a shape in the scene, its nominal geometry stands in the part
frame in mm. Measurements of near-parallel axes are defined so that they stay well-conditioned: see
:func:`axis_distance`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, ValidationInfo, field_validator
from pydantic_core import PydanticCustomError

from characterisation.documents import Document, read_toml
from characterisation.errors import InputError, nearest
from characterisation.features import (
    Cylinder,
    Fit,
    FitError,
    Plane,
    Sphere,
    fit_cylinder,
    fit_plane,
    fit_sphere,
)
from characterisation.point_cloud import PointCloud

Vector = tuple[float, float, float]
Surface = Plane | Cylinder | Sphere


class Feature(Document):
    """Nominal geometry of one surface of the part, in the part frame.

    ``point_mm`` lies on the plane, on the cylinder's axis, or is the sphere's centre; ``direction`` is the plane's
    normal or the cylinder's axis, of any length, and comes out as a unit vector.
    """

    kind: Literal["plane", "cylinder", "sphere"]
    point_mm: Vector
    direction: Vector | None = Field(default=None, validate_default=True)
    radius_mm: Annotated[float, Field(gt=0)] | None = Field(default=None, validate_default=True)

    @field_validator("direction")
    @classmethod
    def _unit_direction(cls, direction: Vector | None, info: ValidationInfo) -> Vector | None:
        _check_presence(direction, info, ("plane", "cylinder"))
        if direction is None:
            return None
        length = float(np.linalg.norm(direction))
        if not length > 1e-9:
            raise ValueError("three numbers that are not all 0: they say which way the normal or axis points")
        x, y, z = direction
        return x / length, y / length, z / length

    @field_validator("radius_mm")
    @classmethod
    def _radius_of_round_features(cls, radius: float | None, info: ValidationInfo) -> float | None:
        _check_presence(radius, info, ("cylinder", "sphere"))
        return radius

    def nominal(self, sensor_from_part: ArrayLike | None = None) -> Surface:
        """Surface in the part frame, or moved to the sensor frame by a (4, 4) matrix."""
        motion = np.eye(4) if sensor_from_part is None else np.asarray(sensor_from_part, float)
        point = motion[:3, :3] @ self.point_mm + motion[:3, 3]
        direction = motion[:3, :3] @ (self.direction or (0.0, 0.0, 1.0))
        if self.kind == "plane":
            return Plane(point, direction)
        if self.kind == "cylinder":
            return Cylinder(point, direction, float(self.radius_mm or 0.0))
        return Sphere(point, float(self.radius_mm or 0.0))


def _check_presence(value: Any, info: ValidationInfo, kinds: tuple[str, ...]) -> None:
    """A key is required for some kinds of feature and meaningless for the others."""
    kind = info.data.get("kind")  # absent where the kind itself is faulty, which is then the fault to tell
    if value is None and kind in kinds:
        raise PydanticCustomError("missing", "this key is required")
    if value is not None and kind is not None and kind not in kinds:
        raise ValueError(f"no such key: a {kind} has none")


MeasurementKind = Literal["intersection_distance", "axis_distance", "plane_axis_angle", "axis_angle", "radius"]


class Measurement(Document):
    """What is measured between features, and what it should be; angles in degrees, lengths in mm."""

    kind: MeasurementKind
    features: tuple[str, ...]
    nominal: float = Field(ge=0)
    unit: Literal["mm", "deg"]
    tolerance: float | None = Field(default=None, gt=0)


class Task(Document):
    """Features by name and measurements by name, both in the file's order."""

    features: dict[str, Feature] = Field(min_length=1)
    measurements: dict[str, Measurement] = Field(min_length=1)


@dataclass(frozen=True)
class Measured:
    """Outcome of one measurement in one cloud, in the measurement's unit.

    ``error`` is value minus nominal; ``standard_uncertainty`` is propagated from the fits. Where the measurement was
    not possible the three are NaN and ``reason`` says why.
    """

    value: float
    error: float
    standard_uncertainty: float
    possible: bool
    reason: str


def read_task(path: str | Path) -> Task:
    """Read a task file.

    Raises
    ------
    InputError
        If the file cannot be used, or a measurement names the wrong features for its kind.
    """
    task = read_toml(path, Task)
    for name, measurement in task.measurements.items():
        place = f"measurements.{name}"
        definition = DEFINITIONS[measurement.kind]
        known = list(task.features)
        for feature in measurement.features:
            if feature not in known:
                raise InputError(
                    path, f"{place}.features", repr(feature), f"features of this task: {', '.join(known)}",
                    nearest(feature, known),
                )  # fmt: skip
        kinds = [task.features[feature].kind for feature in measurement.features]
        fits = len(kinds) == len(definition.kinds) and all(
            kind in allowed for kind, allowed in zip(kinds, definition.kinds, strict=True)
        )
        wanted = ", ".join(" or ".join(allowed) for allowed in definition.kinds)
        if not fits:
            found = ", ".join(f"{f} ({k})" for f, k in zip(measurement.features, kinds, strict=True)) or "none"
            raise InputError(path, f"{place}.features", found, f"[{wanted}] for {measurement.kind}")
        if len(set(measurement.features)) < len(measurement.features):
            raise InputError(path, f"{place}.features", list(measurement.features), "different features")
        if measurement.unit != definition.unit:
            raise InputError(path, f"{place}.unit", repr(measurement.unit), f"'{definition.unit}'")
    return task


def check_features(task: Task, task_path: str | Path, shape_ids: Iterable[str]) -> None:
    """Check that every feature of a task is a shape of the scene.

    Raises
    ------
    InputError
        With the first feature that is not, the ids there are, and the nearest of them.
    """
    known = list(shape_ids)
    for name in task.features:
        if name not in known:
            raise InputError(
                task_path, f"features.{name}", repr(name),
                f"ids of the scene's shapes: {', '.join(known) or 'there are none'}", nearest(name, known),
            )  # fmt: skip


def fit_features(
    cloud: PointCloud, task: Task, sensor_from_part: ArrayLike, minimum_points: int = 100
) -> dict[str, Fit | FitError]:
    """Fit every feature of a task to its points in a labelled cloud, seen from the origin of the cloud's grid.

    ``sensor_from_part`` (4, 4) places the nominal geometry, from which cylinders start. A feature with fewer than
    ``minimum_points`` points, or whose points do not determine it, is answered by the :class:`FitError`.

    Raises
    ------
    InputError
        If the cloud knows no feature of that name.
    """
    fits: dict[str, Fit | FitError] = {}
    for name, feature in task.features.items():
        if name not in cloud.feature_names:
            known = list(cloud.feature_names)
            labels = f"labels of the cloud: {', '.join(known) or 'there are none'}"
            raise InputError("task", f"features.{name}", repr(name), labels, nearest(name, known))
        points = cloud.of_feature(name)
        try:
            if len(points) < minimum_points:
                raise FitError(f"{len(points)} points, at least {minimum_points} are asked for")
            nominal = feature.nominal(sensor_from_part)
            if isinstance(nominal, Plane):
                fits[name] = fit_plane(points, cloud.grid.origin)
            elif isinstance(nominal, Cylinder):
                fits[name] = fit_cylinder(points, nominal, cloud.grid.origin)
            else:
                fits[name] = fit_sphere(points, cloud.grid.origin)
        except FitError as error:
            fits[name] = error
    return fits


def measure(
    cloud: PointCloud, task: Task, sensor_from_part: ArrayLike, minimum_points: int = 100
) -> dict[str, Measured]:
    """Measure everything a task asks for in one labelled cloud; arguments and errors of :func:`fit_features`."""
    fits = fit_features(cloud, task, sensor_from_part, minimum_points)
    return {name: _measured(measurement, fits) for name, measurement in task.measurements.items()}


def _measured(measurement: Measurement, fits: dict[str, Fit | FitError]) -> Measured:
    surfaces: list[Fit] = []
    for name in measurement.features:
        fit = fits[name]
        if isinstance(fit, FitError):
            return Measured(np.nan, np.nan, np.nan, False, f"{name}: {fit}")
        surfaces.append(fit)
    definition = DEFINITIONS[measurement.kind]
    value, uncertainty = evaluate(definition.value, surfaces)
    if not np.isfinite([value, uncertainty]).all():
        return Measured(np.nan, np.nan, np.nan, False, f"{measurement.kind} has no value: the axis lies in the plane")
    scale = np.rad2deg(1.0) if definition.unit == "deg" else 1.0
    return Measured(value * scale, value * scale - measurement.nominal, uncertainty * scale, True, "")


def evaluate(value: Callable[..., float], fits: list[Fit]) -> tuple[float, float]:
    """Value of a measurement function on fits, and its standard uncertainty, both in mm or rad.

    u^2 is the second moment of f about f(x) over the points x +- L_k, where L_k are the columns of a square root of
    the fits' joint (block-diagonal) covariance: sum_k ((f(x + L_k) - f)^2 + (f(x - L_k) - f)^2) / 2. For a linear f
    that is the law of propagation of uncertainty (JCGM 100:2008, 5.1.2). An angle between nominally parallel
    directions is not linear but the length of a small vector, where a central difference would give 0. This gives the
    root mean square of the vector's error where the value is 0, and that of the component along the vector, at most
    sqrt(2) less, where the value is well above its noise.
    """
    best = value(*fits)
    moment = 0.0
    for index, fit in enumerate(fits):
        variances, axes = np.linalg.eigh(fit.covariance)
        for step in (axes * np.sqrt(np.maximum(variances, 0.0))).T:
            for signed in (step, -step):
                moved = [*fits[:index], fit.moved(signed), *fits[index + 1 :]]
                moment += 0.5 * (value(*moved) - best) ** 2
    return best, float(np.sqrt(moment))


def intersection_distance(plane: Plane, first: Cylinder, second: Cylinder) -> float:
    """Distance [mm] between the points where two axes meet a plane; NaN for an axis within 0.1 mrad of the plane."""
    return float(np.linalg.norm(_intersection(plane, first) - _intersection(plane, second)))


def _intersection(plane: Plane, cylinder: Cylinder) -> NDArray[np.float64]:
    climb = float(cylinder.axis @ plane.normal)
    if abs(climb) < 1e-4:
        return np.full(3, np.nan)
    return cylinder.point + ((plane.point - cylinder.point) @ plane.normal / climb) * cylinder.axis


def axis_distance(first: Cylinder, second: Cylinder) -> float:
    """Distance [mm] between two axes where they were measured.

    It is taken in the plane perpendicular to the mean axis through the middle of the two axis points (for fits, the
    points abreast of the measured points). The shortest distance between skew lines, the usual definition, is taken
    where the lines pass nearest: for near-parallel axes that place, and so the distance, hangs on the noise.
    """
    other = second.axis if first.axis @ second.axis >= 0 else -second.axis
    mean = first.axis + other
    plane = Plane((first.point + second.point) / 2, mean / np.linalg.norm(mean))
    return intersection_distance(plane, first, second)


def plane_axis_angle(plane: Plane, cylinder: Cylinder) -> float:
    """Angle [rad], 0 to pi/2, between a plane's normal and an axis: 0 where the axis is normal to the plane."""
    return _line_angle(plane.normal, cylinder.axis)


def axis_angle(first: Cylinder, second: Cylinder) -> float:
    """Angle [rad], 0 to pi/2, between two axes, whichever way they run."""
    return _line_angle(first.axis, second.axis)


def _line_angle(first: NDArray[np.float64], second: NDArray[np.float64]) -> float:
    # the arc cosine would lose half the digits at the small angles that matter most
    return float(np.arctan2(np.linalg.norm(np.cross(first, second)), abs(first @ second)))


def radius(feature: Cylinder | Sphere) -> float:
    """Radius [mm] of a cylinder or sphere."""
    return feature.radius


@dataclass(frozen=True)
class Definition:
    """What a kind of measurement computes, on which kinds of feature in which order, and the unit in files."""

    value: Callable[..., float]
    kinds: tuple[tuple[str, ...], ...]
    unit: Literal["mm", "deg"]


DEFINITIONS: dict[MeasurementKind, Definition] = {
    "intersection_distance": Definition(intersection_distance, (("plane",), ("cylinder",), ("cylinder",)), "mm"),
    "axis_distance": Definition(axis_distance, (("cylinder",), ("cylinder",)), "mm"),
    "plane_axis_angle": Definition(plane_axis_angle, (("plane",), ("cylinder",)), "deg"),
    "axis_angle": Definition(axis_angle, (("cylinder",), ("cylinder",)), "deg"),
    "radius": Definition(radius, (("cylinder", "sphere"),), "mm"),
}
