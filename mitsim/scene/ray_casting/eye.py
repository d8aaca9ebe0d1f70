"""Frames of cameras and projectors on the device, and shadow rays toward them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from mitsim.scene.backend import dr, mi
from mitsim.scene.device import opaque, to_device
from mitsim.sensor.transforms import Transform

#: share of its length by which a shadow ray ends before the eye. Mitsuba offsets its start from the surface
_SHADOW_END = 1e-4


def shadow_ray(surface: Any, toward: Any, distance: Any) -> Any:
    """Return the ray from a surface along unit ``toward``, which ends just before the eye at ``distance`` [mm]."""
    ray = surface.spawn_ray(toward)
    ray.maxt = distance * (1.0 - _SHADOW_END)
    return ray


def of_lane(values: Sequence[float], lane: Any = None) -> Any:
    """Return for each lane one of ``values``: that with the number ``lane``, or the only one if ``lane`` is None.

    The numbers are opaque to Dr.Jit, so that all poses share one kernel.
    """
    if lane is None:
        return opaque(values[0])
    return dr.gather(mi.Float, to_device(values), lane)


class Eye:
    """Frame of a camera or projector on the device, or several frames: ``lane`` then is each lane's number of a frame.

    ``position`` [mm] and ``axes``, in the world frame.
    """

    def __init__(self, world_from_eye: Transform | Sequence[Transform], lane: Any = None) -> None:
        frames = [world_from_eye] if isinstance(world_from_eye, Transform) else world_from_eye
        origins = np.array([frame.translation for frame in frames])
        axes = np.array([frame.rotation.T for frame in frames])
        self.position = mi.Point3f(*[of_lane(component, lane) for component in origins.T])
        self.axes = [
            mi.Vector3f(*[of_lane(component, lane) for component in axis.T]) for axis in np.moveaxis(axes, 1, 0)
        ]

    def to_world(self, local: Any) -> Any:
        """Rotate a direction from the eye's frame to the world frame."""
        return self.axes[0] * local.x + self.axes[1] * local.y + self.axes[2] * local.z

    def to_local(self, direction: Any) -> Any:
        """Rotate a direction from the world frame to the eye's frame."""
        return mi.Vector3f(*[dr.dot(axis, direction) for axis in self.axes])
