"""The region of a camera's image that holds given points."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from characterisation.region_of_interest import Roi

if TYPE_CHECKING:
    from mitsim.sensor.camera import Camera


def roi_around(camera: Camera, points: NDArray[np.floating], margin: int) -> Roi | None:
    """Return the region of a camera's image that holds points (n, 3) of the sensor frame; None if one is behind it."""
    pixels = camera.project(points)
    if not np.isfinite(pixels).all():
        return None
    low = np.clip(np.floor(pixels.min(axis=0)).astype(int) - margin, 0, [camera.width - 1, camera.height - 1])
    high = np.clip(np.ceil(pixels.max(axis=0)).astype(int) + margin + 1, low + 1, [camera.width, camera.height])
    return Roi.between(*low, *high)
