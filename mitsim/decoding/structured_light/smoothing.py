"""Average the distances of neighbouring points, as makers of structured-light sensors do.

Signal chain: cloud -> inverse depth of each point along the axis of the grid -> Gaussian mean over the decoded
neighbours on the same surface -> points on the same rays.

On a plane the inverse depth is linear in the image, so that a symmetric mean keeps its place (Hartley and Zisserman,
Multiple View Geometry, 2nd ed., section 13.1). Edges and small radii become rounder, as with makers' filters.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from characterisation.point_cloud import PointCloud
from characterisation.region_of_interest import Roi

#: relative difference of depths beyond which neighbours belong to different surfaces; assumed
_STEP = 0.01

#: radius of the mean in its standard deviations
_REACH = 2.5


def smoothed_along_rays(cloud: PointCloud, width_px: float) -> PointCloud:
    """Return a cloud with a Gaussian mean, of standard deviation ``width_px``, of the distances; 0 for none.

    Points without a neighbour keep their place, and no pixel gets a point. ``sigma`` is that of the mean of independent
    neighbours.
    """
    region = Roi.around(cloud.valid)
    if width_px == 0 or region is None:
        return cloud
    inside = region.slices
    ray = cloud.points[inside].astype(float) - cloud.grid.origin
    inverse = 1 / (ray @ cloud.grid.rotation[:, 2])
    height, width = inverse.shape
    reach = int(np.ceil(_REACH * width_px))
    padded = np.pad(inverse, reach, constant_values=np.nan)
    total, weights, squares = np.zeros_like(inverse), np.zeros_like(inverse), np.zeros_like(inverse)
    steps = range(-reach, reach + 1)
    for down in steps:
        for right in steps:
            weight = np.exp(-0.5 * (down**2 + right**2) / width_px**2)
            beside = padded[reach + down : reach + down + height, reach + right : reach + right + width]
            # both of two opposite neighbours or none, since one alone would shift the mean along a slope
            opposite = padded[reach - down : reach - down + height, reach - right : reach - right + width]
            with np.errstate(invalid="ignore"):
                near = (np.abs(beside - inverse) < _STEP * inverse) & (np.abs(opposite - inverse) < _STEP * inverse)
            total += np.where(near, weight * beside, 0)
            weights += weight * near
            squares += weight**2 * near
    with np.errstate(invalid="ignore", divide="ignore"):
        scale = weights / total * inverse  # new depth over the old one
        noise = np.sqrt(squares) / weights
    points, sigma = cloud.points.copy(), None if cloud.sigma is None else cloud.sigma.copy()
    points[inside] = cloud.grid.origin + ray * scale[..., None]
    if sigma is not None:
        sigma[inside] *= noise
    return replace(cloud, points=points, sigma=sigma)
