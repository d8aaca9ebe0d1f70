r"""Noise that outlasts a patch: how far patches lie from the known surface, and how their neighbours share it.

Signal chain: inliers of a patch and the coupon's pose -> mean distance along the rays from the known surface, o [mm]
-> products of the offsets of neighbouring patches of one capture -> pooled over
captures (:mod:`characterisation.maps.pooled_offsets`), K_0 = <o^2>, K_1 of patches
that touch, K_2 of patches farther apart -> noise area A [px^2] and persistent standard deviation p [mm].

The spread about a patch's own plane says little of how well a large feature can be fitted: what neighbours have in
common does not average out. Two numbers say the rest, for features that are large against the reach of the correlation:

    var(mean of n neighbouring pixels) = sigma^2 A / n + p^2

Sigma is that about the patch's own plane, which swallows part of a correlated field. If the field's correlation is
exp(-pi h^2 / a), the share that a plane leaves of its variance is kappa(a) = tr(M C) / (m - 3), M = 1 - H with the hat
matrix H of a plane (:mod:`characterisation.coupon.residual_field`), and so A = a / kappa(a): from A follow the field's
own area a and its reach.

What patches share that lie 2 to 4 diameters apart does not average out, K_2: by then decoders that match blocks have
forgotten each other, and what is left is common to that part of the image: bias of a code on a tilted or shiny surface,
and the error of the pose itself (:mod:`characterisation.maps.pooled_offsets` tells what captures share from p, what
they do not). Of the rest, means over patches on a hexagonal lattice sum up to the whole covariance, so

    A sigma^2 = m (K_0 - K_2) + 6 c (K_1 - K_2)

with m pixels of a disc and c = sqrt(3)/2 (2 r)^2 pixels of a cell: exactly 1/F for independent pixels of which a share
F came back, and within some per cent for a correlation that reaches a radius (see the tests).
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from characterisation.coupon.discs import disc_offsets

Floats = NDArray[np.float64]

#: neighbours that touch, and those that are apart, in diameters of a patch: (from, to)
TOUCHING, APART = (0.9, 1.25), (2.0, 4.0)

#: a patch with a smaller share of its pixels has no offset
LEAST_SHARE = 0.3


def known_offset(points: Floats, inlier: NDArray[np.bool_], normal: Floats, reach: float) -> Floats:
    """Mean distance o [mm] (p,) along the rays from the known plane, of patches; NaN with too few inliers.

    ``points`` (p, n, 3) [mm] from the sensor's centre, ``inlier`` (p, n); the plane is q . normal = reach.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        beyond = np.linalg.norm(points, axis=-1) * (1.0 - reach / (points @ normal))
    count = inlier.sum(-1)
    total = np.where(inlier, beyond, 0.0).sum(-1)
    enough = count >= LEAST_SHARE * points.shape[1]
    return np.where(enough, total / np.maximum(count, 1), np.nan)


def neighbour_products(offset: Floats, centres: NDArray[np.integer], radius_px: float) -> tuple[Floats, Floats]:
    """Mean product [mm^2] of each patch's offset with those of its neighbours: touching (p,), and apart (p,).

    ``centres`` (p, 2) [px]. NaN where a patch or all of its neighbours have no offset.
    """
    out = np.full((2, len(offset)), np.nan)
    known = np.flatnonzero(np.isfinite(offset))
    if len(known) < 2:
        return out[0], out[1]
    tree = cKDTree(centres[known])
    pairs = tree.query_pairs(APART[1] * 2 * radius_px, output_type="ndarray")
    apart = np.linalg.norm(np.diff(centres[known][pairs], axis=1)[:, 0], axis=-1) / (2 * radius_px)
    first, second = known[pairs.T]
    product = offset[first] * offset[second]
    for values, (low, high) in zip(out, (TOUCHING, APART), strict=True):
        chosen = (apart >= low) & (apart <= high)
        ends = np.concatenate([first[chosen], second[chosen]])
        number = np.bincount(ends, minlength=len(offset))
        total = np.bincount(ends, np.tile(product[chosen], 2), len(offset))
        values[number > 0] = total[number > 0] / number[number > 0]
    return out[0], out[1]


def noise_area(k_0: Floats, k_1: Floats, k_2: Floats, radius_px: float) -> tuple[Floats, Floats]:
    """Noise area A [px^2], at least 1, and p^2 in units of sigma^2, from K_0, K_1, K_2 in units of sigma^2."""
    persistent = np.maximum(k_2, 0.0)
    cell = np.sqrt(3) / 2 * (2 * radius_px) ** 2
    area = len(disc_offsets(radius_px)) * (k_0 - persistent) + 6 * cell * (k_1 - persistent)
    return np.maximum(area, 1.0), persistent


def own_area(area: Floats, radius_px: float) -> Floats:
    """Area a [px^2] of the field's own correlation exp(-pi h^2 / a), for noise areas A (...) [px^2]."""
    a, noise_areas = _areas(float(radius_px))
    return np.asarray(np.exp(np.interp(np.log(np.maximum(area, 1.0)), np.log(noise_areas), np.log(a))))


@lru_cache(maxsize=4)
def _areas(radius_px: float) -> tuple[Floats, Floats]:
    """A table of a, and of a / kappa(a)."""
    offsets = disc_offsets(radius_px).astype(float)
    plane = np.linalg.qr(np.column_stack([np.ones(len(offsets)), offsets]))[0]
    square = ((offsets[:, None] - offsets) ** 2).sum(-1)
    a = np.geomspace(1.0, 400.0, 60)
    kept = []
    for one in a:
        correlation = np.exp(-np.pi * square / one)
        trace = len(offsets) - np.einsum("ik,ij,jk->", plane, correlation, plane)
        kept.append(trace / (len(offsets) - 3))
    areas = a / np.array(kept)
    areas[0] = min(areas[0], 1.0)
    return a, areas
