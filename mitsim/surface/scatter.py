"""What every material of ours reports of itself: how it scatters at one wavelength, and how well that is known."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Literal

from characterisation.errors import InputError, nearest
from mitsim.surface.coherence import lobe_numbers
from mitsim.surface.microfacet import GGX_PER_BECKMANN

#: direction of the marks on a face: along its u, along its v, or none
Lay = Literal["u", "v", "none"]

#: width of the mirror-like part: form error and waviness of a real face. A true mirror would be black under a
#: point-like projector. Assumed
ALPHA_FORM = 0.005


#: one-sigma factor of a surface's reflectance. Handbooks of optical constants differ by about 5 % in the reflectance of
#: one evaporated metal; oxide, alloy and dirt add to it, and paint is specified no better: assumed
REFLECTANCE_FACTOR = 1.05

#: no surface reflects more than this share of the light [1]
LARGEST_REFLECTANCE = 0.99


@dataclass(frozen=True)
class Scatter:
    """How a surface scatters the light that it reflects, at one wavelength. Shares are [1].

    The reflected light is ``wide_angle`` of it as from a matt surface; of the rest a share A in a narrow lobe, and the
    remainder in a lobe of alpha_u, alpha_v, ``beckmann`` of it Beckmann and the other part GGX. A grows with the angle
    of incidence (:meth:`coherent_at`).

    Parameters
    ----------
    phase_variance
        Variance g of the phase at normal incidence [rad^2], by which A = exp(-g); infinite if A is 0 at every angle.
    alpha_u, alpha_v
        Width of the incoherent lobe along u and v in Beckmann's sense: sqrt(2) times the rms slope. NaN if there is
        no such lobe.
    beckmann
        Share of Beckmann in the incoherent lobe.
    height_um
        Rq that decides coherence and speckle [um]; NaN where light comes out of the volume.
    wide_angle, wide_angle_range
        Share of all reflected light at wide angles; and low and high, about one sigma either side of the best guess.
    alpha_factor
        One-sigma factor of alpha: it lies between alpha / factor and alpha x factor.
    provenance
        Where alpha comes from, in words.
    lay
        Direction of the marks.
    energy_factor
        What the GGX and the Beckmann lobe are multiplied by to give back what single scattering loses.
    coherent_alpha
        Width of the coherent part along u and v.
    correlation_um
        Lateral scale l of the heights [um]; NaN where none was needed.
    depolarising
        Whether the wide-angle light has been inside the material (paint, white), and lost its polarisation there.
    """

    phase_variance: float
    alpha_u: float
    alpha_v: float
    beckmann: float
    height_um: float
    wide_angle: float
    wide_angle_range: tuple[float, float]
    alpha_factor: float
    provenance: str
    lay: Lay = "none"
    energy_factor: tuple[float, float] = (1.0, 1.0)
    coherent_alpha: tuple[float, float] = (ALPHA_FORM, ALPHA_FORM)
    correlation_um: float = float("nan")
    depolarising: bool = False

    @property
    def coherent(self) -> float:
        """Share A [1] of the specular light that is reflected as by a mirror, at normal incidence."""
        return self.coherent_at(0.0)

    def coherent_at(self, incidence: float) -> float:
        """Share A [1] of the specular light that is reflected as by a mirror, at ``incidence`` [rad]."""
        return math.exp(-self.phase_variance * math.cos(incidence) ** 2)

    @property
    def lobe_numbers(self) -> tuple[float, float, float]:
        """Numbers [1] of the factor on the lobe that keeps the energy as A changes across it.

        See :mod:`mitsim.surface.coherence`.
        """
        return lobe_numbers(self.phase_variance, self.alpha_u, self.alpha_v, self.beckmann, self.energy_factor)

    @property
    def ggx_alpha(self) -> tuple[float, float]:
        """Widths (u, v) of the GGX lobe, with the same median slope as the Beckmann one."""
        return GGX_PER_BECKMANN * self.alpha_u, GGX_PER_BECKMANN * self.alpha_v


@dataclass(frozen=True)
class Deviation:
    """How far what is not known of a finish is moved away from the best guess, in its standard deviations.

    ``alpha`` the width of the lobe: times its factor to this power. ``wide_angle`` the share at wide angles: its low
    end at -1, its high end at +1, in equal ratios between and beyond. ``reflectance`` of all light that the surface
    reflects: times :data:`REFLECTANCE_FACTOR` to this power.
    """

    alpha: float = 0.0
    wide_angle: float = 0.0
    reflectance: float = 0.0

    @classmethod
    def parse(cls, text: str, where: str = "--deviation") -> Deviation:
        """Deviation as it is written on a command line: ``alpha=1,wide_angle=-1``; what is not named is not moved.

        Raises
        ------
        InputError
            For a name that is none (it suggests the nearest), one given twice, or a number that is none or too large.
        """
        known, given = [field.name for field in fields(cls)], dict[str, float]()
        for word in filter(None, (word.strip() for word in text.split(","))):
            name, mark, value = (part.strip() for part in word.partition("="))
            if name not in known:
                raise InputError(where, "", repr(name), ", ".join(known), nearest(name, known))
            if name in given:
                raise InputError(where, name, "two values", "one")
            allowed = f"a number of standard deviations from {-LARGEST_DEVIATION:g} to {LARGEST_DEVIATION:g}"
            try:
                given[name] = float(value)
            except ValueError:
                found = repr(value) if mark else "nothing"
                raise InputError(where, name, found, allowed, f"write {name}=1") from None
            if not abs(given[name]) <= LARGEST_DEVIATION:
                raise InputError(where, name, value, allowed)
        return cls(**given)

    def width(self, alpha: float, factor: float) -> float:
        """A lobe's alpha [1], moved; ``factor`` its one sigma."""
        return float(alpha * factor**self.alpha)

    def reflected(self, reflectance: float) -> float:
        """Factor [1] on the light that a surface of a reflectance [1] reflects; it keeps the product below 1."""
        most = max(LARGEST_REFLECTANCE / reflectance, 1.0)
        return float(min(REFLECTANCE_FACTOR**self.reflectance, most))

    def share(self, share: float, ends: tuple[float, float]) -> float:
        """A wide-angle share [1], moved; ``ends`` low and high, one sigma either side."""
        if share <= 0:
            return share
        ratio = ends[1] / share if self.wide_angle > 0 else share / ends[0]
        return float(min(share * ratio**self.wide_angle, 1.0))

    def told(self, provenance: str, factor: float, ends: tuple[float, float]) -> str:
        """Where alpha comes from, and what was moved: nothing of what is known exactly."""
        moved = [f"alpha {self.alpha:+g}"] if self.alpha and factor != 1 else []
        moved += [f"wide angle {self.wide_angle:+g}"] if self.wide_angle and ends[0] != ends[1] else []
        moved += [f"reflectance {self.reflectance:+g}"] if self.reflectance else []
        return f"{provenance}; {' and '.join(moved)} sigma" if moved else provenance


#: farther than this a prior means nothing
LARGEST_DEVIATION = 3.0

#: every finish as it is best guessed
NOMINAL = Deviation()
