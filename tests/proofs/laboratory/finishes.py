"""Express the finish of a face in the laboratory's own materials, one for each family.

Signal chain: finish of the part's drawing with the deviation of a world -> alpha, Fresnel index, reflectance -> numbers
of a stock BSDF: a GGX lobe, a Beckmann lobe and a diffuse part.

Families:

- ``white``: Lambertian.
- ``mitsim``: the lobes and the wide-angle share that mitsim assumes, without its coherent part and without its
  compensation for lost energy. Both matter at grazing angles only.
- ``ward``: lightly brushed aluminium as measured by Ward (SIGGRAPH 1992, table 1: rho_d 0.15, rho_s 0.19, alpha 0.088
  and 0.13). 44 % of the light is diffuse. The total is the reflectance of the metal: Ward measured in the visible.
- ``ggx_diffuse``, ``ggx``, ``beckmann``: a single lobe of the alpha that mitsim assumes; in the first 2 % is diffuse.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

from characterisation.files.errors import InputError
from mitsim.scene.materials import Finish
from mitsim.scene.surface.metals import normal_reflectance, refractive_index
from mitsim.scene.surface.microfacet import GGX_PER_BECKMANN
from mitsim.scene.surface.roughness import ALPHA_LARGEST
from mitsim.scene.surface.scatter import Deviation

Family = Literal["white", "mitsim", "ward", "ggx_diffuse", "ggx", "beckmann"]

#: Ward 1992, table 1, "lightly brushed aluminium"
WARD_DIFFUSE, WARD_SPECULAR, WARD_ALPHA = 0.15, 0.19, (0.088, 0.13)

#: share of the light outside the lobe in the family ``ggx_diffuse``
LITTLE_DIFFUSE = 0.02


@dataclass(frozen=True)
class Surface:
    """Numbers of a face's material, all [1].

    ``diffuse`` is the reflectance of a Lambertian surface, ``diffuse_share`` the weight of that surface; the rest is
    metal of ``index`` (n, k) times ``specular``. Of the metal, ``beckmann`` is a Beckmann lobe and the rest GGX.
    ``ggx_alpha`` and ``beckmann_alpha`` are widths along u and v.
    """

    diffuse: float
    diffuse_share: float = 1.0
    index: tuple[float, float] = (0.0, 1.0)
    specular: float = 1.0
    ggx_alpha: tuple[float, float] = (0.1, 0.1)
    beckmann_alpha: tuple[float, float] = (0.1, 0.1)
    beckmann: float = 0.0
    height_um: float = float("nan")

    @property
    def is_white(self) -> bool:
        """Return whether the face has no metal."""
        return self.diffuse_share == 1.0


def surface_of(
    finish: Finish | None, family: Family, wavelength_nm: float, deviation: Deviation, where: str
) -> Surface:
    """Return the material of a face in a world, from its finish at the best estimate and the world's deviation.

    Raises
    ------
    InputError
        If the finish is neither a metal nor matt white, or the family does not suit it.
    """
    if finish is not None and finish.name == "matt_white":
        if family != "white":
            raise InputError(where, "families", f"{family!r} with a matt white face", "metal faces, or 'white'")
        reflectance = float(finish.description["reflectance"]["value"])
        return Surface(reflectance * deviation.reflected(reflectance))
    if finish is None or finish.scatter is None or "/" not in finish.name:
        raise InputError(where, "", f"a face with the finish {finish}", "machined metal or matt white")
    metal, scatter = finish.name.partition("/")[0], finish.scatter
    bright = normal_reflectance(metal, wavelength_nm)
    reflected = deviation.reflected(bright)
    along_u, along_v = (
        min(deviation.width(alpha, scatter.alpha_factor), ALPHA_LARGEST) for alpha in (scatter.alpha_u, scatter.alpha_v)
    )
    alpha, index = (along_u, along_v), refractive_index(metal, wavelength_nm)
    lobe = Surface(bright * reflected, 0.0, index, reflected, alpha, alpha, height_um=scatter.height_um)
    match family:
        case "mitsim":
            narrower = (GGX_PER_BECKMANN * along_u, GGX_PER_BECKMANN * along_v)
            wide = deviation.share(scatter.wide_angle, scatter.wide_angle_range)
            return replace(lobe, diffuse_share=wide, beckmann=scatter.beckmann, ggx_alpha=narrower)
        case "ward":
            share = WARD_DIFFUSE / (WARD_DIFFUSE + WARD_SPECULAR)
            return replace(lobe, diffuse_share=share, beckmann=1.0, beckmann_alpha=WARD_ALPHA)
        case "ggx_diffuse":
            return replace(lobe, diffuse_share=LITTLE_DIFFUSE)
        case "ggx":
            return lobe
        case "beckmann":
            return replace(lobe, beckmann=1.0)
        case _:
            raise InputError(where, "families", f"{family!r} with a face of metal", "a scene that is matt white")


def bsdf(surface: Surface) -> dict[str, Any]:
    """Return the stock Mitsuba BSDF of a material as a dictionary."""
    diffuse = {"type": "diffuse", "reflectance": {"type": "uniform", "value": surface.diffuse}}
    if surface.is_white:
        return {"type": "twosided", "face": diffuse}

    def lobe(distribution: str, alpha: tuple[float, float]) -> dict[str, Any]:
        return {
            "type": "roughconductor",
            "distribution": distribution,
            "alpha_u": alpha[0],
            "alpha_v": alpha[1],
            "eta": surface.index[0],
            "k": surface.index[1],
            "specular_reflectance": {"type": "uniform", "value": surface.specular},
        }

    lobes = {
        "type": "blendbsdf",
        "weight": surface.beckmann,
        "first": lobe("ggx", surface.ggx_alpha),
        "second": lobe("beckmann", surface.beckmann_alpha),
    }
    return {
        "type": "twosided",
        "face": {"type": "blendbsdf", "weight": surface.diffuse_share, "first": lobes, "second": diffuse},
    }


def parameters(surface: Surface) -> dict[str, float]:
    """Return the values of a BSDF's parameters under the names that Mitsuba gives them, to change it in place."""
    if surface.is_white:
        return {"brdf_0.reflectance.value": surface.diffuse}
    out = {
        "brdf_0.weight.value": surface.diffuse_share,
        "brdf_0.bsdf_1.reflectance.value": surface.diffuse,
        "brdf_0.bsdf_0.weight.value": surface.beckmann,
    }
    for index, alpha in enumerate((surface.ggx_alpha, surface.beckmann_alpha)):
        lobe = f"brdf_0.bsdf_0.bsdf_{index}"
        out |= {f"{lobe}.alpha_u.value": alpha[0], f"{lobe}.alpha_v.value": alpha[1]}
        out |= {f"{lobe}.specular_reflectance.value": surface.specular}
    return out
