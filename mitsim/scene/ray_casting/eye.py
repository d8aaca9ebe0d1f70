"""A camera's or projector's place in the world, as numbers on the device."""

from __future__ import annotations

from typing import Any

from mitsim.scene.backend import dr, mi
from mitsim.sensor.transforms import Transform

#: a shadow ray ends this share of its length before the eye, and starts off the surface by Mitsuba's own rule
_SHADOW_END = 1e-4


def shadow_ray(surface: Any, toward: Any, distance: Any) -> Any:
    """Ray from a surface along the unit direction ``toward`` to an eye ``distance`` [mm] away, short of the eye."""
    ray = surface.spawn_ray(toward)
    ray.maxt = distance * (1.0 - _SHADOW_END)
    return ray


class Eye:
    """A frame on the device; its numbers are opaque, so that another pose does not mean another kernel."""

    def __init__(self, world_from_eye: Transform) -> None:
        self.position = mi.Point3f(*[dr.opaque(mi.Float, float(v)) for v in world_from_eye.translation])
        self.axes = [mi.Vector3f(*[dr.opaque(mi.Float, float(v)) for v in axis]) for axis in world_from_eye.rotation.T]

    def turn(self, local: Any) -> Any:
        """Direction of the eye's frame in the world."""
        return self.axes[0] * local.x + self.axes[1] * local.y + self.axes[2] * local.z

    def local(self, direction: Any) -> Any:
        """Direction of the world in the eye's frame."""
        return mi.Vector3f(*[dr.dot(axis, direction) for axis in self.axes])
