"""Model paints and white standards: a rough dielectric surface over a matt body.

    reflected = F(theta) lobe + base (1 - S),     S the lobe's directional albedo at the nominal incidence

``reflectance`` is that of the base: the share of the light entering the coat that leaves it again. This light has been
scattered inside, so it is neither coherent nor polarised. The height that determines its speckle is an unknown path
length in the coat (NaN). Orange peel, waves of several mm, is geometry and not part of alpha.
"""

from __future__ import annotations

import math

import numpy as np

from characterisation.files.errors import InputError
from mitsim.scene.surface.energy import NOMINAL_INCIDENCE, directional_albedo, energy_factors
from mitsim.scene.surface.gloss import alpha_of_gloss, base_gloss, lobe_gloss
from mitsim.scene.surface.microfacet import GGX_PER_BECKMANN, Distribution, fresnel
from mitsim.scene.surface.scatter import NOMINAL, Deviation, Scatter

#: refractive index of binders, the same for every coat. Assumed
INDEX = (1.5, 0.0)

#: range of widths (Beckmann's sense) of the two coats; beyond 0.2 the renderer's glossy coat loses energy
ALPHA_RANGE = {"gloss_paint": (0.003, 0.2), "powder_coat": (0.02, 0.5)}

#: default gloss if neither gloss nor alpha is given [GU at 60 deg]. Assumed
USUAL_GLOSS = {"gloss_paint": 85.0, "powder_coat": 8.0}

#: hemispherical reflectance of the coat's underside for diffuse light, n = 1.5 (Egan & Hilgeman 1979)
_UNDERSIDE = 0.596

#: one-sigma factors of alpha: from gloss, as given, by default. Assumed
_FACTORS = {"gloss": 1.2, "alpha": 1.0, "usual": 1.6}


def matt_white() -> Scatter:
    """Return ideal diffuse scattering: all light leaves at wide angles."""
    nan = float("nan")
    return Scatter(math.inf, nan, nan, 0.0, nan, 1.0, (1.0, 1.0), 1.0, "Lambertian by definition", depolarising=True)


def paint(
    kind: str,
    reflectance: float,
    gloss: float | None = None,
    alpha: float | None = None,
    where: str = "a paint",
    deviation: Deviation = NOMINAL,
) -> Scatter:
    """Return how ``gloss_paint`` (a Beckmann lobe) or ``powder_coat`` (a GGX lobe) scatters.

    ``kind``, ``reflectance``: of the coat, and of its base [1]. ``gloss``, ``alpha``: [GU at 60 deg], or [1] in
    Beckmann's sense; without either, the default gloss of the coat. ``where``: name of the surface in messages.
    ``deviation``: of alpha, within the range of the coat; its wide-angle share follows. Raises InputError if both are
    given, or no width of that coat has the gloss.
    """
    if gloss is not None and alpha is not None:
        raise InputError(where, "alpha", "alpha beside gloss", "one of them", "keep gloss, which can be measured")
    words, factor = f"alpha {alpha:g} as given" if alpha is not None else "", _FACTORS["alpha"]
    distribution: Distribution = "beckmann" if kind == "gloss_paint" else "ggx"
    width = 1.0 if kind == "gloss_paint" else GGX_PER_BECKMANN
    if alpha is None:
        reading = USUAL_GLOSS[kind] if gloss is None else gloss
        words = f"gloss {reading:g} GU at 60 deg" + (", assumed" if gloss is None else "")
        factor = _FACTORS["usual" if gloss is None else "gloss"]

        def possible(candidate: float) -> float:
            return lobe_gloss(width * candidate, INDEX, distribution) + base_gloss(
                _base_at_60(kind, reflectance, candidate)
            )

        try:
            alpha = alpha_of_gloss(reading, possible, ALPHA_RANGE[kind])
        except ValueError as error:
            hint = "powder_coat is the duller of the two coats"
            raise InputError(where, "gloss", f"{reading:g} GU", str(error), hint) from None
    if deviation.alpha and factor != 1:
        low, high = ALPHA_RANGE[kind]
        alpha = min(max(deviation.width(alpha, factor), low), high)
    surface = surface_share(width * alpha, distribution)
    body = reflectance * (1 - surface)
    share = body / (body + surface)
    return Scatter(
        math.inf,
        alpha,
        alpha,
        1.0 if distribution == "beckmann" else 0.0,
        float("nan"),
        share,
        (share, share),
        factor,
        deviation.provenance_of(words, factor, (share, share)),
        energy_factor=energy_factors(alpha, alpha, float(fresnel(1.0, *INDEX))),
        depolarising=True,
    )


def surface_share(alpha: float, distribution: Distribution) -> float:
    """Return the share S [1] of light at nominal incidence that the coat's surface reflects; alpha in its own sense."""
    return directional_albedo(NOMINAL_INCIDENCE, alpha, alpha, distribution, INDEX)


def _base_at_60(kind: str, reflectance: float, alpha: float) -> float:
    """Return the base's BRDF at the gloss meter's geometry, times pi, as in the renderer's two models."""
    if kind == "powder_coat":
        return reflectance * (1 - surface_share(GGX_PER_BECKMANN * alpha, "ggx"))
    passed = 1 - float(fresnel(np.cos(np.radians(60)), *INDEX))
    return reflectance * passed**2 / (INDEX[0] ** 2 * (1 - _UNDERSIDE))
