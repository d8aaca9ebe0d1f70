"""What a view mirrors: how far it is along the mirrored rays to the next surface, and how the surface bends them.

Signal chain: view rays -> surface, its first and second fundamental forms -> mirrored rays -> next surface.

One centred ray per pixel, and the mirror direction of the geometry's own normal: what a rough face spreads about it is
for others to say.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mitsim.scene.backend import dr, mi
from mitsim.scene.load import Scene
from mitsim.scene.raycast import PixelRays
from mitsim.sensor.frames import Transform


@dataclass(frozen=True)
class Reflections:
    """For every pixel ``distance`` (H, W) [mm] to the next surface along the mirrored ray, and the mirror's power.

    ``distance`` is inf where there is none, NaN where the pixel shows nothing. ``power`` (3, H, W) [1/mm] is
    2 cos(theta) II(p_i, p_j) for ij = 11, 12, 22, positive where the surface is convex toward the view: by how much a
    plane wave diverges behind the mirror, along the directions u_1, u_2 across the ray of which p_i are the steps on
    the surface. u_1 is that of a baseline, and u_2 is across both.
    """

    distance: NDArray[np.float64]
    power: NDArray[np.float64]


def reflections(
    scene: Scene, rays: PixelRays, world_from_sensor: Transform, baseline: NDArray[np.floating]
) -> Reflections:
    """Look at what is mirrored; ``baseline`` (3,), a direction of the sensor frame."""
    frame = rays.frame(world_from_sensor)
    along = frame.turn(mi.Vector3f([float(v) for v in baseline]))
    ray = mi.Ray3f(frame.position, frame.turn(rays.directions))
    surface = scene.mitsuba.ray_intersect(ray, mi.RayFlags.All | mi.RayFlags.dNSdUV, True)
    shown = surface.is_valid()
    cosine = dr.dot(ray.d, surface.n)  # negative where the normal is toward the sensor
    first = dr.normalize(along - dr.dot(along, ray.d) * ray.d)
    second = dr.cross(ray.d, first)
    steps = [u - dr.dot(u, surface.n) / cosine * ray.d for u in (first, second)]
    turns = [_turn(surface, step) for step in steps]
    power = [-2 * cosine * dr.dot(steps[i], turns[j]) for i, j in ((0, 0), (0, 1), (1, 1))]
    mirrored = ray.d - 2 * cosine * surface.n
    further = scene.mitsuba.ray_intersect(surface.spawn_ray(mirrored), shown)
    distance = dr.select(shown, dr.select(further.is_valid(), further.t, dr.inf), dr.nan)
    dr.eval(distance, power)
    size = rays.size
    return Reflections(
        np.asarray(distance, float).reshape(size), np.stack([np.asarray(one, float).reshape(size) for one in power])
    )


def _turn(surface: Any, step: Any) -> Any:
    """By what the normal turns over a step on the surface, to first order."""
    e, f, g = (dr.dot(p, q) for p, q in ((surface.dp_du, surface.dp_du), (surface.dp_du, surface.dp_dv),
                                         (surface.dp_dv, surface.dp_dv)))  # fmt: skip
    x, y = dr.dot(surface.dp_du, step), dr.dot(surface.dp_dv, step)
    determinant = e * g - f * f
    return ((x * g - y * f) * surface.dn_du + (y * e - x * f) * surface.dn_dv) / determinant
