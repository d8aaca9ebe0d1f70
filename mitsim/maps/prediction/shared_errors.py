"""Errors that all points of a view share, from calibration and temperature, as fields over the measuring volume.

Signal chain: displacements of some points of the volume by one standard deviation of each cause -> the few independent
fields that contain nearly all of their variance -> polynomials of direction and distance -> displacement of the points
of a view along their rays by each field.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from characterisation.files.arrays import Floats
from mitsim.maps.prediction.perturbation import Perturbation, SceneView

#: fraction of the variance of the displacements that may be neglected
LEFT_OUT = 1e-3

#: distance that scales the polynomials [mm]
_SCALE_MM = 500.0


@dataclass(frozen=True)
class SharedErrors:
    """Independent displacement fields: ``coefficients`` (k, 30, 3) of :func:`terms`, each for one sigma."""

    coefficients: Floats

    def __call__(self, view: SceneView) -> Perturbation:
        """Return the displacements of a view's ideal points along their rays, by one sigma of each field."""
        nothing = Perturbation.none(len(view.ideal.pixel))
        return replace(nothing, shared=self.along(view.ideal.point, view.ideal.ray, view.normal))

    def along(self, points: Floats, ray: Floats, normal: Floats) -> Floats:
        """Return the displacement (n, k) [mm] along the rays (n, 3) that acts on a face as the fields do.

        It changes the distances of points (n, 3) from the face as the fields change them, which is what a fit of the
        face sees. All arrays are in the sensor frame; ``normal`` (n, 3) is that of the face.
        """
        with np.errstate(invalid="ignore", divide="ignore"):
            weight = normal / (normal * ray).sum(1, keepdims=True)
        count, size, _ = self.coefficients.shape
        moved = np.moveaxis(self.coefficients, 2, 1).reshape(3 * count, size) @ terms(points).T
        return np.asarray((moved.reshape(count, 3, len(points)) * weight.T).sum(1).T)


def independent_fields(points: Floats, moves: Floats) -> SharedErrors:
    """Return the fields of ``moves`` (causes, n, 3) [mm] of points (n, 3), by one standard deviation of each cause.

    Causes are independent. The fields are their principal components over the points, as many as contain all but
    :data:`LEFT_OUT` of the variance.
    """
    fine = np.isfinite(moves).all(axis=(0, 2))
    flat = moves[:, fine].reshape(len(moves), -1)
    _, size, axes = np.linalg.svd(flat, full_matrices=False)
    variance = np.cumsum(size**2)
    count = int(np.searchsorted(variance, (1 - LEFT_OUT) * variance[-1])) + 1 if variance[-1] > 0 else 0
    fields = (size[:count, None] * axes[:count]).reshape(count, fine.sum(), 3)
    values = terms(points[fine])
    solution, *_ = np.linalg.lstsq(values, np.moveaxis(fields, 0, 1).reshape(len(values), 3 * count), rcond=None)
    return SharedErrors(np.moveaxis(solution.reshape(values.shape[1], count, 3), 1, 0))


def terms(points: Floats) -> Floats:
    """Return polynomial terms (n, 30): direction to the third order, times distance to the powers 0, 1 and 2."""
    depth = points[:, 2]
    x, y, z = points[:, 0] / depth, points[:, 1] / depth, depth / _SCALE_MM
    constant = np.ones(len(points))
    shape = [constant, x, y, x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3]
    return np.stack([term * z**power for power in (0, 1, 2) for term in shape], axis=1)
