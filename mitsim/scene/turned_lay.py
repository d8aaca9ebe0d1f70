"""A Mitsuba BSDF that turns another about the normal, for machining marks in any direction.

Signal chain: directions in the local frame of a shape -> the same in a frame turned about the normal -> a BSDF whose
lobe is wider along v than along u.

Mitsuba's ``roughconductor`` has its widths along u and v of the shape. Here u of the lobe lies at the angle
``turn_deg`` from u of the shape, toward v. On a mesh without UVs, Mitsuba derives u from the normal alone: each flat face
then has one direction, and faces that are inclined to one another have unrelated ones.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

#: Mitsuba's name of the BSDF
NAME = "turned_lay"


def turned_description(description: dict[str, Any], turn_deg: float) -> dict[str, Any]:
    """Return the description of a BSDF that is turned by an angle [deg] from u toward v."""
    register_turned_lay()
    return {"type": NAME, "turn_deg": turn_deg, "lobe": description}


@lru_cache(maxsize=1)
def register_turned_lay() -> None:
    """Register the BSDF ``turned_lay`` with Mitsuba.

    Call it after the variant is chosen; repeated calls have no effect. Its properties are ``turn_deg`` [deg] and one
    nested BSDF, ``lobe``.
    """
    from mitsim.scene.backend import dr, mi

    class TurnedLay(mi.BSDF):  # type: ignore[misc]
        def __init__(self, props: Any) -> None:
            mi.BSDF.__init__(self, props)
            self.lobe = props["lobe"]
            self.turn_deg = dr.opaque(mi.Float, props["turn_deg"])  # every angle shares one kernel
            self.m_components = [self.lobe.flags(k) for k in range(self.lobe.component_count())]
            self.m_flags = self.lobe.flags()

        def eval(self, context: Any, surface: Any, outgoing: Any, active: Any = True) -> Any:
            turned, to_lobe, _ = self._turned(surface)
            return self.lobe.eval(context, turned, to_lobe(outgoing), active)

        def pdf(self, context: Any, surface: Any, outgoing: Any, active: Any = True) -> Any:
            turned, to_lobe, _ = self._turned(surface)
            return self.lobe.pdf(context, turned, to_lobe(outgoing), active)

        def eval_pdf(self, context: Any, surface: Any, outgoing: Any, active: Any = True) -> Any:
            turned, to_lobe, _ = self._turned(surface)
            return self.lobe.eval_pdf(context, turned, to_lobe(outgoing), active)

        def sample(self, context: Any, surface: Any, sample1: Any, sample2: Any, active: Any = True) -> Any:
            turned, _, from_lobe = self._turned(surface)
            sampled, weight = self.lobe.sample(context, turned, sample1, sample2, active)
            sampled.wo = from_lobe(sampled.wo)
            return sampled, weight

        def traverse(self, callback: Any) -> None:
            callback.put("turn_deg", self.turn_deg, mi.ParamFlags.Differentiable)
            callback.put("lobe", self.lobe, mi.ParamFlags.Differentiable)

        def to_string(self) -> str:
            return f"TurnedLay[turn_deg={self.turn_deg},\n lobe={self.lobe}]"

        def _turned(self, surface: Any) -> tuple[Any, Any, Any]:
            """Return the surface seen in the lobe's frame, and the maps of directions into that frame and back."""
            sine, cosine = dr.sincos(self.turn_deg * (dr.pi / 180))

            def to_lobe(one: Any) -> Any:
                return mi.Vector3f(dr.fma(cosine, one.x, sine * one.y), dr.fma(cosine, one.y, -sine * one.x), one.z)

            def from_lobe(one: Any) -> Any:
                return mi.Vector3f(dr.fma(cosine, one.x, -sine * one.y), dr.fma(cosine, one.y, sine * one.x), one.z)

            turned = mi.SurfaceInteraction3f(surface)
            turned.wi = to_lobe(surface.wi)
            return turned, to_lobe, from_lobe

    mi.register_bsdf(NAME, TurnedLay)
