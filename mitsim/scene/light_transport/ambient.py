"""Light from the emitters that the author of a scene added: lamps, windows, a sky.

Signal chain: surface point -> an emitter chosen at random, if nothing blocks it; or the emitter that a BSDF sample
meets -> weights of the balance heuristic -> radiance.

The light is the same in all images of a capture, whatever the projector shows. Two methods estimate it: sampling an
emitter, and following the BSDF until it meets one. The balance heuristic (Veach and Guibas, SIGGRAPH 1995) weights
them. Without it, either a small lamp over a matt face or a large window in a glossy one would be noisy.
"""

from __future__ import annotations

from typing import Any

from mitsim.scene.backend import dr, mi
from mitsim.scene.load import Scene

#: in place of a density, of a ray whose direction no other estimate finds: from the camera, or mirrored
ALONE = -1.0


def has_emitters(scene: Scene) -> bool:
    """Whether the scene has emitters of its own."""
    return len(scene.mitsuba.emitters()) > 0


def sampled_emitter_light(scene: Scene, surface: Any, bsdf: Any, random: Any, active: Any) -> Any:
    """Return the reflected radiance of one emitter, chosen at random [W / (mm^2 sr)].

    Parameters
    ----------
    scene, surface, bsdf
        The scene, the surface that reflects, and its BSDF.
    random, active
        Generator of random numbers, and mask of the lanes.

    See Also
    --------
    hit_emitter_light : the other estimate of the same light
    """
    point = mi.Point2f(random.next_float32(), random.next_float32())
    sample, weight = scene.mitsuba.sample_emitter_direction(surface, point, True, active)
    usable = active & (sample.pdf != 0.0)
    toward = surface.to_local(sample.d)
    reflected, pdf = bsdf.eval_pdf(mi.BSDFContext(), surface, toward, usable)
    heuristic = dr.select(sample.delta, 1.0, sample.pdf / (sample.pdf + pdf))
    return dr.select(usable, reflected[0] * weight[0] * heuristic, 0.0)


def hit_emitter_light(scene: Scene, surface: Any, origin: Any, pdf: Any) -> Any:
    """Return the weighted radiance of an emitter that a ray meets [W / (mm^2 sr)].

    Parameters
    ----------
    scene, surface
        The scene, and the surface that the ray meets.
    origin, pdf
        Point that the ray left, and density of its direction there [1/sr], or :data:`ALONE` for the weight 1.

    See Also
    --------
    sampled_emitter_light : the other estimate of the same light
    """
    emitter = surface.emitter(scene.mitsuba)
    emitted = emitter.eval(surface)[0]
    reference = dr.zeros(mi.Interaction3f)
    reference.p = origin
    sample = mi.DirectionSample3f(scene.mitsuba, surface, reference)
    alone = pdf < 0
    emitter_pdf = scene.mitsuba.pdf_emitter_direction(reference, sample, ~alone)
    heuristic = dr.select(alone, 1.0, pdf / (pdf + emitter_pdf))
    return dr.select(emitted > 0, emitted * heuristic, 0.0)
