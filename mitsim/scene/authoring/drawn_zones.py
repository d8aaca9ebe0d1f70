"""Convert geometric tolerances of a drawing to the zones of a task: their kind, their features and their datums.

Signal chain: a tolerance, its faces and the faces of its datums -> the toleranced face, or mid-plane of two sides, of
each zone -> kind of measurement and names of the datums, or a sentence with the reason why there is none.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np

from characterisation.features.surfaces import Cone, Cylinder, Plane, Sphere
from characterisation.tasks.places import mid_plane
from characterisation.tasks.zones import Datum, frame_fault
from mitsim.scene.authoring.drawn_characteristics import COMMON, DIRECTED, PROJECTED, UNEQUAL, GeometricTolerance
from mitsim.scene.authoring.face import Face

#: two sides belong to a slot or a web if their normals are opposite within this cosine
_OPPOSITE = -0.9999

#: how far the round end of a slot may lie off its mid-plane and differ from its width, as a part of the width; also the
#: cosine of its axis with the normal; chosen
_TOUCHING = 1e-3

#: tolerances of the mid-planes of two sides; and those too, if the file gives them to a size instead of to faces
_OF_SIZES = ("position", "symmetry")
_OF_FACES_OR_SIZES = ("parallelism", "perpendicularity", "angularity")

_PLANES = "between two planes"

#: forms of zones, by a part of their names in a file (ISO 10303-47)
_FORMS = {"spher": "within a sphere", "cylind": "within a cylinder", "circ": "within a cylinder", "plane": _PLANES}


@dataclass(frozen=True)
class Side:
    """A toleranced feature or a datum: a face, or the mid-plane of two sides.

    Mid-planes of one face with several others have the same ``name``; those in the task are unique.
    """

    name: str
    surface: Plane | Cylinder | Cone | Sphere
    of: tuple[Face, ...]

    @property
    def derived(self) -> bool:
        """Return whether it is a mid-plane."""
        return len(self.of) == 2

    @property
    def faces(self) -> frozenset[str]:
        """Return the names of its faces."""
        return frozenset(face.name for face in self.of)


@dataclass(frozen=True)
class Zone:
    """A measurement of a zone: its kind, its feature, its datums in order, and remarks."""

    kind: str
    of: Side
    datums: tuple[Side, ...] = ()
    remarks: tuple[str, ...] = ()


@dataclass
class Zones:
    """The zones of one tolerance, and reasons for faces without one: (name of the face or "", reason)."""

    zones: list[Zone] = field(default_factory=list)
    left_out: list[tuple[str, str]] = field(default_factory=list)


def middle(faces: Sequence[Face]) -> Side | None:
    """Return the mid-plane of the two sides of a slot or a web; None for other faces."""
    if len(faces) != 2:
        return None
    first, second = (face.surface for face in faces)
    if not isinstance(first, Plane) or not isinstance(second, Plane):
        return None
    if _outward(faces[0]) @ _outward(faces[1]) > _OPPOSITE:
        return None
    return Side(f"middle_of_{faces[0].name}", mid_plane(first, second), tuple(faces))


def _outward(face: Face) -> np.ndarray:
    """Return the normal of a plane out of the part."""
    assert isinstance(face.surface, Plane)
    return face.surface.normal * (1 if face.convex else -1)


def middles(faces: Sequence[Face]) -> list[Side]:
    """Return the mid-planes of one or several slots, which may have round ends, or webs; none for other faces.

    The sides of several slots are those that face each other, the nearest first; those of several webs face away.
    """
    planes = [face for face in faces if isinstance(face.surface, Plane)]
    both = [side for pair in combinations(planes, 2) if (side := middle(pair)) is not None]
    both.sort(key=lambda side: float(np.linalg.norm(_across(side))))
    for towards in (1, -1) if len(planes) > 2 else (0,):
        found: list[Side] = []
        for side in both:
            if _across(side) @ _outward(side.of[0]) * towards >= 0 and not any(side.faces & one.faces for one in found):
                found.append(side)
        rest = [face for face in faces if not any(face.name in side.faces for side in found)]
        if all(any(_is_end(face, side) for side in found) for face in rest):
            return found
    return []


def _across(side: Side) -> np.ndarray:
    """Return the way from the first to the second of two sides [mm]."""
    first, second = (face.surface for face in side.of)
    assert isinstance(first, Plane)
    assert isinstance(second, Plane)
    return second.point - first.point


def _is_end(face: Face, slot: Side) -> bool:
    """Return whether a face is a round end of a slot: a cylinder about its mid-plane, as wide as the slot."""
    surface, plane = face.surface, slot.surface
    if not isinstance(surface, Cylinder) or not isinstance(plane, Plane):
        return False
    width = abs(float(_across(slot) @ plane.normal))
    off = max(abs(float((surface.point - plane.point) @ plane.normal)), abs(2 * surface.radius - width))
    return off <= _TOUCHING * width and abs(float(surface.axis @ plane.normal)) <= _TOUCHING


def zones(tolerance: GeometricTolerance, faces: Sequence[Face], datum_faces: Mapping[str, Sequence[Face]]) -> Zones:
    """Return the zones of a tolerance on ``faces``; ``datum_faces`` by the letter of their datum."""
    out = Zones()
    datums = [_side(datum_faces.get(letter, ())) for letter in tolerance.datums]
    of_sizes = tolerance.kind in _OF_SIZES or (tolerance.target.of_size and tolerance.kind in _OF_FACES_OR_SIZES)
    sides = middles(faces) if of_sizes else []
    held: Sequence[Side | Face] = sides or [_side([face]) or face for face in faces]
    framed = tolerance.kind == "surface profile" and not isinstance(_frame(tolerance, datums), str)
    located = tolerance.kind == "position" or framed  # a zone at its place is the same for one face and for several
    if COMMON in tolerance.notes and len(held) > 1 and not located:
        out.left_out.append(("", "its zone is common to its faces, and a task has zones of single faces"))
        return out
    if tolerance.kind == "surface profile" and tolerance.datums and len(faces) > 1 and "all around" in tolerance.notes:
        out.left_out.append(("", "all around: it applies to its faces together, and a task has zones of single faces"))
        return out
    for side in held:
        if isinstance(side, Face):
            out.left_out.append((side.name, "a task has no such tolerance for such a face"))
            continue
        zone = _zone(tolerance, side, datums)
        if isinstance(zone, Zone):
            zone = _with_form(zone, tolerance)
        if isinstance(zone, Zone):
            out.zones.append(zone)
        else:
            out.left_out.append((side.name, zone))
    return out


def _side(faces: Sequence[Face]) -> Side | None:
    """Return one face that a task supports, or the mid-plane of two; None for anything else."""
    if len(faces) == 1 and isinstance(surface := faces[0].surface, Plane | Cylinder | Cone | Sphere):
        return Side(faces[0].name, surface, tuple(faces))
    return middle(faces)


def _with_form(zone: Zone, tolerance: GeometricTolerance) -> Zone | str:
    """Return the zone if it has the form that the file states, with a remark if it states none; else the reason."""
    if zone.kind in ("flatness", "cylindricity"):
        return zone
    stated = next((note.casefold() for note in tolerance.notes if note.startswith("zone:")), "")
    form, of_task = next((form for word, form in _FORMS.items() if word in stated), None), _form(zone)
    if form not in (None, of_task):
        return f"its zone lies {form}, and that of a task {of_task}"
    if stated or of_task == _PLANES:
        return zone
    return replace(zone, remarks=(*zone.remarks, f"the file states no form of its zone: it is taken {of_task}"))


def _form(zone: Zone) -> str:
    """Return the form of a zone of position or orientation in a task."""
    if isinstance(zone.of.surface, Sphere):
        return "within a sphere"
    flat_datum = bool(zone.datums) and isinstance(zone.datums[0].surface, Plane)
    across = {"symmetry": True, "parallelism": flat_datum, "perpendicularity": not flat_datum}.get(zone.kind, False)
    return _PLANES if isinstance(zone.of.surface, Plane) or across else "within a cylinder"


def _zone(tolerance: GeometricTolerance, side: Side, datums: Sequence[Side | None]) -> Zone | str:
    """Return the zone of one side, or the reason why a task has none."""
    surface = side.surface
    flat, axis = isinstance(surface, Plane), isinstance(surface, Cylinder | Cone)
    if UNEQUAL in tolerance.notes:
        return f"{UNEQUAL}, and those of a task lie equally about it"
    if PROJECTED in tolerance.notes:
        return f"{PROJECTED}, and those of a task lie at it"
    if DIRECTED in tolerance.notes:
        return f"{DIRECTED}, and those of a task have that of the feature or its datum"
    match tolerance.kind:
        case "flatness" if flat:
            return Zone("flatness", side)
        case "cylindricity" if isinstance(surface, Cylinder):
            return Zone("cylindricity", side)
        case "surface profile" if flat and not tolerance.datums:
            return Zone("flatness", side, (), ("a profile of a plane without datums is its flatness (ISO 1660)",))
        case "surface profile" if flat:
            frame = _frame(tolerance, datums)
            if isinstance(frame, str):
                return f"a profile needs a complete datum frame: {frame}"
            return Zone("position", side, frame, ("a profile of a plane in a datum frame is its position",))
        case "parallelism" | "perpendicularity" if flat or axis:
            return _oriented(tolerance, tolerance.kind, side, datums)
        case "angularity" if flat:
            return _oriented(tolerance, "angularity", side, datums)
        case "coaxiality" | "concentricity" if axis:
            zone = _oriented(tolerance, "coaxiality", side, datums)
            if isinstance(zone, Zone) and isinstance(zone.datums[0].surface, Plane):
                return f"its datum {zone.datums[0].name} has no axis"
            return zone
        case "symmetry" if side.derived or axis:
            zone = _oriented(tolerance, "symmetry", side, datums)
            if isinstance(zone, Zone) and not isinstance(zone.datums[0].surface, Plane):
                return f"its datum {zone.datums[0].name} is not a plane"
            return zone
        case "position":
            frame = _frame(tolerance, datums)
            if not isinstance(frame, str):
                return Zone("position", side, frame)
            if not tolerance.datums:
                return Zone("position", side, (), ("without datums: relative to the pose of the part",))
            said = (
                f"{'|'.join(tolerance.datums)} are no datum frame of a task ({frame}): relative to the pose of the part"
            )
            return Zone("position", side, (), (said,))
    return "a task has no such tolerance for such a face"


def _oriented(tolerance: GeometricTolerance, kind: str, side: Side, datums: Sequence[Side | None]) -> Zone | str:
    """Return a zone with one datum, a plane or an axis."""
    datum = datums[0] if datums else None
    if datum is None:
        return f"its datum {'|'.join(tolerance.datums)} is not one face"
    if isinstance(datum.surface, Sphere):
        return f"its datum {datum.name} is neither a plane nor has an axis"
    if datum.faces == side.faces:
        return f"its datum {datum.name} is the face itself"
    more = (f"only its first datum {tolerance.datums[0]} is used",) if len(datums) > 1 else ()
    return Zone(kind, side, (datum,), more)


def _frame(tolerance: GeometricTolerance, datums: Sequence[Side | None]) -> tuple[Side, ...] | str:
    """Return three datums that define a frame, or the condition that is not met."""
    frame_datums = [datum for datum in datums if datum is not None]
    surfaces: list[Datum] = [datum.surface for datum in frame_datums if not isinstance(datum.surface, Sphere)]
    if len(tolerance.datums) != 3 or len(surfaces) != 3 or len({datum.faces for datum in frame_datums}) != 3:
        return "three datums that are planes or axes"
    return frame_fault(surfaces) or tuple(frame_datums)


def middle_outline(side: Side, spread: np.ndarray) -> np.ndarray:
    """Project points (k, 3) [mm] of a side's outline onto its mid-plane."""
    surface = side.surface
    assert isinstance(surface, Plane)
    return np.asarray(spread - np.outer((spread - surface.point) @ surface.normal, surface.normal))
