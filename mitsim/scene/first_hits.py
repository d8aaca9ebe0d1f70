"""Find the first surface on each ray in a Mitsuba scene, whichever side it shows, and Mitsuba's numbers of shapes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from characterisation.files.arrays import Floats
from mitsim.scene.backend import dr, mi
from mitsim.scene.device import known_to_device, vectors_to_device, vectors_to_host


@dataclass(frozen=True)
class Hits:
    """First surfaces on n rays."""

    shape: NDArray[np.int16]  # (n,) index of the shape, of the instance for a shape in a group; -1 for none
    front: NDArray[np.bool_]  # (n,) whether the ray meets the reflecting side
    #: ``normal`` (n, 3) on the side of the ray's origin, world frame, and ``distance`` (n,) [mm]; NaN without a surface
    normal: Floats
    distance: Floats


def first_hits(scene: Any, origins: NDArray[np.floating], directions: NDArray[np.floating]) -> Hits:
    """Return the first surfaces on n rays in an ``mi.Scene``.

    ``origins`` (n, 3) [mm] and unit ``directions`` (n, 3), world frame. A direction of NaN meets nothing.
    """
    start = vectors_to_device(np.asarray(origins).reshape(-1, 3))
    along, active = known_to_device(np.asarray(directions).reshape(-1, 3))
    ray = mi.Ray3f(mi.Point3f(start), along)
    surface = scene.ray_intersect(ray, active)
    behind = dr.dot(surface.n, ray.d) > 0
    two_sided = (surface.bsdf().flags() & mi.UInt32(int(mi.BSDFFlags.BackSide))) != 0
    front = ~behind | two_sided
    normal = dr.select(behind, -surface.n, surface.n)
    shape_id_of_ray = numbers_met(surface, surface.is_valid())
    distance = dr.select(surface.is_valid(), surface.t, dr.nan)
    dr.eval(front, normal, shape_id_of_ray, distance)
    shape = shape_indices(scene, shape_id_of_ray)
    vectors = np.where((shape >= 0)[:, None], vectors_to_host(normal, float), np.nan)
    return Hits(shape, np.array(front, bool) & (shape >= 0), vectors, np.array(distance, float))


def numbers_met(surface: Any, valid: Any) -> Any:
    """Return the number of the shape, or instance, that each lane of an interaction met; 0 for none."""
    inside, instance = (dr.reinterpret_array(mi.UInt32, pointer) for pointer in (surface.shape, surface.instance))
    return dr.select(valid, dr.select(instance != 0, instance, inside), 0)


def shape_indices(scene: Any, numbers: Any) -> NDArray[np.int16]:
    """Return the indices (n,) into the shapes of an ``mi.Scene`` of Mitsuba's shape numbers; -1 for none."""
    ids = np.array(numbers)
    lookup = np.full(int(ids.max(initial=0)) + 1, -1, np.int16)
    shapes = shape_numbers(scene)
    within = shapes < len(lookup)
    lookup[shapes[within]] = np.flatnonzero(within)
    lookup[0] = -1
    return np.asarray(lookup[ids])


def shape_numbers(scene: Any) -> NDArray[np.uint32]:
    """Return Mitsuba's numbers of the shapes of an ``mi.Scene``, in their order; each is 1 or more."""
    return np.array(dr.reinterpret_array(mi.UInt32, scene.shapes_dr()))
