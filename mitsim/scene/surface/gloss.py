"""Predict the reading of a gloss meter (ISO 2813) from a lobe, and the lobe's width from a reading.

Signal chain: parallel light at 20, 60 or 85 deg -> microfacet lobe (single scattering, Smith shadowing, Fresnel) plus a
matt base -> share within the receptor's aperture about the specular direction -> relative to polished black glass of
n = 1.567, which reads 100.

    G = 100 / F_glass  integral over the aperture of  [ F D G1 G1 / (4 cos_i cos_o) + base / pi ] cos_o domega

The receptors' apertures are 1.8 x 3.6, 4.4 x 11.7 and 4 x 6 deg (in and across the plane of incidence) at 20, 60 and
85 deg. The size of the light source is neglected.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.optimize import brentq

from mitsim.scene.surface.microfacet import Distribution, fresnel, shadowing, slope_density

#: angle [deg] -> full aperture of the receptor in and across the plane of incidence [deg]
APERTURES_DEG = {20: (1.8, 3.6), 60: (4.4, 11.7), 85: (4.0, 6.0)}

BLACK_GLASS = 1.567

#: wavelength at which the eye, and so a gloss meter, is most sensitive [nm]
GLOSS_WAVELENGTH_NM = 555.0

#: nodes (96,) of a Gauss-Legendre quadrature over -1..1, and their weights (96,); the number is chosen
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(96)


def lobe_gloss(alpha: float, index: tuple[float, float], distribution: Distribution, angle_deg: int = 60) -> float:
    """Return the gloss [GU] of a lobe alone.

    ``alpha``, ``distribution``: width [1], in the sense of the distribution. ``index``: n and k of the surface [1].
    ``angle_deg``: of the gloss meter: 20, 60 or 85 deg.
    """
    theta = np.radians(angle_deg)
    incoming = np.array([np.sin(theta), 0.0, np.cos(theta)])
    within, within_weight = _crowded(np.radians(APERTURES_DEG[angle_deg][0]) / 2, alpha)
    across, across_weight = _crowded(np.radians(APERTURES_DEG[angle_deg][1]) / 2, alpha)
    polar = (theta + within)[:, None]
    outgoing = np.stack(
        [
            -np.sin(polar) * np.cos(across),
            np.broadcast_to(np.sin(across), (len(within), len(across))),
            np.cos(polar) * np.cos(across),
        ]
    )
    cosine = outgoing[2]
    above = cosine > 0
    half = outgoing + incoming[:, None, None]
    half /= np.linalg.norm(half, axis=0)
    tangent_squared = 1 / half[2] ** 2 - 1
    density = slope_density(tangent_squared / alpha**2, distribution) / (np.pi * alpha**2 * half[2] ** 4)
    safe = np.where(above, cosine, 1.0)
    shadow = shadowing(alpha * np.sqrt(1 - np.minimum(safe, 1) ** 2) / safe, distribution) * shadowing(
        alpha * np.tan(theta), distribution
    )
    reflected = fresnel(np.einsum("i,ijk->jk", incoming, half), *index)
    radiance = np.where(above, reflected * density * shadow / (4 * np.cos(theta)), 0.0)
    flux = float(np.einsum("i,j,ij->", within_weight, across_weight * np.cos(across), radiance))
    return 100 * flux / float(fresnel(np.cos(theta), BLACK_GLASS, 0.0))


def base_gloss(reflectance: float) -> float:
    """Return the gloss [GU] at 60 deg of a matt base whose BRDF at the specular direction is ``reflectance`` / pi."""
    theta = np.radians(60)
    within, across = np.radians(APERTURES_DEG[60])
    # exact over the aperture: the integral of cos(polar) cos^2(across)
    end = min(theta + within / 2, np.pi / 2)
    flux = (np.sin(end) - np.sin(theta - within / 2)) * (across + np.sin(across)) / 2
    return float(100 * reflectance / np.pi * flux / fresnel(np.cos(theta), BLACK_GLASS, 0.0))


def alpha_of_gloss(value: float, reading: Callable[[float], float], bounds: tuple[float, float]) -> float:
    """Return alpha [1] between ``bounds`` at which ``reading`` [GU], a falling function of alpha, equals ``value``.

    Raises ValueError if no alpha gives it; the message states the possible readings.
    """
    highest, lowest = (reading(alpha) for alpha in bounds)
    if not lowest <= value <= highest:
        raise ValueError(f"{lowest:.2g} to {highest:.3g} GU at 60 deg, for alpha {bounds[1]:g} to {bounds[0]:g}")
    logs = np.log(bounds)
    return float(np.exp(brentq(lambda x: reading(float(np.exp(x))) - value, *logs, xtol=1e-7)))


def _crowded(half: float, alpha: float) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes and weights from -half to half [rad], concentrated about 0 on the scale of the lobe."""
    end = np.arcsinh(half / alpha)
    return alpha * np.sinh(end * _NODES), _WEIGHTS * end * alpha * np.cosh(end * _NODES)
