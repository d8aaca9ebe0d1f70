"""Form deviation of a real part: its faces waver about their nominal geometry.

Signal chain: place on a face -> a smooth random height of a stated standard deviation -> the point moves along its ray
as far as the surface has moved along its normal.

The field is a sum of plane waves in random directions with random phases, whose lengths lie between half the part and
twice its size: form, as against waviness, is what a face does over its whole extent (ISO 1101, ISO 12781-1). Each face
has a field of its own.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from characterisation.point_cloud import ViewGrid
from mitsim.scene.load import Scene, bounds_of
from mitsim.scene.ray_casting.raycast import Surfaces
from mitsim.sensor.transforms import Transform

#: plane waves of a field, and the cosine to the view ray under which a point does not move any more: it would leap
_WAVES, _GRAZING = 24, 0.1


def form_deviation(
    points: NDArray[np.float32],
    surfaces: Surfaces,
    scene: Scene,
    sizes: Mapping[str, float],
    world_from_sensor: Transform,
    grid: ViewGrid,
    seed: int,
) -> NDArray[np.float32]:
    """Points (H, W, 3) [mm], sensor frame, moved by the form of the faces in ``sizes`` (one sigma, mm)."""
    out = points.copy()
    rays = grid.rays()
    for name, size in sizes.items():
        index = scene.names.index(name)
        here = (surfaces.shape == index) & np.isfinite(points[..., 2])
        if not here.any():
            continue
        place = world_from_sensor.points(points[here].astype(float))
        extent = float(np.linalg.norm(np.ptp(bounds_of(scene.shapes[index]), axis=0)))
        height = size * random_field(place, extent, np.random.default_rng([seed, zlib.crc32(name.encode())]))
        cosine = np.maximum(np.abs((surfaces.normal[here] * rays[here]).sum(axis=-1)), _GRAZING)
        out[here] -= (rays[here] * (height / cosine)[:, None]).astype(np.float32)  # outward is toward the sensor
    return out


def random_field(places: NDArray[np.floating], extent: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """Smooth field of variance 1 at places (n, 3) [mm]; wavelengths from half of ``extent`` to twice of it."""
    directions = rng.standard_normal((_WAVES, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    waves = directions * (2 * np.pi / (extent * rng.uniform(0.5, 2.0, (_WAVES, 1))))
    phases = rng.uniform(0, 2 * np.pi, _WAVES)
    return np.asarray(np.sqrt(2 / _WAVES) * np.cos(places @ waves.T + phases).sum(axis=1))
