"""Compute the signed difference of two clouds, along the rays of a shared grid or to the surface of the other cloud.

Signal chain, along rays: distance |V| of each pixel in one cloud -> minus that in the other. To the surface: points of
one cloud -> nearest points of the other -> the surface of second order through these -> distance along its normal. A
plane through them would lie inside a ball of 60 mm radius by 0.16 mm, if they are 2.7 mm apart.

Of a reference whose noise is as large as its pitch, the points nearest to a point err toward it, and the distance is
too small. Of such a reference the points nearest in direction are taken, which their noise along the ray does not move,
wherever all lie on one surface: the surface of second order is fitted to their distances along the ray, the slope to
more of them.

For a window of pixels only the points of the reference near it are searched, and no search extends beyond the distance
at which a point has no counterpart.

Both are positive where the cloud lies *farther from the sensor* than the reference. The difference along rays assumes
no surface, and a step gives its full height along the ray. The distance to a surface is smaller by the cosine of the
incidence angle, and needs no shared grid. Both clouds must be in one frame: they are not aligned to each other.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from characterisation.features.starts import LEAST_STEP_MM
from characterisation.files.arrays import MEDIAN_TO_STD, Floats
from characterisation.files.errors import InputError
from characterisation.files.threads import thread_count
from characterisation.point_cloud import FALSE_SHARE_OF_DISTANCE, PointCloud, ViewGrid

#: rows and columns of a window of a grid
Window = tuple[slice, slice]

_ALL = (slice(None), slice(None))

#: number of points of the reference that determine the surface at a point: it has six coefficients
NEIGHBOURS = 12

#: number of points of a noisy reference nearest to a point in direction, for the slope of its surface; chosen
_SLOPE_NEIGHBOURS = 64

#: those among them that determine the surface; chosen
_SURFACE_NEIGHBOURS = 16

#: least noise of a reference over the distance of its points that moves the difference; chosen: there by 4 %
_NOISY = 0.2

#: a foot farther from the middle of its neighbours than this many times their distance lies beyond the edge
_ASIDE = 1.5

#: stiffness of the terms of second order, which two rows of points leave undetermined; chosen: takes 0.3 % of a bow
_STIFF = (0.0, 1e-12, 1e-12, 1e-3, 1e-3, 1e-3)

#: about the number of points by which a reference is known to be noisy: if a twentieth of them is there; chosen
_SOME = 2000

#: number of points processed at once
_BLOCK = 32768


@dataclass(frozen=True)
class Difference:
    """Distribution of a difference [mm]: ``count`` of pixels or points in both, of ``points_given`` in the cloud.

    ``mean``, ``median``, standard ``deviation``, ``robust_deviation`` (1.4826 times the median distance from the
    median), ``low`` and ``high``, which enclose 95 % of the values; NaN with too few values. If most values are the
    same by rounding, the median and its deviation are the mean and the deviation of those within two steps.
    """

    count: int
    points_given: int
    mean: float
    median: float
    deviation: float
    robust_deviation: float
    low: float
    high: float


def difference_along_rays(cloud: PointCloud, reference: PointCloud, window: Window = _ALL) -> Floats:
    """Return the difference (h, w) [mm] of clouds of one grid in a window, NaN where one has no point."""
    if not cloud.grid.same_rays(reference.grid):
        allowed = f"the grid of the reference: {_described(reference.grid)}"
        hint = "or use the difference to the surface"
        raise InputError("difference along rays", "grid", _described(cloud.grid), allowed, hint)
    away = (compared.points[window].astype(np.float64) - compared.grid.origin for compared in (cloud, reference))
    distance, reference_distance = (np.linalg.norm(vectors, axis=-1) for vectors in away)
    return np.asarray(distance - reference_distance)


def difference_to_surface(
    cloud: PointCloud,
    reference: PointCloud,
    window: Window = _ALL,
    progress: Callable[[Sequence[int]], Iterable[int]] = iter,
) -> Floats:
    """Return the difference (h, w) [mm] of a cloud's points in a window from the surface of a reference.

    It is NaN where the cloud has no point, or the reference has none within 1 % of the point's distance, and beyond the
    edge of the reference. Raises InputError if the reference has fewer than :data:`NEIGHBOURS` points.

    Parameters
    ----------
    cloud, reference, window, progress
        The cloud to judge, and that of the surface in the same frame; they need no common grid. Rows and columns (h,
        w); iterates over the starts of the blocks of points, and may report them.
    """
    surface = reference.points[reference.valid].astype(np.float64)
    if len(surface) < NEIGHBOURS:
        raise InputError("difference to the surface", "reference", f"{len(surface)} points", f"{NEIGHBOURS} or more")
    valid = cloud.valid[window]
    points = cloud.points[window][valid].astype(np.float64)
    farthest = FALSE_SHARE_OF_DISTANCE * np.linalg.norm(points - cloud.grid.origin, axis=1)
    searched = _Searched(surface, points, float(farthest.max(initial=0.0)))
    height = np.full(len(points), np.nan)
    some = slice(None, None, 1 + len(points) // _SOME)
    beside = _Beside(searched.near, reference.grid.origin)
    noisy = np.isfinite(beside.heights(points[some], farthest[some])).sum() * 20 > len(points[some])
    for start in progress(range(0, len(points), _BLOCK)):
        block = slice(start, start + _BLOCK)
        heights = height[block]
        if noisy:
            heights[:] = beside.heights(points[block], farthest[block])
        rest = np.isnan(heights)
        heights[rest] = _to_surface(points[block][rest], farthest[block][rest], searched, cloud.grid.origin)
    out = np.full(valid.shape, np.nan)
    out[valid] = height
    return out


def distribution(difference: Floats, points_given: int) -> Difference:
    """Return the distribution of a difference, for a cloud that has ``points_given`` points."""
    finite = difference[np.isfinite(difference)]
    if len(finite) < 2:
        return Difference(len(finite), points_given, *[float("nan")] * 6)
    median = float(np.median(finite))
    low, high = np.quantile(finite, [0.025, 0.975])
    off = np.abs(finite - median)
    robust = MEDIAN_TO_STD * float(np.median(off))
    step = float(off.min(where=off > 0, initial=np.inf))
    if robust == 0 and LEAST_STEP_MM < step < np.inf:  # of rounded depths, of which most are the same
        near = finite[off <= 2 * step]
        median, robust = float(near.mean()), float(near.std(ddof=1))
    mean, deviation = float(finite.mean()), float(finite.std(ddof=1))
    return Difference(len(finite), points_given, mean, median, deviation, robust, float(low), float(high))


class _Searched:
    """The points of a reference near the points of a cloud, with trees for their neighbours.

    A box around the cloud's points, larger by the distance of the farthest counterpart, holds all points within that
    distance. The few points with fewer neighbours there are searched in the whole reference.
    """

    def __init__(self, surface: Floats, points: Floats, farthest: float) -> None:
        self.surface = surface
        margin = farthest * (1 + 1e-6)
        low, high = (points.min(axis=0) - margin, points.max(axis=0) + margin) if len(points) else (np.inf, -np.inf)
        self.near = surface[((surface >= low) & (surface <= high)).all(axis=1)]
        self.tree = cKDTree(self.near) if len(self.near) else None
        self.whole: cKDTree | None = self.tree if len(self.near) == len(surface) else None

    def neighbours(self, points: Floats, farthest: Floats) -> tuple[NDArray[np.bool_], Floats]:
        """Return which points have a counterpart within ``farthest`` [mm], and the nearest NEIGHBOURS of those."""
        if self.tree is None or not len(points):
            return np.zeros(len(points), bool), np.empty((0, NEIGHBOURS, 3))
        limit = float(farthest.max()) * (1 + 1e-9)
        distance, index = self.tree.query(points, NEIGHBOURS, distance_upper_bound=limit, workers=thread_count())
        met = distance[:, 0] <= farthest
        few = met & ~np.isfinite(distance[:, -1])
        if few.any():
            self.whole = self.whole or cKDTree(self.surface)
        out = self.near[np.minimum(index[met], len(self.near) - 1)]
        if few.any() and self.whole is not None:
            out[few[met]] = self.surface[self.whole.query(points[few], NEIGHBOURS, workers=thread_count())[1]]
        return met, out


class _Beside:
    """The points (n, 3) of a reference, by their direction from its eye (3,)."""

    def __init__(self, surface: Floats, eye: Floats) -> None:
        self.surface, self.eye = surface, eye
        self.tree = cKDTree(_directions(surface - eye)) if len(surface) >= _SLOPE_NEIGHBOURS else None

    def heights(self, points: Floats, farthest: Floats) -> Floats:
        """Return distances (n,) of points (n, 3) from the surface by the points nearest in direction.

        NaN where their noise is small, one lies deeper or higher by more than ``farthest`` (n,) [mm], or none is near.
        """
        out = np.full(len(points), np.nan)
        if self.tree is None or not len(points):
            return out
        rays = _directions(points - self.eye)
        beside = self.surface[self.tree.query(rays, _SLOPE_NEIGHBOURS, workers=thread_count())[1]]
        away = beside - points[:, None]
        one = np.abs(np.einsum("nki,ni->nk", away, rays)).max(axis=1) <= farthest
        one &= np.linalg.norm(away, axis=-1).min(axis=1) <= farthest
        if one.any():
            out[one] = _along_ray(points[one], beside[one], self.eye)
        return out


def _directions(away: Floats) -> Floats:
    """Return the unit vectors of vectors (n, 3)."""
    return np.asarray(away / np.linalg.norm(away, axis=1, keepdims=True))


def _to_surface(points: Floats, farthest: Floats, searched: _Searched, viewpoint: Floats) -> Floats:
    """Return signed distances (n,) of points (n, 3) from a surface, NaN without a counterpart within ``farthest``."""
    out = np.full(len(points), np.nan)
    met, patch = searched.neighbours(points, farthest)
    points = points[met]
    middle = patch.mean(axis=1)
    spread = patch - middle[:, None]
    values, axes = np.linalg.eigh(spread.swapaxes(1, 2) @ spread)
    axes[..., 0] *= np.sign(np.einsum("ni,ni->n", axes[..., 0], points - viewpoint))[:, None]
    # the square root of the largest variance of the neighbours is about their distance
    out[met] = _over_surface(points - middle, spread, axes, np.sqrt(values[:, 2] / NEIGHBOURS))
    return out


def _along_ray(points: Floats, beside: Floats, eye: Floats) -> Floats:
    """Return the distances (n,) of points (n, 3) from the surface of the points beside them, (n, k, 3), if noisy.

    They are distances along the ray times the cosine of the incidence angle, and positive away from the eye (3,). They
    are NaN where the noise is small against the pitch: the nearest points give a curved surface more exactly.
    """
    ray = _directions(points - eye)
    across = np.cross(ray, np.eye(3)[np.argmin(np.abs(ray), axis=1)])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    axes = np.stack([ray, across, np.cross(ray, across)], axis=-1)
    heights, feet = np.split((beside - beside.mean(axis=1, keepdims=True)) @ axes, [1], axis=-1)
    slope = np.linalg.solve(feet.swapaxes(1, 2) @ feet, feet.swapaxes(1, 2) @ heights)
    cosine = 1 / np.sqrt(1 + np.sum(slope**2, axis=(1, 2)))
    noise = cosine * np.sqrt(np.mean((heights - feet @ slope) ** 2, axis=(1, 2)))
    patch = beside[:, :_SURFACE_NEIGHBOURS]
    middle = patch.mean(axis=1)
    spread = patch - middle[:, None]
    apart = np.sqrt(np.mean(np.sum((spread @ axes)[..., 1:] ** 2, axis=-1), axis=1) / 2)
    return np.where(noise > _NOISY * apart, cosine * _over_surface(points - middle, spread, axes, apart), np.nan)


def _over_surface(local: Floats, spread: Floats, axes: Floats, apart: Floats) -> Floats:
    """Return the heights (n,) of points over the surface of second order through their neighbours, NaN beyond its edge.

    ``local`` (n, 3) and ``spread`` (n, k, 3) are points and neighbours about the middle of these [mm]. Columns of
    ``axes`` are the direction of the heights, and two across; ``apart`` [mm] is about the distance of the neighbours.
    """
    height, *foot = np.einsum("nij,ni->jn", axes, local)
    heights, *feet = np.moveaxis(spread @ axes, -1, 0)
    scale = np.maximum(apart, np.finfo(float).tiny)
    terms = _second_order(*(coordinate / scale[:, None] for coordinate in feet))
    products = terms.swapaxes(1, 2) @ terms + terms.shape[1] * np.diag(_STIFF)
    coefficients = np.linalg.solve(products, terms.swapaxes(1, 2) @ heights[..., None])[..., 0]
    surface = np.einsum("ni,ni->n", coefficients, _second_order(*(coordinate / scale for coordinate in foot)))
    low, high = heights.min(axis=1), heights.max(axis=1)
    height -= np.clip(surface, low - (high - low) / 2, high + (high - low) / 2)  # points of two faces have no surface
    return np.asarray(np.where(np.hypot(*foot) > _ASIDE * apart, np.nan, height))


def _second_order(u: Floats, v: Floats) -> Floats:
    """Return the terms (..., 6) of a surface of second order at places (...)."""
    return np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=-1)


def _described(grid: ViewGrid) -> str:
    return f"{grid.width} x {grid.height} px, f {grid.fx:.2f}, centre ({grid.cx:.2f}, {grid.cy:.2f})"
