"""Read the unit of length that a part's file states.

- 3MF: the attribute ``unit`` of its model, millimetres without one (3MF Core Specification 1.3, section 3.4).
- glTF: metres by definition (glTF 2.0, section 3.4).
- STEP: the units that its contexts assign (ISO 10303-41, ``global_unit_assigned_context``).
- STL, OBJ, PLY, OFF: their formats have no unit; some programs write one in a comment, as in ``# File units = inches``.
"""

from __future__ import annotations

import math
import re
from typing import Any

from mitsim.scene.authoring.part21 import Entity, Enumeration, Reference, StepText, Typed
from mitsim.sensor.calibration_qualifiers import LENGTHS_MM, UNITS_MM

#: head of a file in which a comment may state the unit [bytes]
_HEAD = 4096

_COMMENT = {".obj": rb"#", ".off": rb"#", ".ply": rb"comment|obj_info", ".stl": rb"solid"}
#: a unit after the word ``unit``, or before ``as unit``; ``in`` is the inch only after = or :
_STATEMENT = re.compile(
    r"\bunits?\b(?:\s+(?:is|are)\b)?(?:\s+in\b)?(?:\s*[=:]\s*[\"'(\[]*([a-z]+)|\s*[\"'(\[]*(?!in\b)([a-z]+))"
    r"|\b([a-z]+) as units?\b"
)

_PREFIX = {
    "EXA": 1e18,
    "PETA": 1e15,
    "TERA": 1e12,
    "GIGA": 1e9,
    "MEGA": 1e6,
    "KILO": 1e3,
    "HECTO": 1e2,
    "DECA": 10.0,
    "DECI": 0.1,
    "CENTI": 0.01,
    "MILLI": 1e-3,
    "MICRO": 1e-6,
    "NANO": 1e-9,
}
_DEEPEST = 20


def unit_words(size_mm: float) -> str:
    """Return the name of a unit of ``size_mm``, as an option names it; else its size in mm."""
    return next((name for name, size in LENGTHS_MM.items() if math.isclose(size, size_mm)), f"{size_mm:g} mm")


def unit_assumed(name: str) -> str:
    """Return the remark about the file ``name`` that states no unit of length."""
    return f"{name} states no unit of length: mm assumed; --units inch, for example, changes it"


def commented_unit(suffix: str, data: bytes) -> float | None:
    """Return the unit [mm] in a comment at the head of an STL, OBJ, PLY or OFF file; None without one."""
    mark, head = _COMMENT.get(suffix), data[:_HEAD]
    if mark is None:
        return None
    if suffix == ".ply":
        head = head.partition(b"end_header")[0]
    lines = head.splitlines()
    if suffix == ".stl":  # the name of the solid, or the free text at the head of a binary file
        lines = [b"solid " + b" ".join(head[:80].split())]
    for line in lines:
        if re.match(mark, line.strip()):
            for statement in _STATEMENT.finditer(line.decode("ascii", "replace").lower()):
                size = UNITS_MM.get(next(filter(None, statement.groups())))
                if size is not None:
                    return size
    return None


def step_units(text: StepText) -> list[float]:
    """Return the units of length [mm] that the contexts of a STEP file assign, each once."""
    sizes: dict[float, None] = {}
    for context in text.all("GLOBAL_UNIT_ASSIGNED_CONTEXT"):
        for values in context.of("GLOBAL_UNIT_ASSIGNED_CONTEXT") or ():
            for reference in values if isinstance(values, tuple) else ():
                unit = text.follow(reference)
                size = unit_size(text, reference) if unit is not None and _is_length(unit) else None
                if size is not None:
                    sizes[round(size, 9)] = None
    return list(sizes)


def stated_units(text: StepText) -> str:
    """Return the units of length that a STEP file states, in words; an empty text without one."""
    return " and ".join(map(unit_words, step_units(text)))


def _is_length(unit: Entity) -> bool:
    si = unit.of("SI_UNIT")
    metre = si is not None and any(isinstance(value, Enumeration) and value.name == "METRE" for value in si)
    return unit.has("LENGTH_UNIT") or metre


def unit_size(text: StepText, reference: Any, depth: int = 0) -> float | None:
    """Return the size of a STEP file's unit in mm or deg; None for other units or none."""
    entity = text.follow(reference)
    if entity is None or depth > _DEEPEST:
        return None
    converted = entity.of("CONVERSION_BASED_UNIT")
    if converted is not None:
        base = text.follow(converted[1]) if len(converted) > 1 else None
        values = [value for part in base.parts for value in part.values] if base else []
        plain = [
            v.values[0] if isinstance(v, Typed) and v.values else v for v in values
        ]  # some programs leave the type
        factor = next((v for v in plain if isinstance(v, float)), None)
        inner = unit_size(text, next((v for v in values if isinstance(v, Reference)), None), depth + 1)
        return None if factor is None or inner is None else factor * inner
    si = entity.of("SI_UNIT")
    if si is None:
        return None
    prefix, name = ([value.name if isinstance(value, Enumeration) else "" for value in si[-2:]] + ["", ""])[:2]
    base_unit = {"METRE": 1e3, "RADIAN": math.degrees(1.0)}.get(name)
    return None if base_unit is None else base_unit * _PREFIX.get(prefix, 1.0)
