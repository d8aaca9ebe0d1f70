"""Light from the emitters that a scene's author put there: lamps, windows, a sky.

It is the same in every image of a capture, whatever the projector shows. A surface's share of it is found in two ways,
by aiming at an emitter and by following the BSDF until one is hit, and the two are weighed by the balance heuristic
(Veach & Guibas 1995), so that neither a small lamp over a dull face nor a large window in a shiny one is noisy.
"""

from __future__ import annotations

from typing import Any

from mitsim.scene.backend import dr, mi
from mitsim.scene.load import Scene


def has_emitters(scene: Scene) -> bool:
    """Whether the author lit the scene."""
    return len(scene.mitsuba.emitters()) > 0


def aimed(scene: Scene, surface: Any, bsdf: Any, random: Any, active: Any) -> Any:
    """Radiance toward the ray that comes of one emitter chosen at random [W / (mm^2 sr)]."""
    place = mi.Point2f(random.next_float32(), random.next_float32())
    sample, weight = scene.mitsuba.sample_emitter_direction(surface, place, True, active)
    usable = active & (sample.pdf != 0.0)
    toward = surface.to_local(sample.d)
    reflected, pdf = bsdf.eval_pdf(mi.BSDFContext(), surface, toward, usable)
    share = dr.select(sample.delta, 1.0, sample.pdf / (sample.pdf + pdf))
    return dr.select(usable, reflected[0] * weight[0] * share, 0.0)


def met(scene: Scene, surface: Any, origin: Any, pdf: Any, first: Any) -> Any:
    """Radiance of an emitter that the ray has run into [W / (mm^2 sr)].

    ``pdf`` of the direction in which the ray left ``origin``; a camera's own rays (``first``) were not sampled.
    """
    emitter = surface.emitter(scene.mitsuba)
    emitted = emitter.eval(surface)[0]
    reference = dr.zeros(mi.Interaction3f)
    reference.p = origin
    sample = mi.DirectionSample3f(scene.mitsuba, surface, reference)
    other = scene.mitsuba.pdf_emitter_direction(reference, sample, ~first)
    share = dr.select(first, 1.0, pdf / (pdf + other))
    return dr.select(emitted > 0, emitted * share, 0.0)
