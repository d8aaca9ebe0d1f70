"""Dots of a known plate: how far apart a cloud has them, against the pitch of their print.

Signal chain: image on the cloud's grid -> dot centres [px] (:mod:`mitsim.decode.dot_centres`) -> view ray of each, met
with the plane through the cloud's points on all dots, shifted by the median residual of the dot's own -> 3D centres ->
neighbours about a pitch apart -> row and column of each dot in the plate -> similarity that takes the plate to the
dots: scale, and what is left over.

The scale s minimises sum |p_i - t - s R g_i|^2 with g_i the plate's own dots (Umeyama, IEEE PAMI 13(4), 1991). Its
standard uncertainty is sigma / sqrt(sum |g_i - g|^2), sigma from the residuals within the plate's plane with 2 n - 4
degrees of freedom: noise across the plane does not change the scale. The mean of the distances of neighbours is given
beside it; an error of an inner dot lengthens one distance and shortens the next, so that their standard deviation over
the root of their number says too much.
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

from characterisation.features.fits import FitError, fit_plane
from characterisation.features.robust_fit import SMALLEST_SCALE
from characterisation.features.surfaces import tangents
from characterisation.point_cloud import PointCloud, ViewGrid
from mitsim.capture.capture import Capture
from mitsim.decode.dot_centres import dot_centres, resample_to_grid
from mitsim.measuring.result import Result, failed
from mitsim.measuring.windows import window_slices
from mitsim.sensor.roi import Roi

Array = NDArray[np.float64]

#: distances of neighbours over the pitch; the diagonal is 1.41
_NEIGHBOURS = (0.8, 1.2)

#: dots that a plate must have
LEAST_DOTS = 9

#: distance of two dots in the image over the median distance of the nearest, within which they are on one plate
_BESIDE = 1.35

#: shares of the distance within which the plate lies, and standard deviations of the plate's points, for false matches
_DEPTH_SHARE, _GATE = 0.2, 6.0

#: points of the cloud that a dot must have
_LEAST_AROUND = 12


@dataclass(frozen=True)
class Plate:
    """A plate of dots ``pitch`` [mm] apart in a window, None for the whole grid.

    ``dark`` dots lie on bright ground; otherwise bright dots on dark ground.
    """

    window: Roi | None
    pitch: float
    dark: bool = True


@dataclass(frozen=True)
class PlateDots:
    """Dots of a plate in the sensor frame.

    ``centres`` (n, 3) [mm]; ``places`` (n, 2) whole row and column of each in the plate; ``distances`` (m,) [mm] of all
    neighbours along rows and columns; ``found`` dots in the window, on the plate or not.
    """

    centres: Array
    places: NDArray[np.int64]
    distances: Array
    found: int


def image_on_grid(capture: Capture, grid: ViewGrid) -> NDArray[np.uint8]:
    """Mean image of the reference camera, scaled to 8 bits by its own brightest pixels, as the grid's pixels see it."""
    name = next(iter(capture.rig.cameras))
    mean = capture.images[name].mean(axis=0)
    bright = float(np.percentile(mean, 99.9))
    level = np.clip(mean * (255.0 / max(bright, 1.0)), 0, 255).astype(np.uint8)
    return resample_to_grid(level, capture.rig.reference, grid)


def measure_plate(name: str, plate: Plate, cloud: PointCloud, image: NDArray[np.uint8]) -> list[Result]:
    """Measure a plate: pitch, neighbour distance, what is left over in the plate's plane and across it [mm].

    Raises
    ------
    InputError
        If the window does not lie in the grid.
    """
    names = [f"{name} {what}" for what in ("pitch", "neighbour distance", "neighbour spread", "in-plane", "flatness")]
    try:
        dots = plate_dots(name, plate, cloud, image)
    except FitError as error:
        return [failed(one, "mm", str(error)) for one in names]
    scale, uncertainty, residual = plate_scale(dots, plate.pitch)
    count, freedom = len(dots.centres), 2 * len(dots.centres) - 4
    within = math.sqrt(float((residual[:, :2] ** 2).sum()) / freedom)
    mean, spread = float(dots.distances.mean()), float(dots.distances.std(ddof=1))
    result = partial(Result, unit="mm", points=count, points_given=dots.found)
    fitted = partial(result, origin="fit")
    return [
        fitted(names[0], value=scale * plate.pitch, uncertainty=uncertainty * plate.pitch, nominal=plate.pitch),
        result(names[1], value=mean, nominal=plate.pitch),
        result(names[2], value=spread),
        fitted(names[3], value=within, uncertainty=within / math.sqrt(2 * freedom)),
        result(names[4], value=float(np.ptp(residual[:, 2]))),
    ]


def plate_dots(name: str, plate: Plate, cloud: PointCloud, image: NDArray[np.uint8]) -> PlateDots:
    """Dots of a plate in a cloud, by the image (H, W) on the cloud's grid; the plate that shows the most of them.

    Raises
    ------
    FitError
        If there are too few dots, or none as far apart as the plate's.
    InputError
        If the window does not lie in the grid.
    """
    rows, columns = window_slices(plate.window, cloud, name)
    found = dot_centres(np.ascontiguousarray(image[rows, columns]), plate.dark)
    if len(found) < LEAST_DOTS:
        raise FitError(f"{len(found)} round dots in the image, at least {LEAST_DOTS} are asked for")
    spacing = cKDTree(found).query(found, 2)[0][:, 1]
    beside = cKDTree(found).query_pairs(_BESIDE * float(np.median(spacing)), output_type="ndarray")
    at = found[_largest_group(beside, len(found))] + np.array([columns.start, rows.start])
    if len(at) < LEAST_DOTS:
        raise FitError(f"{len(found)} round dots that do not lie side by side")
    points = _on_plate(cloud, at, float(np.median(spacing)) / 2)
    if len(points) < LEAST_DOTS:
        raise FitError(f"the cloud has points on {len(points)} of {len(at)} dots, at least {LEAST_DOTS} are asked for")
    low, high = (share * plate.pitch for share in _NEIGHBOURS)
    tree = cKDTree(points)
    nearest = float(np.median(tree.query(points, 2)[0][:, 1]))
    if not low < nearest < high:
        raise FitError(f"dots whose nearest is at a median of {nearest:.4g} mm, not about {plate.pitch:g} mm")
    pairs = tree.query_pairs(high, output_type="ndarray")
    pairs = pairs[np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1) > low]
    largest = _largest_group(pairs, len(points))
    if len(largest) < LEAST_DOTS:
        raise FitError(f"only {len(largest)} dots about {plate.pitch:g} mm apart, at least {LEAST_DOTS} are asked for")
    own = {int(dot): k for k, dot in enumerate(largest)}
    kept = np.array([(own[a], own[b]) for a, b in pairs.tolist() if a in own])
    centres = points[largest]
    places, steps = _places(centres, kept, plate.pitch)
    neighbours = kept[steps]
    distances = np.linalg.norm(centres[neighbours[:, 0]] - centres[neighbours[:, 1]], axis=1)
    return PlateDots(centres, places, distances, len(found))


def plate_scale(dots: PlateDots, pitch: float) -> tuple[float, float, Array]:
    """Scale of the dots against the plate [1], its standard uncertainty, and the residuals (n, 3) [mm].

    The first two of a residual lie in the plate's plane, the third across it.
    """
    plate = np.column_stack([dots.places * pitch, np.zeros(len(dots.places))]).astype(float)
    plate -= plate.mean(axis=0)
    found = dots.centres - dots.centres.mean(axis=0)
    u, singular, vt = np.linalg.svd(found.T @ plate)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    turn = u @ np.diag(sign) @ vt
    inertia = float((plate**2).sum())
    scale = float((singular * sign).sum()) / inertia
    residual = found @ turn - scale * plate
    sigma = math.sqrt(float((residual[:, :2] ** 2).sum()) / (2 * len(plate) - 4))
    return scale, sigma / math.sqrt(inertia), residual


def _largest_group(pairs: NDArray[Any], count: int) -> NDArray[np.intp]:
    """Numbers of the largest group of ``count`` things that pairs (m, 2) connect."""
    links = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    _, label = connected_components(links, directed=False)
    return np.flatnonzero(label == np.bincount(label).argmax())


def _on_plate(cloud: PointCloud, at: Array, reach: float) -> Array:
    """Points (k, 3) [mm] of the dots at grid positions (n, 2) around which the cloud has points.

    A dot alone, of which a matcher often has the rim only, does not say how the plate leans there: all together do. So
    one plane is fitted to the points within ``reach`` pixels of all dots, and at each dot shifted along the ray by the
    median residual of its own.
    """
    grid, near = cloud.grid, [_around(cloud, place, reach) for place in at]
    every = np.concatenate(near)
    if len(every) <= _LEAST_AROUND:
        return np.empty((0, 3))
    distance = np.linalg.norm(every - grid.origin, axis=1)
    middle = np.median(distance)
    plane = fit_plane(every[np.abs(distance - middle) < _DEPTH_SHARE * middle], grid.origin)
    out = []
    for place, points in zip(at, near, strict=True):
        if len(points) < _LEAST_AROUND:
            continue
        rays = points - grid.origin
        residual = plane.meet(points, rays / np.linalg.norm(rays, axis=1, keepdims=True)).residual
        residual = residual[np.abs(residual) <= _GATE * max(plane.residual_std, SMALLEST_SCALE)]
        if len(residual) < _LEAST_AROUND:
            continue
        ray = _ray(grid, place)
        away = (plane.point - grid.origin) @ plane.normal / (ray @ plane.normal) + float(np.median(residual))
        out.append(grid.origin + away * ray)
    return np.array(out).reshape(-1, 3)


def _around(cloud: PointCloud, place: Array, reach: float) -> Array:
    """Points (n, 3) [mm] within ``reach`` pixels of a grid position (2,)."""
    low = np.maximum(np.floor(place - reach), 0).astype(int)
    high = np.ceil(place + reach).astype(int) + 1
    points = cloud.points[low[1] : high[1], low[0] : high[0]]
    row, column = np.mgrid[low[1] : low[1] + points.shape[0], low[0] : low[0] + points.shape[1]]
    near = (np.hypot(column - place[0], row - place[1]) <= reach) & np.isfinite(points[..., 2])
    return np.asarray(points[near], np.float64)


def _ray(grid: ViewGrid, place: Array) -> Array:
    """Unit view direction (3,) of a position between pixels, linear between the four around it."""
    column, row = np.minimum(place.astype(int), [grid.width - 2, grid.height - 2])
    a, b = place - [column, row]
    columns, rows = np.array([column, column + 1, column, column + 1]), np.array([row, row, row + 1, row + 1])
    rays = grid.rays_at(columns, rows)
    local = rays @ grid.rotation
    local /= local[:, 2:]
    mixed = np.array([(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b]) @ local
    ray: Array = grid.rotation @ (mixed / np.linalg.norm(mixed))
    return ray


def _places(centres: Array, pairs: NDArray[Any], pitch: float) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Whole row and column (n, 2) of dots in their plate, and which of the pairs (m, 2) are steps along these."""
    middle = centres.mean(axis=0)
    normal = np.linalg.svd(centres - middle, full_matrices=False)[2][-1]
    flat = (centres - middle) @ tangents(normal).T
    edge = flat[pairs[:, 1]] - flat[pairs[:, 0]]
    # directions of edges modulo 90 deg
    angle = float(np.angle(np.exp(4j * np.arctan2(edge[:, 1], edge[:, 0])).sum())) / 4
    turn = np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
    step = np.rint(edge @ turn.T / pitch).astype(np.int64)
    along = np.abs(step).sum(axis=1) == 1
    if along.sum() < LEAST_DOTS:
        raise FitError(f"{len(centres)} dots that do not lie in rows and columns")
    beside: dict[int, list[tuple[int, NDArray[np.int64]]]] = {}
    for (first, second), move in zip(pairs[along].tolist(), step[along], strict=True):
        beside.setdefault(first, []).append((second, move))
        beside.setdefault(second, []).append((first, -move))
    start = max(beside, key=lambda dot: len(beside[dot]))
    places = {start: np.zeros(2, np.int64)}
    todo = [start]
    while todo:
        dot = todo.pop(0)
        for other, move in beside[dot]:
            if other not in places:
                places[other] = places[dot] + move
                todo.append(other)
            elif (places[other] != places[dot] + move).any():
                raise FitError("dots that do not lie in one grid of rows and columns: two plates in one window?")
    if len(places) < len(centres):
        raise FitError(f"only {len(places)} of {len(centres)} dots lie in one grid of rows and columns")
    return np.array([places[dot] for dot in range(len(centres))]), along
