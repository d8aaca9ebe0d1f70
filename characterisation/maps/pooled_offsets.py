"""Estimate noise area, persistent noise and bias at the nodes of a map, from the offsets of patches of many captures.

Signal chain: offsets and their products (:mod:`characterisation.coupon.offsets`) -> K_0, K_1, K_2 of each capture in
units of its own sigma^2 -> averaged over the captures about a place -> A, and two parts of the persistent variance, K_2
= beta^2 + p^2. Beta / sigma is common to the captures about a place; p / sigma is the rest.

Beta is a bias with a sign, such as that of a code that is read too near on faces of one orientation. Neighbouring
normals share it, so it moves a large feature as a whole. The correlation of the second part is unknown.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr

from characterisation.coupon.offsets import noise_area
from characterisation.files.arrays import Floats
from characterisation.lambert_projection import lambert_projection
from characterisation.maps.pooling import patch_normals

#: radius of the kernel over which captures are pooled, in the equal-area plane: 0.0175 is about 1 deg. It is wide
#: because A and p / sigma vary slowly, and one capture determines them poorly
POOLING_RADIUS = 0.2

#: radius of the discs of :func:`characterisation.coupon.patches.measure_patches` where a table does not contain it [px]
DISC_RADIUS = 6.0


@dataclass(frozen=True)
class PooledOffsets:
    """At q places, arrays (q,): noise area A [px^2], p / sigma and beta / sigma [1], positive away from the sensor."""

    area: Floats
    persistent: Floats
    bias: Floats


def pool_offsets(patches: xr.Dataset, positions: Floats) -> PooledOffsets:
    """Estimate A, p / sigma and beta / sigma at positions (q, 2) of the equal-area plane, from the offsets of patches.

    Every capture gives K_0, K_1, K_2 in units of the mean square of its own patches' sigma. Those within
    ``POOLING_RADIUS`` are averaged with their numbers of patches and the biweight as weights; NaN without a capture.
    """
    columns = [patches[name].values.astype(float) for name in ("offset_product_touching", "offset_product_apart")]
    offset = patches["ray_offset"].values.astype(float)
    columns = [patches["ray_noise_inliers"].values ** 2, offset**2, *columns, offset]
    normal = patch_normals(patches)
    use = np.isfinite(np.stack([*columns, *normal.T])).all(0)
    if not use.any():
        return PooledOffsets(*np.full((3, len(positions)), np.nan))
    capture = np.unique(patches["orientation"].values[use], return_inverse=True)[1]
    number = np.bincount(capture).astype(float)
    square, *products, mean = (np.bincount(capture, column[use]) / number for column in columns)
    centre = np.stack([np.bincount(capture, axis) / number for axis in lambert_projection(normal[use]).T], axis=-1)
    usable = square > 0
    centre, number, square = centre[usable], number[usable], square[usable]
    apart = ((positions[:, None] - centre) ** 2).sum(-1)
    weight = np.maximum(1 - apart / POOLING_RADIUS**2, 0.0) ** 2 * number
    with np.errstate(invalid="ignore", divide="ignore"):
        k = [weight @ (product[usable] / square) / weight.sum(1) for product in products]
    area, lasting = noise_area(k[0], k[1], k[2], DISC_RADIUS)
    most = np.sqrt(lasting)
    bias = np.clip(_common(weight, mean[usable] / np.sqrt(square)), -most, most)
    return PooledOffsets(area, np.sqrt(np.maximum(lasting - bias**2, 0.0)), bias)


def _common(weight: Floats, offset: Floats) -> Floats:
    """Return the offset that captures have in common (q,): their weighted mean, corrected for noise; 0 for one capture.

    Its square is the mean product of the offsets of different captures, so it contains neither noise nor persistent
    errors of one capture.
    """
    total, squares = weight @ offset, weight**2 @ offset**2
    with np.errstate(invalid="ignore", divide="ignore"):
        product = (total**2 - squares) / (weight.sum(1) ** 2 - (weight**2).sum(1))
    finite = np.nan_to_num(product, nan=0.0, posinf=0.0, neginf=0.0)
    return np.asarray(np.sign(total) * np.sqrt(np.maximum(finite, 0.0)))
