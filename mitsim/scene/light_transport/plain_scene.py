"""Shortcuts for scenes in which a ray needs no search: one flat shape, such as a coupon, or one material.

Mitsuba calls shapes and BSDFs indirectly, for each lane. If all lanes reach the same object, mitsim calls the object
directly. Its arithmetic becomes part of the kernel: the same formulas in a third of the time. A single flat shape also
needs no shadow rays, because it cannot shadow itself.
"""

from __future__ import annotations

from typing import Any

from mitsim.scene.backend import dr, mi
from mitsim.scene.light_transport.ambient import has_emitters
from mitsim.scene.load import Scene


def single_plane(scene: Scene) -> Any | None:
    """Return the shape of a scene that is one rectangle and has no emitters; None for any other scene."""
    shapes = scene.shapes
    if len(shapes) > 1 or has_emitters(scene) or shapes[0].shape_type() != mi.ShapeType.Rectangle.value:
        return None
    return shapes[0]


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
