"""From correspondence to point: where the ray of one camera passes nearest to the ray of another, or of a projector.

Both rays come from exact camera models, so lens distortion on either side needs no linearisation.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mitsim.sensor.camera import Camera


def triangulate(
    camera: Camera, pixels: NDArray[np.floating], other: Camera, other_pixels: NDArray[np.floating]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points seen at ``pixels`` (..., 2) of one camera and ``other_pixels`` (..., 2) of another (or of a projector).

    Returns
    -------
    points
        (..., 3) [mm] in the sensor frame, *on the first camera's ray*: that is where its pixel sees, and the error of
        a correspondence then lies along the view ray. NaN where a pixel is NaN or the rays are parallel.
    gap
        (...) [mm], distance between the two rays: large where the correspondence is wrong across the epipolar line.
    """
    first = camera.sensor_from_camera.directions(camera.rays(pixels))
    second = other.sensor_from_camera.directions(other.rays(other_pixels))
    base = other.centre - camera.centre
    cosine = np.einsum("...k,...k->...", first, second)
    along_first, along_second = first @ base, second @ base
    with np.errstate(divide="ignore", invalid="ignore"):
        sine2 = 1.0 - cosine**2
        distance = np.where(sine2 > 1e-14, (along_first - cosine * along_second) / sine2, np.nan)
    points = camera.centre + first * distance[..., None]
    to_point = points - other.centre
    gap = np.linalg.norm(np.cross(to_point, second), axis=-1)
    return points, gap
