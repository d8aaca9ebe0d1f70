"""Estimate the pose of the sensor over a flat coupon from the points that the coupon gave.

Signal chain: cloud and the window of its pixels that shows the coupon -> plane through most of the points there
(:func:`mitsim.twin.finish.specimen.specimen_in_cloud`) -> a frame in that plane: origin where the middle of the window
meets it, x along the window's rows, z along the normal, toward the sensor.

The plane is that of the points, so the offset of the points from the true surface is not seen.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from characterisation.files.errors import InputError
from characterisation.point_cloud import PointCloud, Status
from characterisation.region_of_interest import Roi
from mitsim.sensor.transforms import Transform
from mitsim.twin.finish.specimen import specimen_in_cloud

#: least cosine of the incidence: a plane seen at 85 deg, beyond the limit of a campaign's orientations
_LEAST_COSINE = 0.087


def pose_over_coupon(cloud: PointCloud, window: Roi, where: str) -> Transform:
    """Return ``world_from_sensor``, with the frame of a coupon as the world.

    Parameters
    ----------
    cloud
        Points of the coupon [mm] in the sensor frame, and of other things.
    window
        Pixels of the cloud that show only the coupon.
    where
        Name of the capture in messages.

    Raises
    ------
    InputError
        If the window is not in the cloud, too few of its points lie in one plane, or the plane is seen edge-on.
    """
    grid = cloud.grid
    asked = f"{window.left} {window.top} {window.width} {window.height}"
    if not window.fits(grid.width, grid.height):
        raise InputError("--coupon", "", asked, f"COLUMN ROW WIDTH HEIGHT within {grid.width} x {grid.height} pixels")
    outside = np.ones(cloud.status.shape, bool)
    outside[window.slices] = False
    points, status = cloud.points.copy(), cloud.status.copy()
    points[outside], status[outside] = np.nan, Status.NO_SURFACE
    plane = specimen_in_cloud(replace(cloud, points=points, status=status), where).world_from_sensor
    normal = plane.rotation[2]  # in the sensor frame
    middle = window.top + window.height // 2
    columns = np.array([window.left, window.left + window.width // 2, window.right - 1])
    rays = grid.rays_at(columns, np.full(3, middle))
    cosines = -rays @ normal
    if cosines.min() < _LEAST_COSINE:
        raise InputError("--coupon", "", f"{asked}, a plane seen edge-on", "a coupon tilted by less than 85 deg")
    left, origin, right = (
        grid.origin + rays * (((grid.origin - plane.inverse().translation) @ normal) / cosines)[:, None]
    )
    across = (right - left) / np.linalg.norm(right - left)
    return Transform(np.stack([across, np.cross(normal, across), normal], axis=1), origin).inverse()
