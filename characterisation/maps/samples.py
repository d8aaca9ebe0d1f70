"""Which samples of a map answer for a surface: the same to light, or between two of its own finish.

Signal chain: finish, Ra and what light sees of a surface -> the sample that is the same to light, whatever either is
called; or two samples of its finish between which it lies, all of them as made; or a refusal that says what is known.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from characterisation.errors import InputError, nearest
from characterisation.maps.light import Light, lies_between, same_light

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Samples:
    """The samples of a map: finish ``names``, ``roughness`` Ra (n,) [um] or NaN, and what light sees of each.

    ``where`` names the map in messages.
    """

    names: Sequence[str]
    roughness: Floats
    lights: Sequence[Light | None]
    where: str

    @property
    def finishes(self) -> list[str]:
        """Names of the finishes, each once."""
        return list(dict.fromkeys(self.names))

    def told(self) -> str:
        """What is known, in words: finishes with the range of their Ra."""
        out = []
        for name in self.finishes:
            rough = self.roughness[[i for i, one in enumerate(self.names) if one == name]]
            ends = (
                ""
                if np.isnan(rough).any()
                else f" Ra {rough.min():g}" + (f" to {rough.max():g}" if len(rough) > 1 else "") + " um"
            )
            out.append(name + ends)
        return ", ".join(out)

    def answering(self, finish: str, roughness: float, light: Light | None = None) -> tuple[list[int], float]:
        """Numbers of the samples that answer for a surface, by Ra, and the Ra [um] to look up among them.

        With ``light`` a surface is the same as a sample, whatever either is called (the Ra is NaN then); or it lies
        between two samples of its finish, all of them as made. Without, finish and Ra alone decide; so they do for
        samples of which a map does not know what light sees, if the surface is as made.

        Raises
        ------
        InputError
            If the surface was not characterised.
        """
        if light is None:
            members = self.members(finish)
        else:
            for number, known in enumerate(self.lights):
                if known is not None and same_light(known, light):
                    return [number], math.nan
            members = self._family(finish, roughness, light)
        rough = self.roughness[members]
        if math.isnan(rough[0]):
            return members[:1], math.nan
        self._check_roughness(finish, float(roughness), rough)
        if light is not None:
            self._check_between(finish, float(roughness), light, members)
        return members, float(roughness)

    def members(self, finish: str) -> list[int]:
        """Numbers of the samples of a finish, by Ra; the first of each Ra.

        Raises
        ------
        InputError
            If it was not characterised.
        """
        members: dict[str, int] = {}
        for i, name in enumerate(self.names):
            if name == finish:
                members.setdefault(str(self.roughness[i]), i)
        if not members:
            hint = nearest(finish, self.finishes)
            raise InputError(self.where, "finish", repr(finish), ", ".join(self.finishes), hint)
        return sorted(members.values(), key=lambda i: self.roughness[i])

    def _family(self, finish: str, roughness: float, light: Light) -> list[int]:
        """Samples of a finish between which a surface may lie, by Ra: as made, as it is itself."""
        alike = list[int]()
        for number in self.members(finish) if light.as_made else ():
            sample = self.lights[number]
            if sample is None or (sample.as_made and not math.isnan(self.roughness[number])):
                alike.append(number)
        if not alike:
            told = finish if math.isnan(roughness) else f"{finish} Ra {roughness:g} um"
            known = "; ".join(str(self.lights[i] or "not known to light") for i in self.members(finish))
            raise InputError(
                self.where,
                "finish",
                f"{told} ({light})",
                f"samples of {finish}: {known}",
                "a map answers for what it was made of: characterise this finish",
            )
        return alike

    def _check_between(self, finish: str, roughness: float, light: Light, members: list[int]) -> None:
        """Refuse a surface that does not lie, to light, between its neighbours by Ra: laws may have changed."""
        upper = min(int(np.searchsorted(self.roughness[members], roughness * (1 - 1e-6))), len(members) - 1)
        low, high = self.lights[members[max(upper - 1, 0)]], self.lights[members[upper]]
        if low is not None and high is not None and not lies_between(light, low, high):
            raise InputError(
                self.where,
                "finish",
                f"{finish} Ra {roughness:g} um ({light})",
                f"what lies between its neighbours: {low}, and {high}",
                "characterise this finish",
            )

    def _check_roughness(self, finish: str, roughness: float, known: Floats) -> None:
        if not known[0] * (1 - 1e-6) <= roughness <= known[-1] * (1 + 1e-6):
            allowed = f"{known[0]:g} to {known[-1]:g} um, the range that was characterised for {finish}"
            raise InputError(self.where, "Ra", f"{roughness:g} um", allowed, "characterise a sample beyond it")
