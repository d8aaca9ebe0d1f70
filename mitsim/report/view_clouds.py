"""Reduce the part and its predicted clouds to a size that a browser can rotate.

Signal chain: choice of clouds -> points of every s-th row and column in the part frame, s not an integer -> integer
coordinates in a box that all clouds and the part share, noise on a logarithmic scale -> base64. The part keeps its own
triangles if they are few; otherwise a raster merges them.

Each point is written little-endian and by planes: x, y, z as ``uint16``, noise and feature as ``uint8``. The page says
how many of the points it shows.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import trimesh
import xarray as xr
from numpy.typing import NDArray

from characterisation.files.arrays import Floats
from characterisation.point_cloud import PointCloud

#: largest number of clouds on a page; chosen, as the other limits are, for the size of the file
MOST_CLOUDS = 60

#: largest number of points of a cloud
MOST_POINTS = 20_000

#: largest number of points of all clouds: each takes 11 characters
MOST_POINTS_IN_ALL = 120_000

#: largest number of triangles of the part
MOST_TRIANGLES = 20_000

#: percentiles of the noise of all points at the ends of its colour scale
NOISE_PERCENTILES = (2, 98)

#: faces that meet at a smaller angle are shaded as one round surface [rad]
CREASE = math.radians(30.0)

#: code of an unknown noise, or of a point outside all features: the largest in a byte
UNKNOWN = 255

#: largest integer coordinate: the largest in two bytes
LAST_STEP = 65535


@dataclass(frozen=True)
class ShownCloud:
    """Points of a predicted cloud that a page shows.

    ``points`` (n, 3) [mm], part frame; ``sigma`` (n,) [mm], NaN if unknown; ``feature`` (n,) index into the features of
    the task, -1 for any other. ``count`` is the number of points of the whole cloud, ``spacing`` [mm] the largest
    distance of neighbours that are shown.
    """

    points: Floats
    sigma: Floats
    feature: NDArray[np.int64]
    count: int
    spacing: float


@dataclass(frozen=True)
class CoordinateRaster:
    """Raster of coordinates: ``origin`` (3,) [mm] of step 0, and the ``step`` [mm] along all axes."""

    origin: Floats
    step: float

    def steps(self, points: Floats) -> NDArray[np.uint16]:
        """Return points (n, 3) [mm] as integer steps."""
        return np.clip(np.rint((points - self.origin) / self.step), 0, LAST_STEP).astype("<u2")


def box_around(clouds: Iterable[Floats]) -> CoordinateRaster:
    """Return the raster that encloses all points (n, 3) [mm]."""
    filled = [points for points in clouds if len(points)]
    if not filled:
        return CoordinateRaster(np.zeros(3), 1.0)
    every = np.concatenate(filled)
    low, high = every.min(axis=0), every.max(axis=0)
    return CoordinateRaster(low, max(float((high - low).max()), 1e-6) / LAST_STEP)


def choose_clouds(scores: xr.Dataset, available: Sequence[int], first: Sequence[int]) -> list[int]:
    """Return the numbers of the views whose clouds are shown, ascending, at most :data:`MOST_CLOUDS` of ``available``.

    The choice takes ``first`` (checked views, sets), then the best of every measurement by uncertainty and by V_m in
    turn, then others, evenly spaced in number.
    """
    numbers = scores["view"].values
    ranks = [scores[name].transpose("measurement", "view").values for name in ("uncertainty_rank", "rank")]
    by_rank = np.argsort(np.concatenate(ranks), axis=1, kind="stable").T.ravel()
    wanted = dict.fromkeys([*first, *numbers[by_rank[: 10 * 2 * scores.sizes["measurement"]]].tolist()])
    chosen = [view for view in wanted if view in set(available)][:MOST_CLOUDS]
    candidates = [view for view in available if view not in set(chosen)]
    more = min(MOST_CLOUDS - len(chosen), len(candidates))
    return sorted(chosen + [candidates[i * len(candidates) // more] for i in range(more)])


def shown_cloud(cloud: PointCloud, part_from_sensor: Floats, features: Sequence[str], most: int) -> ShownCloud:
    """Return at most ``most`` points of a cloud, evenly over its pixels, by a pose (4, 4) [mm]."""
    valid, stride = cloud.valid, 1.0
    rows, columns = np.nonzero(valid)
    while len(rows) > most:
        stride = max(1.02 * stride, math.sqrt(stride**2 * len(rows) / most))
        kept = np.zeros_like(valid)
        every = [np.unique(np.arange(0, size, stride).astype(int)) for size in valid.shape]
        kept[np.ix_(*every)] = True
        rows, columns = np.nonzero(valid & kept)
    points = cloud.points[rows, columns].astype(np.float64)
    distance = float(np.median(np.linalg.norm(points - cloud.grid.origin, axis=1))) if len(points) else math.nan
    sigma = np.full(len(points), np.nan) if cloud.sigma is None else cloud.sigma[rows, columns].astype(np.float64)
    feature = np.full(len(points), -1)
    if cloud.feature is not None:
        of_task = [features.index(name) if name in features else -1 for name in cloud.feature_names]
        feature = np.array([*of_task, -1])[cloud.feature[rows, columns]]
    return ShownCloud(
        points @ part_from_sensor[:3, :3].T + part_from_sensor[:3, 3],
        sigma,
        feature,
        int(valid.sum()),
        math.ceil(stride) * cloud.grid.angular_pitch * distance,
    )


def noise_ends(clouds: Mapping[int, ShownCloud]) -> tuple[float, float] | None:
    """Return the ends [mm] of the colour scale of noise; None if no cloud has a noise."""
    sigmas = np.concatenate([np.empty(0), *(cloud.sigma[cloud.sigma > 0] for cloud in clouds.values())])
    if not len(sigmas):
        return None
    low, high = np.percentile(sigmas, NOISE_PERCENTILES)
    return (float(low), float(high)) if high > low else (float(low) / 1.1, float(low) * 1.1)


def packed_cloud(cloud: ShownCloud, box: CoordinateRaster, ends: tuple[float, float] | None) -> str:
    """Return base64 of planes x, y, z (steps of the box), noise (0 to 254, log of ``ends`` [mm]), feature."""
    noise = np.full(len(cloud.sigma), UNKNOWN, np.uint8)
    if ends is not None:
        valid = cloud.sigma > 0
        share = np.log(cloud.sigma[valid] / ends[0]) / math.log(ends[1] / ends[0])
        noise[valid] = np.rint(np.clip(share, 0, 1) * (UNKNOWN - 1)).astype(np.uint8)
    feature = np.where((cloud.feature < 0) | (cloud.feature >= UNKNOWN), UNKNOWN, cloud.feature).astype(np.uint8)
    return packed(box.steps(cloud.points).T.tobytes() + noise.tobytes() + feature.tobytes())


def packed_part(mesh: trimesh.Trimesh, box: CoordinateRaster) -> dict[str, Any]:
    """Return the page's part: ``vertices``, ``normals`` (x 127), ``triangles`` (uint16), ``shown`` of ``count``."""
    shaded = smoothly_shaded(mesh)
    return {
        "vertices": packed(box.steps(np.asarray(shaded.vertices)).T.tobytes()),
        "normals": packed_normals(np.asarray(shaded.vertex_normals)),
        "triangles": packed(np.asarray(shaded.faces).astype("<u2").tobytes()),
        "shown": len(shaded.faces),
        "count": len(mesh.faces),
    }


def smoothly_shaded(mesh: trimesh.Trimesh, most: int = MOST_TRIANGLES) -> trimesh.Trimesh:
    """Return a surface with at most ``most`` triangles and vertex normals that are smooth except at creases."""
    vertices, triangles = fewer_triangles(np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int64), most)
    merged = trimesh.Trimesh(vertices, triangles, process=True)
    shaded: trimesh.Trimesh = trimesh.graph.smooth_shade(merged, angle=CREASE)
    return shaded


def packed_normals(normals: Floats) -> str:
    """Return base64 of unit normals (n, 3): planes x, y, z, times 127."""
    return packed(np.rint(127 * normals).astype(np.int8).T.tobytes())


def fewer_triangles(
    vertices: Floats, triangles: NDArray[np.int64], most: int = MOST_TRIANGLES
) -> tuple[Floats, NDArray[np.int64]]:
    """Decimate a surface to at most ``most`` triangles: vertices in one cell of a raster become their mean.

    Rossignac and Borrel, "Multi-resolution 3D approximations for rendering complex scenes", 1993. It serves for display
    only; nothing is measured on it.
    """
    extent = float(np.ptp(vertices, axis=0).max())
    cells = 2 * math.sqrt(most)
    while len(triangles) > most:
        cell = np.floor((vertices - vertices.min(axis=0)) / (extent / cells))
        _, of_vertex = np.unique(cell, axis=0, return_inverse=True)
        of_vertex = of_vertex.ravel()
        number = np.bincount(of_vertex).astype(float)
        vertices = np.stack([np.bincount(of_vertex, axis) / number for axis in vertices.T], axis=1)
        triangles = of_vertex[triangles]
        a, b, c = triangles.T
        triangles = triangles[(a != b) & (b != c) & (c != a)]
        _, once = np.unique(np.sort(triangles, axis=1), axis=0, return_index=True)
        triangles = triangles[np.sort(once)]
        cells *= 0.85
    return vertices, triangles


def packed(data: bytes) -> str:
    """Return bytes as base64 text."""
    return base64.b64encode(data).decode("ascii")
