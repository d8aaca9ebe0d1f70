"""Effects on a view that flat coupons cannot show: an effect is a function of a view that perturbs the map's answers.

Signal chain: ideal points of a view (:class:`SceneView`) -> every effect -> changes of F, sigma and position of each
point (:class:`Perturbation`) -> all of them combined.

A map is made from flat coupons without neighbours. Other influences are effects: interreflections
(:mod:`mitsim.maps.prediction.interreflections`) and errors of calibration and temperature
(:mod:`mitsim.maps.prediction.shared_errors`). A new effect is a module with a function of a :class:`SceneView`, and an
entry in :func:`mitsim.study.virtual.screening.effects_of`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from characterisation.files.arrays import Floats
from mitsim.scene.load import Scene
from mitsim.scene.ray_casting.raycast import Surfaces
from mitsim.sensor.transforms import Transform


@dataclass(frozen=True)
class Ideal:
    """Points that a perfect sensor would measure; flat arrays over the n pixels that meet a surface.

    ``pixel`` (n,) flat index into the grid; ``point`` (n, 3) and ``ray`` (n, 3) in the sensor frame [mm]; ``distance``
    (n,) |V| [mm]; ``normal`` (n, 3) in the view frame; ``shape`` (n,) index into the scene's names; ``status`` (n,)
    VALID where every eye sees the point; ``along`` (n, 3) the direction of the surface's parameter u in the view frame,
    None in a scene without a lay.
    """

    pixel: NDArray[np.int64]
    point: NDArray[np.float64]
    ray: NDArray[np.float64]
    distance: NDArray[np.float64]
    normal: NDArray[np.float64]
    shape: NDArray[np.int16]
    status: NDArray[np.uint8]
    along: NDArray[np.float64] | None = None


@dataclass(frozen=True)
class SceneView:
    """A view of a scene, ray by ray: ``surfaces`` in the sensor frame, and their n ``ideal`` points."""

    scene: Scene
    world_from_sensor: Transform
    surfaces: Surfaces
    ideal: Ideal

    @property
    def normal(self) -> Floats:
        """Return the normals of the faces at the ideal points (n, 3), sensor frame."""
        return np.asarray(self.surfaces.normal.reshape(-1, 3)[self.ideal.pixel], float)


@dataclass(frozen=True)
class Perturbation:
    """Changes of the map's answers at n ideal points.

    ``kept`` (n,) multiplies F, ``noisier`` (n,) multiplies sigma. ``displaced`` (n,) [mm] is the mean displacement
    along the rays, positive away from the sensor; ``scattered`` (n,) [mm] is the standard deviation about it, in
    addition to sigma. ``shared`` (n, k) [mm] is the displacement by one standard deviation of each of k errors that all
    features of a view share.
    """

    kept: Floats
    noisier: Floats
    displaced: Floats
    scattered: Floats
    shared: Floats

    @staticmethod
    def none(count: int) -> Perturbation:
        """Return a perturbation of ``count`` points that changes nothing."""
        as_it_is, nothing = np.ones(count), np.zeros(count)
        return Perturbation(as_it_is, as_it_is, nothing, nothing, np.zeros((count, 0)))


Effect = Callable[[SceneView], Perturbation]


def together(perturbations: Iterable[Perturbation], count: int) -> Perturbation:
    """Combine all perturbations of the same ``count`` points."""
    out = Perturbation.none(count)
    for perturbation in perturbations:
        out = Perturbation(
            out.kept * perturbation.kept,
            out.noisier * perturbation.noisier,
            out.displaced + perturbation.displaced,
            np.hypot(out.scattered, perturbation.scattered),
            np.concatenate([out.shared, perturbation.shared], axis=1),
        )
    return out
