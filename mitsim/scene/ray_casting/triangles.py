"""Return all solid surfaces of a scene as triangles, to test a housing for collisions.

Signal chain: shape -> its own triangles, a grid on a sphere, cylinder or disk, or the bounding box -> triangles in the
world frame -> corners of their convex hull.

A sphere, cylinder or disk is approximated with 128 corners around. The corners lie on the surface; the triangles lie up
to 6e-4 of the radius inside it. Any other shape that is no mesh (an instance, curves, a signed distance grid) is
replaced by its bounding box, which is larger.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import trimesh
from scipy.spatial import ConvexHull, QhullError

from characterisation.files.arrays import Floats
from mitsim.scene.backend import mi
from mitsim.scene.load import Scene, bounds_of

#: corners around a circle
_ANGLES = np.linspace(0, 2 * np.pi, 129)


def triangles(scene: Scene) -> Floats:
    """Return triangles (n, 3, 3) [mm], world frame, with corners anticlockwise as seen from the side of the normal.

    Shapes whose BSDF transmits all light unchanged (``null``) are left out, because they bound a medium and are not
    solid. Glass is solid.
    """
    return np.concatenate([np.empty((0, 3, 3)), *triangles_by_shape(scene).values()])


def triangles_by_shape(scene: Scene) -> dict[str, Floats]:
    """Return the :func:`triangles` of each solid shape, by its name."""
    named = zip(scene.names, scene.shapes, strict=True)
    return {name: _of_shape(shape) for name, shape in named if _solid(shape)}


def hull_corners(scene: Scene) -> Floats:
    """Return the corners (k, 3) [mm], world frame, of the convex hull of all solid surfaces but lamps."""
    parts = [_of_shape(shape) for shape in scene.shapes if _solid(shape) and not shape.is_emitter()]
    corners = np.unique(np.concatenate([np.empty((0, 3, 3)), *parts]).reshape(-1, 3), axis=0)
    try:
        return np.asarray(corners[ConvexHull(corners).vertices])
    except QhullError:  # all in one plane, or on a line
        return corners


def _solid(shape: Any) -> bool:
    flags = int(shape.bsdf().flags())
    delta_lobes = mi.BSDFFlags.DeltaReflection, mi.BSDFFlags.DeltaTransmission, mi.BSDFFlags.Delta1D
    return any(flags & int(flag) for flag in (mi.BSDFFlags.Smooth, *delta_lobes))


def _of_shape(shape: Any) -> Floats:
    if shape.is_mesh():
        vertices = np.array(shape.vertex_positions_buffer(), float).reshape(-1, 3)
        faces = np.array(shape.faces_buffer(), np.int64).reshape(-1, 3)
        return np.asarray(vertices[faces[:, ::-1] if shape.has_flipped_normals() else faces])
    if shape.class_name() not in _UNIT:
        return np.asarray(trimesh.creation.box(bounds=bounds_of(shape)).triangles, float)
    kind = shape.class_name()
    world = np.array(mi.traverse(shape)["to_world"].matrix, float).reshape(4, 4)
    corners = _UNIT[kind]() @ world[:3, :3].T + world[:3, 3]
    mirrored = kind != "Cylinder" and np.linalg.det(world[:3, :3]) < 0  # a cylinder's flag includes this
    flipped = mirrored != shape.has_flipped_normals()
    return np.asarray(corners[:, ::-1] if flipped else corners)


def _grid_triangles(corners: Floats) -> Floats:
    """Return two triangles for each cell of a grid of corners (m, n, 3), without those that have no area."""
    a, b, c, d = corners[:-1, :-1], corners[1:, :-1], corners[1:, 1:], corners[:-1, 1:]
    both = np.concatenate([np.stack([a, b, c], axis=-2), np.stack([a, c, d], axis=-2)]).reshape(-1, 3, 3)
    size = np.linalg.norm(np.cross(both[:, 1] - both[:, 0], both[:, 2] - both[:, 0]), axis=1)
    return np.asarray(both[size > 1e-9])


def _sphere() -> Floats:
    around, down = np.meshgrid(_ANGLES, np.linspace(np.pi, 0, len(_ANGLES) // 2 + 1), indexing="ij")
    coordinates = [np.sin(down) * np.cos(around), np.sin(down) * np.sin(around), np.cos(down)]
    return _grid_triangles(np.stack(coordinates, axis=-1))


def _cylinder() -> Floats:
    around, up = np.meshgrid(_ANGLES, [0.0, 1.0], indexing="ij")
    return _grid_triangles(np.stack([np.cos(around), np.sin(around), up], axis=-1))


def _disk() -> Floats:
    out, around = np.meshgrid([0.0, 1.0], _ANGLES, indexing="ij")
    return _grid_triangles(np.stack([out * np.cos(around), out * np.sin(around), np.zeros_like(out)], axis=-1))


#: Mitsuba's stock surfaces before ``to_world``: radius 1, about z, the cylinder from z = 0 to 1
_UNIT: dict[str, Callable[[], Floats]] = {"Sphere": _sphere, "Cylinder": _cylinder, "Disk": _disk}
