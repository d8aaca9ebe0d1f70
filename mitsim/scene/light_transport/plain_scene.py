"""Shortcuts for scenes in which a ray needs no search: one flat shape, such as a coupon, or one material.

Mitsuba calls shapes and BSDFs indirectly, for each lane. If all lanes reach the same object, mitsim calls the object
directly. Its arithmetic becomes part of the kernel: the same formulas in a third of the time. A single flat shape also
needs no shadow rays, because it cannot shadow itself.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from mitsim.scene.backend import dr, mi
from mitsim.scene.light_transport.ambient import has_emitters
from mitsim.scene.load import Scene

#: tolerance for rounding of a rotation in single precision times its inverse
_ROUNDINGS = 1e-5


def single_plane(scene: Scene) -> Any | None:
    """Return the shape of a scene that is one rectangle and has no emitters; None for any other scene.

    None also if the rectangle's transform times its inverse is not the identity. Mitsuba 3.9.1 makes such a transform
    from a rotation about a vector that is not a unit vector. Called directly, the rectangle would lose a part.
    """
    shapes = scene.shapes
    if len(shapes) > 1 or has_emitters(scene) or shapes[0].shape_type() != mi.ShapeType.Rectangle.value:
        return None
    to_world = mi.traverse(shapes[0])["to_world"]
    product = np.array((to_world @ to_world.inverse()).matrix, float).reshape(4, 4)[:3, :3]
    return shapes[0] if np.allclose(product, np.eye(3), rtol=0, atol=_ROUNDINGS) else None


def single_bsdf(scene: Scene) -> Any | None:
    """Return the BSDF that all shapes share; None if there are several."""
    first, *others = [shape.bsdf() for shape in scene.shapes]
    return first if all(bsdf is first for bsdf in others) else None


def intersect_plane(plane: Any, ray: Any) -> Any:
    """Return what ``mi.Scene.ray_intersect`` returns for a scene that is a :func:`single_plane`."""
    found = plane.ray_intersect_preliminary(ray)
    hit = found.is_valid()
    surface = plane.compute_surface_interaction(ray, found, mi.RayFlags.All, hit)
    surface.t = dr.select(hit, surface.t, dr.inf)
    surface.shape = found.shape
    surface.initialize_sh_frame()
    surface.wi = surface.to_local(-ray.d)
    return surface
