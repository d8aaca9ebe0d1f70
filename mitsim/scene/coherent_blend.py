"""A Mitsuba BSDF whose coherent (mirror-like) share grows with the angle of incidence, as wave optics predicts.

Signal chain: directions i and o in the local frame -> coherent share A -> value and density of two stock BSDFs -> their
weighted sum.

Mitsuba's ``blendbsdf`` weights its two children by one constant. The coherent share of the light that a rough surface
reflects depends on both directions (:mod:`mitsim.scene.surface.coherence`):

    f(i, o) = A f_mirror(i, o) + (1 - A) h f_lobe(i, o),      A = exp(-g [(cos i + cos o) / 2]^2)

f is symmetric, so camera and projector may be exchanged. The factor h conserves energy. Sampling chooses the mirror
child with the probability A of the mirror direction. The children are stock BSDFs that are called directly, so that the
whole BSDF compiles into one kernel.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

from mitsim.scene.surface.coherence import EVEN_FROM

#: Mitsuba's name of the BSDF
NAME = "coherent_blend"

#: a coherent share below this is neglected: even at its centre, the mirror lobe then has 1e-3 of the other's light
_LEAST_SHARE = 1e-6

#: properties with the coefficients of h
NUMBERS = ("c_0", "c_1", "c_2")


@lru_cache(maxsize=1)
def register_coherent_blend() -> None:
    """Register the BSDF ``coherent_blend`` with Mitsuba.

    Call it after the variant is chosen; repeated calls have no effect. The properties of the BSDF are
    ``phase_variance`` g [rad^2], the coefficients ``c_0``, ``c_1`` and ``c_2`` of h [1], and two nested BSDFs,
    ``mirror`` and ``lobe``.
    """
    from mitsim.scene.backend import dr, mi

    class CoherentBlend(mi.BSDF):  # type: ignore[misc]
        def __init__(self, props: Any) -> None:
            mi.BSDF.__init__(self, props)
            self.mirror, self.lobe = props["mirror"], props["lobe"]
            self.phase_variance = dr.opaque(mi.Float, props["phase_variance"])  # every value shares one kernel
            self.numbers = [dr.opaque(mi.Float, props[name]) for name in NUMBERS]
            self.m_components = [
                child.flags(k) for child in (self.lobe, self.mirror) for k in range(child.component_count())
            ]
            self.m_flags = self.lobe.flags() | self.mirror.flags()

        def eval(self, context: Any, surface: Any, outgoing: Any, active: Any = True) -> Any:
            mirror = dr.if_stmt(
                (surface, outgoing),
                self._mirror_needed(surface, outgoing, active),
                lambda s, o: self.mirror.eval(context, s, o, True),
                lambda s, o: mi.Spectrum(0.0),
            )
            lobe = self.lobe.eval(context, surface, outgoing, active)
            return self._blended(mirror, lobe, surface.wi.z, outgoing.z)

        def pdf(self, context: Any, surface: Any, outgoing: Any, active: Any = True) -> Any:
            probability = self._share(surface.wi.z)
            mirror = dr.if_stmt(
                (surface, outgoing),
                self._mirror_needed(surface, outgoing, active),
                lambda s, o: self.mirror.pdf(context, s, o, True),
                lambda s, o: mi.Float(0.0),
            )
            return probability * mirror + (1.0 - probability) * self.lobe.pdf(context, surface, outgoing, active)

        def eval_pdf(self, context: Any, surface: Any, outgoing: Any, active: Any = True) -> Any:
            probability = self._share(surface.wi.z)
            mirror, mirror_pdf = dr.if_stmt(
                (surface, outgoing),
                self._mirror_needed(surface, outgoing, active),
                lambda s, o: self.mirror.eval_pdf(context, s, o, True),
                lambda s, o: (mi.Spectrum(0.0), mi.Float(0.0)),
            )
            lobe, lobe_pdf = self.lobe.eval_pdf(context, surface, outgoing, active)
            value = self._blended(mirror, lobe, surface.wi.z, outgoing.z)
            return value, probability * mirror_pdf + (1.0 - probability) * lobe_pdf

        def sample(self, context: Any, surface: Any, sample1: Any, sample2: Any, active: Any = True) -> Any:
            probability = self._share(surface.wi.z)
            chose_mirror = sample1 < probability
            sample1 = dr.select(chose_mirror, sample1 / probability, (sample1 - probability) / (1.0 - probability))
            sampled = dr.if_stmt(
                (surface, sample1, sample2, mi.Bool(active)),
                chose_mirror,
                lambda *arguments: self.mirror.sample(context, *arguments)[0],
                lambda *arguments: self.lobe.sample(context, *arguments)[0],
            )
            value, sampled.pdf = self.eval_pdf(context, surface, sampled.wo, active)
            usable = active & (sampled.pdf > 0)
            return sampled, dr.select(usable, value / sampled.pdf, 0.0)

        def traverse(self, callback: Any) -> None:
            differentiable = mi.ParamFlags.Differentiable
            callback.put("phase_variance", self.phase_variance, differentiable)
            callback.put("mirror", self.mirror, differentiable)
            for name, number in zip(NUMBERS, self.numbers, strict=True):
                callback.put(name, number, differentiable)
            callback.put("lobe", self.lobe, differentiable)

        def to_string(self) -> str:
            return f"CoherentBlend[phase_variance={self.phase_variance},\n mirror={self.mirror},\n lobe={self.lobe}]"

        def _mirror_needed(self, surface: Any, outgoing: Any, active: Any) -> Any:
            """Where the coherent lobe must be evaluated; elsewhere it is skipped."""
            significant = (self._share(surface.wi.z) > _LEAST_SHARE) | (self._share(outgoing.z) > _LEAST_SHARE)
            return active & (surface.wi.z > 0) & (outgoing.z > 0) & significant

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
