"""Divide light between the specular part and the diffuse lobe of a face, at every angle and without energy loss.

The coherent share of a pair of directions i and o is A = exp(-g m^2) with m = (cos i + cos o) / 2. Here g is the phase
variance at normal incidence. The source is Beckmann and Spizzichino, "The Scattering of Electromagnetic Waves from
Rough Surfaces", 1963, chapter 5. In the specular direction A is exp(-g cos^2 i). The BRDF

    f(i, o) = A f_mirror(i, o) + (1 - A) h(m) f_lobe(i, o)

is symmetric, as Helmholtz reciprocity requires. The lobe should return the share 1 - exp(-g cos^2 i) of the energy
E(i) that it would return alone. With h = 1 it does so up to 45 deg. Beyond, A changes across a lobe: the lobe returns
1 % too little at 60 deg and up to 4 % too much at 75 deg. Beyond 45 deg h is therefore the polynomial

    h = 1 + u^2 (c_0 + c_1 u + c_2 u^2),      u = 1 - m / cos 45 deg

Its three coefficients restore the energy to 0.5 %, by least squares at angles up to 75 deg. At larger angles facets
shadow one another and A does not hold; there h is only kept positive.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsim.scene.surface.energy import facets
from mitsim.scene.surface.microfacet import GGX_PER_BECKMANN, Distribution

#: cosine at and above which h is 1
EVEN_FROM = float(np.cos(np.radians(45)))

#: incidence [rad] up to which A holds and energy is conserved
LARGEST_INCIDENCE = float(np.radians(75))

#: angles of incidence at which energy is conserved
_ANGLES = 12

#: facets of the quadrature at each angle, as of :func:`~mitsim.scene.surface.energy.facets`
_COUNTS = (96, 48, 4)


def coherent_weight(phase_variance: float, mean_cosine: ArrayLike) -> NDArray[np.float64]:
    """Return A [1] of pairs of directions; ``mean_cosine`` is the mean of their cosines to the normal, any shape."""
    return np.asarray(np.exp(-phase_variance * np.square(mean_cosine)))


@lru_cache(maxsize=1024)
def lobe_numbers(
    phase_variance: float, alpha_u: float, alpha_v: float, beckmann: float, energy_factor: tuple[float, float]
) -> tuple[float, float, float]:
    """Return the coefficients c_0, c_1 and c_2 [1] of h.

    For an elongated lobe the energy is averaged over the azimuth of the light.

    ``phase_variance``, ``alpha_u``, ``alpha_v``, ``beckmann``, ``energy_factor``: of the lobe, as in
    :class:`~mitsim.scene.surface.scatter.Scatter`.
    """
    returned, missing = [], []
    lobes: tuple[tuple[float, float, Distribution], ...] = (
        (beckmann * energy_factor[1], 1.0, "beckmann"),
        ((1 - beckmann) * energy_factor[0], GGX_PER_BECKMANN, "ggx"),
    )
    for cosine in np.linspace(np.cos(LARGEST_INCIDENCE), EVEN_FROM, _ANGLES).tolist():
        sums, lacking = np.zeros(3), 0.0
        for share, width, distribution in lobes:
            if share == 0:
                continue
            angle = float(np.arccos(cosine))
            weight, out = facets(angle, width * alpha_u, width * alpha_v, distribution, _COUNTS)
            mean = 0.5 * (cosine + out)
            kept = share * weight * (1 - coherent_weight(phase_variance, mean))
            u = np.maximum(1 - mean / EVEN_FROM, 0.0)
            square = u * u
            sums += [kept @ square, kept @ (square * u), kept @ (square * square)]
            lacking += share * weight.sum() * (1 - float(coherent_weight(phase_variance, cosine))) - kept.sum()
        returned.append(sums)
        missing.append(lacking)
    first, second, third = np.linalg.lstsq(np.array(returned), np.array(missing), rcond=1e-6)[0].tolist()
    return first, second, third
