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


def triangles(scene: Scene, lamps: bool = True) -> Floats:
    """Return triangles (n, 3, 3) [mm], world frame, with corners anticlockwise as seen from the side of the normal.

    Shapes whose BSDF transmits all light unchanged (``null``) are left out, because they bound a medium and are not
    solid. Glass is solid. ``lamps`` are left out on request.
    """
    parts = [_of_shape(shape) for shape in scene.shapes if _solid(shape) and (lamps or not shape.is_emitter())]
    return np.concatenate([np.empty((0, 3, 3)), *parts])


def triangles_by_shape(scene: Scene) -> dict[str, Floats]:
    """Return the :func:`triangles` of each solid shape, by its name."""
    named = zip(scene.names, scene.shapes, strict=True)
    return {name: _of_shape(shape) for name, shape in named if _solid(shape)}


def places_over(corners: Floats, longest: float) -> tuple[Floats, Floats]:
    """Return places (n, 3) on triangles (t, 3, 3), and the area (n,) that each of them stands for [mm^2].

    Triangles are halved until no edge is longer than ``longest`` [mm]. Their corners have a twelfth of their area each,
    and their centres the rest: the sum over a flat triangle is exact for polynomials of degree 2.
    """
    while True:
        edges = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2)
        long = edges.max(axis=1) > longest
        if not long.any():
            break
        turn = (edges[long].argmax(axis=1)[:, None] + np.arange(3)) % 3
        a, b, c = np.take_along_axis(corners[long], turn[:, :, None], axis=1).transpose(1, 0, 2)
        middle = (a + b) / 2
        halves = np.concatenate([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)])
        corners = np.concatenate([corners[~long], halves])
    first, second, third = corners.transpose(1, 0, 2)
    area = np.linalg.norm(np.cross(second - first, third - first), axis=1) / 2
    everywhere = np.concatenate([corners.mean(axis=1), first, second, third])
    places, number = np.unique(everywhere, axis=0, return_inverse=True)
    return places, np.bincount(number.ravel(), np.concatenate([0.75 * area, np.tile(area / 12, 3)])).astype(float)


def hull_corners(scene: Scene) -> Floats:
    """Return the corners (k, 3) [mm], world frame, of the convex hull of all solid surfaces but lamps."""
    corners = np.unique(triangles(scene, lamps=False).reshape(-1, 3), axis=0)
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


def solid_angles(triangles: Floats) -> Floats:
    """Return signed solid angles (n,) [sr] of triangles (n, 3, 3) from the origin; positive for outward normals.

    Those of a closed surface add to 4 pi from inside and to 0 from outside (Van Oosterom and Strackee, IEEE Trans.
    Biomed. Eng. 30, 1983).
    """
    a, b, c = np.moveaxis(triangles, 1, 0)
    la, lb, lc = (np.linalg.norm(corner, axis=1) for corner in (a, b, c))
    volume = np.einsum("ij,ij->i", a, np.cross(b, c))
    ab, bc, ca = ((first * second).sum(axis=1) for first, second in ((a, b), (b, c), (c, a)))
    return np.asarray(2 * np.arctan2(volume, la * lb * lc + ab * lc + bc * la + ca * lb))
