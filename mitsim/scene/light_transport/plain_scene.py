"""Scenes so plain that a ray need not search them: one flat shape, as a coupon is, or one material.

Mitsuba finds the surface and the BSDF of a ray by calls that each lane makes for itself. Where every lane must come to
the same object the object is asked directly, and its arithmetic becomes a part of the kernel: the same formulas, in a
third of the time. A flat shape that is alone also needs no shadow rays, because it cannot stand in its own light.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from mitsim.scene.backend import dr, mi
from mitsim.scene.light_transport.ambient import has_emitters
from mitsim.scene.load import Scene

#: of a rotation in single precision times its inverse
_ROUNDINGS = 1e-5


def lone_plane(scene: Scene) -> Any | None:
    """The shape of a scene that is one rectangle and has no light of its own; None for any other.

    None also for a rectangle whose transform does not know its own inverse, as Mitsuba 3.9.1 makes one of a rotation
    about an axis that is no unit vector: asked directly, such a rectangle would lose a part.
    """
    shapes = scene.shapes
    if len(shapes) > 1 or has_emitters(scene) or shapes[0].shape_type() != mi.ShapeType.Rectangle.value:
        return None
    world = mi.traverse(shapes[0])["to_world"]
    back_and_forth = np.array((world @ world.inverse()).matrix, float).reshape(4, 4)[:3, :3]
    return shapes[0] if np.allclose(back_and_forth, np.eye(3), rtol=0, atol=_ROUNDINGS) else None


def lone_bsdf(scene: Scene) -> Any | None:
    """The BSDF that all shapes have in common; None if there are several."""
    first, *others = [shape.bsdf() for shape in scene.shapes]
    return first if all(bsdf is first for bsdf in others) else None


def meet(plane: Any, ray: Any) -> Any:
    """What ``mi.Scene.ray_intersect`` returns where a :func:`lone_plane` is all there is."""
    found = plane.ray_intersect_preliminary(ray)
    hit = found.is_valid()
    surface = plane.compute_surface_interaction(ray, found, mi.RayFlags.All, hit)
    surface.t = dr.select(hit, surface.t, dr.inf)
    surface.shape = found.shape
    surface.initialize_sh_frame()
    surface.wi = surface.to_local(-ray.d)
    return surface
