"""Define microfacet lobes as in Mitsuba's ``roughconductor``: normal distributions, shadowing, Fresnel.

The slopes of a facet are s = (sx, sy). alpha is the width in the sense of its distribution, one value along u and one
along v. P(s) is the distribution of slopes over the mean plane:

    Beckmann   P = exp(-q) / (pi alpha_u alpha_v)              q = (sx / alpha_u)^2 + (sy / alpha_v)^2
    GGX        P = 1 / (pi alpha_u alpha_v (1 + q)^2)

D(m) = P / cos^4(theta_m) is the density of normals (Walter et al., EGSR 2007; Heitz, JCGT 3(2), 2014).
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

Distribution = Literal["beckmann", "ggx"]

#: alpha of the GGX lobe whose median slope equals that of a Beckmann lobe of alpha 1: sqrt(ln 2)
GGX_PER_BECKMANN = float(np.sqrt(np.log(2)))


def slope_density(q: ArrayLike, distribution: Distribution) -> NDArray[np.float64]:
    """Return P(s) times pi alpha_u alpha_v [1] at q = (sx / alpha_u)^2 + (sy / alpha_v)^2, any shape."""
    q = np.asarray(q, float)
    return np.asarray(np.exp(-q) if distribution == "beckmann" else (1 + q) ** -2.0)


def shadowing(tangent: ArrayLike, distribution: Distribution) -> NDArray[np.float64]:
    """Return Smith's G1 [1] at alpha tan(polar angle); Beckmann's rational as Walter et al. and the renderer."""
    t = np.maximum(np.asarray(tangent, float), 1e-12)
    if distribution == "ggx":
        return np.asarray(2 / (1 + np.sqrt(1 + t**2)))
    a = 1 / t
    return np.where(a >= 1.6, 1.0, a * (3.535 + 2.181 * a) / (1 + a * (2.276 + 2.577 * a)))


def fresnel(cosine: ArrayLike, n: float, k: float) -> NDArray[np.float64]:
    """Return the unpolarised reflectance [1] of a medium n - ik in air at the cosine of incidence; k = 0 is glass.

    Born & Wolf, Principles of Optics, section 14.2, in complex arithmetic.
    """
    c = np.asarray(cosine, float)
    index = complex(n, k)
    refracted = np.sqrt(1 - (1 - c**2) / index**2 + 0j)
    across = (c - index * refracted) / (c + index * refracted)
    within = (index * c - refracted) / (index * c + refracted)
    return np.asarray((np.abs(across) ** 2 + np.abs(within) ** 2) / 2)
