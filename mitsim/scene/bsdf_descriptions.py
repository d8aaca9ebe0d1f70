"""Descriptions of finishes in Mitsuba's words: stock BSDFs that reflect light as :mod:`mitsim.surface` says."""

from __future__ import annotations

from typing import Any

import numpy as np

from mitsim.scene.coherent_blend import NAME, NUMBERS, register_coherent_blend
from mitsim.surface.coherence import LARGEST_INCIDENCE
from mitsim.surface.microfacet import GGX_PER_BECKMANN, fresnel
from mitsim.surface.paint import INDEX, surface_share
from mitsim.surface.scatter import Scatter

#: a coherent share that stays under this at every angle at which its law holds is not rendered
_LEAST_COHERENT = 0.005

#: weight of a powder coat's surface lobe in its blend; its reflectance is divided by it, so it shapes nothing
_COAT_WEIGHT = 0.1

#: alpha -> by what the base of Mitsuba's ``roughplastic`` (Beckmann, 1.5, linear) must be multiplied for a white base
#: to return all light at 30 deg; measured on Mitsuba 3.9.1
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
    """Mitsuba description of a machined metal: up to two incoherent lobes, a coherent one, a wide-angle share.

    ``index`` (n, k). All lobes have the same, and no child is a delta, so blending them keeps the energy.
    ``reflected`` is a factor on all of the light [1].
    """

    def lobe(distribution: str, alphas: tuple[float, float], factor: float) -> dict[str, Any]:
        return {
            "type": "roughconductor",
            "distribution": distribution,
            "alpha_u": alphas[0],
            "alpha_v": alphas[1],
            "eta": index[0],
            "k": index[1],
            "specular_reflectance": {"type": "uniform", "value": factor * reflected},
        }

    ggx, beckmann = scatter.energy_factor
    incoherent = _blend(
        lobe("ggx", scatter.ggx_alpha, ggx),
        lobe("beckmann", (scatter.alpha_u, scatter.alpha_v), beckmann),
        scatter.beckmann,
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
    return _blend(specular, diffuse_bsdf(reflected * float(fresnel(1.0, *index))), scatter.wide_angle)


def gloss_paint_bsdf(reflectance: float, scatter: Scatter) -> dict[str, Any]:
    """Mitsuba description of a gloss paint on a base of that reflectance [1]."""
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
    """Mitsuba description of a powder coat: a conductor without absorption (k = 0) has a dielectric's Fresnel curve."""
    alpha = scatter.ggx_alpha[0]
    body = reflectance * (1 - surface_share(GGX_PER_BECKMANN * scatter.alpha_u, "ggx"))
    coat = {
        "type": "roughconductor",
        "distribution": "ggx",
        "alpha": alpha,
        "eta": INDEX[0],
        "k": 0.0,
        "specular_reflectance": {"type": "uniform", "value": scatter.energy_factor[0] / _COAT_WEIGHT},
    }
    return _blend(diffuse_bsdf(body / (1 - _COAT_WEIGHT)), coat, _COAT_WEIGHT)


def _blend(first: dict[str, Any], second: dict[str, Any], weight: float) -> dict[str, Any]:
    """``blendbsdf`` gives its weight to the second child."""
    if weight < 1e-3:
        return first
    if weight > 1 - 1e-3:
        return second
    return {"type": "blendbsdf", "weight": weight, "first": first, "second": second}


def diffuse_bsdf(reflectance: float) -> dict[str, Any]:
    """Mitsuba description of a Lambertian surface of that reflectance [1]."""
    return {"type": "diffuse", "reflectance": {"type": "uniform", "value": reflectance}}
