"""Frames of cameras and projectors on the device, and shadow rays toward them."""

from __future__ import annotations

from typing import Any

from mitsim.scene.backend import dr, mi
from mitsim.sensor.transforms import Transform

#: share of its length by which a shadow ray ends before the eye. Mitsuba offsets its start from the surface
_SHADOW_END = 1e-4


def shadow_ray(surface: Any, toward: Any, distance: Any) -> Any:
    """Return the ray from a surface toward an eye, which ends just before the eye.

    ``toward`` is a unit vector, ``distance`` that of the eye [mm].
    """
    ray = surface.spawn_ray(toward)
    ray.maxt = distance * (1.0 - _SHADOW_END)
    return ray


class Eye:
    """Frame of a camera or projector on the device.

    ``position`` [mm] and ``axes``, in the world frame. They are opaque to Dr.Jit, so that all poses share one kernel.
    """

    def __init__(self, world_from_eye: Transform) -> None:
        self.position = mi.Point3f(*[dr.opaque(mi.Float, float(v)) for v in world_from_eye.translation])
        self.axes = [mi.Vector3f(*[dr.opaque(mi.Float, float(v)) for v in axis]) for axis in world_from_eye.rotation.T]

    def to_world(self, local: Any) -> Any:
        """Rotate a direction from the eye's frame to the world frame."""
        return self.axes[0] * local.x + self.axes[1] * local.y + self.axes[2] * local.z

    def to_local(self, direction: Any) -> Any:
        """Rotate a direction from the world frame to the eye's frame."""
        return mi.Vector3f(*[dr.dot(axis, direction) for axis in self.axes])
