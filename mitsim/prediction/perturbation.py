"""What one view adds to the map's answers: the protocol of effects, each of which is one function of a view.

Signal chain: ideal points of a view (:class:`LookedAt`) -> every effect -> what it changes of F, sigma and the place of
each point (:class:`Perturbation`) -> all of them together.

A map is made of flat coupons that stand alone. What else matters is an effect: light by way of other surfaces
(:mod:`mitsim.prediction.other_light`), what the calibration leaves open (:mod:`mitsim.prediction.shared_errors`). A new
one is a module with a function of a :class:`LookedAt`, and an entry in :func:`mitsim.virtual.screening.effects_of`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mitsim.prediction.predictor import Ideal
from mitsim.scene.load import Scene
from mitsim.scene.ray_casting.raycast import Surfaces
from mitsim.sensor.transforms import Transform

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class LookedAt:
    """A view of a scene, ray by ray: ``surfaces`` in the sensor frame, and the n ``ideal`` points of them."""

    scene: Scene
    world_from_sensor: Transform
    surfaces: Surfaces
    ideal: Ideal

    @property
    def normal(self) -> Floats:
        """Of the faces at the ideal points (n, 3), sensor frame."""
        return np.asarray(self.surfaces.normal.reshape(-1, 3)[self.ideal.pixel], float)


@dataclass(frozen=True)
class Perturbation:
    """What changes of the map's answers at n ideal points.

    F is multiplied by ``kept`` (n,) and sigma by ``noisier`` (n,). Points lie ``displaced`` (n,) [mm] too far along
    their rays in the mean, and ``scattered`` (n,) [mm] about that, beside sigma. ``shared`` (n, k) [mm] is what one
    standard deviation of each of k errors displaces points by that all features of a view share.
    """

    kept: Floats
    noisier: Floats
    displaced: Floats
    scattered: Floats
    shared: Floats

    @staticmethod
    def none(count: int) -> Perturbation:
        """Nothing changes at so many points."""
        as_it_is, nothing = np.ones(count), np.zeros(count)
        return Perturbation(as_it_is, as_it_is, nothing, nothing, np.zeros((count, 0)))


Effect = Callable[[LookedAt], Perturbation]


def together(perturbations: Iterable[Perturbation], count: int) -> Perturbation:
    """All perturbations of the same ``count`` points at once."""
    out = Perturbation.none(count)
    for one in perturbations:
        out = Perturbation(
            out.kept * one.kept,
            out.noisier * one.noisier,
            out.displaced + one.displaced,
            np.hypot(out.scattered, one.scattered),
            np.concatenate([out.shared, one.shared], axis=1),
        )
    return out
