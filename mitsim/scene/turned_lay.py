"""A Mitsuba BSDF that turns another about the normal, for machining marks whose direction is drawn.

Signal chain: directions in the local frame of a surface -> the same in the frame of the marks -> a BSDF whose lobe is
wider along v than along u.

Mitsuba's ``roughconductor`` has its widths along u and v of the shape. On a mesh without UVs these follow the edges of
each triangle, so that a flat face has several directions. Here the marks have the angle ``turn_deg`` to the z axis of
the part, projected onto the surface, and to its x axis where the surface is normal to z. Every flat face then has one
direction. On a cylinder along z or across it, the marks have one angle to the axis; on others the angle varies.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

#: Mitsuba's name of the BSDF
NAME = "turned_lay"

#: angle between normal and z axis below which the marks are counted from x [rad]
_NORMAL_TO_Z = 1e-3


def turned_description(description: dict[str, Any], turn_deg: float) -> dict[str, Any]:
    """Return the description of a BSDF whose u is turned to an angle [deg] from the projected z axis of the part."""
    register_turned_lay()
    return {"type": NAME, "turn_deg": turn_deg, "lobe": description}


def is_turned(bsdf: Any) -> bool:
    """Return whether a BSDF is or contains a turned one."""
    from mitsim.scene.backend import mi

    return any(key.rpartition(".")[2] == "turn_deg" for key in mi.traverse(bsdf).keys())  # noqa: SIM118 - not a dict


def from_z_axis(frame: Any, direction: Any) -> Any:
    """Return a local direction in the frame whose first axis is the projected z axis of the part.

    A turned BSDF returns the same for such directions on a surface without ``sh_frame`` as for local directions on the
    surface itself.
    """
    from mitsim.scene.backend import mi

    sine, cosine = _reference(frame)
    return mi.Vector3f(*_turned(sine, cosine, direction))


def _turned(sine: Any, cosine: Any, direction: Any) -> tuple[Any, Any, Any]:
    """Return a direction's coordinates in axes that are turned about z by an angle."""
    from mitsim.scene.backend import dr

    return (
        dr.fma(cosine, direction.x, sine * direction.y),
        dr.fma(cosine, direction.y, -sine * direction.x),
        direction.z,
    )


def _reference(frame: Any) -> tuple[Any, Any]:
    """Return sine and cosine of the angle from u to the projected z axis; 0 and 1 for a surface without a frame."""
    from mitsim.scene.backend import dr

    flat = dr.square(frame.s.z) + dr.square(frame.t.z) < _NORMAL_TO_Z**2
    along_u, along_v = dr.select(flat, frame.s.x, frame.s.z), dr.select(flat, frame.t.x, frame.t.z)
    square = dr.square(along_u) + dr.square(along_v)
    placed = square > 0
    scale = dr.rsqrt(dr.select(placed, square, 1.0))
    return along_v * scale, dr.select(placed, along_u * scale, 1.0)


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
            zero_sine, zero_cosine = _reference(surface.sh_frame)
            turn_sine, turn_cosine = dr.sincos(self.turn_deg * (dr.pi / 180))
            cosine = dr.fma(zero_cosine, turn_cosine, -zero_sine * turn_sine)
            sine = dr.fma(zero_sine, turn_cosine, zero_cosine * turn_sine)

            def to_lobe(direction: Any) -> Any:
                return mi.Vector3f(*_turned(sine, cosine, direction))

            def from_lobe(direction: Any) -> Any:
                return mi.Vector3f(*_turned(-sine, cosine, direction))

            turned = mi.SurfaceInteraction3f(surface)
            turned.wi = to_lobe(surface.wi)
            return turned, to_lobe, from_lobe

    mi.register_bsdf(NAME, TurnedLay)
