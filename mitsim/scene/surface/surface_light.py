"""Summarise the optical properties of a surface, as a performance map stores them with its samples.

Signal chain: scattering of a surface (:class:`~mitsim.scene.surface.scatter.Scatter`) and its material -> a
:class:`~characterisation.maps.light.Light`; the same from finish and Ra alone -> comparison of the two, which shows
whether a surface is as made.
"""

from __future__ import annotations

import math
from dataclasses import replace

from characterisation.files.errors import InputError
from characterisation.maps.light import Light, same_light
from mitsim.scene.surface.machined import machined
from mitsim.scene.surface.machined_face import MachinedFace
from mitsim.scene.surface.metals import CONSTANTS, normal_reflectance
from mitsim.scene.surface.paint import matt_white, paint
from mitsim.scene.surface.processes import PROCESSES
from mitsim.scene.surface.scatter import Scatter

#: default reflectance [1] of a paint's body, and of matt white; assumed
USUAL_REFLECTANCE = {"matt_white": 0.85, "gloss_paint": 0.85, "powder_coat": 0.8}


def light_of_scatter(kind: str, reflectance: float, scatter: Scatter) -> Light:
    """Return the light of a surface of a kind (``metal``, ``gloss_paint``, ``powder_coat``, ``matt``), not as made."""
    nan = math.nan
    mirror = (nan, nan) if math.isnan(scatter.height_um) else scatter.coherent_alpha
    return Light(
        kind,
        reflectance,
        scatter.wide_angle,
        scatter.alpha_u,
        scatter.alpha_v,
        scatter.beckmann,
        *mirror,
        scatter.height_um,
        as_made=False,
    )


def nominal_light(finish: str, roughness_um: float, wavelength_nm: float) -> Light | None:
    """Return the light of a finish known only by its name and its Ra [um]; None for an unknown name."""
    if finish == "matt_white":
        return replace(light_of_scatter("matt", USUAL_REFLECTANCE[finish], matt_white()), as_made=True)
    if finish in USUAL_REFLECTANCE:
        reflectance = USUAL_REFLECTANCE[finish]
        return replace(light_of_scatter(finish, reflectance, paint(finish, reflectance)), as_made=True)
    metal, _, process = finish.partition("/")
    if metal not in CONSTANTS or process not in PROCESSES or not roughness_um > 0:
        return None
    try:
        scatter = machined(MachinedFace(metal, process, roughness_um), wavelength_nm)
        reflectance = normal_reflectance(metal, wavelength_nm)
    except (InputError, ValueError):
        return None
    return replace(light_of_scatter("metal", reflectance, scatter), as_made=True)


def surface_light(
    kind: str, reflectance: float, scatter: Scatter, finish: str, roughness_um: float, wavelength_nm: float
) -> Light:
    """Return the light of a surface, and whether its finish and Ra alone would give the same.

    ``kind``, ``reflectance``, ``scatter``: as for :func:`light_of_scatter`. ``finish``, ``roughness_um``,
    ``wavelength_nm``: as for :func:`nominal_light`.
    """
    light, usual = light_of_scatter(kind, reflectance, scatter), nominal_light(finish, roughness_um, wavelength_nm)
    return replace(light, as_made=usual is not None and same_light(light, usual))
