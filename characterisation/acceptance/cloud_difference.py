"""Compute the signed difference of two clouds, along the rays of a shared grid or to the surface of the other cloud.

Signal chain, along rays: distance |V| of each pixel in one cloud -> minus that in the other. To the surface: points of
one cloud -> nearest points of the other -> the plane through these -> orthogonal distance.

Both are positive where the cloud lies *farther from the sensor* than the reference. The difference along rays assumes
no surface, and a step gives its full height along the ray. The distance to a surface is smaller by the cosine of the
incidence angle, and needs no shared grid. Both clouds must be in one frame: they are not aligned to each other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from characterisation.features.robust_fit import MEDIAN_TO_STD
from characterisation.files.errors import InputError
from characterisation.point_cloud import FALSE_SHARE_OF_DISTANCE, PointCloud, ViewGrid

Floats = NDArray[np.float64]

#: number of points of the reference that determine the plane at a point
NEIGHBOURS = 12

#: a foot farther from the middle of its neighbours than this many times their distance lies beyond the edge
_ASIDE = 1.5

#: number of points processed at once
_BLOCK = 65536


@dataclass(frozen=True)
class Difference:
    """Distribution of a difference [mm]: ``count`` of pixels or points in both, of ``points_given`` in the cloud.

    ``mean``, ``median``, standard ``deviation``, ``robust_deviation`` (1.4826 times the median distance from the
    median), ``low`` and ``high``, which enclose 95 % of the values; NaN with too few values.
    """

    count: int
    points_given: int
    mean: float
    median: float
    deviation: float
    robust_deviation: float
    low: float
    high: float


def difference_along_rays(cloud: PointCloud, reference: PointCloud) -> Floats:
    """Return the difference (H, W) [mm] of two clouds on one grid, NaN where either has no point.

    Raises
    ------
    InputError
        If the grids are not the same.
    """
    if not same_grid(cloud.grid, reference.grid):
        allowed = f"the grid of the reference: {_described(reference.grid)}"
        hint = "or use the difference to the surface"
        raise InputError("difference along rays", "grid", _described(cloud.grid), allowed, hint)
    one, other = (
        np.linalg.norm(each.points.astype(np.float64) - each.grid.origin, axis=-1) for each in (cloud, reference)
    )
    return np.asarray(one - other)


def difference_to_surface(cloud: PointCloud, reference: PointCloud) -> Floats:
    """Return the difference (H, W) [mm] of a cloud's points from the surface of a reference in the same frame.

    It is NaN where the cloud has no point, or the reference has none within 1 % of the point's distance. It is also NaN
    beyond the edge of the reference.

    Raises
    ------
    InputError
        If the reference has fewer than :data:`NEIGHBOURS` points.
    """
    surface = reference.points[reference.valid].astype(np.float64)
    if len(surface) < NEIGHBOURS:
        raise InputError("difference to the surface", "reference", f"{len(surface)} points", f"{NEIGHBOURS} or more")
    tree = cKDTree(surface)
    rows, columns = np.nonzero(cloud.valid)
    out = np.full(cloud.status.shape, np.nan)
    for start in range(0, len(rows), _BLOCK):
        some = slice(start, start + _BLOCK)
        points = cloud.points[rows[some], columns[some]].astype(np.float64)
        out[rows[some], columns[some]] = _to_surface(points, surface, tree, cloud.grid.origin)
    return out


def distribution(difference: Floats, points_given: int) -> Difference:
    """Return the distribution of a difference, for a cloud that has ``points_given`` points."""
    known = difference[np.isfinite(difference)]
    if len(known) < 2:
        return Difference(len(known), points_given, *[float("nan")] * 6)
    median = float(np.median(known))
    low, high = np.quantile(known, [0.025, 0.975])
    robust = MEDIAN_TO_STD * float(np.median(np.abs(known - median)))
    return Difference(
        len(known), points_given, float(known.mean()), median, float(known.std(ddof=1)), robust, float(low), float(high)
    )


def same_grid(one: ViewGrid, other: ViewGrid) -> bool:
    """Return whether two grids have the same rays, to a hundredth of a pixel and a micrometre."""
    if (one.width, one.height) != (other.width, other.height):
        return False
    if not np.allclose(one.origin, other.origin, atol=1e-3):
        return False
    corners = np.array([0, one.width - 1, 0, one.width - 1]), np.array([0, 0, one.height - 1, one.height - 1])
    apart = np.linalg.norm(one.rays_at(*corners) - other.rays_at(*corners), axis=-1)
    return bool((apart < 0.01 * one.angular_pitch).all())


def _to_surface(points: Floats, surface: Floats, tree: cKDTree, viewpoint: Floats) -> Floats:
    """Return signed distances (n,) of points (n, 3) from planes through their nearest points of a surface (m, 3)."""
    away = points - viewpoint
    length = np.linalg.norm(away, axis=1)
    distance, index = tree.query(points, NEIGHBOURS)
    patch = surface[index]
    middle = patch.mean(axis=1)
    spread = patch - middle[:, None]
    values, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", spread, spread))
    normal = vectors[:, :, 0]
    normal *= np.sign(np.einsum("ni,ni->n", normal, away))[:, None]
    height = np.einsum("ni,ni->n", points - middle, normal)
    aside = np.linalg.norm(points - height[:, None] * normal - middle, axis=1)
    # the square root of the largest variance of the neighbours is about their distance
    reach = _ASIDE * np.sqrt(values[:, 2] / NEIGHBOURS)
    far = (distance[:, 0] > FALSE_SHARE_OF_DISTANCE * length) | (aside > reach)
    return np.where(far, np.nan, height)


def _described(grid: ViewGrid) -> str:
    return f"{grid.width} x {grid.height} px, f {grid.fx:.2f}, centre ({grid.cx:.2f}, {grid.cy:.2f})"
