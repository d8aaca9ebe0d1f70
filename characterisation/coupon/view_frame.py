"""Turn normals into the view frame, in which maps keep them: z back along the view ray, x along the baseline."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from characterisation.files.arrays import Floats


def view_frame(view: NDArray[np.floating], baseline: NDArray[np.floating]) -> Floats:
    """Return the axes of view frames: z back toward the sensor, x along the baseline, y = z cross x.

    ``view`` (..., 3) are directions from the sensor to the surface, ``baseline`` is (3,). Returns (..., 3, 3), rows =
    axes. The two optical centres of a sensor lie on its baseline, so a tilt about the baseline and a tilt across it
    have different effects.
    """
    z = -np.asarray(view, float) / np.linalg.norm(view, axis=-1, keepdims=True)
    x = baseline - np.einsum("...k,k->...", z, baseline)[..., None] * z
    x /= np.linalg.norm(x, axis=-1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=-2)


def in_view_frame(normals: Floats, view: Floats, baseline: Floats) -> Floats:
    """Return normals (..., 3) of the sensor frame in the view frame; the last component is the cosine of incidence."""
    return in_frame(normals, view_frame(view, baseline))


def in_frame(directions: Floats, frames: Floats) -> Floats:
    """Return directions (..., 3) of the sensor frame in the frames (..., 3, 3) of :func:`view_frame`."""
    return np.asarray(np.einsum("...ij,...j->...i", frames, directions))
