"""Decide whether the faces of a part can see each other: only then are there interreflections.

Signal chain: triangles -> random points on them -> directions by the cosine law -> share of rays that meet the part.
"""

from __future__ import annotations

import numpy as np

from mitsim.scene.backend import dr, mi
from mitsim.scene.device import vectors_to_device
from mitsim.scene.load import Scene
from mitsim.scene.ray_casting.triangles import triangles

#: number of rays that leave the faces outward
_RAYS = 20_000

#: offset of the start of a ray from its face, as a share of the size of the scene. Triangles approximate round faces
_OFFSET = 2e-3


def sees_itself(scene: Scene) -> bool:
    """Return whether more than one in 1000 random rays that leave the faces outward meets a face again.

    Points are uniform over the area and directions follow the cosine law. The share of rays that meet a face therefore
    estimates the share of reflected light that does.
    """
    corners = triangles(scene)
    if not len(corners):
        return False
    edges = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(edges, axis=1)
    rng = np.random.default_rng(0)
    chosen = rng.choice(len(corners), _RAYS, p=area / area.sum())
    u, v = rng.random((2, _RAYS, 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    a, b, c = np.moveaxis(corners[chosen], 1, 0)
    normal = edges[chosen] / area[chosen, None]
    direction = rng.standard_normal((_RAYS, 3))
    direction = normal + direction / np.linalg.norm(direction, axis=1, keepdims=True)  # Lambert's law, unnormalised
    size = float(np.linalg.norm(np.ptp(scene.bounds, axis=0)))
    start = a + u * (b - a) + v * (c - a) + _OFFSET * size * normal
    rays = mi.Ray3f(mi.Point3f(vectors_to_device(start)), dr.normalize(vectors_to_device(direction)))
    blocked = np.array(scene.mitsuba.ray_test(rays), bool)
    return bool(blocked.mean() > 1e-3)
