"""Describe how a material scatters at one wavelength, and the uncertainty of that description."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Literal

import numpy as np

from characterisation.files.errors import InputError, nearest
from mitsim.scene.surface.coherence import lobe_numbers
from mitsim.scene.surface.microfacet import GGX_PER_BECKMANN
from mitsim.scene.surface.processes import LARGEST_WIDE_ANGLE, LAY_FACTOR, moved_odds

#: direction of the marks on a face: along its u, along its v, or none
Lay = Literal["u", "v", "none"]

#: width of the specular part, from form error and waviness of a real face. An ideal mirror would appear black under a
#: point-like projector. Assumed
ALPHA_FORM = 0.005


#: one-sigma factor of a surface's reflectance. Handbooks of optical constants differ by about 5 % in the reflectance of
#: one evaporated metal. Oxide, alloy and dirt add to that, and paint is specified no better. Assumed
REFLECTANCE_FACTOR = 1.05

#: largest reflectance of any surface [1]
LARGEST_REFLECTANCE = 0.99


@dataclass(frozen=True)
class Scatter:
    """Scattering of the light that a surface reflects, at one wavelength. Shares are [1].

    The share ``wide_angle`` of the reflected light is scattered as by a matt surface. Of the rest, the share A is in a
    narrow lobe and the remainder in a lobe of alpha_u, alpha_v, whose share ``beckmann`` is Beckmann and the rest GGX.
    A grows with the angle of incidence (:meth:`coherent_at`).
    """

    #: variance g of the phase at normal incidence [rad^2] in A = exp(-g); infinite if A is 0 at every angle
    phase_variance: float
    #: ``alpha_u``, ``alpha_v``: width of the incoherent lobe along u and v in Beckmann's sense: sqrt(2) times the rms
    #: slope. NaN if there is no such lobe
    alpha_u: float
    alpha_v: float
    beckmann: float  # share of Beckmann in the incoherent lobe
    height_um: float  # Rq that determines coherence and speckle [um]; NaN if light is scattered in the volume
    wide_angle: float  # share of all reflected light at wide angles
    wide_angle_range: tuple[float, float]  # its one-sigma range
    alpha_factor: float  # one-sigma factor of alpha, which lies between alpha / factor and alpha x factor
    provenance: str  # source of alpha, in words
    lay: Lay = "none"  # direction of the marks
    #: factors on the GGX and the Beckmann lobe that compensate the energy lost by single scattering
    energy_factor: tuple[float, float] = (1.0, 1.0)
    coherent_alpha: tuple[float, float] = (ALPHA_FORM, ALPHA_FORM)  # width of the coherent part along u and v
    depolarising: bool = False  # whether the wide-angle light was scattered inside the material (paint, white)
    beckmann_range: tuple[float, float] | None = None  # its one-sigma range
    #: angle of the lobe's u, along the marks, as of :mod:`mitsim.scene.turned_lay` [deg]; None where u is that of the
    #: shape
    turn_deg: float | None = None
    lay_open: bool = False  # whether there are marks whose direction is not given

    @property
    def coherent(self) -> float:
        """Return the share A [1] of the specular light that is coherent, at normal incidence."""
        return self.coherent_at(0.0)

    def coherent_at(self, incidence: float) -> float:
        """Return the share A [1] of the specular light that is coherent, at ``incidence`` [rad]."""
        return math.exp(-self.phase_variance * math.cos(incidence) ** 2)

    @property
    def lobe_numbers(self) -> tuple[float, float, float]:
        """Return the coefficients [1] of the factor that conserves the lobe's energy where A changes across it.

        See :mod:`mitsim.scene.surface.coherence`.
        """
        return lobe_numbers(self.phase_variance, self.alpha_u, self.alpha_v, self.beckmann, self.energy_factor)

    @property
    def ggx_alpha(self) -> tuple[float, float]:
        """Return the widths (u, v) of the GGX lobe with the same median slope as the Beckmann lobe."""
        return GGX_PER_BECKMANN * self.alpha_u, GGX_PER_BECKMANN * self.alpha_v


@dataclass(frozen=True)
class Deviation:
    """Deviation of the unknown properties of a finish from their best estimates, in standard deviations."""

    alpha: float = 0.0  # multiplies the width of the lobe by its one-sigma factor to this power
    #: the wide-angle share w is at the low end of its range at -1, at the high end at +1. The logarithm of its odds w /
    #: (0.6 - w) is interpolated and extrapolated
    wide_angle: float = 0.0
    reflectance: float = 0.0  # multiplies all reflected light by :data:`REFLECTANCE_FACTOR` to this power
    #: the Beckmann share of the lobe is at the low end of its range at -1 and at the high end at +1; it is 0 at -3 and
    #: 1 at +3, linear between. At -3 the tail of the lobe is the longest, that of GGX
    tail: float = 0.0
    #: multiplies the ratio of alpha along the marks to alpha across them by
    #: :data:`~mitsim.scene.surface.processes.LAY_FACTOR` to this power, up to a ratio of 1
    lay: float = 0.0
    #: direction of the marks on faces whose lay is not given: angle to the projected z axis of the part, or to its x
    #: axis on a face normal to z [deg]. None leaves such a face round, and then ``lay`` has no effect
    lay_deg: float | None = None

    @classmethod
    def parse(cls, text: str, where: str = "--deviation") -> Deviation:
        """Parse a deviation as on a command line: ``alpha=1,wide_angle=-1``; properties not named stay at 0.

        Raises InputError for an unknown name (it suggests the nearest), a name given twice, or an invalid or too large
        number.
        """
        names, values = [field.name for field in fields(cls)], dict[str, float]()
        for word in filter(None, (word.strip() for word in text.split(","))):
            name, mark, value = (part.strip() for part in word.partition("="))
            if name not in names:
                raise InputError(where, "", repr(name), ", ".join(names), nearest(name, names))
            if name in values:
                raise InputError(where, name, "two values", "one")
            low, high, unit = -LARGEST_DEVIATION, LARGEST_DEVIATION, "standard deviations"
            if name == "lay_deg":
                low, high, unit = 0.0, 180.0, "degrees"
            allowed = f"a number of {unit} from {low:g} to {high:g}"
            try:
                values[name] = float(value)
            except ValueError:
                found = repr(value) if mark else "nothing"
                raise InputError(where, name, found, allowed, f"write {name}=1") from None
            if not low <= values[name] <= high:
                raise InputError(where, name, value, allowed)
        return cls(**values)

    def width(self, alpha: float, factor: float) -> float:
        """Return a lobe's alpha [1] after the deviation; ``factor`` is its one-sigma factor."""
        return float(alpha * factor**self.alpha)

    def reflected(self, reflectance: float) -> float:
        """Return the factor [1] on the reflected light of a surface; the product with ``reflectance`` stays below 1."""
        most = max(LARGEST_REFLECTANCE / reflectance, 1.0)
        return float(min(REFLECTANCE_FACTOR**self.reflectance, most))

    def share(self, share: float, ends: tuple[float, float]) -> float:
        """Return a wide-angle share [1] after the deviation; ``ends`` are its one-sigma range, low and high."""
        if not self.wide_angle or ends[0] == ends[1] or not 0 < share < LARGEST_WIDE_ANGLE:
            return share

        def odds(wide_share: float) -> float:
            return wide_share / (LARGEST_WIDE_ANGLE - wide_share)

        ratio = odds(ends[1]) / odds(share) if self.wide_angle > 0 else odds(share) / odds(ends[0])
        return moved_odds(share, ratio**self.wide_angle)

    def beckmann(self, share: float, ends: tuple[float, float]) -> float:
        """Return the Beckmann share of a lobe [1] after the deviation; ``ends`` are its one-sigma range."""
        deviations = (-LARGEST_DEVIATION, -1.0, 0.0, 1.0, LARGEST_DEVIATION)
        return float(np.interp(self.tail, deviations, (0.0, ends[0], share, ends[1], 1.0)))

    def along(self, along: float, across: float, factor: float = LAY_FACTOR) -> float:
        """Return alpha along the marks [1] after the deviation; it is ``across`` at most."""
        return float(min(along * factor**self.lay, across))

    def provenance_of(
        self, provenance: str, factor: float, ends: tuple[float, float], tails: tuple[float, float] = (0.0, 0.0)
    ) -> str:
        """Return the source of alpha and the deviations applied; exactly known properties do not deviate.

        ``provenance``, ``factor``: source of alpha and its one-sigma factor. ``ends``, ``tails``: one-sigma ranges of
        the wide-angle share and of the Beckmann share; without width if they are known.
        """
        moved = [f"alpha {self.alpha:+g}"] if self.alpha and factor != 1 else []
        moved += [f"wide angle {self.wide_angle:+g}"] if self.wide_angle and ends[0] != ends[1] else []
        moved += [f"reflectance {self.reflectance:+g}"] if self.reflectance else []
        moved += [f"tail {self.tail:+g}"] if self.tail and tails[0] != tails[1] else []
        return f"{provenance}; {' and '.join(moved)} sigma" if moved else provenance


#: largest deviation; the prior is not meaningful beyond
LARGEST_DEVIATION = 3.0

#: every finish at its best estimate
NOMINAL = Deviation()
