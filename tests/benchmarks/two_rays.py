"""Triangulate: find the point where the ray of a camera passes nearest to the ray of another camera or a projector.

Signal chain: pixels of both -> view rays in the sensor frame -> distance along the first ray to the point nearest to
the second -> point.

The rays are those of the exact camera models, so lens distortion is not linearised.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mitsim.sensor.camera import Camera


def triangulate(
    camera: Camera, pixels: NDArray[np.floating], other: Camera, other_pixels: NDArray[np.floating]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the points seen at ``pixels`` of one camera and ``other_pixels`` of another camera or a projector.

    With unit directions d1 and d2 and the baseline b between the centres, the distance along the first ray is

        t = (d1.b - (d1.d2) (d2.b)) / (1 - (d1.d2)^2)

    which minimises the distance between the two lines (the closest points of two skew lines).

    Parameters
    ----------
    camera, other
        The camera, and the other camera or projector.
    pixels, other_pixels
        (..., 2) column and row [px].

    Returns
    -------
    points
        (..., 3) [mm] in the sensor frame, *on the first camera's ray*. An error of the correspondence thus acts along
        this view ray. NaN where a pixel is NaN or the rays are parallel.
    gap
        (...) [mm], distance between the two rays. It is large where the correspondence is wrong across the epipolar
        line.
    """
    first = camera.sensor_from_camera.directions(camera.rays(pixels))
    second = other.sensor_from_camera.directions(other.rays(other_pixels))
    baseline = other.centre - camera.centre
    cosine = np.einsum("...k,...k->...", first, second)
    along_first, along_second = first @ baseline, second @ baseline
    with np.errstate(divide="ignore", invalid="ignore"):
        sine2 = 1.0 - cosine**2
        distance = np.where(sine2 > 1e-14, (along_first - cosine * along_second) / sine2, np.nan)
    points = camera.centre + first * distance[..., None]
    to_point = points - other.centre
    gap = np.linalg.norm(np.cross(to_point, second), axis=-1)
    return points, gap
