"""Average the distances of neighbouring points, as makers of structured-light sensors do.

Signal chain: cloud -> inverse depth of each point along the axis of the grid -> Gaussian mean over neighbours, weighted
by their distance in space -> points on the same rays.

On a plane the inverse depth is linear in the image, so that a symmetric mean keeps its place (Hartley and Zisserman,
Multiple View Geometry, 2nd ed., section 13.1). Zivid's filter is based on distances in space (its knowledge base from
2.10 on), the one of a Xema's firmware is bilateral: a surface far behind an edge hardly counts. Edges and radii of a
few pixels become rounder, as with makers' filters.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from characterisation.point_cloud import PointCloud
from characterisation.region_of_interest import Roi

#: radius of the mean in its standard deviations
_REACH = 2.5

#: difference of distances in ``sigma`` that counts as far as the mean's own width; chosen: weights that follow the
#: noise of a point would make the mean noisier than ``sigma`` says, by 1.8 for noise of one pixel
_NOISE = 4.0


def smoothed_along_rays(cloud: PointCloud, width_px: float) -> PointCloud:
    """Return a cloud with a Gaussian mean of the distances, of a standard deviation of ``width_px``; 0 for none.

    A neighbour's weight follows from its distance in space, in pixels of the point's own depth, where a difference of
    depths within the noise counts little. Points without a neighbour keep their place, and no pixel gets a point.
    ``sigma`` is that of the mean of independent neighbours.
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
    # difference of inverse depths that is as far as the width of the mean
    wide = (inverse * cloud.grid.angular_pitch * width_px) ** 2
    if cloud.sigma is not None:
        wide += np.nan_to_num(_NOISE * cloud.sigma[inside] * inverse / np.linalg.norm(ray, axis=-1)) ** 2
    total, weights, squares = inverse.copy(), np.ones_like(inverse), np.ones_like(inverse)
    half = [(down, right) for down in range(reach + 1) for right in range(-reach, reach + 1) if (down, right) > (0, 0)]
    for down, right in half:
        beside = padded[reach + down : reach + down + height, reach + right : reach + right + width]
        opposite = padded[reach - down : reach - down + height, reach - right : reach - right + width]
        # the farther of two opposite neighbours weights both, since one alone would shift the mean along a slope
        apart = np.maximum(np.abs(beside - inverse), np.abs(opposite - inverse))
        weight = np.nan_to_num(np.exp(-0.5 * ((down**2 + right**2) / width_px**2 + apart**2 / wide)))
        total += weight * np.nan_to_num(beside + opposite)
        weights += 2 * weight
        squares += 2 * weight**2
    scale = weights / total * inverse  # new depth over the old one
    points, sigma = cloud.points.copy(), None if cloud.sigma is None else cloud.sigma.copy()
    points[inside] = cloud.grid.origin + ray * scale[..., None]
    if sigma is not None:
        sigma[inside] *= np.sqrt(squares) / weights
    return replace(cloud, points=points, sigma=sigma)
