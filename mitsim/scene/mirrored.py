"""Turn the triangles of mirrored shapes, so that they face the side of their normals.

Mitsuba shades the side of the normals of a shape; rays tell its sides by its triangles. A ``to_world`` that mirrors, or
a mesh file whose normals oppose its triangles, sets them on opposite sides: images would show the side that a
prediction takes for the back.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from mitsim.scene.backend import mi

#: triangles of a mesh that tell its side; chosen: more take time in each loading
_TRIANGLES = 10_000


def face_normals_side(scene: Any) -> None:
    """Make the triangles of every mesh of an ``mi.Scene`` face the side of its normals, in place."""
    parameters = mi.traverse(scene)
    for key, (_, _, shape, _) in list(parameters.properties.items()):
        owner, _, name = key.rpartition(".")
        if name == "to_world" and shape.class_name() == "Rectangle":  # its triangles follow from its transform
            world = np.array(parameters[key].matrix, float).reshape(4, 4)
            uniform = not shape.bsdf().flags() & int(mi.BSDFFlags.SpatiallyVarying)  # a texture would be mirrored
            if uniform and np.linalg.det(world[:3, :3]) < 0:  # the same square, with its own x reversed
                parameters[key] = mi.Transform4f(world * [-1.0, 1.0, 1.0, 1.0])
        elif name == "faces" and shape.has_vertex_normals():
            places, normals = f"{owner}.vertex_positions", f"{owner}.vertex_normals"
            triangles = np.array(parameters[key], np.uint32).reshape(-1, 3)
            some = triangles[:: max(1, len(triangles) // _TRIANGLES)]
            corners, outward = (np.array(parameters[n]).reshape(-1, 3)[some].astype(float) for n in (places, normals))
            a, b, c = np.moveaxis(corners, 1, 0)
            if np.einsum("ij,ikj->", np.cross(b - a, c - a), outward) < 0:
                parameters[key] = mi.UInt32(np.ascontiguousarray(triangles[:, ::-1]).ravel())
                for kept in (places, normals):  # rays would meet the old triangles, and normals be made anew
                    parameters.set_dirty(kept)
    parameters.update()
