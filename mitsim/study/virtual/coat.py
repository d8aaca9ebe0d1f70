"""Coat of a sprayed part: the sensor measures the surface of the coat, which lies above that of the part.

Signal chain: seed of a trial -> mean thickness, and a smooth relative deviation from it over the part -> thickness at
every point on a coated face -> displacement of the point along its ray, by the distance that matches the thickness
along the normal.

A coat from a spray can varies over the part with the passes of the hand. The relative deviation is a sum of waves of
fixed directions and of wavelengths between half and twice the extent of the part, with normal amplitudes. It is linear
in the numbers that are drawn, so that a budget can be regressed on them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from characterisation.files.arrays import Floats
from mitsim.scene.load import Scene
from mitsim.sensor.unknowns import CoatUnknowns
from mitsim.study.virtual.form import SeenFaces, random_waves

#: finish of the faces that are sprayed: no part is made of it
SPRAY = "matt_white"

#: number of waves of a coat's thickness; chosen
_WAVES = 6

#: seed of their directions and wavelengths, which all trials share: only the amplitudes are drawn
_WAVES_SEED = 77


@dataclass(frozen=True)
class Coat:
    """Coat of a trial: ``mean`` thickness [mm], relative ``spread`` [1], and normal ``amplitudes`` (2 w,) of waves."""

    mean: float
    spread: float
    amplitudes: Floats

    def thickness(self, positions: NDArray[np.floating], extent: float) -> Floats:
        """Return the thickness (n,) [mm] at positions (n, 3) [mm] on a part of an extent [mm]; nowhere below 0."""
        phases = positions @ random_waves(_WAVES, extent, np.random.default_rng(_WAVES_SEED)).T
        cosines, sines = np.split(self.amplitudes, 2)
        deviation = (np.cos(phases) @ cosines + np.sin(phases) @ sines) / np.sqrt(_WAVES)
        return np.asarray(self.mean * np.maximum(1 + self.spread * deviation, 0.0))


def coat_numbers(seed: int) -> Floats:
    """Return the independent numbers of mean 0 and variance 1 behind a coat: of its mean, and the amplitudes."""
    rng = np.random.default_rng(seed)
    return np.array([np.sqrt(3) * rng.uniform(-1, 1), *rng.standard_normal(2 * _WAVES)])


def drawn_coat(table: CoatUnknowns, seed: int) -> Coat:
    """Return the coat of a seed: its mean is uniform within the table's range."""
    numbers = coat_numbers(seed)
    low, high = table.thickness_um
    mean = (low + high) / 2 + (high - low) / 2 * numbers[0] / np.sqrt(3)
    return Coat(float(1e-3 * mean), table.spread, numbers[1:])


def coated_shapes(scene: Scene, table: CoatUnknowns) -> list[int]:
    """Return the indices of the shapes of a scene that are sprayed; none if the coat has no thickness."""
    if not table.thickness_um[1] > 0:
        return []
    return [index for index, finish in enumerate(scene.finishes) if finish is not None and finish.name == SPRAY]


def coated(points: NDArray[np.float32], seen: SeenFaces, table: CoatUnknowns, seed: int) -> NDArray[np.float32]:
    """Return points (H, W, 3) [mm], sensor frame, displaced along their rays by the coat of their faces.

    - ``points``: (H, W, 3) points [mm], sensor frame, NaN where there is none. They are not changed.
    - ``seen``: faces that the pixels meet.
    - ``table``: thickness and spread of the coat.
    - ``seed``: selects the coat.
    """
    scene = seen.scene
    here = np.isin(seen.surfaces.shape, coated_shapes(scene, table)) & np.isfinite(points[..., 2])
    if not here.any():
        return points
    positions = seen.world_from_sensor.points(points[here].astype(float))
    extent = float(np.linalg.norm(scene.bounds[1] - scene.bounds[0]))
    return seen.raised(points, here, drawn_coat(table, seed).thickness(positions, extent))
