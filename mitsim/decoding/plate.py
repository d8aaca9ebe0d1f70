"""Measure the spacing of the dots of a printed plate in a cloud, and compare it with the pitch of the print.

Signal chain: image on the cloud's grid -> dot centres [px] (:mod:`mitsim.decoding.dot_centres`) -> plane through the
cloud's points on all dots -> view ray of each dot, intersected with this plane, shifted by the median residual of the
dot's points -> 3D centres -> neighbours about a pitch apart -> row and column of each dot in the plate -> similarity
transform from plate to dots: scale and residuals.

The scale s minimises sum |p_i - t - s R g_i|^2 (Umeyama, IEEE PAMI 13(4), 1991). Here p_i are the measured centres, g_i
those of the print, and g is the mean of the g_i. The standard uncertainty of s follows from the residuals r_i in the
plane of the plate, with 2 n - 4 degrees of freedom,

    u^2(s) = 2 n / (2 n - 4) sum (r_i . (g_i - g))^2 / (sum |g_i - g|^2)^2.

Noise across the plane does not change the scale. Noise along the view rays errs in the plane in one direction only, and
more the more the ray leans; residuals of one size in all directions would give u/sqrt(2) or less.

The mean distance of neighbours is also reported, without an uncertainty. An error of an inner dot lengthens one
distance and shortens the next. So the distances are not independent: their standard deviation over the root of their
number overestimates the uncertainty of their mean.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from characterisation.features.fits import fit_plane
from characterisation.features.robust_fit import SMALLEST_SCALE, FitError
from characterisation.features.vectors import tangents
from characterisation.point_cloud import PointCloud, ViewGrid
from characterisation.region_of_interest import Roi
from characterisation.tasks.result import Result, failed
from characterisation.tasks.windows import window_slices
from mitsim.capture.capture import Capture
from mitsim.decoding.dot_centres import dot_centres, resample_to_grid

Array = NDArray[np.float64]

#: range of the distance of neighbours over the pitch; diagonal neighbours have 1.41
_NEIGHBOURS = (0.8, 1.2)

#: least number of dots of a plate
LEAST_DOTS = 9

#: largest distance of adjacent dots in the image, over the median distance of the nearest dots
_ADJACENT = 1.35

#: difference from the median range, as a share of it, from which a point is a false match; chosen
_DEPTH_SHARE = 0.2

#: residual from the plate's plane [standard deviations] beyond which a point is a false match; chosen
_GATE = 6.0

#: least number of the cloud's points near a dot
_LEAST_POINTS = 12


@dataclass(frozen=True)
class Plate:
    """A plate of dots in a window [px] of the grid, None for the whole grid.

    ``pitch`` [mm] of the dots; ``dark``: dark dots on bright ground, otherwise bright dots on dark ground.
    """

    window: Roi | None
    pitch: float
    dark: bool = True


@dataclass(frozen=True)
class PlateDots:
    """Measured dots of a plate."""

    centres: Array  # (n, 3) [mm], in the sensor frame
    indices: NDArray[np.int64]  # (n, 2) row and column of each dot in the plate
    distances: Array  # (m,) [mm] of all neighbours along rows and columns
    dot_count: int  # number of dots in the window, on the plate or not


def image_on_grid(capture: Capture, grid: ViewGrid) -> NDArray[np.uint8]:
    """Return the light that the reference camera sees, resampled to the pixels of a cloud's grid (H, W), 8 bits.

    The 99.9th percentile of its levels becomes 255.
    """
    name = next(iter(capture.rig.cameras))
    light = capture.brightness(name)
    bright = float(np.percentile(light, 99.9))
    level = np.clip(light * (255.0 / max(bright, 1.0)), 0, 255).astype(np.uint8)
    return resample_to_grid(level, capture.rig.reference, grid)


def measure_plate(name: str, plate: Plate, cloud: PointCloud, image: NDArray[np.uint8]) -> list[Result]:
    """Measure a plate of dots in a cloud, by the image (H, W) on the cloud's grid.

    The results, in mm, are called ``name`` and:

    - pitch: scale times the nominal pitch, with its standard uncertainty.
    - neighbour distance, neighbour spread: mean and standard deviation of the distances of neighbours.
    - in-plane: standard deviation of the residuals per axis in the plane of the plate, with 2 n - 4 degrees of freedom.
      Its standard uncertainty takes the residuals along the view ray and across it as normal, each of its own size.
    - flatness: range of the dots across the plate.

    If the dots cannot be measured, each result has no value and gives the reason. Raises InputError if the window does
    not lie in the grid.

    Parameters
    ----------
    name
        Start of the names of the results.
    plate
        Window, pitch and colour of the dots.
    cloud
        Organised cloud of the plate.
    image
        (H, W) grey image on the grid of the cloud.

    See Also
    --------
    plate_dots : the dots alone
    """
    names = [
        f"{name} {quantity}" for quantity in ("pitch", "neighbour distance", "neighbour spread", "in-plane", "flatness")
    ]
    try:
        dots = plate_dots(name, plate, cloud, image)
    except FitError as error:
        return [failed(quantity, "mm", str(error)) for quantity in names]
    scale, uncertainty, residual, rotation = plate_scale(dots, plate.pitch)
    count, freedom = len(dots.centres), 2 * len(dots.centres) - 4
    square = float((residual[:, :2] ** 2).sum())
    within = math.sqrt(square / freedom)
    leaning = ((dots.centres - cloud.grid.origin) @ rotation)[:, :2]
    leaning /= np.maximum(np.linalg.norm(leaning, axis=1, keepdims=True), SMALLEST_SCALE)
    along = (residual[:, :2] * leaning).sum(axis=1)
    across = residual[:, 0] * leaning[:, 1] - residual[:, 1] * leaning[:, 0]
    # the square of a normal error has the variance 2 v^2, its fourth power the mean 3 v^2
    variance = 2 / 3 * float((along**4 + across**4).sum()) * 2 * count / freedom
    mean, spread = float(dots.distances.mean()), float(dots.distances.std(ddof=1))
    result = partial(Result, unit="mm", points=count, points_given=dots.dot_count)
    fitted = partial(result, origin="fit")
    return [
        fitted(names[0], value=scale * plate.pitch, uncertainty=uncertainty * plate.pitch, nominal=plate.pitch),
        result(names[1], value=mean, nominal=plate.pitch),
        result(names[2], value=spread),
        fitted(names[3], value=within, uncertainty=within * math.sqrt(variance) / (2 * max(square, SMALLEST_SCALE**2))),
        result(names[4], value=float(np.ptp(residual[:, 2]))),
    ]


def plate_dots(name: str, plate: Plate, cloud: PointCloud, image: NDArray[np.uint8]) -> PlateDots:
    """Return the dots of a plate in a cloud.

    Of several plates in the window, the one with the most dots is used. Raises FitError if there are too few dots, or
    they are not about a pitch apart, or do not form one grid. Raises InputError if the window does not lie in the grid.

    Parameters
    ----------
    name
        Name of the plate in messages.
    plate
        Window, pitch and colour of the dots.
    cloud
        Organised cloud of the plate.
    image
        (H, W) grey image on the grid of the cloud, in which the dots are found.

    See Also
    --------
    measure_plate : the results from the dots
    """
    rows, columns = window_slices(plate.window, cloud, name)
    dots = dot_centres(np.ascontiguousarray(image[rows, columns]), plate.dark)
    if len(dots) < LEAST_DOTS:
        raise FitError(f"{len(dots)} round dots in the image, at least {LEAST_DOTS} are needed")
    spacing = cKDTree(dots).query(dots, 2)[0][:, 1]
    adjacent = cKDTree(dots).query_pairs(_ADJACENT * float(np.median(spacing)), output_type="ndarray")
    pixels = dots[_largest_group(adjacent, len(dots))] + np.array([columns.start, rows.start])
    if len(pixels) < LEAST_DOTS:
        raise FitError(f"{len(dots)} round dots in the image, but fewer than {LEAST_DOTS} side by side")
    points = _dot_positions(cloud, pixels, float(np.median(spacing)) / 2)
    if len(points) < LEAST_DOTS:
        raise FitError(f"the cloud has points on {len(points)} of {len(pixels)} dots, at least {LEAST_DOTS} are needed")
    low, high = (share * plate.pitch for share in _NEIGHBOURS)
    tree = cKDTree(points)
    nearest = float(np.median(tree.query(points, 2)[0][:, 1]))
    if not low < nearest < high:
        raise FitError(f"dots with the nearest dot at a median of {nearest:.4g} mm, not about {plate.pitch:g} mm")
    pairs = tree.query_pairs(high, output_type="ndarray")
    pairs = pairs[np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1) > low]
    largest = _largest_group(pairs, len(points))
    if len(largest) < LEAST_DOTS:
        raise FitError(f"only {len(largest)} dots about {plate.pitch:g} mm apart, at least {LEAST_DOTS} are needed")
    number = {int(dot): k for k, dot in enumerate(largest)}
    kept = np.array([(number[a], number[b]) for a, b in pairs.tolist() if a in number])
    centres = points[largest]
    indices, is_step = _grid_indices(centres, kept, plate.pitch)
    neighbours = kept[is_step]
    distances = np.linalg.norm(centres[neighbours[:, 0]] - centres[neighbours[:, 1]], axis=1)
    return PlateDots(centres, indices, distances, len(dots))


def plate_scale(dots: PlateDots, pitch: float) -> tuple[float, float, Array, Array]:
    """Return the scale of the dots relative to the print, its standard uncertainty, residuals and rotation.

    ``pitch`` [mm] is that of the print. The residuals (n, 3) [mm] are in the frame of the plate, from which the
    rotation (3, 3) leads to the sensor frame: the first two components lie in the plane of the plate, the third across
    it. Formulas and source: :mod:`mitsim.decoding.plate`.
    """
    plate = np.column_stack([dots.indices * pitch, np.zeros(len(dots.indices))]).astype(float)
    plate -= plate.mean(axis=0)
    centred = dots.centres - dots.centres.mean(axis=0)
    rotation, scale = turn_and_scale(centred, plate)
    residual = centred @ rotation - scale * plate
    stretch = (residual[:, :2] * plate[:, :2]).sum(axis=1)
    spread = math.sqrt(float((stretch**2).sum()) * 2 * len(plate) / (2 * len(plate) - 4))
    return scale, spread / float((plate**2).sum()), residual, rotation


def turn_and_scale(points: Array, printed: Array) -> tuple[Array, float]:
    """Return the rotation (3, 3) from print to sensor, and the scale, that take printed points to measured ones.

    Both (n, 3) [mm] have their mean at 0. Least squares: Umeyama, IEEE PAMI 13(4), 1991.
    """
    u, singular, vt = np.linalg.svd(points.T @ printed)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    return u @ np.diag(sign) @ vt, float((singular * sign).sum()) / float((printed**2).sum())


def _largest_group(pairs: NDArray[Any], count: int) -> NDArray[np.intp]:
    """Return the indices of the largest of the groups into which pairs (m, 2) connect ``count`` items."""
    links = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    _, label = connected_components(links, directed=False)
    return np.flatnonzero(label == np.bincount(label).argmax())


def _dot_positions(cloud: PointCloud, pixels: Array, radius_px: float) -> Array:
    """Return positions (k, 3) [mm] of those dots at ``pixels`` (n, 2) of the grid that have points around them.

    A matcher often recovers only the rim of a dot, which does not determine the inclination of the plate. So one plane
    is fitted to the points within ``radius_px`` of all dots. At each dot it is shifted along the ray by the median
    residual of the points of this dot.
    """
    grid, points_of_dots = cloud.grid, [_points_near(cloud, position, radius_px) for position in pixels]
    plate_points = np.concatenate(points_of_dots)
    if len(plate_points) <= _LEAST_POINTS:
        return np.empty((0, 3))
    ranges = np.linalg.norm(plate_points - grid.origin, axis=1)
    middle = np.median(ranges)
    plane = fit_plane(plate_points[np.abs(ranges - middle) < _DEPTH_SHARE * middle], grid.origin)
    out = []
    for position, points in zip(pixels, points_of_dots, strict=True):
        if len(points) < _LEAST_POINTS:
            continue
        rays = points - grid.origin
        residual = plane.meet(points, rays / np.linalg.norm(rays, axis=1, keepdims=True)).residual
        residual = residual[np.abs(residual) <= _GATE * max(plane.residual_std, SMALLEST_SCALE)]
        if len(residual) < _LEAST_POINTS:
            continue
        ray = rays_between(grid, position[None])[0]
        distance = (plane.point - grid.origin) @ plane.normal / (ray @ plane.normal) + float(np.median(residual))
        out.append(grid.origin + distance * ray)
    return np.array(out).reshape(-1, 3)


def _points_near(cloud: PointCloud, position: Array, radius_px: float) -> Array:
    """Return points (n, 3) [mm] within ``radius_px`` pixels of a grid position (2,)."""
    low = np.maximum(np.floor(position - radius_px), 0).astype(int)
    high = np.ceil(position + radius_px).astype(int) + 1
    points = cloud.points[low[1] : high[1], low[0] : high[0]]
    row, column = np.mgrid[low[1] : low[1] + points.shape[0], low[0] : low[0] + points.shape[1]]
    near = (np.hypot(column - position[0], row - position[1]) <= radius_px) & np.isfinite(points[..., 2])
    return np.asarray(points[near], np.float64)


def rays_between(grid: ViewGrid, pixels: Array) -> Array:
    """Return the unit view rays (n, 3) at places (n, 2) between pixels, by bilinear interpolation of x/z and y/z."""
    low = np.clip(np.floor(pixels).astype(int), 0, [grid.width - 2, grid.height - 2])
    a, b = (pixels - low).T
    mixed = np.zeros((len(pixels), 3))
    for right, below, weight in ((0, 0, (1 - a) * (1 - b)), (1, 0, a * (1 - b)), (0, 1, (1 - a) * b), (1, 1, a * b)):
        local = grid.rays_at(low[:, 0] + right, low[:, 1] + below) @ grid.rotation
        mixed += weight[:, None] * local / local[:, 2:]
    turned = mixed @ grid.rotation.T
    return np.asarray(turned / np.linalg.norm(turned, axis=1, keepdims=True))


def _grid_indices(centres: Array, pairs: NDArray[Any], pitch: float) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return row and column (n, 2) of dots in their plate, and which pairs (m, 2) are one step in a row or column."""
    middle = centres.mean(axis=0)
    normal = np.linalg.svd(centres - middle, full_matrices=False)[2][-1]
    flat = (centres - middle) @ tangents(normal).T
    edges = flat[pairs[:, 1]] - flat[pairs[:, 0]]
    # mean direction of the edges modulo 90 deg
    angle = float(np.angle(np.exp(4j * np.arctan2(edges[:, 1], edges[:, 0])).sum())) / 4
    rotation = np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
    offsets = np.rint(edges @ rotation.T / pitch).astype(np.int64)
    is_step = np.abs(offsets).sum(axis=1) == 1
    if is_step.sum() < LEAST_DOTS:
        raise FitError(f"{len(centres)} dots that do not lie in rows and columns")
    links: dict[int, list[tuple[int, NDArray[np.int64]]]] = {}
    for (first, second), offset in zip(pairs[is_step].tolist(), offsets[is_step], strict=True):
        links.setdefault(first, []).append((second, offset))
        links.setdefault(second, []).append((first, -offset))
    start = max(links, key=lambda dot: len(links[dot]))
    indices = {start: np.zeros(2, np.int64)}
    queue = [start]
    while queue:
        dot = queue.pop(0)
        for other, offset in links[dot]:
            if other not in indices:
                indices[other] = indices[dot] + offset
                queue.append(other)
            elif (indices[other] != indices[dot] + offset).any():
                raise FitError("dots that do not lie in one grid of rows and columns: two plates in one window?")
    if len(indices) < len(centres):
        raise FitError(f"only {len(indices)} of {len(centres)} dots lie in one grid of rows and columns")
    return np.array([indices[dot] for dot in range(len(centres))]), is_step
