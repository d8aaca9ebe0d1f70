"""Define finishes by their trade names: plastics, castings and paints, as materials of a scene.

A moulded plastic scatters like a paint: a surface of n = 1.5 that reflects a few per cent specularly, over a body that
scatters the rest. A textured mould gives the wide lobe of a powder coat, a polished mould that of a gloss paint. A
blasted casting is a blasted metal. All numbers are *assumed*. They are written into the scene for replacement by
measured gloss and reflectance.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class NamedFinish:
    """A material of a scene: its BSDF ``kind``, its ``properties`` in the scene, and its description in ``words``."""

    kind: str
    properties: dict[str, str | float]
    words: str


def _metal(metal: str, process: str, roughness: float, words: str) -> NamedFinish:
    return NamedFinish("machined_metal", {"metal": metal, "process": process, "Ra": roughness}, words)


def _coat(kind: str, reflectance: float, gloss: float, words: str) -> NamedFinish:
    return NamedFinish(kind, {"reflectance": reflectance, "gloss": gloss}, words)


#: by the name in ``mitsim part --finish``
NAMED_FINISHES: dict[str, NamedFinish] = {
    "matt_white": NamedFinish("matt_white", {"reflectance": 0.85}, "the ideal diffuse white"),
    "gloss_paint": _coat("gloss_paint", 0.85, 85.0, "a white gloss paint"),
    "powder_coat": _coat("powder_coat", 0.8, 8.0, "a light powder coat"),
    "black_plastic": _coat("powder_coat", 0.04, 10.0, "black, from a textured mould"),
    "grey_plastic": _coat("powder_coat", 0.25, 10.0, "grey, from a textured mould"),
    "white_plastic": _coat("powder_coat", 0.75, 10.0, "white, from a textured mould"),
    "glossy_black_plastic": _coat("gloss_paint", 0.04, 85.0, "black, from a polished mould"),
    "iron_casting": _metal("carbon_steel", "grit_blasted", 6.0, "cast in sand and shot-blasted"),
    "aluminium_casting": _metal("aluminium", "bead_blasted", 2.0, "die-cast and bead-blasted"),
}
