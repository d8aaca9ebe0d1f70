"""Convert the dimensions and tolerances of a drawing to measurements of a task, and list those without one.

Signal chain: dimensions and tolerances with the numbers of their faces
(:mod:`mitsim.scene.authoring.product_information`) -> faces by name -> a measurement if the task has its kind for these
features, else a sentence with the reason.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from characterisation.features.surfaces import Cone, Cylinder, Plane, Sphere
from characterisation.files.documents import LONGEST_NAME
from characterisation.tasks.definitions import (
    axis_angle,
    axis_distance,
    plane_angle,
    plane_axis_angle,
    plane_distance,
    point_plane_distance,
)
from mitsim.scene.authoring.drawn_characteristics import (
    NO_LIMITS,
    Dimension,
    DrawnTarget,
    GeometricTolerance,
    ProductInformation,
)
from mitsim.scene.authoring.drawn_zones import Side, middles, zones
from mitsim.scene.authoring.face import Face
from mitsim.scene.authoring.naming import identifier

#: difference between the drawing and its own model above which it is reported [mm, deg]
_AGREE = 0.005

#: measurements of two kinds of feature, and the kind that comes first
_FIRST = {"plane_axis_angle": "plane", "point_plane_distance": "sphere"}


@dataclass(frozen=True)
class DrawnMeasurement:
    """A measurement in a task's terms, the number of its entity in the file, and remarks about it."""

    kind: str
    features: tuple[str, ...]
    nominal: float
    unit: str
    tolerance: float | tuple[float, float] | None
    number: int
    remarks: tuple[str, ...] = ()

    def keys(self) -> dict[str, Any]:
        """Return the keys of the task."""
        keys: dict[str, Any] = {
            "kind": self.kind,
            "features": list(self.features),
            "nominal": round(self.nominal, 6) + 0.0,
            "unit": self.unit,
        }
        if isinstance(self.tolerance, tuple):
            keys["tolerance"] = [round(end, 6) + 0.0 for end in self.tolerance]
        elif self.tolerance is not None:
            keys["tolerance"] = round(self.tolerance, 6)
        return keys


@dataclass
class DrawnTask:
    """Content of a drawing: measurements by name, names of the faces of each datum, and items left out.

    ``middles``: the mid-planes of two sides that measurements use, by name. ``in_part``: how measurements differ from
    the drawing.
    """

    measurements: dict[str, DrawnMeasurement] = field(default_factory=dict)
    datums: dict[str, tuple[str, ...]] = field(default_factory=dict)
    middles: dict[str, Side] = field(default_factory=dict)
    left_out: list[str] = field(default_factory=list)
    in_part: list[str] = field(default_factory=list)

    def datum_of(self, name: str) -> str:
        """Return the letters of the datums on a face."""
        return ", ".join(letter for letter, faces in self.datums.items() if name in faces)

    def remarks(self) -> list[str]:
        """Return a summary of the drawing for the user."""
        lines = [f"The file's own dimensions and tolerances: {len(self.measurements)} measurements."]
        lines += [f"Datum {letter}: {', '.join(faces) or 'no face'}." for letter, faces in self.datums.items()]
        if self.in_part:
            lines += ["Converted, with a remark:", *(f"  {remark}" for remark in self.in_part)]
        if self.left_out:
            lines += ["Not converted:", *(f"  {omission}" for omission in self.left_out)]
        return lines


def drawn_task(information: ProductInformation, faces: Sequence[Face]) -> DrawnTask:
    """Convert a drawing: measurements for all that a task supports, sentences for the rest."""
    builder = _TaskBuilder(faces)
    builder.task.datums = {letter: tuple(f.name for f in builder.faces(t)) for letter, t in information.datums.items()}
    for dimension in information.dimensions:
        builder.dimension(dimension)
    for tolerance in information.tolerances:
        builder.tolerance(tolerance)
    for letter, target in information.datums.items():
        if not builder.task.datums[letter]:
            builder.task.left_out.append(f"datum {letter}: it is {_what(target)}")
    builder.task.left_out += information.unread
    return builder.task


def _what(target: DrawnTarget) -> str:
    return f"on {', '.join(target.other_types)}, no face" if target.other_types else "on no face of the part"


class _TaskBuilder:
    """Builds a task; finds faces by the numbers of their entities."""

    def __init__(self, faces: Sequence[Face]) -> None:
        self.task = DrawnTask()
        self.by_name = {face.name: face for face in faces}
        self.by_entity: dict[int, list[Face]] = defaultdict(list)
        for face in faces:
            for number in face.entities:
                self.by_entity[number].append(face)

    def faces(self, target: DrawnTarget) -> list[Face]:
        """Return the faces of a target, each once: halves of a bore are one face."""
        return list({face.name: face for number in target.faces for face in self.by_entity.get(number, ())}.values())

    def add(self, name: str, measurement: DrawnMeasurement) -> None:
        """Add a measurement under a unique name."""
        self.task.measurements[_unique(name, self.task.measurements)] = measurement

    def feature(self, side: Side) -> str:
        """Return the name of the feature of a side, a face or one of the mid-planes of the task."""
        if not side.derived:
            return side.name
        there = next((name for name, known in self.task.middles.items() if known.faces == side.faces), None)
        name = there or _unique(side.name, [*self.by_name, *self.task.middles])
        self.task.middles.setdefault(name, side)
        return name

    def dimension(self, dimension: Dimension) -> None:
        """Convert a size or a location."""
        described = f"#{dimension.number} {dimension.kind}" + (
            f" {dimension.nominal:g}" if dimension.nominal is not None else ""
        )
        first, second = self.faces(dimension.first), self.faces(dimension.second) if dimension.second else []
        on = f" of {', '.join(f.name for f in [*first, *second])}" if first or second else ""

        def left_out(why: str) -> None:
            self.task.left_out.append(f"{described}{on}: {why}")

        if dimension.nominal is None:
            return left_out("it has no value in the file")
        if not first or (dimension.second is not None and not second):
            return left_out(f"it is {_what(dimension.first if not first else dimension.second or DrawnTarget())}")
        remarks = list(dimension.notes)
        lost = [note for note in remarks if NO_LIMITS in note]
        tolerance = _deviations(dimension)
        if dimension.limits is not None and tolerance is None:
            lost.append(f"its limits {dimension.limits[0]:g} and {dimension.limits[1]:g} are not in increasing order")
            remarks.append(lost[-1])
        made: list[tuple[str, str, tuple[Face, ...], float]] = []
        if dimension.second is None:
            made = self._sizes(dimension, first)
        else:
            kind, value = (
                _between(first[0], second[0], dimension.angular) if len(first) == len(second) == 1 else ("", 0.0)
            )
            if kind:
                short = "angle" if dimension.angular else "distance"
                made = [(f"{first[0].name}_to_{second[0].name}_{short}", kind, (first[0], second[0]), value)]
        if not made:
            return left_out("a task has no such measurement between such faces")
        self.task.in_part += [f"{described}{on}: without its tolerance, because {note}" for note in lost]
        for name, kind, members, model in made:
            nominal, allowed, said = dimension.nominal, tolerance, list(remarks)
            if dimension.angular and kind != "cone_angle" and nominal > 90:  # a task has lines' angles, 0 to 90 deg
                nominal, allowed = 180.0 - nominal, _turned(allowed)
            if kind == "plane_axis_angle":  # the drawing's angle is that of the face, the task's that of its normal
                nominal, allowed = 90.0 - nominal, _turned(allowed)
            if abs(nominal - model) > _AGREE:
                said.append(f"the drawing states {nominal:g}, the model has {model:.6g}")
                nominal, allowed = _about(model, nominal, allowed)
            ordered = members[::-1] if kind in _FIRST and members[0].kind != _FIRST[kind] else members
            unit = "deg" if dimension.angular else "mm"
            self.add(
                name,
                DrawnMeasurement(
                    kind, tuple(f.name for f in ordered), nominal, unit, allowed, dimension.number, tuple(said)
                ),
            )
        return None

    def _sizes(self, dimension: Dimension, faces: list[Face]) -> list[tuple[str, str, tuple[Face, ...], float]]:
        """Return the sizes of faces: of each round face, of two planes, or the widths of slots."""
        planes = [face for face in faces if isinstance(face.surface, Plane)]
        if dimension.angular:
            cones = [f for f in faces if isinstance(f.surface, Cone)]
            if cones and len(cones) == len(faces):
                return [(f"{f.name}_angle", "cone_angle", (f,), 2 * _half_angle(f)) for f in cones]
        elif len(planes) == len(faces) == 2:
            kind, value = _between(faces[0], faces[1], False)
            return [(f"{faces[0].name}_to_{faces[1].name}_distance", kind, (faces[0], faces[1]), value)] if kind else []
        elif all(isinstance(face.surface, Cylinder | Sphere) for face in faces):
            kind = "radius" if "radius" in dimension.kind else "diameter" if "diameter" in dimension.kind else ""
            if kind:
                scale = 1 if kind == "radius" else 2
                return [(f"{f.name}_{kind}", kind, (f,), scale * _radius(f)) for f in faces]
        else:
            widths = [(side.of, *_between(side.of[0], side.of[1], False)) for side in middles(faces)]
            return [
                (f"{of[0].name}_to_{of[1].name}_distance", kind, of, value)
                for of, kind, value in widths
                if abs(value - (dimension.nominal or 0.0)) <= _AGREE
            ]
        return []

    def tolerance(self, geometric_tolerance: GeometricTolerance) -> None:
        """Convert a geometric tolerance."""
        faces = self.faces(geometric_tolerance.target)
        frame = f" |{'|'.join(geometric_tolerance.datums)}" if geometric_tolerance.datums else ""
        size = f" {geometric_tolerance.zone:g}" if geometric_tolerance.zone is not None else ""
        described = f"#{geometric_tolerance.number} {geometric_tolerance.kind}{size}{frame}"
        on = f" of {', '.join(f.name for f in faces)}" if faces else ""
        if geometric_tolerance.zone is None or geometric_tolerance.zone <= 0:
            self.task.left_out.append(f"{described}{on}: it has no zone in the file")
            return
        if not faces:
            self.task.left_out.append(f"{described}{on}: it is {_what(geometric_tolerance.target)}")
            return
        datums = {letter: [self.by_name[name] for name in names] for letter, names in self.task.datums.items()}
        made = zones(geometric_tolerance, faces, datums)
        for zone in made.zones:
            features = tuple(self.feature(side) for side in (zone.of, *zone.datums))
            said = (*geometric_tolerance.notes, *zone.remarks)
            self.add(
                f"{features[0]}_{zone.kind}",
                DrawnMeasurement(
                    zone.kind, features, 0.0, "mm", geometric_tolerance.zone, geometric_tolerance.number, said
                ),
            )
            told = (*(note for note in geometric_tolerance.notes if not note.startswith("zone:")), *zone.remarks)
            self.task.in_part += [f"{described} of {features[0]}: {remark}" for remark in told]
        self.task.left_out += [f"{described}{f' of {name}' if name else on}: {why}" for name, why in made.left_out]


def _unique(name: str, taken: Collection[str]) -> str:
    """Return a name, cut to the length that a task allows, and with a number if it is taken."""
    name = base = identifier(name, LONGEST_NAME - len("_1000"))
    count = 1
    while name in taken:
        count += 1
        name = f"{base}_{count}"
    return name


def _deviations(dimension: Dimension) -> float | tuple[float, float] | None:
    """Return the tolerance of a task: one number if both deviations are equal, else the lower and the upper one."""
    if dimension.limits is None or dimension.nominal is None:
        return None
    low, high = dimension.limits[0] - dimension.nominal, dimension.limits[1] - dimension.nominal
    if not low < high:
        return None
    alike = abs(high + low) <= 1e-9 * max(abs(high), abs(low), 1.0)
    return (high - low) / 2 if alike else (low, high)


def _turned(allowed: float | tuple[float, float] | None) -> float | tuple[float, float] | None:
    """Return a tolerance of the supplementary or the complementary angle."""
    return (-allowed[1], -allowed[0]) if isinstance(allowed, tuple) else allowed


def _about(
    model: float, nominal: float, allowed: float | tuple[float, float] | None
) -> tuple[float, float | tuple[float, float] | None]:
    """Return a nominal value and its tolerance about the model's value, with the same limits.

    Errors are counted from the model. A model outside the limits keeps the drawing's value, which a study rejects.
    """
    if allowed is None:
        return model, None
    low, high = (-allowed, allowed) if isinstance(allowed, float) else allowed
    shift = nominal - model
    return (model, (low + shift, high + shift)) if low + shift <= 0 <= high + shift else (nominal, allowed)


def _radius(face: Face) -> float:
    assert isinstance(face.surface, Cylinder | Sphere)
    return face.surface.radius


def _half_angle(face: Face) -> float:
    assert isinstance(face.surface, Cone)
    return float(np.rad2deg(face.surface.half_angle))


def _between(first: Face, second: Face, angular: bool) -> tuple[str, float]:
    """Return kind and model value of a distance [mm] or an angle [deg] between two faces; an empty kind if none."""
    surface, other = first.surface, second.surface
    if angular:
        if isinstance(surface, Plane) and isinstance(other, Plane):
            return "plane_angle", float(np.rad2deg(plane_angle(surface, other)))
        if isinstance(surface, Cylinder | Cone) and isinstance(other, Plane):
            surface, other = other, surface
        if isinstance(surface, Plane) and isinstance(other, Cylinder | Cone):
            return "plane_axis_angle", float(np.rad2deg(plane_axis_angle(surface, other)))
        if isinstance(surface, Cylinder | Cone) and isinstance(other, Cylinder | Cone):
            return "axis_angle", float(np.rad2deg(axis_angle(surface, other)))
        return "", 0.0
    if isinstance(surface, Plane) and isinstance(other, Plane) and abs(float(surface.normal @ other.normal)) > 0.9999:
        return "plane_distance", plane_distance(surface, other, nominal=(surface, other))
    if isinstance(surface, Cylinder | Cone) and isinstance(other, Cylinder | Cone):
        return "axis_distance", axis_distance(surface, other)
    if isinstance(surface, Sphere) and isinstance(other, Sphere):
        return "point_distance", float(np.linalg.norm(surface.centre - other.centre))
    if isinstance(surface, Plane) and isinstance(other, Sphere):
        surface, other = other, surface
    if isinstance(surface, Sphere) and isinstance(other, Plane):
        return "point_plane_distance", point_plane_distance(surface, other)
    return "", 0.0
