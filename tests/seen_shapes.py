"""Clouds of planes, spheres and cylinders with known noise along the rays, met in closed form."""

from __future__ import annotations

import numpy as np

from characterisation.point_cloud import PointCloud, Status, ViewGrid

GRID = ViewGrid(600.0, 600.0, 99.5, 79.5, 200, 160)


def cloud_of(distance, sigma=0.0, rng=None, grid=GRID):
    """A cloud with points at distances (H, W) [mm] along the grid's rays, NaN where there is none."""
    noisy = distance + (0.0 if rng is None else sigma * rng.standard_normal(distance.shape))
    points = (grid.origin + grid.rays() * noisy[..., None]).astype(np.float32)
    status = np.where(np.isfinite(noisy), Status.VALID, Status.NO_SURFACE).astype(np.uint8)
    return PointCloud(points, status, grid, "known", "simulated")


def plane(point, normal, grid=GRID):
    """Distances (H, W) to a plane."""
    normal = np.asarray(normal, float) / np.linalg.norm(normal)
    return (np.asarray(point, float) - grid.origin) @ normal / (grid.rays() @ normal)


def sphere(centre, radius, grid=GRID):
    """Distances (H, W) to the near side of a sphere; NaN beside it and within 15 deg of its rim."""
    return _round(np.asarray(centre, float) - grid.origin, np.eye(3), radius, grid)


def cylinder(point, axis, radius, grid=GRID):
    """Distances (H, W) to the near side of an endless cylinder."""
    axis = np.asarray(axis, float) / np.linalg.norm(axis)
    return _round(np.asarray(point, float) - grid.origin, np.eye(3) - np.outer(axis, axis), radius, grid)


def _round(centre, across, radius, grid):
    rays = grid.rays() @ across
    a, b = (rays**2).sum(-1), rays @ (across @ centre)
    square = b**2 - a * ((across @ centre) @ (across @ centre) - radius**2)
    with np.errstate(invalid="ignore"):
        near = (b - np.sqrt(square)) / a
        normal = (near[..., None] * rays - across @ centre) / radius
        facing = -(normal * grid.rays()).sum(-1)
        return np.where(facing > np.sin(np.deg2rad(15)), near, np.nan)


def points_of(surfaces, grid):
    """Points where the rays of a grid meet surfaces, (H, W, 3) [mm], sensor frame; NaN without a surface."""
    return grid.origin + grid.rays() * surfaces.distance[..., None].astype(float)
