"""Describe finishes as Mitsuba BSDFs that reflect light as :mod:`mitsim.scene.surface` computes.

Signal chain: refractive index and :class:`~mitsim.scene.surface.scatter.Scatter` of a finish -> widths, factors and
blend weights of stock BSDFs -> dictionary for ``mi.load_dict``.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from mitsim.scene.coherent_blend import NAME, NUMBERS, register_coherent_blend
from mitsim.scene.surface.coherence import LARGEST_INCIDENCE
from mitsim.scene.surface.microfacet import GGX_PER_BECKMANN, Distribution, fresnel
from mitsim.scene.surface.paint import INDEX, surface_share
from mitsim.scene.surface.scatter import Scatter
from mitsim.scene.turned_lay import turned_description

#: a coherent share below this at every angle where its law holds is not rendered
_LEAST_COHERENT = 0.005

#: blend weight of a powder coat's surface lobe. Its reflectance is divided by the weight, so the weight has no effect
#: on the BSDF, only on its sampling
_COAT_WEIGHT = 0.1

#: alpha, and a factor on the base reflectance of Mitsuba's ``roughplastic`` (Beckmann, index 1.5, linear). With it, a
#: white base returns all light at 30 deg. Measured on Mitsuba 3.9.1
_PLASTIC_BASE = np.array(
    [
        (0.003, 1.0195),
        (0.01, 1.0212),
        (0.02, 1.0220),
        (0.05, 1.0247),
        (0.1, 1.0350),
        (0.15, 1.0529),
        (0.2, 1.0786),
    ]
)


def metal_bsdf(index: tuple[float, float], scatter: Scatter, reflected: float = 1.0) -> dict[str, Any]:
    """Return the Mitsuba description of a machined metal.

    It blends up to two incoherent lobes, a coherent lobe and a diffuse wide-angle share. All lobes have the same
    refractive index, and none is a delta function, so blending conserves energy. The parts depend on the finish, but
    not on its deviation: a part is left out only if its share is known to be nothing.

    ``index`` is n and k of the metal [1], ``scatter`` has lobes and shares of the finish, ``reflected`` is a factor on
    all reflected light [1].
    """

    def lobe(distribution: Distribution, alphas: tuple[float, float], factor: float) -> dict[str, Any]:
        return conductor_bsdf(distribution, alphas, index, factor * reflected)

    ggx, beckmann = scatter.energy_factor
    incoherent = _blend(
        lobe("ggx", scatter.ggx_alpha, ggx),
        lobe("beckmann", (scatter.alpha_u, scatter.alpha_v), beckmann),
        scatter.beckmann,
        scatter.beckmann_range,
    )
    mirror = lobe("beckmann", scatter.coherent_alpha, 1.0)
    specular = incoherent
    if scatter.coherent_at(LARGEST_INCIDENCE) > _LEAST_COHERENT:
        register_coherent_blend()
        specular = {
            "type": NAME,
            "phase_variance": scatter.phase_variance,
            "mirror": mirror,
            "lobe": incoherent,
            **dict(zip(NUMBERS, scatter.lobe_numbers, strict=True)),
        }
    if scatter.turn_deg is not None:
        specular = turned_description(specular, scatter.turn_deg)
    matt = diffuse_bsdf(reflected * float(fresnel(1.0, *index)))
    return _blend(specular, matt, scatter.wide_angle, scatter.wide_angle_range)


def gloss_paint_bsdf(reflectance: float, scatter: Scatter) -> dict[str, Any]:
    """Return the Mitsuba description of a gloss paint whose base has this reflectance [1]."""
    return {
        "type": "roughplastic",
        "distribution": "beckmann",
        "alpha": scatter.alpha_u,
        "int_ior": INDEX[0],
        "ext_ior": 1.0,
        "nonlinear": False,
        "diffuse_reflectance": {
            "type": "uniform",
            "value": reflectance * float(np.interp(scatter.alpha_u, *_PLASTIC_BASE.T)),
        },
    }


def powder_coat_bsdf(reflectance: float, scatter: Scatter) -> dict[str, Any]:
    """Return the Mitsuba description of a powder coat whose base has this reflectance [1].

    A conductor without absorption (k = 0) has the Fresnel reflectance of a dielectric.
    """
    alpha = scatter.ggx_alpha[0]
    body = reflectance * (1 - surface_share(GGX_PER_BECKMANN * scatter.alpha_u, "ggx"))
    coat = conductor_bsdf("ggx", (alpha, alpha), INDEX, scatter.energy_factor[0] / _COAT_WEIGHT)
    return _blend(diffuse_bsdf(body / (1 - _COAT_WEIGHT)), coat, _COAT_WEIGHT)


def _blend(
    first: dict[str, Any], second: dict[str, Any], weight: float, ends: tuple[float, float] | None = None
) -> dict[str, Any]:
    """Blend two descriptions; ``weight`` is the share of the second [1], as in ``blendbsdf``.

    A share below 1e-3 is dropped, except if ``ends``, its one-sigma range, say that it is not known.
    """
    if ends is None or ends[0] == ends[1]:
        if weight < 1e-3:
            return first
        if weight > 1 - 1e-3:
            return second
    return {"type": "blendbsdf", "weight": weight, "first": first, "second": second}


def conductor_bsdf(
    distribution: Distribution, alphas: tuple[float, float], index: tuple[float, float], factor: float = 1.0
) -> dict[str, Any]:
    """Return the Mitsuba description of one microfacet lobe.

    ``distribution``, ``alphas``: of the normals; its widths along u and v [1], in the sense of the distribution.
    ``index``, ``factor``: n and k of the surface [1], and a factor on all reflected light [1].
    """
    return {
        "type": "roughconductor",
        "distribution": distribution,
        "alpha_u": alphas[0],
        "alpha_v": alphas[1],
        "eta": index[0],
        "k": index[1],
        "specular_reflectance": {"type": "uniform", "value": factor},
    }


def diffuse_bsdf(reflectance: float) -> dict[str, Any]:
    """Return the Mitsuba description of a Lambertian surface of this reflectance [1]."""
    return {"type": "diffuse", "reflectance": {"type": "uniform", "value": reflectance}}
