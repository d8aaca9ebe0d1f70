"""Lambert's azimuthal equal-area projection of the hemisphere toward the sensor.

(a, b) = (N_x, N_y) sqrt(2 / (1 + N_z)); equal cells for equal solid angles, and the radius is 2 sin(incidence / 2).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from characterisation.files.arrays import Floats


def lambert_projection(normals: NDArray[np.floating]) -> Floats:
    """Project unit normals (..., 3) in the view frame to the plane (..., 2)."""
    z = np.asarray(normals[..., 2], float)
    return np.asarray(normals[..., :2] * np.sqrt(2.0 / np.maximum(1.0 + z, 1e-12))[..., None])


def inverse_lambert_projection(positions: NDArray[np.floating]) -> Floats:
    """Return the unit normals (..., 3) of projected points (..., 2)."""
    r2 = (np.asarray(positions, float) ** 2).sum(-1)
    scale = np.sqrt(np.maximum(1.0 - r2 / 4.0, 0.0))
    return np.concatenate([positions * scale[..., None], (1.0 - r2 / 2.0)[..., None]], axis=-1)
