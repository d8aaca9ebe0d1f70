"""Read dimensions, tolerances and datums of a STEP file (PMI of AP242 and AP203e2) from its entities.

Signal chain: entities of the text (:mod:`mitsim.scene.authoring.part21`) -> dimensions with their values and limits,
tolerances with their zones, datums with their letters -> the faces of each, by the number of their entity.

Follows the CAx-IF "Recommended Practices for the Representation and Presentation of Product Manufacturing Information
(PMI) (AP242)", version 4.0, sections 5 (dimensions) and 6 (tolerances and datums).
"""

from __future__ import annotations

from collections import defaultdict
from typing import Any

from mitsim.scene.authoring.drawn_characteristics import (
    DIRECTED,
    NO_LIMITS,
    PROJECTED,
    UNEQUAL,
    Dimension,
    DrawnTarget,
    GeometricTolerance,
    ProductInformation,
)
from mitsim.scene.authoring.fits import fit_deviations
from mitsim.scene.authoring.part21 import Entity, Enumeration, Reference, StepText, Typed
from mitsim.scene.authoring.units import unit_size

_KINDS = (
    "flatness straightness roundness cylindricity parallelism perpendicularity angularity position coaxiality "
    "concentricity symmetry circular_runout total_runout line_profile surface_profile"
)

#: geometric tolerances by the type of their entity
TOLERANCES = {f"{name.upper()}_TOLERANCE": name.replace("_", " ") for name in _KINDS.split()}
_SIZES = ("DIMENSIONAL_SIZE", "ANGULAR_SIZE", "DIMENSIONAL_SIZE_WITH_PATH", "DIMENSIONAL_SIZE_WITH_DATUM_FEATURE")
_LOCATIONS = (
    "DIMENSIONAL_LOCATION",
    "ANGULAR_LOCATION",
    "DIRECTED_DIMENSIONAL_LOCATION",
    "DIMENSIONAL_LOCATION_WITH_PATH",
)
_RELATIONS = (
    "SHAPE_ASPECT_RELATIONSHIP",
    "SHAPE_DEFINING_RELATIONSHIP",
    "SHAPE_ASPECT_DERIVING_RELATIONSHIP",
    "FEATURE_FOR_DATUM_TARGET_RELATIONSHIP",
)
_USAGES = ("GEOMETRIC_ITEM_SPECIFIC_USAGE", "ITEM_IDENTIFIED_REPRESENTATION_USAGE")
_FACES = ("ADVANCED_FACE", "FACE_SURFACE")
_TARGETS = ("DATUM_TARGET", "PLACED_DATUM_TARGET_FEATURE")
_TEXTURES = ("SURFACE_TEXTURE_REPRESENTATION",)
_MODIFIERS = ("GEOMETRIC_TOLERANCE_WITH_MODIFIERS", "MODIFIED_GEOMETRIC_TOLERANCE")
_RESTRICTIONS = {
    "UNEQUALLY_DISPOSED_GEOMETRIC_TOLERANCE": UNEQUAL,
    "GEOMETRIC_TOLERANCE_WITH_DEFINED_UNIT": "it holds for each length of the feature",
    "GEOMETRIC_TOLERANCE_WITH_DEFINED_AREA_UNIT": "it holds for each area of the feature",
    "GEOMETRIC_TOLERANCE_WITH_MAXIMUM_TOLERANCE": "its zone has a maximum",
}
_ZONES = (
    "TOLERANCE_ZONE",
    "DIRECTED_TOLERANCE_ZONE",
    "ORIENTED_TOLERANCE_ZONE",
    "DIRECTION_FEATURE_TOLERANCE_ZONE",
    "TOLERANCE_ZONE_WITH_DATUM",
)
_DEEPEST = 20


def read_product_information(text: StepText) -> ProductInformation:
    """Read dimensions, tolerances and datums of a STEP file."""
    reader = _Reader(text)
    dimensions = [reader.dimension(entity) for entity in text.all(*_SIZES, *_LOCATIONS)]
    tolerances = [reader.tolerance(entity) for entity in text.all(*TOLERANCES)]
    return ProductInformation(dimensions, tolerances, reader.datums(), reader.unread())


def _tolerance_class(fit: tuple[Any, ...]) -> str:
    """Return the class of a fit: its letters in capitals for a hole, and its grade, which may stand with them."""
    letter, of, grade = (word if isinstance(word, str) else "" for word in (*fit, None, None, None)[:3])
    letter = {"hole": letter.upper(), "shaft": letter.lower()}.get(of.strip().lower(), letter)
    return letter + grade


class _Reader:
    """Follows references of one file."""

    def __init__(self, text: StepText) -> None:
        self.text = text
        self.items: dict[int, list[Any]] = defaultdict(list)  # by shape aspect
        for usage in text.all(*_USAGES):
            values = usage.of(*_USAGES) or ()
            if len(values) >= 5 and isinstance(values[2], Reference):
                self.items[values[2].number].append(values[4])
        self.members: dict[int, list[int]] = defaultdict(list)  # relating -> related
        self.owners: dict[int, list[int]] = defaultdict(list)  # related -> relating
        for relation in text.all(*_RELATIONS):
            values = relation.of(*_RELATIONS) or ()
            ends = [value.number for value in values[2:4] if isinstance(value, Reference)]
            if len(ends) == 2 and not relation.has(*_LOCATIONS):
                self.members[ends[0]].append(ends[1])
                self.owners[ends[1]].append(ends[0])
        self.values: dict[int, list[Entity]] = defaultdict(list)  # by dimension
        for link in text.all("DIMENSIONAL_CHARACTERISTIC_REPRESENTATION"):
            of, by = (*(link.of("DIMENSIONAL_CHARACTERISTIC_REPRESENTATION") or ()), None, None)[:2]
            shown = text.follow(by)
            if isinstance(of, Reference) and shown is not None:
                self.values[of.number].append(shown)
        self.limits: dict[int, Entity] = {}
        for limit in text.all("PLUS_MINUS_TOLERANCE"):
            by, of = (*(limit.of("PLUS_MINUS_TOLERANCE") or ()), None, None)[:2]
            band = text.follow(by)
            if isinstance(of, Reference) and band is not None:
                self.limits[of.number] = band
        self.zones: dict[int, str] = {}  # form of the zone, by tolerance
        definitions = [
            definition.of("TOLERANCE_ZONE_DEFINITION", "PROJECTED_ZONE_DEFINITION") or (None,)
            for definition in text.all("PROJECTED_ZONE_DEFINITION")
        ]
        projected = {values[0].number for values in definitions if values and isinstance(values[0], Reference)}
        self.projected: set[int] = set()  # tolerances
        self.directed: set[int] = set()  # tolerances
        for zone in text.all(*_ZONES):
            values = zone.of(*_ZONES) or ()
            of, form = (None, None, *(values[4:6] if len(values) >= 6 else values))[-2:]
            shape = text.follow(form)
            zone_form = shape.of("TOLERANCE_ZONE_FORM") if shape else None
            members = {
                member.number for member in (of if isinstance(of, tuple) else ()) if isinstance(member, Reference)
            }
            if zone_form and isinstance(zone_form[0], str):
                self.zones |= dict.fromkeys(members, zone_form[0])
            self.projected |= members if zone.number in projected else set()
            self.directed |= members if zone.has(*_ZONES[1:]) else set()

    def target(self, reference: Any) -> DrawnTarget:
        """Return the object of a shape aspect, through its members and the aspects it was derived from."""
        faces: dict[int, None] = {}
        other_types: dict[str, None] = {}
        seen: set[int] = set()

        def item(value: Any, depth: int) -> None:
            if isinstance(value, tuple):
                for member in value:
                    item(member, depth)
            elif isinstance(value, Typed):
                item(value.values, depth)
            elif (entity := self.text.follow(value)) is not None:
                if entity.has(*_FACES):
                    faces[entity.number] = None
                else:
                    other_types[entity.types.replace("_", " ").lower()] = None

        def aspect(number: int, depth: int) -> None:
            if number in seen or depth > _DEEPEST:
                return
            seen.add(number)
            for item_reference in self.items.get(number, ()):
                item(item_reference, depth)
            for member in self.members.get(number, ()):
                aspect(member, depth + 1)
            entity = self.text.entity(number)
            size = entity.of(*_SIZES) if entity else None  # a tolerance may refer to a size instead of a shape
            if size and isinstance(size[0], Reference):
                aspect(size[0].number, depth + 1)

        if isinstance(reference, Reference):
            aspect(reference.number, 0)
        of = self.text.follow(reference)
        return DrawnTarget(tuple(faces), tuple(other_types), of is not None and of.has(*_SIZES))

    def dimension(self, entity: Entity) -> Dimension:
        """Read one size or location."""
        size = entity.of("DIMENSIONAL_SIZE", *_SIZES)
        second, angular = None, entity.has("ANGULAR_SIZE", "ANGULAR_LOCATION")
        if size is not None:
            first = self.target(size[0] if size else None)
            name = size[1] if len(size) > 1 and isinstance(size[1], str) else ""
        else:
            values = entity.of("SHAPE_ASPECT_RELATIONSHIP") or entity.of(*_LOCATIONS) or ()
            name = values[0] if values and isinstance(values[0], str) else ""
            first, second = (self.target(aspect) for aspect in (*values[2:4], None, None)[:2])
        kind = name.strip().lower() or ("angle" if angular else "size" if second is None else "linear distance")
        measured: dict[str, float] = {}
        notes: list[str] = []
        for shown in self.values.get(entity.number, ()):
            parts = shown.of("SHAPE_DIMENSION_REPRESENTATION", "REPRESENTATION") or ()
            for reference in parts[1] if len(parts) > 1 and isinstance(parts[1], tuple) else ():
                self.value(reference, measured, notes)
        nominal = measured.get("nominal")
        limits = (measured["lower"], measured["upper"]) if {"lower", "upper"} <= set(measured) else None
        if nominal is None and limits is not None:
            nominal = sum(limits) / 2
        band = self.limits.get(entity.number)
        if band is not None and nominal is not None:
            if (ends := band.of("TOLERANCE_VALUE")) is not None:
                low, high = (self.measure(end) for end in (*ends, None, None)[:2])
                if low is not None and high is not None:
                    limits = (nominal + low, nominal + high)
            elif (fit := band.of("LIMITS_AND_FITS")) is not None:
                name = _tolerance_class(fit)
                ends = None if angular or "radius" in kind else fit_deviations(name, nominal)
                if ends is not None and limits is None:
                    limits = (nominal + ends[0], nominal + ends[1])
                notes.append(f"the fit {name}" if limits else f"the fit {name} {NO_LIMITS}")
        return Dimension(entity.number, kind, first, second, nominal, limits, angular, tuple(notes))

    def value(self, reference: Any, measured: dict[str, float], notes: list[str]) -> None:
        """Read one item of a dimension's values: nominal, upper or lower limit, or a note."""
        entity = self.text.follow(reference)
        if entity is None:
            return
        described = entity.of("DESCRIPTIVE_REPRESENTATION_ITEM")
        if described is not None:
            notes.append(" ".join(str(word) for word in described if word))
            return
        if entity.has("VALUE_RANGE"):  # its bounds stand in a list, which may name its type
            for value in (value for part in entity.parts for value in part.values):
                bounds = value.values[0] if isinstance(value, Typed) and value.values else value
                for bound in bounds if isinstance(bounds, tuple) else ():
                    self.value(bound, measured, notes)
            return
        name = next((v for part in entity.parts for v in part.values if isinstance(v, str)), "").lower()
        value = self.measure(reference)
        if value is not None:
            measured["lower" if "lower" in name else "upper" if "upper" in name else "nominal"] = value

    def measure(self, reference: Any) -> float | None:
        """Return a measure with its unit [mm or deg]; None if it is not a measure."""
        entity = self.text.follow(reference)
        if entity is None:
            return None
        values = [value for part in entity.parts for value in part.values]
        number = next((v for v in values if isinstance(v, Typed) and v.values and isinstance(v.values[0], float)), None)
        if number is None:
            return None
        unit = next((v for v in values if isinstance(v, Reference)), None)
        scale = unit_size(self.text, unit)
        return None if scale is None else float(number.values[0]) * scale

    def tolerance(self, entity: Entity) -> GeometricTolerance:
        """Read one geometric tolerance."""
        kind = next(TOLERANCES[part.type] for part in entity.parts if part.type in TOLERANCES)
        values = entity.of("GEOMETRIC_TOLERANCE") or next(p.values for p in entity.parts if p.type in TOLERANCES)
        values = (*values, None, None, None, None)
        name = values[0] if isinstance(values[0], str) else ""
        referred = entity.of("GEOMETRIC_TOLERANCE_WITH_DATUM_REFERENCE")
        named = referred[0] if referred else values[4] if len(entity.parts) == 1 else None
        notes = [note for kind_, note in _RESTRICTIONS.items() if entity.has(kind_)]
        for modifiers in (entity.of(kind_) for kind_ in _MODIFIERS):
            words = [
                w.name
                for v in modifiers or ()
                for w in (v if isinstance(v, tuple) else (v,))
                if isinstance(w, Enumeration)
            ]
            notes += [word.replace("_", " ").lower() for word in words]
        aspect = self.text.follow(values[3])
        if aspect is not None and aspect.has("ALL_AROUND_SHAPE_ASPECT"):
            notes.append("all around")
        if entity.number in self.zones:
            notes.append(f"zone: {self.zones[entity.number]}")
        notes += [PROJECTED] * (entity.number in self.projected) + [DIRECTED] * (entity.number in self.directed)
        letters = self.letters(named, 0)
        return GeometricTolerance(
            entity.number, name, kind, self.measure(values[2]), self.target(values[3]), letters, tuple(notes)
        )

    def letters(self, value: Any, depth: int) -> tuple[str, ...]:
        """Return the letters of the datums of a system in order; ``A-B`` for a common datum."""
        if depth > _DEEPEST:
            return ()
        if isinstance(value, tuple):
            references = [self.text.follow(reference) for reference in value]
            old = [reference for reference in references if reference is not None and reference.has("DATUM_REFERENCE")]
            if old and len(old) == len(references):  # older editions number datums instead of using datum systems
                numbered = [reference.of("DATUM_REFERENCE") or (0.0, None) for reference in old]
                ordered = sorted(numbered, key=lambda values: float(values[0] or 0.0))
                return tuple(letter for values in ordered for letter in self.letters(values[1], depth + 1))
            return tuple(letter for member in value for letter in self.letters(member, depth + 1))
        if isinstance(value, Typed):  # a common datum
            return ("-".join(self.letters(value.values, depth + 1)),)
        entity = self.text.follow(value)
        if entity is None:
            return ()
        datum = entity.of("DATUM")
        if datum is not None:
            return (str(datum[-1]),)
        system = entity.of("DATUM_SYSTEM")
        if system is not None:
            return self.letters(system[-1], depth + 1)
        part = entity.of("DATUM_REFERENCE_COMPARTMENT", "DATUM_REFERENCE_ELEMENT", "GENERAL_DATUM_REFERENCE")
        if part is not None and len(part) >= 2:
            bases = [base for base in part[-2:] if base is not None]
            return self.letters(bases[0], depth + 1) if bases else ()
        return ()

    def datums(self) -> dict[str, DrawnTarget]:
        """Return the datums by letter, with the faces of the features that carry them."""
        out: dict[str, DrawnTarget] = {}
        for datum in self.text.all("DATUM"):
            values = datum.of("DATUM") or ()
            if not values or not isinstance(values[-1], str):
                continue
            targets = [self.target(Reference(owner)) for owner in self.owners.get(datum.number, ())]
            faces = tuple(dict.fromkeys(face for target in targets for face in target.faces))
            other_types = tuple(dict.fromkeys(kind for target in targets for kind in target.other_types))
            out[values[-1]] = DrawnTarget(faces, other_types)
        return out

    def unread(self) -> list[str]:
        """Describe the information in the file that is not read."""
        out = []
        targets = sum(1 for _ in self.text.all(*_TARGETS))
        if targets:
            out.append(f"{targets} datum targets: mitsim uses whole faces as datums")
        textures = sum(1 for _ in self.text.all(*_TEXTURES))
        if textures:
            out.append(f"{textures} surface textures: give Ra in the scene")
        read_numbers = {
            entity.number for entity in self.text.all(*_SIZES, *_LOCATIONS, *TOLERANCES, "DATUM_FEATURE", "DATUM")
        }
        tied: set[int] = set()
        for link in self.text.all("DRAUGHTING_MODEL_ITEM_ASSOCIATION"):
            values = link.of("DRAUGHTING_MODEL_ITEM_ASSOCIATION") or ()
            if len(values) < 5 or not isinstance(values[2], Reference) or not isinstance(values[4], Reference):
                continue
            if values[2].number in read_numbers:
                tied.add(values[4].number)
        callouts = {entity.number for entity in self.text.all("DRAUGHTING_CALLOUT")}
        if callouts - tied:
            out.append(f"{len(callouts - tied)} annotations as graphics only: notes, or dimensions without values")
        return out
