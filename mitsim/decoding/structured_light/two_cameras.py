"""Decode structured light with two cameras: the code identifies points, and the two cameras triangulate them.

Signal chain: images of both cameras [DN] -> projector coordinate u seen by each raw pixel -> coordinates (not images)
rectified -> along each row, the column in the right image with the left pixel's u, interpolated between two neighbours
-> disparity d [px] -> depth Z = f B / (d + cx_right - cx_left) [mm] -> points on the rectified left grid.

For a Gray code without fringes, u is interpolated between the edges of its stripes
(:mod:`mitsim.decoding.structured_light.stripe_edges`).

The projector needs no calibration and may have any distortion, since it only shows the same code to both cameras. A
rectified pixel interpolates four raw ones, and has a coordinate only if all four have one.

The noise of a disparity is that of the two coordinates, divided by the slope of the right one:

    sigma_d^2 = (g_l sigma_l^2 + g_r sigma_r^2) / (du_r/dx)^2        sigma_Z = Z^2 / (f B) sigma_d

This is first-order propagation (JCGM 100:2008, 5.1.2) with f B = Z (d + cx_right - cx_left). An interpolated coordinate
is a weighted mean of independent raw pixels, so g is the sum of the squares of their weights. On the left these are
four pixels. On the right they are the pixels of two neighbouring rectified pixels, some of which are the same.

A region of interest has the same points as in the whole image, up to its edge. On the right, whole rows are decoded,
since a coordinate that occurs twice in a row is ambiguous.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from characterisation.files.errors import InputError
from characterisation.point_cloud import PointCloud, Status
from characterisation.region_of_interest import Roi, checked_roi
from mitsim.decoding.grid_cloud import cloud_on_grid
from mitsim.decoding.image_context import ImageContext
from mitsim.decoding.interpolated import needed_region, was_read_out
from mitsim.decoding.matching.stereo import rectified_roi
from mitsim.decoding.matching.stereo_geometry import StereoGeometry
from mitsim.decoding.structured_light.decoder import decode_coordinates
from mitsim.decoding.structured_light.projector_coordinate import ProjectorCoordinate
from mitsim.sensor.decoder_settings import DecoderSettings
from mitsim.sensor.image_role import Axis
from mitsim.sensor.light_code import LightCode, axes, has_fringes

#: largest difference of the coordinates of neighbouring pixels on one surface [projector px], chosen; larger in rows
#: of a camera that has few pixels for those of the projector
LARGEST_STEP_PX = 8.0

#: largest difference in steps of the row's median, where this is more; chosen
LARGEST_STEP = 4.0


def decode_structured_light_stereo(
    stacks: tuple[NDArray[np.generic], NDArray[np.generic]],
    geometry: StereoGeometry,
    code: LightCode,
    settings: DecoderSettings,
    projector_size: tuple[int, int],
    context: ImageContext,
    decoded_before: Sequence[Mapping[Axis, ProjectorCoordinate]] | None = None,
) -> PointCloud:
    """Decode the images of one code by two cameras to a cloud on the rectified left grid, sensor frame [mm].

    ``sigma`` [mm] is along the view ray, if the imager determines it, and None for Gray code without fringes, whose
    error is not independent between pixels. Status, in addition to that of the code:

    - ``HIDDEN``: the right image does not have the pixel's coordinate in its row.
    - ``AMBIGUOUS``: the right image has it more than once.
    - ``OUT_OF_RANGE``: the depth is not between near and far.
    - ``NO_SURFACE``: the camera has no such pixel.

    ``stacks``: (P, H, W) raw images [DN] of first and second camera, in the order of
    :func:`mitsim.sensor.light_code.roles`. ``projector_size``: width and height of the pattern [px]. ``context``: its
    ``roi`` is a region of the grid. ``decoded_before``: (H, W) of whole images, with ``interpolate`` of
    :func:`~mitsim.decoding.structured_light.decoder.decode_coordinates`. Raises InputError if the code has no columns,
    the images do not fit code and calibration, or the ``roi`` does not lie in the grid.
    """
    for name, stack, size in zip(("left", "right"), stacks, geometry.raw_size, strict=True):
        if stack.shape[1:] != size:
            raise InputError(f"{name} images", "shape", stack.shape, f"(images, {size[0]}, {size[1]})")

    def decoded(camera: int, region: Roi) -> ProjectorCoordinate:
        if decoded_before is not None:
            return decoded_before[camera]["columns"].part(region.slices)
        stack = stacks[camera]
        shown = context.read_out[camera] or Roi.whole(stack.shape[2], stack.shape[1])
        # the stripes at the edge of a region are cut: without a region of interest, no stripe of the image is
        used = shown if context.roi is None else region
        columns = decode_coordinates(
            np.ascontiguousarray(stack[:, *used.slices]),
            code,
            projector_size,
            settings,
            full_scale=context.full_scale,
            imager=context.imager,
            interpolate=True,
        )["columns"]
        top, left_edge = region.top - used.top, region.left - used.left
        return columns.part((slice(top, top + region.height), slice(left_edge, left_edge + region.width)))

    return _cloud_of_pair(decoded, geometry, code, settings, context)


def _cloud_of_pair(
    decoded: Callable[[int, Roi], ProjectorCoordinate],
    geometry: StereoGeometry,
    code: LightCode,
    settings: DecoderSettings,
    context: ImageContext,
) -> PointCloud:
    """Return the cloud of two cameras; ``decoded`` returns columns in a region of the raw image of camera 0 or 1."""
    if "columns" not in axes(code):
        raise InputError(
            "pattern", "axis", ", ".join(axes(code)), "'columns' or 'both', for cameras that are side by side"
        )
    roi, read_out = context.roi, context.read_out
    grid, rectification = geometry.grid, geometry.rectification
    if roi is None and read_out[0] is not None:
        roi = rectified_roi(geometry, read_out[0])
    roi = checked_roi(roi, grid.width, grid.height, "decode_structured_light_stereo")
    region = rows, columns = roi.slices

    def coordinates_of(camera: int, positions: NDArray[np.float32], read_region: Roi | None) -> _CameraCoordinates:
        size = geometry.raw_size[camera][::-1]
        read_region = read_region or Roi.whole(*size)
        used_region = needed_region(positions, *size).overlap(read_region)
        if used_region is None:
            return _CameraCoordinates.without_pixels(positions)
        seen = was_read_out(positions, read_region, *size)
        origin = np.array([used_region.left, used_region.top], np.float32)[:, None, None]
        return _CameraCoordinates.of(decoded(camera, used_region), positions - origin, seen)

    # whole rows on the right, since a coordinate may lie anywhere in them
    left_decoded = coordinates_of(0, geometry.map_left[:, *region], read_out[0])
    right_decoded = coordinates_of(1, geometry.map_right[:, rows], read_out[1])
    u_left = np.where(geometry.seen_left[region], left_decoded.coordinate, np.nan)
    u_right = np.where(geometry.seen_right[rows], right_decoded.coordinate, np.nan)

    right_column, ambiguous = np.full(u_left.shape, np.nan), np.zeros(u_left.shape, bool)
    for row in range(len(right_column)):
        right_column[row], ambiguous[row] = find_coordinates(u_left[row], u_right[row])
    depth = rectification.depth(np.arange(columns.start, columns.stop) - right_column)
    in_range = (depth >= settings.near_mm) & (depth <= settings.far_mm)

    status = np.where(left_decoded.status == Status.VALID, np.uint8(Status.HIDDEN), left_decoded.status)
    matched = np.isfinite(right_column)
    status = np.where(matched, np.where(in_range, np.uint8(Status.VALID), np.uint8(Status.OUT_OF_RANGE)), status)
    status[ambiguous] = Status.AMBIGUOUS
    status[~(geometry.seen_left[region] & left_decoded.seen)] = Status.NO_SURFACE
    column_grid, row_grid = roi.pixels()
    local_ray = grid.rays_at(column_grid, row_grid) @ grid.rotation
    points = (local_ray / local_ray[..., 2:] * depth[..., None]) @ grid.rotation.T + grid.origin
    sigma = None
    if context.imager is not None and has_fringes(code, "columns"):
        ray_per_disparity = depth**2 / (rectification.matrix_left[0, 0] * rectification.baseline) / local_ray[..., 2]
        sigma = _disparity_sigma(right_column, left_decoded, right_decoded, u_right) * ray_per_disparity
        sigma[status != Status.VALID] = np.nan
    points[status != Status.VALID] = np.nan
    return cloud_on_grid(points, status, sigma, roi, geometry, context.sensor, context.source)


@dataclass(frozen=True)
class _CameraCoordinates:
    """Decoded coordinates of one camera at rectified pixels (h, w)."""

    coordinate: NDArray[np.float64]  # [projector px], NaN unless all four raw pixels have one
    sigma: NDArray[np.float64]  # of a raw pixel there [projector px]
    status: NDArray[np.uint8]  # of the nearest raw pixel
    seen: NDArray[np.bool_]  # whether the pixels were read out
    positions: NDArray[np.float32]  # (2, h, w) raw column and row [px]

    @classmethod
    def of(
        cls, raw: ProjectorCoordinate, positions: NDArray[np.float32], seen: NDArray[np.bool_]
    ) -> _CameraCoordinates:
        """Interpolate raw pixels; ``positions`` start from the first of them."""
        # not cv2.remap, which rounds positions to 1/32 px
        coordinate, sigma = (
            map_coordinates(values, positions[::-1], output=np.float64, order=1, mode="constant", cval=np.nan)
            for values in (raw.value, raw.sigma)
        )
        column, row = (
            np.clip(np.rint(position), 0, size - 1).astype(np.intp)
            for position, size in zip(positions, raw.status.shape[::-1], strict=True)
        )
        return cls(coordinate, sigma, raw.status[row, column], seen, positions)

    @classmethod
    def without_pixels(cls, positions: NDArray[np.float32]) -> _CameraCoordinates:
        """Return the coordinates of a camera from which no pixel was read out there."""
        shape = positions.shape[1:]
        missing, status = np.full(shape, np.nan), np.full(shape, Status.NO_SURFACE, np.uint8)
        return cls(missing, missing, status, np.zeros(shape, bool), positions)


def _disparity_sigma(
    right_column: NDArray[np.float64], left: _CameraCoordinates, right: _CameraCoordinates, u_right: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the sigma (h, w) [px] of disparities; ``right_column`` (h, w) [px], ``u_right`` (h, W) [projector px]."""
    matched = np.isfinite(right_column)
    position = np.where(matched, right_column, 0.0)
    column = np.minimum(position.astype(np.intp), u_right.shape[1] - 2)
    t = position - column

    def value_at(values: NDArray[np.floating], step: int) -> NDArray[np.floating]:
        return np.take_along_axis(values, column + step, axis=1)

    position_left, position_right = (np.stack([value_at(axis, step) for axis in right.positions]) for step in (0, 1))
    share_left = _shared_weight(left.positions, left.positions)
    share_right = (1 - t) ** 2 * _shared_weight(position_left, position_left) + t**2 * _shared_weight(
        position_right, position_right
    )
    share_right += 2 * t * (1 - t) * _shared_weight(position_left, position_right)
    variance = share_left * left.sigma**2 + share_right * value_at(right.sigma, 0) ** 2
    slope = np.abs(value_at(u_right, 1) - value_at(u_right, 0))  # it falls if the projector is turned by 180 degrees
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(matched, np.sqrt(variance) / slope, np.nan)


def _shared_weight(first: NDArray[np.floating], second: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return the sum over raw pixels of the product of two bilinear interpolations' weights, at (2, ...) [px] each."""
    first_pixel, second_pixel = np.floor(first), np.floor(second)
    first_fraction, second_fraction, offset = first - first_pixel, second - second_pixel, second_pixel - first_pixel
    product = np.select(
        [offset == 0, offset == 1, offset == -1],
        [
            (1 - first_fraction) * (1 - second_fraction) + first_fraction * second_fraction,
            first_fraction * (1 - second_fraction),
            (1 - first_fraction) * second_fraction,
        ],
        0.0,
    )
    return np.asarray(product[0] * product[1])


def find_coordinates(
    coordinates: NDArray[np.float64], row: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the only column (w,) [px] of a row with each coordinate, else NaN; and whether it has several (w,).

    The row is linear between neighbouring pixels whose coordinates change as most of the row do. They increase wherever
    camera and projector see a surface from the same side, and fall if the projector is turned by 180 degrees.

    ``coordinates`` (w,) are NaN where unknown, ``row`` (W,) are those of the row's pixels [projector px].
    """
    columns = np.flatnonzero(np.isfinite(row[:-1]) & np.isfinite(row[1:]))
    step = row[columns + 1] - row[columns]
    largest = max(LARGEST_STEP_PX, LARGEST_STEP * float(np.median(np.abs(step)))) if step.size else LARGEST_STEP_PX
    near = np.abs(step) <= largest
    if np.sum(near & (step < 0)) > np.sum(near & (step > 0)):
        coordinates, row, step = -coordinates, -row, -step
    columns = columns[(step > 0) & (step <= largest)]
    found_columns, ambiguous = np.full(coordinates.shape, np.nan), np.zeros(coordinates.shape, bool)
    finite = np.flatnonzero(np.isfinite(coordinates))
    if columns.size == 0 or finite.size == 0:
        return found_columns, ambiguous
    low, high = row[columns], row[columns + 1]
    # the number of segments that enclose u is the number that start at or below u, less the number that end there
    u = coordinates[finite]
    started = np.searchsorted(np.sort(low), u, side="right")
    ended = np.searchsorted(np.sort(high), u, side="right")
    ambiguous[finite] = started - ended > 1
    single = started - ended == 1
    # nearly always u lies in the segment that started last; if that one has ended and an older one encloses u, u is
    # unmatched
    order = np.argsort(low)
    segment = order[started[single] - 1]
    enclosed = u[single] < high[segment]
    fraction = (u[single] - low[segment]) / (high[segment] - low[segment])
    found_columns[finite[single]] = np.where(enclosed, columns[segment] + fraction, np.nan)
    return found_columns, ambiguous
