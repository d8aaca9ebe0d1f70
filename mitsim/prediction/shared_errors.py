"""Errors that all points of a view share, as fields over the measuring volume: by a calibration, by temperature.

Signal chain: displacements of some points of the volume, by one standard deviation of each cause -> the few independent
fields that make nearly all of their variance -> polynomials of direction and distance -> by how much each field moves
the points of a view along their rays.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mitsim.prediction.perturbation import LookedAt, Perturbation

Floats = NDArray[np.float64]

#: variance of the displacements that may be left out, as a share of all of it
LEFT_OUT = 1e-3

#: distance [mm] that polynomials are scaled by
_SCALE_MM = 500.0


@dataclass(frozen=True)
class SharedErrors:
    """Independent fields of displacement: ``coefficients`` (k, 30, 3) of :func:`terms`, each for one sigma."""

    coefficients: Floats

    def __call__(self, view: LookedAt) -> Perturbation:
        """What one standard deviation of each field displaces the ideal points of a view by, along their rays."""
        nothing = Perturbation.none(len(view.ideal.pixel))
        return replace(nothing, shared=self.along(view.ideal.point, view.ideal.ray, view.normal))

    def along(self, points: Floats, ray: Floats, normal: Floats) -> Floats:
        """Displacement (n, k) [mm] along the rays (n, 3) that leaves points (n, 3) at the same distance from a face.

        That is what a fit of the face sees. All in the sensor frame; ``normal`` (n, 3) of the face.
        """
        with np.errstate(invalid="ignore", divide="ignore"):
            weight = normal / (normal * ray).sum(1, keepdims=True)
        known = terms(points)
        moved = [((known @ one) * weight).sum(1) for one in self.coefficients]
        return np.stack(moved, axis=1) if moved else np.zeros((len(points), 0))


def independent_fields(points: Floats, moves: Floats) -> SharedErrors:
    """Find the fields of ``moves`` (causes, n, 3) [mm] of points (n, 3), one standard deviation of each cause.

    Causes are independent. The fields are their principal components over the points, as many as are needed for all
    but :data:`LEFT_OUT` of the variance.
    """
    fine = np.isfinite(moves).all(axis=(0, 2))
    flat = moves[:, fine].reshape(len(moves), -1)
    _, size, axes = np.linalg.svd(flat, full_matrices=False)
    variance = np.cumsum(size**2)
    count = int(np.searchsorted(variance, (1 - LEFT_OUT) * variance[-1])) + 1 if variance[-1] > 0 else 0
    fields = (size[:count, None] * axes[:count]).reshape(count, fine.sum(), 3)
    known = terms(points[fine])
    solution, *_ = np.linalg.lstsq(known, np.moveaxis(fields, 0, 1).reshape(len(known), 3 * count), rcond=None)
    return SharedErrors(np.moveaxis(solution.reshape(known.shape[1], count, 3), 1, 0))


def terms(points: Floats) -> Floats:
    """Polynomial terms (n, 30) of the direction, to the third order, times distance to powers of 0, 1 and 2."""
    depth = points[:, 2]
    x, y, z = points[:, 0] / depth, points[:, 1] / depth, depth / _SCALE_MM
    one = np.ones(len(points))
    shape = [one, x, y, x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3]
    return np.stack([term * z**power for power in (0, 1, 2) for term in shape], axis=1)
