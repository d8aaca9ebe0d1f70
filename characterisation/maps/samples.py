"""Find the samples of a map that represent a surface: one that is optically equal, or two of its finish about it.

Signal chain: finish, Ra and optical properties of a surface -> the sample with equal optical properties, whatever its
name; or two as-made samples of its finish between which it lies; or an error that lists the known samples.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from characterisation.files.arrays import Floats
from characterisation.files.errors import InputError, nearest
from characterisation.maps.light import Light, lies_between, same_light


@dataclass(frozen=True)
class Samples:
    """Samples of a map: finish ``names``, ``roughness`` Ra (n,) [um] or NaN, and optical properties ``lights`` of each.

    ``where`` names the map in messages.
    """

    names: Sequence[str]
    roughness: Floats
    lights: Sequence[Light | None]
    where: str

    @property
    def finishes(self) -> list[str]:
        """Return the names of the finishes, each once."""
        return list(dict.fromkeys(self.names))

    def in_words(self) -> str:
        """Describe the samples in words: finishes with the range of their Ra."""
        out = []
        for name in self.finishes:
            rough = self.roughness[[i for i, finish_name in enumerate(self.names) if finish_name == name]]
            ends = f"{rough.min():g}" + (f" to {rough.max():g}" if len(rough) > 1 else "")
            out.append(name if np.isnan(rough).any() else f"{name} Ra {ends} um")
        return ", ".join(out)

    def representing(self, finish: str, roughness: float, light: Light | None = None) -> tuple[list[int], float]:
        """Return the numbers of the samples that represent a surface, by Ra, and the Ra [um] to look up among them.

        With ``light``, a surface is represented by a sample with equal optical properties, whatever its name, and the
        Ra is NaN. Otherwise the surface must lie between two samples of its finish, all of them as made. Without
        ``light``, finish and Ra alone decide. They also decide for samples of unknown optical properties, if the
        surface is as made. Raises InputError if the surface was not characterised.
        """
        if light is None:
            members = self.members(finish)
        else:
            for number, sample_light in enumerate(self.lights):
                if sample_light is not None and same_light(sample_light, light):
                    return [number], math.nan
            members = self._family(finish, roughness, light)
        rough = self.roughness[members]
        if math.isnan(rough[0]):
            return members[:1], math.nan
        if not rough[0] * (1 - 1e-6) <= roughness <= rough[-1] * (1 + 1e-6):
            allowed = f"{rough[0]:g} to {rough[-1]:g} um, the characterised range of {finish}"
            raise InputError(self.where, "Ra", f"{roughness:g} um", allowed, "characterise a sample outside this range")
        if light is not None:
            self._check_between(finish, float(roughness), light, members)
        return members, float(roughness)

    def members(self, finish: str) -> list[int]:
        """Return the numbers of the samples of a finish, by Ra; the first of each Ra. InputError if there is none."""
        members: dict[str, int] = {}
        for i, name in enumerate(self.names):
            if name == finish:
                members.setdefault(str(self.roughness[i]), i)
        if not members:
            hint = nearest(finish, self.finishes)
            raise InputError(self.where, "finish", repr(finish), ", ".join(self.finishes), hint)
        return sorted(members.values(), key=lambda i: self.roughness[i])

    def _family(self, finish: str, roughness: float, light: Light) -> list[int]:
        """Return as-made samples of a finish, by Ra, between which a surface may lie if it is as made itself."""
        alike = list[int]()
        for number in self.members(finish) if light.as_made else ():
            sample = self.lights[number]
            if sample is None or (sample.as_made and not math.isnan(self.roughness[number])):
                alike.append(number)
        if not alike:
            asked = finish if math.isnan(roughness) else f"{finish} Ra {roughness:g} um"
            lights = "; ".join(str(self.lights[i] or "of unknown optical properties") for i in self.members(finish))
            hint = "a map holds only characterised finishes: characterise this finish"
            raise InputError(self.where, "finish", f"{asked} ({light})", f"samples of {finish}: {lights}", hint)
        return alike

    def _check_between(self, finish: str, roughness: float, light: Light, members: list[int]) -> None:
        """Reject a surface outside its neighbours by Ra, as after a change of the laws of the renderer."""
        upper = min(int(np.searchsorted(self.roughness[members], roughness * (1 - 1e-6))), len(members) - 1)
        low, high = self.lights[members[max(upper - 1, 0)]], self.lights[members[upper]]
        if low is not None and high is not None and not lies_between(light, low, high):
            found = f"{finish} Ra {roughness:g} um ({light})"
            allowed = f"optical properties between those of its neighbours: {low}, and {high}"
            raise InputError(self.where, "finish", found, allowed, "characterise this finish")
