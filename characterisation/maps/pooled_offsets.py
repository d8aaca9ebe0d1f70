"""Noise area and persistent share at the nodes of a map, from the offsets of the patches of many captures.

Signal chain: offsets and their products (:mod:`characterisation.coupon.offsets`) -> K_0, K_1, K_2 of each capture in
units of its own sigma^2 -> averaged over the captures about a place -> A and p / sigma.
"""

from __future__ import annotations

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from characterisation.coupon.offsets import noise_area
from characterisation.equal_area import equal_area
from characterisation.maps.pooling import capture_numbers, patch_normals

Floats = NDArray[np.float64]

#: radius of the kernel over which captures are pooled, in the equal-area plane: 0.0175 is about 1 deg. A and p / sigma
#: vary slowly, and one capture tells little of them
POOLING_RADIUS = 0.2

#: radius of the discs of :func:`characterisation.coupon.patches.measure_patches` where a table does not say [px]
DISC_RADIUS = 6.0


def pool_offsets(patches: xr.Dataset, places: Floats) -> tuple[Floats, Floats]:
    """Noise area A [px^2] and persistent share p / sigma [1] at places (q, 2) of the equal-area plane.

    Every capture tells K_0, K_1, K_2 in units of the mean square of its own patches' sigma; those within
    ``POOLING_RADIUS`` are averaged by their patches, with the biweight. NaN where there is none.
    """
    nothing = np.full((2, len(places)), np.nan)
    if "ray_offset" not in patches:  # tables made before offsets were measured
        return nothing[0], nothing[1]
    columns = [patches[name].values.astype(float) for name in ("offset_product_touching", "offset_product_apart")]
    columns = [patches["ray_noise_inliers"].values ** 2, patches["ray_offset"].values ** 2, *columns]
    normal = patch_normals(patches)
    use = np.isfinite(np.stack([*columns, *normal.T])).all(0)
    if not use.any():
        return nothing[0], nothing[1]
    capture = capture_numbers(patches, normal)[use]
    capture = np.unique(capture, return_inverse=True)[1].ravel()
    number = np.bincount(capture).astype(float)
    square, *products = (np.bincount(capture, column[use]) / number for column in columns)
    centre = np.stack([np.bincount(capture, axis) / number for axis in equal_area(normal[use]).T], axis=-1)
    usable = square > 0
    centre, number, square = centre[usable], number[usable], square[usable]
    apart = ((places[:, None] - centre) ** 2).sum(-1)
    weight = np.maximum(1 - apart / POOLING_RADIUS**2, 0.0) ** 2 * number
    with np.errstate(invalid="ignore", divide="ignore"):
        k = [weight @ (product[usable] / square) / weight.sum(1) for product in products]
    area, persistent = noise_area(k[0], k[1], k[2], DISC_RADIUS)
    return area, np.sqrt(persistent)
