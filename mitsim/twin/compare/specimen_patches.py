"""Metrics of a specimen in one capture, in patches of 40 px: grey levels, points and their noise.

Signal chain, image: plain image of the reference camera (:mod:`mitsim.twin.compare.plain_image`), pixels on the
specimen (:func:`mitsim.twin.finish.find_specimen.image_mask`) -> local mean and deviation, crossings of the local mean,
changes of sign between neighbouring pixels -> values of every patch.

Signal chain, cloud: pixels on the specimen, on the cloud's grid -> points and statuses of every patch; plane of the
patch along the rays -> sigma, residuals and their products at every lag (:mod:`characterisation.coupon.metrics`,
:mod:`characterisation.coupon.residual_field`). For stereo also the row error of the rectified right image.

Patches are pixels of the image in one table and pixels of the cloud's grid in the other. Two captures with the same
calibration and plane have the same patches in the same order, so they can be compared in pairs.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter
from scipy.sparse import csr_array

from characterisation.coupon.metrics import RayNoise, ray_noise_std
from characterisation.coupon.residual_field import LARGEST_LAG, autocorrelation
from characterisation.files.arrays import MEDIAN_TO_STD, Floats
from characterisation.point_cloud import FALSE_SHARE_OF_DISTANCE, PointCloud, Status
from characterisation.region_of_interest import Roi
from mitsim.capture.capture import Capture
from mitsim.decoding.cloud import Geometry, Settings, capture_cloud
from mitsim.decoding.matching.row_error import row_error
from mitsim.decoding.matching.stereo_geometry import StereoGeometry
from mitsim.twin.compare.plain_image import plain_image
from mitsim.twin.finish.find_specimen import MARGIN_PX, feet_of, image_mask, on_specimen
from mitsim.twin.finish.fine_detail import finest_detail
from mitsim.twin.finish.specimen import Specimen

PATCH_PX = 40

#: smallest fraction of a patch on the specimen; chosen
LEAST_ON = 0.5

#: smallest fraction of a patch's pixels with points for its noise; chosen
LEAST_POINTS = 0.5

#: smallest fraction of a patch's pixels with points for its row error, which is one number for the whole patch
_LEAST_FOR_ROWS = 0.15

#: limits of the window of local means [px]; chosen
_WINDOWS = (7, 31)

#: width of this window in run lengths of the pattern, so that several dots lie in it; chosen
_RUNS = 2.5


@dataclass(frozen=True)
class SpecimenPatches:
    """P patches of the raw image and Q patches of the cloud's grid; unknown values are NaN.

    Image: ``levels`` (P, 2^bits), sparse, are pixels of each grey level. ``contrast`` (P,) [1] is local deviation over
    local mean. ``crossings`` (P,) count crossings of the local mean in ``pixels`` (P,) pixels. ``finest`` (P,) is in
    DN.

    Cloud: ``status`` (Q, 12) are pixels of each :class:`Status`, ``recovered`` (Q,) those with a point on the specimen,
    within 1 % of its distance as in F of a coupon (:mod:`characterisation.coupon.patches`). ``sigma`` (Q,) [mm] is
    along the rays, ``sigma_px`` [px] in disparity. ``distance`` (Q,) [mm] is that of the patch's plane along its mean
    ray. ``products`` and ``pairs`` (Q, k, k) are those of residuals by lag. ``row_error`` (Q,) [px] is that of the
    right image. ``cloud`` is the cloud, ``on_grid`` (H, W) are the specimen's pixels, ``residual`` (H, W) [mm] is about
    the planes of the patches.
    """

    levels: csr_array = field(repr=False)
    contrast: Floats
    crossings: Floats
    pixels: Floats
    finest: Floats
    status: Floats
    recovered: Floats
    sigma: Floats
    sigma_px: Floats
    distance: Floats
    products: Floats = field(repr=False)
    pairs: Floats = field(repr=False)
    row_error: Floats
    cloud: PointCloud = field(repr=False)
    on_grid: NDArray[np.bool_] = field(repr=False)
    residual: Floats = field(repr=False)


def specimen_patches(
    capture: Capture, settings: Settings, geometry: Geometry, specimen: Specimen, window_px: int
) -> SpecimenPatches:
    """Return the patches of a flat specimen, sensor frame; ``window_px`` of local mean and deviation."""
    camera, image = capture.rig.reference, reference_levels(capture).astype(float)
    on_image = image_mask(specimen, camera, MARGIN_PX)
    mean = uniform_filter(image, window_px)
    deviation = np.sqrt(np.maximum(uniform_filter(image**2, window_px) - mean**2, 0.0))
    across = (image[:, 1:] > mean[:, 1:]) != (image[:, :-1] > mean[:, :-1])
    finest = np.abs(finest_detail(image))
    corners = patch_corners(on_image, PATCH_PX, LEAST_ON)

    def of_image(values: Floats) -> Floats:
        return _tiles(np.where(on_image, values, np.nan), corners)

    crossings = of_image(np.pad(across.astype(float), ((0, 0), (1, 0))))
    grid = geometry.grid
    cloud, on_grid, grid_corners = _cloud_patches(capture, settings, geometry, specimen)
    status = _tiles(np.where(on_grid, cloud.status.astype(float), np.nan), grid_corners)
    recovered = _tiles(np.where(on_grid, points_on_specimen(cloud, specimen), np.nan), grid_corners)
    points = np.where(on_grid[..., None], cloud.points, np.nan).astype(float) - grid.origin
    tiles = np.stack([_tiles(points[..., axis], grid_corners) for axis in range(3)], axis=-1)
    noise = ray_noise_std(tiles)
    usable = noise.count >= LEAST_POINTS * np.isfinite(status).sum(axis=-1)
    sigma = np.where(usable, noise.sigma, np.nan)
    residual = np.where(usable[:, None], noise.inlier_residual, np.nan)
    products, pairs = _products(residual)
    field_ = np.full(on_grid.shape, np.nan)
    for (row, column), tile in zip(grid_corners, residual, strict=True):
        field_[row : row + PATCH_PX, column : column + PATCH_PX] = tile.reshape(PATCH_PX, PATCH_PX)
    return SpecimenPatches(
        levels=_histograms(of_image(image), 2**capture.bits),
        contrast=np.nanmean(of_image(deviation / np.maximum(mean, 1.0)), axis=-1),
        crossings=np.nansum(crossings, axis=-1),
        pixels=np.isfinite(crossings).sum(axis=-1).astype(float),
        finest=MEDIAN_TO_STD * np.nanmedian(of_image(finest), axis=-1),
        status=np.stack([(status == value).sum(axis=-1) for value in Status], axis=-1).astype(float),
        recovered=np.nansum(recovered, axis=-1),
        sigma=sigma,
        sigma_px=_in_disparity(noise, sigma, tiles, geometry),
        distance=np.where(usable, noise.distance, np.nan),
        products=products,
        pairs=pairs,
        row_error=_row_errors(capture, geometry, cloud, grid_corners, usable),
        cloud=cloud,
        on_grid=on_grid,
        residual=field_,
    )


def patch_rows(
    capture: Capture, settings: Settings, geometry: StereoGeometry, specimen: Specimen
) -> tuple[Floats, Floats, Floats]:
    """Return row errors (Q,) [px] of a pair's patches, and columns and rows of their middles in the right image."""
    cloud, on_grid, corners = _cloud_patches(capture, settings, geometry, specimen)
    valid = _tiles(np.where(on_grid, cloud.valid.astype(float), np.nan), corners)
    usable = np.nansum(valid, axis=-1) >= _LEAST_FOR_ROWS * np.isfinite(valid).sum(axis=-1)
    off = _tiles(np.where(cloud.valid, _disparity(cloud, geometry), np.nan), corners)
    disparity = np.full(len(corners), np.nan)
    disparity[usable] = np.nanmedian(off[usable], axis=-1)
    middles = np.array(corners, float).reshape(-1, 2) + (PATCH_PX - 1) / 2
    errors = _row_errors(capture, geometry, cloud, corners, usable)
    return errors, middles[:, 1] - disparity, middles[:, 0]


def _cloud_patches(
    capture: Capture, settings: Settings, geometry: Geometry, specimen: Specimen
) -> tuple[PointCloud, NDArray[np.bool_], list[tuple[int, int]]]:
    """Return the cloud of a specimen, its pixels (H, W) on the grid, and the corners of its patches."""
    grid = geometry.grid
    on_grid = on_specimen(specimen, grid.origin, grid.rays(), grid.angular_pitch, MARGIN_PX)
    cloud = capture_cloud(capture, settings, geometry, Roi.around(on_grid), capture.decoding.imager)
    return cloud, on_grid, patch_corners(on_grid, PATCH_PX, LEAST_ON)


def points_on_specimen(cloud: PointCloud, specimen: Specimen) -> NDArray[np.bool_]:
    """Return which pixels (H, W) have a point on the specimen: within 1 % of its distance along their ray."""
    start = float(specimen.world_from_sensor.points(cloud.grid.origin)[2])
    feet, reach, _ = feet_of(specimen.world_from_sensor, cloud.grid.origin, cloud.grid.rays())
    if specimen.bend is not None:
        reach = reach * (1 - specimen.bend.heights(feet) / start)
    distance = np.linalg.norm(cloud.points.astype(float) - cloud.grid.origin, axis=-1)
    return np.asarray(np.abs(distance - reach) <= FALSE_SHARE_OF_DISTANCE * reach) & cloud.valid


def _disparity(cloud: PointCloud, geometry: StereoGeometry) -> Floats:
    local = (cloud.points.astype(float) - geometry.grid.origin) @ geometry.grid.rotation
    return np.asarray(geometry.rectification.disparity(local[..., 2]))


def reference_levels(capture: Capture) -> NDArray[np.unsignedinteger[Any]]:
    """Return the plain image (H, W) [DN] of the reference camera."""
    return plain_image(capture).of(next(iter(capture.images.values())))


def contrast_window(capture: Capture, specimen: Specimen) -> int:
    """Return the odd side [px] of a window for local means: 2.5 times the mean run about the mean of 31 px."""
    image = reference_levels(capture).astype(float)
    bright = image > uniform_filter(image, _WINDOWS[1])
    there = image_mask(specimen, capture.rig.reference, MARGIN_PX)[:, 1:]
    changes = np.count_nonzero((bright[:, 1:] != bright[:, :-1]) & there)
    run = float(np.count_nonzero(there) / changes) if changes else float(_WINDOWS[1])
    return int(np.clip(_RUNS * run, *_WINDOWS)) // 2 * 2 + 1


def patch_corners(mask: NDArray[np.bool_], side: int, least: float) -> list[tuple[int, int]]:
    """Return the upper left pixels (row, column) of adjacent square patches, at least a share ``least`` in a mask."""
    box = Roi.around(mask)
    if box is None:
        return []
    return [
        (row, column)
        for row in range(box.top, box.bottom - side + 1, side)
        for column in range(box.left, box.right - side + 1, side)
        if mask[row : row + side, column : column + side].mean() >= least
    ]


def _tiles(values: Floats, corners: list[tuple[int, int]]) -> Floats:
    """Return the pixels (P, 1600) of the patches."""
    tiles = [values[row : row + PATCH_PX, column : column + PATCH_PX].ravel() for row, column in corners]
    return np.array(tiles).reshape(-1, PATCH_PX**2)


def _histograms(levels: Floats, count: int) -> csr_array:
    known = np.isfinite(levels)
    patch, level = np.nonzero(known)[0], levels[known].astype(int)
    return csr_array((np.ones(len(level)), (patch, level)), shape=(len(levels), count))


def _products(residual: Floats) -> tuple[Floats, Floats]:
    """Return sums of the products of residuals (Q, n) at every lag, and numbers of pairs; 0 without points."""
    side = 2 * LARGEST_LAG + 1
    products, pairs = np.zeros((2, len(residual), side, side))
    for index, tile in enumerate(residual):
        if np.isfinite(tile).sum() < 2 or not np.nanvar(tile) > 0:
            continue
        rho = autocorrelation(tile.reshape(PATCH_PX, PATCH_PX))
        products[index] = np.nan_to_num(rho.values) * rho.pairs * np.nanvar(tile)
        pairs[index] = rho.pairs
    return products, pairs


def _in_disparity(noise: RayNoise, sigma: Floats, tiles: Floats, geometry: Geometry) -> Floats:
    """Return sigma of patches as disparity [px], NaN without stereo: Z^2 sigma_d = f B sigma_Z, Z = V cos(off axis)."""
    if not isinstance(geometry, StereoGeometry):
        return np.full(len(sigma), np.nan)
    filled = np.isfinite(tiles[..., 2]).any(axis=-1)
    ray = np.full((len(tiles), 3), np.nan)
    ray[filled] = np.nanmean(tiles[filled], axis=1)
    focal_baseline = geometry.rectification.matrix_left[0, 0] * geometry.rectification.baseline
    return np.asarray(sigma * focal_baseline / (noise.distance**2 * geometry.grid.cos_off_axis(ray)))


def _row_errors(
    capture: Capture, geometry: Geometry, cloud: PointCloud, corners: list[tuple[int, int]], usable: NDArray[np.bool_]
) -> Floats:
    """Return the shift [rows] of the right image that fits best (:mod:`mitsim.decoding.matching.row_error`)."""
    out = np.full(len(corners), np.nan)
    if capture.technology == "structured_light" or not isinstance(geometry, StereoGeometry):
        return out  # stripes along the rows do not identify a row
    left, right = (stack[0].astype(float) for stack in list(capture.images.values())[:2])
    disparity = _disparity(cloud, geometry)
    for index in np.flatnonzero(usable):
        row, column = corners[index]
        rows, columns = np.nonzero(cloud.valid[row : row + PATCH_PX, column : column + PATCH_PX])
        rows, columns = rows + row, columns + column
        out[index] = row_error(left, right, geometry, rows, columns, disparity[rows, columns])
    return out
