"""Displace the decoded points of a trial by the errors of the path length and the expansion of the part."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from characterisation.files.arrays import Floats
from characterisation.point_cloud import PointCloud
from mitsim.sensor.transforms import Transform
from mitsim.study.virtual.world import DrawnValues


def displaced(
    cloud: PointCloud, drawn: DrawnValues, world_from_sensor: Transform, centre: Sequence[float] | Floats
) -> NDArray[np.float32]:
    """Return points (H, W, 3) [mm] of a cloud with the errors of the path length and the expansion of the part.

    The part expands about its middle.

    Parameters
    ----------
    cloud
        Organised cloud, sensor frame.
    drawn
        Drawn errors of a trial: of the path length (offset [mm] and scale) and of the expansion of the part.
    world_from_sensor
        Pose of the sensor that the evaluation assumes.
    centre
        Middle (3,) of the part [mm], part frame.
    """
    valid = cloud.valid
    points = cloud.points[valid].astype(float)
    offset, scale = drawn.path
    if offset or scale:
        away = points - cloud.grid.origin
        length = np.linalg.norm(away, axis=-1, keepdims=True)
        points = cloud.grid.origin + away * (1 + scale + offset / length)
    if drawn.expansion:
        middle = world_from_sensor.inverse().points(np.asarray(centre, float))
        points = middle + (1 + drawn.expansion) * (points - middle)
    out = cloud.points.copy()
    out[valid] = points
    return out
