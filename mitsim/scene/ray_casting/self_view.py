"""Decide whether the faces of a part can see each other: only then are there interreflections.

Signal chain: triangles -> random points on them -> directions by the cosine law -> share of rays that meet the part.
For the faces in a view: points that the view shows -> directions from which light reaches the camera -> share that
comes from faces.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mitsim.scene.backend import dr, mi
from mitsim.scene.device import vectors_to_device
from mitsim.scene.load import Scene
from mitsim.scene.ray_casting.triangles import triangles

#: number of rays that leave the faces outward
_RAYS = 20_000

#: offset of the start of a ray from its face, as a share of the size of the scene. Triangles approximate round faces
_OFFSET = 2e-3

#: largest number of points of a view from which rays leave
_POINTS = 40_000

#: half-angle [rad] of the cone about the mirrored view ray; most light of a ground metal of alpha 0.3 leaves within it
_LOBE = np.deg2rad(20.0)


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


def seen_faces(
    scene: Scene, points: NDArray[np.floating], normals: NDArray[np.floating], rays: NDArray[np.floating]
) -> NDArray[np.float64]:
    """Return from how much of its surroundings each point of a view is lit by faces, (n, 2).

    The first column is 1 where a random direction of the cosine law meets a face, as a diffuse face sees others; the
    second where a random direction within 20 degrees of the mirrored view ray does, as a shiny face sees them. Else
    they are 0, and NaN for points that are left out, since few thousand points give the mean of a face.

    Parameters
    ----------
    scene
        The part.
    points, normals, rays
        (n, 3) in the part frame: points [mm], unit normals toward the sensor, and unit view rays toward the points.

    See Also
    --------
    sees_itself : whether a part lights itself at all
    """
    out = np.full((len(points), 2), np.nan)
    chosen = np.arange(0, len(points), 1 + len(points) // _POINTS)
    if not len(chosen):
        return out
    rng = np.random.default_rng(0)
    point, normal, ray = (np.asarray(vectors, float)[chosen] for vectors in (points, normals, rays))
    start = point + _OFFSET * float(np.linalg.norm(np.ptp(scene.bounds, axis=0))) * normal
    ball = rng.standard_normal((2, len(chosen), 3))
    ball /= np.linalg.norm(ball, axis=2, keepdims=True)
    mirrored = ray - 2 * np.sum(ray * normal, axis=1, keepdims=True) * normal
    for column, direction in enumerate((normal + ball[0], mirrored + np.sin(_LOBE) * ball[1])):
        outward = np.sum(direction * normal, axis=1) > 0
        towards = mi.Ray3f(mi.Point3f(vectors_to_device(start)), dr.normalize(vectors_to_device(direction)))
        out[chosen, column] = np.array(scene.mitsuba.ray_test(towards), bool) & outward
    return out
