"""Axes and pixels of Mitsuba's own cameras and projectors, with which tests compare."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mitsim.sensor.transforms import Transform

#: camera axes of Mitsuba in those of OpenCV (the matrix is its own inverse)
MITSUBA_FROM_OPENCV = np.diag([-1.0, -1.0, 1.0])

#: film coordinate (pixel corner at 0) minus OpenCV pixel coordinate (pixel centre at 0)
FILM_OFFSET_PX = 0.5


def mitsuba_to_world(world_from_camera: Transform) -> NDArray[np.float64]:
    """Return the ``to_world`` matrix (4, 4) of a stock Mitsuba sensor or projector at the pose of a camera."""
    out = world_from_camera.matrix()
    out[:3, :3] = out[:3, :3] @ MITSUBA_FROM_OPENCV
    return out
