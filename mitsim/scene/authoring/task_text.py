"""Write the task of a part as TOML: its drawn or recognised features, and the measurements of the drawing."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from characterisation.features.surfaces import Cone, Cylinder, Plane, Sphere
from characterisation.features.vectors import tangents
from characterisation.files.arrays import Floats
from mitsim.scene.authoring.drawing_task import DrawnTask
from mitsim.scene.authoring.drawn_zones import middle_outline
from mitsim.scene.authoring.face import Face

#: kinds of face that a task supports
MEASURED = (Plane, Cylinder, Sphere, Cone)

#: number of directions whose farthest points give the outline of a face
_DIRECTIONS = 8


def outline(face: Face) -> Floats:
    """Return points (k, 3) [mm] on a surface that span a face: corners of a plane, the two ends of an axis."""
    surface = face.surface
    if isinstance(surface, Plane):
        basis = tangents(surface.normal)
        flat = (face.vertices - surface.point) @ basis.T
        # rotated off the axes, so that each corner of a rectangle is farthest in some direction
        angle = 2 * np.pi * (np.arange(_DIRECTIONS) + 0.3) / _DIRECTIONS
        far = (flat @ np.stack([np.cos(angle), np.sin(angle)])).argmax(axis=0)
        return np.asarray(surface.point + flat[list(dict.fromkeys(far.tolist()))] @ basis)
    if isinstance(surface, Cylinder | Cone):
        along = (face.vertices - surface.point) @ surface.axis
        return np.asarray(surface.point + np.outer([along.min(), along.max()], surface.axis))
    return np.empty((0, 3))


def feature_keys(face: Face) -> dict[str, Any]:
    """Return the keys of a face's feature in a task; empty for faces that no task measures."""
    surface = face.surface
    if isinstance(surface, Sphere):
        return {"kind": "sphere", "point_mm": numbers(surface.centre), "radius_mm": number(surface.radius)}
    if not isinstance(surface, Plane | Cylinder | Cone):
        return {}
    along = surface.normal if isinstance(surface, Plane) else surface.axis
    keys: dict[str, Any] = {"kind": surface.kind, "point_mm": numbers(surface.point), "direction": numbers(along, 7)}
    if isinstance(surface, Cylinder | Cone):
        keys["radius_mm"] = number(surface.radius)
    if isinstance(surface, Cone):
        keys["half_angle_deg"] = number(float(np.rad2deg(surface.half_angle)), 5)
    spread = outline(face)
    if len(spread) >= (3 if isinstance(surface, Plane) else 2):
        keys["outline_mm"] = [numbers(point) for point in spread]
    return keys


def task_toml(faces: Sequence[Face], name: str, drawing: DrawnTask | None = None) -> str:
    """Return the features of a part as TOML, with the drawing's measurements, or with an example as a comment."""
    lines = [
        f"# Features of {name}.xml, as mitsim part read them: geometry in the part frame, in mm.",
        "# Keep the features that you measure, delete the rest; a study needs at least one measurement:",
        "# docs/reference/formats/task.md",
        "",
    ]
    if drawing is not None:
        lines += [f"# {line}".rstrip() for line in drawing.remarks()] + [""]
    measured = drawing.measurements if drawing else {}
    if not measured:
        lines += _example(faces)
    fitted_faces = [face for face in faces if isinstance(face.surface, MEASURED)]
    if not fitted_faces:
        lines += ["# No plane, cylinder, cone or sphere was recognised.", "[features]", ""]
    for face in fitted_faces:
        datum = drawing.datum_of(face.name) if drawing else ""
        lines += [
            f"[features.{_key(face.name)}]{f'  # datum {datum}' if datum else ''}",
            *toml_lines(feature_keys(face)),
            "",
        ]
    for title, side in (drawing.middles if drawing else {}).items():
        spread = middle_outline(side, outline(side.of[0]))
        keys = {"kind": "mid_plane", "of": [face.name for face in side.of], "outline_mm": [numbers(p) for p in spread]}
        lines += [f"[features.{_key(title)}]", *toml_lines(keys), ""]
    for title, measurement in measured.items():
        lines += [
            f"[measurements.{_key(title)}]",
            *(f"# {line}" for line in measurement.remarks),
            *toml_lines(measurement.keys()),
            "",
        ]
    return "\n".join(lines)


def toml_lines(keys: dict[str, Any]) -> list[str]:
    """Return keys as TOML."""
    return [f"{key} = {_toml(value)}" for key, value in keys.items()]


def _key(name: str) -> str:
    """Return a name as a key; TOML wants quotes around letters beyond ASCII."""
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else _toml(name)


def _toml(value: Any) -> str:
    if isinstance(value, str):
        return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
    if isinstance(value, list | tuple):
        return f"[{', '.join(_toml(item) for item in value)}]"
    return str(value)


def _example(faces: Sequence[Face]) -> list[str]:
    first = next((face for face in faces if isinstance(face.surface, Cylinder | Sphere)), None)
    if first is None or not isinstance(first.surface, Cylinder | Sphere):
        return ["# Measurements between planes: see docs/reference/formats/task.md.", ""]
    return [
        f"# [measurements.{_key(f'{first.name}_radius')}]",
        '# kind = "radius"',
        f'# features = ["{first.name}"]',
        f"# nominal = {number(first.surface.radius)}",
        '# unit = "mm"',
        "",
    ]


def numbers(values: NDArray[np.floating], decimals: int = 4) -> list[float]:
    """Round lengths to 0.1 um."""
    return [number(float(value), decimals) for value in values]


def number(value: float, decimals: int = 4) -> float:
    """Round a length to 0.1 um, the precision of a mesh file in single precision."""
    return round(float(value), decimals) + 0.0
