"""A BSDF whose mirror-like share grows with the angle of incidence, as wave optics has it.

Mitsuba's ``blendbsdf`` weighs its two children by one number. The coherent share of the light that a rough face
reflects depends on both directions (:mod:`mitsim.surface.coherence`):

    f(i, o) = A f_mirror(i, o) + (1 - A) h f_lobe(i, o),      A = exp(-g [(cos i + cos o) / 2]^2)

It is symmetric, so camera and lamp may change places, and h keeps the energy. Directions are drawn from the two
children in the ratio of A in the mirror direction. The children are stock BSDFs, asked directly, so that all of it is
one piece of the kernel.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

from mitsim.surface.coherence import EVEN_FROM

#: Mitsuba's name of the BSDF
NAME = "coherent_blend"

#: a share under this is none: even in its middle so narrow a lobe has 1e-3 of the other's light
_LEAST_SHARE = 1e-6

#: names of the properties that are the numbers of h
NUMBERS = ("c_0", "c_1", "c_2")


@lru_cache(maxsize=1)
def register_coherent_blend() -> None:
    """Tell Mitsuba of the BSDF ``coherent_blend``; to be called once the variant is set, as often as one likes.

    Its properties are ``phase_variance`` g [rad^2], the numbers ``c_0``, ``c_1`` and ``c_2`` of h, and two nested
    BSDFs, ``mirror`` and ``lobe``.
    """
    from mitsim.scene.backend import dr, mi

    class CoherentBlend(mi.BSDF):  # type: ignore[misc]
        def __init__(self, props: Any) -> None:
            mi.BSDF.__init__(self, props)
            self.mirror, self.lobe = props["mirror"], props["lobe"]
            self.phase_variance = dr.opaque(mi.Float, props["phase_variance"])  # one kernel, whatever its value
            self.numbers = [dr.opaque(mi.Float, props[name]) for name in NUMBERS]
            self.m_components = [
                child.flags(k) for child in (self.lobe, self.mirror) for k in range(child.component_count())
            ]
            self.m_flags = self.lobe.flags() | self.mirror.flags()

        def eval(self, context: Any, surface: Any, outgoing: Any, active: Any = True) -> Any:
            mirror = dr.if_stmt(
                (surface, outgoing),
                self._mirrors(surface, outgoing, active),
                lambda s, o: self.mirror.eval(context, s, o, True),
                lambda s, o: mi.Spectrum(0.0),
            )
            lobe = self.lobe.eval(context, surface, outgoing, active)
            return self._blended(mirror, lobe, surface.wi.z, outgoing.z)

        def pdf(self, context: Any, surface: Any, outgoing: Any, active: Any = True) -> Any:
            chance = self._share(surface.wi.z)
            mirror = dr.if_stmt(
                (surface, outgoing),
                self._mirrors(surface, outgoing, active),
                lambda s, o: self.mirror.pdf(context, s, o, True),
                lambda s, o: mi.Float(0.0),
            )
            return chance * mirror + (1.0 - chance) * self.lobe.pdf(context, surface, outgoing, active)

        def eval_pdf(self, context: Any, surface: Any, outgoing: Any, active: Any = True) -> Any:
            chance = self._share(surface.wi.z)
            mirror, mirror_pdf = dr.if_stmt(
                (surface, outgoing),
                self._mirrors(surface, outgoing, active),
                lambda s, o: self.mirror.eval_pdf(context, s, o, True),
                lambda s, o: (mi.Spectrum(0.0), mi.Float(0.0)),
            )
            lobe, lobe_pdf = self.lobe.eval_pdf(context, surface, outgoing, active)
            value = self._blended(mirror, lobe, surface.wi.z, outgoing.z)
            return value, chance * mirror_pdf + (1.0 - chance) * lobe_pdf

        def sample(self, context: Any, surface: Any, pick: Any, place: Any, active: Any = True) -> Any:
            chance = self._share(surface.wi.z)
            to_mirror = pick < chance
            pick = dr.select(to_mirror, pick / chance, (pick - chance) / (1.0 - chance))
            found = dr.if_stmt(
                (surface, pick, place, mi.Bool(active)),
                to_mirror,
                lambda *given: self.mirror.sample(context, *given)[0],
                lambda *given: self.lobe.sample(context, *given)[0],
            )
            value, found.pdf = self.eval_pdf(context, surface, found.wo, active)
            usable = active & (found.pdf > 0)
            return found, dr.select(usable, value / found.pdf, 0.0)

        def traverse(self, callback: Any) -> None:
            differentiable = mi.ParamFlags.Differentiable
            callback.put("phase_variance", self.phase_variance, differentiable)
            callback.put("mirror", self.mirror, differentiable)
            for name, number in zip(NUMBERS, self.numbers, strict=True):
                callback.put(name, number, differentiable)
            callback.put("lobe", self.lobe, differentiable)

        def to_string(self) -> str:
            return f"CoherentBlend[phase_variance={self.phase_variance},\n mirror={self.mirror},\n lobe={self.lobe}]"

        def _mirrors(self, surface: Any, outgoing: Any, active: Any) -> Any:
            """Where the mirror-like lobe has to be worked out; elsewhere it is skipped."""
            worth_it = (self._share(surface.wi.z) > _LEAST_SHARE) | (self._share(outgoing.z) > _LEAST_SHARE)
            return active & (surface.wi.z > 0) & (outgoing.z > 0) & worth_it

        def _blended(self, mirror: Any, lobe: Any, cosine_in: Any, cosine_out: Any) -> Any:
            mean = 0.5 * (cosine_in + cosine_out)
            share = self._share(mean)
            u = dr.maximum(1.0 - mean * (1.0 / EVEN_FROM), 0.0)
            first, second, third = self.numbers
            factor = dr.maximum(dr.fma(dr.square(u), dr.fma(u, dr.fma(u, third, second), first), 1.0), 0.0)
            return share * mirror + (1.0 - share) * factor * lobe

        def _share(self, mean_cosine: Any) -> Any:
            return dr.exp(-self.phase_variance * dr.square(mean_cosine))

    mi.register_bsdf(NAME, CoherentBlend)
