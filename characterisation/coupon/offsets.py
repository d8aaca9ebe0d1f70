"""Measure the mean offsets of patches from the known surface, and how they correlate between neighbours.

Signal chain: inliers of a patch and the pose of the coupon -> mean distance o [mm] along the rays from the known
surface -> products of the offsets of neighbouring patches of one capture -> pooled over captures
(:mod:`characterisation.maps.pooled_offsets`): K_0 = <o^2>, K_1 of patches that touch, K_2 of patches farther apart ->
noise area A [px^2] and persistent standard deviation p [mm].

The noise about a patch's own plane is not sufficient to predict the fit of a large feature: noise that neighbours have
in common does not average out. For features that are large against the correlation length, two numbers describe it:

    var(mean of n neighbouring pixels) = sigma^2 A / n + p^2

Sigma refers to the patch's own plane, and fitting this plane removes part of a correlated field. Let the field have the
correlation exp(-pi h^2 / a). The plane fit leaves the share kappa(a) = tr(M C) / (m - 3) of its variance. Here M = 1 -
H, with the hat matrix H of a plane. Hence A = a / kappa(a), and A
determines the area a of the field itself and its correlation length.

K_2 is the covariance of patches that lie 2 to 4 diameters apart, and does not average out. At this distance, errors of
block-matching decoders are no longer correlated. The rest is common to that part of the image: the bias of a code on a
tilted or shiny surface, and the error of the pose itself. :mod:`characterisation.maps.pooled_offsets` separates the
part of p that captures share from the part that they do not.

Without K_2, the means over patches on a hexagonal lattice add up to the whole covariance:

    A sigma^2 = m (K_0 - K_2) + 6 c (K_1 - K_2)

with m pixels in a disc and c = sqrt(3)/2 (2 r)^2 pixels in a cell. For independent pixels of which a share F was
recovered, the result is exactly 1/F. For a correlation that extends over one radius it is accurate to some per cent
(see the tests).
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from characterisation.coupon.discs import disc_offsets
from characterisation.files.arrays import Floats

#: distances (from, to) of neighbours that touch, in diameters of a patch
TOUCHING = (0.9, 1.25)

#: distances (from, to) of neighbours apart, in diameters of a patch: errors of block matching are not correlated there
APART = (2.0, 4.0)

#: smallest share of its pixels with which a patch has an offset
LEAST_SHARE = 0.3


def known_offset(points: Floats, inlier: NDArray[np.bool_], normal: Floats, reach: float) -> Floats:
    """Return the mean distance o [mm] (p,) of patches from the known plane, along the rays; NaN with too few inliers.

    ``points`` (p, n, 3) [mm] are relative to the optical centre of the sensor. The plane is q . normal = reach [mm].
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        beyond = np.linalg.norm(points, axis=-1) * (1.0 - reach / (points @ normal))
    count = inlier.sum(-1)
    total = np.where(inlier, beyond, 0.0).sum(-1)
    enough = count >= LEAST_SHARE * points.shape[1]
    return np.where(enough, total / np.maximum(count, 1), np.nan)


def neighbour_products(offset: Floats, centres: NDArray[np.integer], radius_px: float) -> tuple[Floats, Floats]:
    """Return the mean product [mm^2] of each patch's offset with the offsets of its neighbours.

    Arrays (p,) for neighbours that touch (:data:`TOUCHING`), and for those apart (:data:`APART`); NaN where a patch or
    all of its neighbours have no offset.
    """
    out = np.full((2, len(offset)), np.nan)
    finite = np.flatnonzero(np.isfinite(offset))
    if len(finite) < 2:
        return out[0], out[1]
    tree = cKDTree(centres[finite])
    pairs = tree.query_pairs(APART[1] * 2 * radius_px, output_type="ndarray")
    apart = np.linalg.norm(np.diff(centres[finite][pairs], axis=1)[:, 0], axis=-1) / (2 * radius_px)
    first, second = finite[pairs.T]
    product = offset[first] * offset[second]
    for values, (low, high) in zip(out, (TOUCHING, APART), strict=True):
        chosen = (apart >= low) & (apart <= high)
        ends = np.concatenate([first[chosen], second[chosen]])
        number = np.bincount(ends, minlength=len(offset))
        total = np.bincount(ends, np.tile(product[chosen], 2), len(offset))
        values[number > 0] = total[number > 0] / number[number > 0]
    return out[0], out[1]


def noise_area(k_0: Floats, k_1: Floats, k_2: Floats, radius_px: float) -> tuple[Floats, Floats]:
    """Return the noise area A [px^2], at least 1, and p^2 in units of sigma^2.

    Parameters
    ----------
    k_0, k_1, k_2, radius_px
        K_0, K_1 and K_2 in units of sigma^2; radius of the discs.
    """
    persistent = np.maximum(k_2, 0.0)
    cell = np.sqrt(3) / 2 * (2 * radius_px) ** 2
    area = len(disc_offsets(radius_px)) * (k_0 - persistent) + 6 * cell * (k_1 - persistent)
    return np.maximum(area, 1.0), persistent


def own_area(area: Floats, radius_px: float) -> Floats:
    """Return the area a [px^2] of the field with correlation exp(-pi h^2 / a), for noise areas A (...) [px^2]."""
    a, noise_areas = _areas(float(radius_px))
    return np.asarray(np.exp(np.interp(np.log(np.maximum(area, 1.0)), np.log(noise_areas), np.log(a))))


@lru_cache(maxsize=4)
def _areas(radius_px: float) -> tuple[Floats, Floats]:
    """Return a table of a, and of a / kappa(a)."""
    offsets = disc_offsets(radius_px).astype(float)
    plane = np.linalg.qr(np.column_stack([np.ones(len(offsets)), offsets]))[0]
    square = ((offsets[:, None] - offsets) ** 2).sum(-1)
    a = np.geomspace(1.0, 400.0, 60)
    removed = [np.einsum("ik,ij,jk->", plane, np.exp(-np.pi * square / area), plane) for area in a]
    areas = a / ((len(offsets) - np.array(removed)) / (len(offsets) - 3))
    areas[0] = min(areas[0], 1.0)
    return a, areas
