"""Shortcuts for scenes in which a ray needs no search: one flat shape, such as a coupon, or one material.

Mitsuba calls shapes and BSDFs indirectly, for each lane. If all lanes reach the same object, mitsim calls the object
directly. Its arithmetic becomes part of the kernel: the same formulas in a third of the time. A single flat shape also
needs no shadow rays, because it cannot shadow itself.

If the scene has several materials, mitsim calls them indirectly, but those of the scene alone. Mitsuba's own call
compiles every BSDF of the process into the kernel: also those of other scenes, and the parts of a blend beside the
blend. It takes half as long again to compile, and twice the time for small images.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from mitsim.scene.backend import dr, mi
from mitsim.scene.load import Scene


def has_emitters(scene: Scene) -> bool:
    """Whether the scene has emitters of its own."""
    return len(scene.mitsuba.emitters()) > 0


def single_plane(scene: Scene) -> Any | None:
    """Return the shape of a scene that is one rectangle and has no emitters; None for any other scene."""
    shapes = scene.shapes
    if len(shapes) > 1 or has_emitters(scene) or shapes[0].shape_type() != mi.ShapeType.Rectangle.value:
        return None
    return shapes[0]


def single_bsdf(scene: Scene) -> Any | None:
    """Return the BSDF that all shapes share; None if there are several."""
    bsdfs = distinct_bsdfs(scene)
    return bsdfs[0] if bsdfs is not None and len(bsdfs) == 1 else None


def distinct_bsdfs(scene: Scene) -> list[Any] | None:
    """Return the BSDFs of a scene, each once; None if there are instances, whose BSDFs Mitsuba does not tell."""
    if any(shape.class_name() == "Instance" for shape in scene.shapes):
        return None
    return list(dict.fromkeys(shape.bsdf() for shape in scene.shapes))


class SceneBsdfs:
    """The BSDFs of a scene, for indirect calls that compile no others.

    ``instead`` are others to call in their place, in the order of :func:`distinct_bsdfs`.
    """

    def __init__(self, scene: Scene, instead: Sequence[Any] | None = None) -> None:
        self._bsdfs = distinct_bsdfs(scene)
        if self._bsdfs is None:
            return
        numbers = np.array(dr.reinterpret_array(mi.UInt32, scene.mitsuba.shapes_dr()))
        indices = np.zeros(numbers.max() + 1, np.uint32)  # for each of Mitsuba's numbers of shapes
        indices[numbers] = [self._bsdfs.index(shape.bsdf()) for shape in scene.shapes]
        self._indices = mi.UInt32(indices)
        self._bsdfs = self._bsdfs if instead is None else list(instead)

    def index_of(self, surface: Any, valid: Any) -> Any:
        """Return the index of each valid lane's BSDF in the list of the scene's."""
        return dr.gather(mi.UInt32, self._indices, dr.reinterpret_array(mi.UInt32, surface.shape), valid)

    def at(self, surface: Any) -> Any:
        """Return the BSDF of each lane's surface, with the methods that light paths need."""
        if self._bsdfs is None:
            return surface.bsdf()
        valid = surface.is_valid()
        index = self.index_of(surface, valid)
        return _BsdfOfLane(self._bsdfs, index, valid)


class _BsdfOfLane:
    """A BSDF that calls, for each ``valid`` lane, the one of some BSDFs that is at its ``index`` in the list."""

    def __init__(self, bsdfs: list[Any], index: Any, valid: Any) -> None:
        self._bsdfs, self._index, self._valid = bsdfs, index, valid

    def eval(self, context: Any, surface: Any, outgoing: Any, active: Any) -> Any:
        return self._call("eval", context, active, surface, outgoing)

    def pdf(self, context: Any, surface: Any, outgoing: Any, active: Any) -> Any:
        return self._call("pdf", context, active, surface, outgoing)

    def eval_pdf(self, context: Any, surface: Any, outgoing: Any, active: Any) -> Any:
        return self._call("eval_pdf", context, active, surface, outgoing)

    def sample(self, context: Any, surface: Any, sample1: Any, sample2: Any, active: Any) -> Any:
        return self._call("sample", context, active, surface, sample1, sample2)

    def _call(self, method: str, context: Any, active: Any, *arguments: Any) -> Any:
        targets = [partial(getattr(bsdf, method), context) for bsdf in self._bsdfs]
        return dr.switch(self._index, targets, *arguments, self._valid & active)


def intersect_plane(plane: Any, ray: Any) -> Any:
    """Return the intersection of a ray with a :func:`single_plane`, as ``mi.Scene.ray_intersect`` does."""
    intersection = plane.ray_intersect_preliminary(ray)
    hit = intersection.is_valid()
    surface = plane.compute_surface_interaction(ray, intersection, mi.RayFlags.All, hit)
    surface.t = dr.select(hit, surface.t, dr.inf)
    surface.shape = intersection.shape
    surface.initialize_sh_frame()
    surface.wi = surface.to_local(-ray.d)
    return surface
