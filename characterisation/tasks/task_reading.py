"""Read a task file, and report errors beyond its keys and types, with their place and the allowed values.

Features must be derived from others of the right kinds and lie where these do. Measurements must name features of the
kinds that they take, in order, and have the right unit.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from characterisation.features.figures import Circle, EdgePoint, Point
from characterisation.features.surfaces import Cone, Cylinder, Plane
from characterisation.files.documents import read_toml
from characterisation.files.errors import InputError, nearest
from characterisation.tasks.definitions import AXIS, DEFINITIONS, FLAT, Definition
from characterisation.tasks.measurement_model import nominal_value
from characterisation.tasks.places import MOST_ASKEW_DEG, askew_deg
from characterisation.tasks.task_file import KEYS, Feature, Nominal, Task
from characterisation.tasks.zones import ASKEW, frame_fault

#: sorted kinds that an ``of`` may name, and their description in messages
PARENTS: dict[str, tuple[tuple[tuple[str, ...], ...], str]] = {
    "circle": ((("plane",),), "[plane]"),
    "edge_point": ((("plane",),), "[plane]"),
    "intersection": (
        (("axis", "plane"), ("plane", "plane", "plane"), ("axis", "axis")),
        "[axis, plane], [plane, plane, plane] or [axis, axis], an axis being a cylinder or a cone",
    ),
    "mid_plane": ((("plane", "plane"),), "[plane, plane]"),
}

#: largest distance of nominal geometry from its plane or axis [mm]
MISPLACED_MM = 0.05

#: largest difference of a nominal value from that of the nominal geometry [mm or deg]
MISSTATED = 0.005

#: largest tilt of a direction out of its face
LEANING = 1e-3


def read_task(path: str | Path) -> Task:
    """Read a task TOML file: features of a part, and the measurements of them.

    Parameters
    ----------
    path
        The file; its keys are in ``docs/reference/task.md``.

    Returns
    -------
    Task
        ``features`` and ``measurements`` by name, geometry in the part frame [mm].

    Raises
    ------
    InputError
        If the file is missing or is not TOML, a feature does not match the features from which it is derived, or a
        measurement names the wrong features for its kind; the error names the key.

    Examples
    --------
    >>> import mitsim as ms
    >>> task = ms.read_task("task.toml")
    >>> task.measurements["pillar1_radius"].nominal
    20.0
    """
    task = read_toml(path, Task)
    check_task(path, task)
    return task


def check_task(path: str | Path, task: Task) -> None:
    """Check features and measurements of a task against one another.

    Raises InputError for the first that does not match; the error names the key.
    """
    for name in task.features:
        _check_feature(path, task, name)
    for name in task.measurements:
        _check_measurement(path, task, name)


def check_features(task: Task, task_path: str | Path, shape_ids: Iterable[str]) -> None:
    """Check that every feature of a task that is a shape exists in the scene.

    Raises InputError for the first feature that does not, with the ids of the scene and the most similar of them.
    """
    names = list(shape_ids)
    for name in task.shapes:
        if name not in names:
            allowed = f"ids of the scene's shapes: {', '.join(names) or 'there are none'}"
            hint = nearest(name, names)
            raise InputError(task_path, f"features.{name}", repr(name), allowed, hint)


def check_nominal_values(task: Task, task_path: str | Path) -> None:
    """Check that nominal values are those of the nominal geometry, from which simulated errors are counted.

    Raises InputError for the first measurement that states another; the hint gives the same limits about the value of
    the geometry.
    """
    for name in task.measurements:
        if fault := misstated(task, name):
            found, allowed, hint = fault
            raise InputError(task_path, f"measurements.{name}.nominal", found, allowed, hint)


def misstated(task: Task, measurement: str) -> tuple[str, str, str] | None:
    """Return value, allowed value and hint if a nominal value differs from the nominal geometry; None if it does not.

    The model of a part may lie at the middle of its tolerance. Limits about another nominal value are the same limits.
    """
    asked, model = task.measurements[measurement], nominal_value(task, measurement)
    if abs(model - asked.nominal) <= MISSTATED:
        return None
    of = ", ".join(asked.features)
    if asked.zone:
        allowed = f"features whose {asked.kind} is 0 in the model: that of {of} is {model:.6g} {asked.unit}"
        return "0", allowed, "correct the kind or the features"
    if not np.isfinite(model):
        allowed = f"features whose nominal geometry has this value: that of {of} has none"
        return f"{asked.nominal:g}", allowed, "correct their directions, such as that of an axis along its plane"
    allowed = f"{model:.6g} {asked.unit}, from the geometry of {of}"
    low, high = asked.limits
    if not low <= model <= high:
        hint = "correct the value, the kind or the features"
    elif asked.tolerance is None:
        hint = "errors are counted from the model"
    else:
        deviations = f"[{low - model:.6g}, {high - model:.6g}]"
        hint = f"errors are counted from the model; the same limits are nominal = {model:.6g}, tolerance = {deviations}"
    return f"{asked.nominal:g}", allowed, hint


def _check_feature(path: str | Path, task: Task, name: str) -> None:
    """Check the features from which a feature is derived, and the place of its nominal geometry."""
    feature, location = task.features[name], f"features.{name}"
    if feature.of is not None:
        _check_names(path, f"{location}.of", feature.of, task)
        kinds = [task.features[parent].kind for parent in feature.of]
        possible, wanted = PARENTS[feature.kind]
        if tuple(sorted("axis" if kind in AXIS else kind for kind in kinds)) not in possible:
            raise InputError(path, f"{location}.of", _listed(feature.of, kinds), f"{wanted} for {feature.kind}")
    nominal = task.nominal(name)
    if isinstance(nominal, Point) and not np.isfinite(nominal.place).all():
        found = f"{', '.join(feature.of or ())}, which are parallel"
        raise InputError(path, f"{location}.of", found, "features that meet in one point")
    if isinstance(nominal, Circle | EdgePoint):
        (plane,) = feature.of or ("",)
        on = task.features[plane].nominal()
        assert isinstance(on, Plane)
        off = abs(float((np.array(feature.point_mm) - on.point) @ on.normal))
        if off > MISPLACED_MM:
            raise InputError(path, f"{location}.point_mm", f"a point {off:.3g} mm off {plane}", f"a point on {plane}")
        if isinstance(nominal, EdgePoint) and abs(float(nominal.direction @ on.normal)) > LEANING:
            raise InputError(path, f"{location}.direction", list(feature.direction or ()), f"a direction in {plane}")
    if feature.kind == "mid_plane":
        first, second = (task.features[parent].nominal() for parent in feature.of or ())
        assert isinstance(first, Plane) and isinstance(second, Plane)
        if len(set(feature.of or ())) < 2:
            raise InputError(path, f"{location}.of", list(feature.of or ()), "different features")
        if np.linalg.norm(np.cross(first.normal, second.normal)) > ASKEW:
            raise InputError(path, f"{location}.of", ", ".join(feature.of or ()), "two planes that are nearly parallel")
    if feature.outline_mm is not None:
        _check_outline(path, f"{location}.outline_mm", feature, nominal)


def _check_outline(path: str | Path, location: str, feature: Feature, surface: Nominal) -> None:
    outline = np.array(feature.outline_mm).reshape(-1, 3)
    least, meaning = (3, "corners of the face") if isinstance(surface, Plane) else (2, "ends of the axis")
    if len(outline) < least:
        raise InputError(path, location, f"{len(outline)} places", f"{least} or more {meaning}")
    if isinstance(surface, Plane):
        off = np.abs((outline - surface.point) @ surface.normal)
    elif isinstance(surface, Cylinder | Cone):
        off = np.linalg.norm(np.cross(outline - surface.point, surface.axis), axis=1)
    if off.max() > MISPLACED_MM:
        found = f"{list(outline[off.argmax()])}, {off.max():.3g} mm off"
        raise InputError(path, location, found, f"{meaning}, on the feature")


def _check_measurement(path: str | Path, task: Task, name: str) -> None:
    measurement, location = task.measurements[name], f"measurements.{name}"
    definition = DEFINITIONS[measurement.kind]
    _check_names(path, f"{location}.features", measurement.features, task)
    kinds = [task.features[feature].kind for feature in measurement.features]
    if not _fit(kinds, definition):
        found = _listed(measurement.features, kinds)
        raise InputError(path, f"{location}.features", found, f"{_wanted(definition)} for {measurement.kind}")
    if len(set(measurement.features)) < len(measurement.features):
        raise InputError(path, f"{location}.features", list(measurement.features), "different features")
    if measurement.kind in ("plane_distance", "axis_distance"):
        angle = askew_deg([task.nominal(feature) for feature in measurement.features])
        if angle > MOST_ASKEW_DEG:
            found = f"{', '.join(measurement.features)}, {angle:.0f} deg apart"
            raise InputError(
                path, f"{location}.features", found, "nearly parallel features: others have no one distance"
            )
    if measurement.unit != definition.unit:
        raise InputError(path, f"{location}.unit", repr(measurement.unit), f"'{definition.unit}'")
    if definition.zone and measurement.nominal != 0:
        hint = "its tolerance is the largest allowed value"
        raise InputError(path, f"{location}.nominal", measurement.nominal, f"0: {measurement.kind} is a zone", hint)
    if measurement.point_mm is not None and measurement.kind != "pose_position":
        raise InputError(
            path, f"{location}.point_mm", list(measurement.point_mm), "no such key: only pose_position has point_mm"
        )
    first = task.features[measurement.features[0]]
    if "outline" in definition.needs and "outline_mm" in KEYS[first.kind][1] and first.outline_mm is None:
        allowed = "corners of the face" if first.kind in FLAT else "ends of the axis"
        hint = f"{location} is a zone over the extent of the feature"
        raise InputError(path, f"features.{measurement.features[0]}.outline_mm", "nothing", allowed, hint)
    if definition.datums and len(kinds) > len(definition.kinds):
        names = measurement.features[len(definition.kinds) :]
        datums = [datum for datum in map(task.nominal, names) if isinstance(datum, Plane | Cylinder | Cone)]
        if fault := frame_fault(datums):
            raise InputError(path, f"{location}.features", ", ".join(names), fault)


def _check_names(path: str | Path, location: str, names: tuple[str, ...], task: Task) -> None:
    feature_names = list(task.features)
    for name in names:
        if name not in feature_names:
            allowed = f"features of this task: {', '.join(feature_names)}"
            raise InputError(path, location, repr(name), allowed, nearest(name, feature_names))


def _fit(kinds: Sequence[str], definition: Definition) -> bool:
    """Return whether the kinds of feature are those that a measurement takes."""
    if definition.many:
        return len(kinds) > 0 and all(kind in definition.kinds[0] for kind in kinds)
    wanted = definition.kinds if len(kinds) == len(definition.kinds) else definition.kinds + definition.datums
    return len(kinds) == len(wanted) and all(
        kind in allowed_kinds for kind, allowed_kinds in zip(kinds, wanted, strict=True)
    )


def _wanted(definition: Definition) -> str:
    words = [" or ".join(kinds) for kinds in definition.kinds]
    if definition.many:
        return f"any number of {words[0]}"
    more = f", or these and the datums [{', '.join(' or '.join(kinds) for kinds in definition.datums)}]"
    return f"[{', '.join(words)}]" + (more if definition.datums else "")


def _listed(names: tuple[str, ...], kinds: Sequence[str]) -> str:
    return ", ".join(f"{name} ({kind})" for name, kind in zip(names, kinds, strict=True)) or "none"
