"""What every material of ours reports of itself: how it scatters at one wavelength, and how well that is known."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from mitsim.surface.microfacet import GGX_PER_BECKMANN

#: direction of the marks on a face: along its u, along its v, or none
Lay = Literal["u", "v", "none"]

#: width of the mirror-like part: form error and waviness of a real face. A true mirror would be black under a
#: point-like projector. Assumed
ALPHA_FORM = 0.005


@dataclass(frozen=True)
class Scatter:
    """How a surface scatters the light that it reflects, at one wavelength near normal incidence. Shares are [1].

    The reflected light is ``wide_angle`` of it as from a matt surface; of the rest, ``coherent`` (A) in a narrow
    lobe, and the remainder in a lobe of alpha_u, alpha_v, ``beckmann`` of it Beckmann and the other part GGX.

    Parameters
    ----------
    coherent
        Share A of the specular light that is reflected as by a mirror.
    alpha_u, alpha_v
        Width of the incoherent lobe along u and v in Beckmann's sense: sqrt(2) times the rms slope. NaN if there is
        no such lobe.
    beckmann
        Share of Beckmann in the incoherent lobe.
    height_um
        Rq that decides coherence and speckle [um]; NaN where light comes out of the volume.
    wide_angle, wide_angle_range
        Share of all reflected light at wide angles, and low and high, about one sigma either side.
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

    coherent: float
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
    def ggx_alpha(self) -> tuple[float, float]:
        """Widths (u, v) of the GGX lobe, with the same median slope as the Beckmann one."""
        return GGX_PER_BECKMANN * self.alpha_u, GGX_PER_BECKMANN * self.alpha_v
