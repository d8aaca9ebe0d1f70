"""Dimensions, geometric tolerances and datums of a drawing, as a STEP file has them."""

from __future__ import annotations

from dataclasses import dataclass, field

#: note of a tolerance whose zone is not centred on the surface
UNEQUAL = "its zone lies unequally about the surface"

#: note of a tolerance whose zone lies outside the feature
PROJECTED = "its zone is projected out of the feature"

#: note of a tolerance whose zone has an orientation plane, intersection plane or direction feature
DIRECTED = "its zone has a direction of its own"

#: note of a tolerance whose faces have one zone together
COMMON = "common zone"

#: end of the note of a fit that leaves its dimension without limits
NO_LIMITS = "has no limits here: ISO 286-1 has none for this size, or mitsim does not know its class"


@dataclass(frozen=True)
class DrawnTarget:
    """The object of a dimension, tolerance or datum: faces by number, and anything else by its type.

    ``of_size``: whether a tolerance is given to the size of the faces, so that it applies to their axis or mid-plane.
    """

    faces: tuple[int, ...] = ()
    other_types: tuple[str, ...] = ()
    of_size: bool = False


@dataclass(frozen=True)
class Dimension:
    """A size or location: its ``kind`` as in the file, values in mm or deg, limits about the nominal value.

    ``second``: the other end of a location; ``angular``: whether values are angles; ``notes``: further data of the
    file, such as a fit.
    """

    number: int
    kind: str
    first: DrawnTarget
    second: DrawnTarget | None
    nominal: float | None
    limits: tuple[float, float] | None
    angular: bool
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class GeometricTolerance:
    """A geometric tolerance: width or diameter of its ``zone`` [mm], letters of its datums in order."""

    number: int
    name: str
    kind: str
    zone: float | None
    target: DrawnTarget
    datums: tuple[str, ...]
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class ProductInformation:
    """All product information, in the file's order; ``unread``: sentences about information that is not read."""

    dimensions: list[Dimension] = field(default_factory=list)
    tolerances: list[GeometricTolerance] = field(default_factory=list)
    datums: dict[str, DrawnTarget] = field(default_factory=dict)
    unread: list[str] = field(default_factory=list)

    @property
    def found(self) -> bool:
        """Return whether the file has any product information."""
        return bool(self.dimensions or self.tolerances or self.datums or self.unread)
