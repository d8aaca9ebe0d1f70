"""Describe the optical properties of samples at the sensor's wavelength, and compare them with those of a surface.

A drawing states Ra and process. A sensor responds to the width of the lobe, the share of light at wide angles, and the
reflectance. A map therefore identifies its samples by these: two surfaces that agree in all of them are equal for the
sensor, whatever their names.

A sample is *as made* if its optical properties follow from its finish and Ra alone, by the laws of
:mod:`mitsim.scene.surface`. A third surface between two as-made samples of one finish follows the same laws, so a map
may interpolate by Ra. A lobe from another source (a trace, a gloss, alpha itself) has no such neighbours: it equals a
sample, or it is unknown to the map.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np

from characterisation.files.datasets import Variable

if TYPE_CHECKING:
    import xarray as xr

#: two surfaces are optically equal if all numbers agree within this share. Assumed: a tenth of the uncertainty of the
#: renderer's laws for a well-known finish
SAME = 0.01

#: the same of shares of light near 0, as a difference [1]. Widths and heights near 0 are of narrow lobes, which differ
SAME_NEAR_ZERO = 0.002

#: numbers that are shares of light
_SHARES = ("reflectance", "wide_angle", "beckmann")


@dataclass(frozen=True)
class Light:
    """Optical properties of a surface at one wavelength; shares and alphas are [1], NaN where not applicable.

    Parameters
    ----------
    kind
        ``metal``, ``gloss_paint``, ``powder_coat`` or ``matt``: the kind of lobe, and whether light enters the
        material.
    reflectance, wide_angle
        At normal incidence, of a metal, or of the body under a coat; share of it that leaves at wide angles.
    alpha_u, alpha_v
        Width of the lobe along u and v, Beckmann's alpha; they differ where the face has a lay.
    beckmann, mirror_u, mirror_v
        Share of Beckmann in the lobe, whose rest has the long tail of GGX; width of the mirror-like part.
    height_um
        Rms height Rq [um], which determines the share of the mirror-like part, and speckle.
    as_made
        Whether finish and Ra alone determine these numbers.
    """

    kind: str
    reflectance: float
    wide_angle: float
    alpha_u: float
    alpha_v: float
    beckmann: float
    mirror_u: float
    mirror_v: float
    height_um: float
    as_made: bool = True

    @property
    def has_lay(self) -> bool:
        """Return whether the lobe is wider along one direction of the face than along the other."""
        return self.alpha_u != self.alpha_v and not math.isnan(self.alpha_u)

    def numbers(self) -> tuple[float, ...]:
        """Return all fields except ``kind`` and ``as_made``, in the order of :data:`NUMBERS`."""
        return tuple(float(getattr(self, name)) for name in NUMBERS)

    def __str__(self) -> str:
        return f"{self.kind}, {self.in_words()}"

    def in_words(self) -> str:
        """Describe the numbers in words, without the kind."""
        widths = f"{self.alpha_u:.3g}" + (f" and {self.alpha_v:.3g}" if self.has_lay else "")
        lobe = "" if math.isnan(self.alpha_u) else f", alpha {widths}"
        return f"reflectance {self.reflectance:.3g}, {self.wide_angle:.3g} at wide angles{lobe}"


NUMBERS = tuple(field.name for field in fields(Light) if field.name not in ("kind", "as_made"))

#: variables of a map by field: name, unit, long name
VARIABLES: dict[str, tuple[str, str, str]] = {
    "kind": ("light_kind", "", "kind of lobe: metal, gloss_paint, powder_coat or matt; empty where unknown"),
    "as_made": ("light_as_made", "1", "whether finish and Ra alone determine the optical properties"),
    "reflectance": ("light_reflectance", "1", "reflectance at normal incidence; of a coat, that of its body"),
    "wide_angle": ("light_wide_angle", "1", "share of the reflected light at wide angles"),
    "alpha_u": ("light_alpha_u", "1", "width of the lobe along u, Beckmann's alpha"),
    "alpha_v": ("light_alpha_v", "1", "width of the lobe along v"),
    "beckmann": ("light_beckmann", "1", "share of Beckmann in the lobe"),
    "mirror_u": ("light_mirror_u", "1", "width of the mirror-like part along u"),
    "mirror_v": ("light_mirror_v", "1", "width of the mirror-like part along v"),
    "height_um": ("light_height", "um", "rms height Rq"),
}

#: variables in the file of a map
SCHEMA = {
    "light_kind": Variable(("sample",), "text", needed=False),
    "light_as_made": Variable(("sample",), "truth", needed=False),
    **{VARIABLES[name][0]: Variable(("sample",), low=0.0, high=1e3, gaps=True, needed=False) for name in NUMBERS},
}


def same_light(light: Light, other: Light) -> bool:
    """Return whether two surfaces have equal optical properties, within :data:`SAME`."""
    return lies_between(light, other, other)


def lies_between(light: Light, low: Light, high: Light) -> bool:
    """Return whether each number of a surface lies between those of two others, within :data:`SAME`."""
    return light.kind == low.kind == high.kind and all(
        _near(name, *(getattr(one, name) for one in (light, low, high))) for name in NUMBERS
    )


def _near(name: str, number: float, *ends: float) -> bool:
    if math.isnan(number):
        return all(math.isnan(end) for end in ends)
    near_zero = name in _SHARES and abs(number) < SAME_NEAR_ZERO / SAME
    slack = SAME_NEAR_ZERO if near_zero else SAME * abs(number)
    return min(ends) - slack <= number <= max(ends) + slack


def light_variables(lights: Sequence[Light | None]) -> dict[str, tuple[str, Any, dict[str, str]]]:
    """Return the variables of a map with the optical properties of its samples; None where they are unknown."""
    out: dict[str, tuple[str, Any, dict[str, str]]] = {}
    for field, (name, units, description) in VARIABLES.items():
        attributes = {"long_name": description} | ({"units": units} if units else {})
        if field == "kind":
            values: Any = np.array(["" if light is None else light.kind for light in lights], dtype=str)
        elif field == "as_made":
            values = np.array([light is not None and light.as_made for light in lights], np.int8)
        else:
            values = np.array([math.nan if light is None else getattr(light, field) for light in lights], float)
        out[name] = ("sample", values, attributes)
    return out


def lights_of(data: xr.Dataset) -> list[Light | None]:
    """Return the optical properties of each sample of a map; None where the map does not contain them."""
    count = data.sizes["sample"]
    if any(name not in data.variables for name in SCHEMA):
        return [None] * count
    columns = [data[name].values.tolist() for name, _, _ in VARIABLES.values()]
    rows = (dict(zip(VARIABLES, row, strict=True)) for row in zip(*columns, strict=True))
    return [Light(**row | {"as_made": bool(row["as_made"])}) if row["kind"] else None for row in rows]
