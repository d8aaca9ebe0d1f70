"""Structured light with two cameras: the code only says which pixels see the same place; the cameras measure it.

Signal chain: images of both cameras [DN] -> projector coordinate u seen by each raw pixel; of a Gray code without
fringes smooth between the edges of its stripes (:mod:`mitsim.decode.structured_light.stripe_edges`) -> coordinates (not
images) rectified -> along each row, the place in the right image that has the left pixel's u, between two neighbours
that enclose it -> disparity d [px] -> depth Z = f B / (d + cx_right - cx_left) [mm] -> points on the rectified left
grid.

The projector needs no calibration and may have any distortion: it only has to show the same code to both. A rectified
pixel interpolates four raw ones, and has a coordinate only if all four have.

The noise of a disparity is that of the two coordinates that are set equal, over the slope of the right one:

    sigma_d^2 = (g_l sigma_l^2 + g_r sigma_r^2) / (du_r/dx)^2        sigma_Z = Z^2 / (f B) sigma_d

(first-order propagation, JCGM 100:2008, 5.1.2, with f B = Z (d + cx_right - cx_left)). Raw pixels are independent and
an interpolated coordinate is a weighted mean of some, so g is the sum of the squares of their weights: four pixels on
the left; on the right those of two neighbouring rectified pixels, some of which are the same.

A region of interest is decoded up to its very edge, with whole rows on the right: a coordinate that a row shows twice
is ambiguous wherever the row shows it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from characterisation.errors import InputError
from characterisation.point_cloud import PointCloud, Status
from mitsim.decode.grid_cloud import placed_cloud
from mitsim.decode.image_context import ImageContext
from mitsim.decode.interpolated import has_been_read, reach
from mitsim.decode.matching.stereo import StereoGeometry, rectified_roi, stereo_geometry
from mitsim.decode.structured_light.decoder import decode_coordinates
from mitsim.decode.structured_light.projector_coordinate import ProjectorCoordinate
from mitsim.sensor.camera import Rig
from mitsim.sensor.decoder_settings import DecoderSettings
from mitsim.sensor.light_code import LightCode, axes, has_fringes
from mitsim.sensor.roi import Roi, checked_roi

#: neighbours whose coordinates differ by more than this [projector px] lie on the two sides of an edge
LARGEST_STEP_PX = 8.0


def decode_structured_light_stereo(
    left: NDArray[np.generic],
    right: NDArray[np.generic],
    rig: Rig | StereoGeometry,
    code: LightCode,
    settings: DecoderSettings,
    projector_size: tuple[int, int],
    context: ImageContext,
) -> PointCloud:
    """Decode the images that two cameras took of one code.

    Parameters
    ----------
    left, right
        (P, H, W) raw images [DN] of the first and second camera of the rig, in the order of
        :func:`mitsim.sensor.light_code.roles`.
    rig
        The calibration of the cameras, or the geometry made of it by
        :func:`mitsim.decode.matching.stereo.stereo_geometry`.
    projector_size
        Width and height of the pattern [px].
    context
        Of the images; its ``roi`` is one of the rectified left grid.

    Returns
    -------
    PointCloud
        On the rectified left grid, points in the sensor frame [mm]; ``sigma`` [mm] along the view ray where the imager
        tells it, but for Gray code without fringes, whose error is not another from pixel to pixel. A pixel whose
        coordinate the right image does not show in its row is ``HIDDEN``, one whose coordinate it shows more than once
        ``AMBIGUOUS``.

    Raises
    ------
    InputError
        If the code does not run along the columns, the images are not what code and calibration say, or the region
        of interest does not lie in the grid.
    """
    if "columns" not in axes(code):
        raise InputError(
            "pattern", "axis", ", ".join(axes(code)), "'columns' or 'both', for cameras that stand side by side"
        )
    geometry = rig if isinstance(rig, StereoGeometry) else stereo_geometry(rig)
    roi, read_out = context.roi, context.read_out
    for name, stack, size in zip(("left", "right"), (left, right), geometry.raw_size, strict=True):
        if stack.shape[1:] != size:
            raise InputError(f"{name} images", "shape", stack.shape, f"(images, {size[0]}, {size[1]})")
    grid, rectification = geometry.grid, geometry.rectification
    if roi is None and read_out[0] is not None:
        roi = rectified_roi(geometry, read_out[0])
    roi = checked_roi(roi, grid.width, grid.height, "decode_structured_light_stereo")
    part = rows, columns = roi.slices

    def eye(stack: NDArray[np.generic], positions: NDArray[np.float32], region: Roi | None) -> _Eye:
        size = stack.shape[2], stack.shape[1]
        region = region or Roi.whole(*size)
        needed = reach(positions, *size).overlap(region)
        if needed is None:
            return _Eye.blind(positions)
        images = np.ascontiguousarray(stack[:, *needed.slices])
        found = decode_coordinates(
            images, code, projector_size, settings, full_scale=context.full_scale, imager=context.imager, between=True
        )
        seen = has_been_read(positions, region, *size)
        first = np.array([needed.left, needed.top], np.float32)[:, None, None]
        return _Eye.of(found["columns"], positions - first, seen)

    # whole rows on the right: a coordinate may lie anywhere in them
    at_left = eye(left, geometry.map_left[:, *part], read_out[0])
    at_right = eye(right, geometry.map_right[:, rows], read_out[1])
    u_left = np.where(geometry.seen_left[part], at_left.coordinate, np.nan)
    u_right = np.where(geometry.seen_right[rows], at_right.coordinate, np.nan)

    place, several = np.full(u_left.shape, np.nan), np.zeros(u_left.shape, bool)
    for row in range(len(place)):
        place[row], several[row] = same_coordinate(u_left[row], u_right[row])
    depth = rectification.depth(np.arange(columns.start, columns.stop) - place)
    in_range = (depth >= settings.near_mm) & (depth <= settings.far_mm)

    status = np.where(at_left.status == Status.VALID, np.uint8(Status.HIDDEN), at_left.status)
    found = np.isfinite(place)
    status = np.where(found, np.where(in_range, np.uint8(Status.VALID), np.uint8(Status.OUT_OF_RANGE)), status)
    status[several] = Status.AMBIGUOUS
    status[~(geometry.seen_left[part] & at_left.seen)] = Status.NO_SURFACE
    along, down = roi.pixels()
    local = grid.rays_at(along, down) @ grid.rotation
    points = (local / local[..., 2:] * depth[..., None]) @ grid.rotation.T + grid.origin
    sigma = None
    if context.imager is not None and has_fringes(code, "columns"):
        reach_mm = depth**2 / (rectification.matrix_left[0, 0] * rectification.baseline) / local[..., 2]
        sigma = _disparity_noise(place, at_left, at_right, u_right) * reach_mm
        sigma[status != Status.VALID] = np.nan
    points[status != Status.VALID] = np.nan
    return placed_cloud(points, status, sigma, roi, geometry, context.sensor, context.source)


@dataclass(frozen=True)
class _Eye:
    """What one camera decoded, at rectified pixels (h, w).

    ``coordinate`` [projector px], NaN if one of the four raw pixels has none; ``sigma`` [projector px] of a raw pixel
    there; ``status`` of the nearest raw pixel; ``seen``: it was read out; ``positions`` (2, h, w), raw column and row.
    """

    coordinate: NDArray[np.float64]
    sigma: NDArray[np.float64]
    status: NDArray[np.uint8]
    seen: NDArray[np.bool_]
    positions: NDArray[np.float32]

    @classmethod
    def of(cls, raw: ProjectorCoordinate, positions: NDArray[np.float32], seen: NDArray[np.bool_]) -> _Eye:
        """Of raw pixels, ``positions`` counted from the first of them."""
        # not cv2.remap, which rounds positions to 1/32 px
        coordinate, sigma = (
            map_coordinates(values, positions[::-1], output=np.float64, order=1, mode="constant", cval=np.nan)
            for values in (raw.value, raw.sigma)
        )
        column, row = (
            np.clip(np.rint(each), 0, size - 1).astype(np.intp)
            for each, size in zip(positions, raw.status.shape[::-1], strict=True)
        )
        return cls(coordinate, sigma, raw.status[row, column], seen, positions)

    @classmethod
    def blind(cls, positions: NDArray[np.float32]) -> _Eye:
        """Of a camera of which nothing was read out there."""
        shape = positions.shape[1:]
        nothing, status = np.full(shape, np.nan), np.full(shape, Status.NO_SURFACE, np.uint8)
        return cls(nothing, nothing, status, np.zeros(shape, bool), positions)


def _disparity_noise(
    place: NDArray[np.float64], left: _Eye, right: _Eye, u_right: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Standard deviation (h, w) [px] of a disparity whose right ``place`` is a column of the grid; NaN without one."""
    found = np.isfinite(place)
    at = np.where(found, place, 0.0)
    column = np.minimum(at.astype(np.intp), u_right.shape[1] - 2)
    t = at - column

    def here(values: NDArray[np.floating], step: int) -> NDArray[np.floating]:
        return np.take_along_axis(values, column + step, axis=1)

    one, other = (np.stack([here(each, step) for each in right.positions]) for step in (0, 1))
    share_left = _shared_weight(left.positions, left.positions)
    share_right = (1 - t) ** 2 * _shared_weight(one, one) + t**2 * _shared_weight(other, other)
    share_right += 2 * t * (1 - t) * _shared_weight(one, other)
    variance = share_left * left.sigma**2 + share_right * here(right.sigma, 0) ** 2
    slope = here(u_right, 1) - here(u_right, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(found, np.sqrt(variance) / slope, np.nan)


def _shared_weight(one: NDArray[np.floating], other: NDArray[np.floating]) -> NDArray[np.floating]:
    """Sum over raw pixels of the product of their weights in two bilinear interpolations, at positions (2, ...)."""
    first, second = np.floor(one), np.floor(other)
    a, b, apart = one - first, other - second, second - first
    each = np.select([apart == 0, apart == 1, apart == -1], [(1 - a) * (1 - b) + a * b, a * (1 - b), (1 - a) * b], 0.0)
    return np.asarray(each[0] * each[1])


def same_coordinate(
    wanted: NDArray[np.float64], row: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Where a row (W,) has the ``wanted`` coordinates (w,): columns, NaN if nowhere; and whether in several places.

    Linear between neighbouring pixels that rise, as they do wherever camera and projector see a surface from the same
    side.
    """
    columns = np.flatnonzero(np.isfinite(row[:-1]) & np.isfinite(row[1:]))
    step = row[columns + 1] - row[columns]
    columns = columns[(step > 0) & (step <= LARGEST_STEP_PX)]
    place, several = np.full(wanted.shape, np.nan), np.zeros(wanted.shape, bool)
    asked = np.flatnonzero(np.isfinite(wanted))
    if columns.size == 0 or asked.size == 0:
        return place, several
    low, high = row[columns], row[columns + 1]
    # how many pieces begin at or below a coordinate, less how many end there, is how many enclose it
    u = wanted[asked]
    begun = np.searchsorted(np.sort(low), u, side="right")
    ended = np.searchsorted(np.sort(high), u, side="right")
    several[asked] = begun - ended > 1
    once = begun - ended == 1
    # nearly always it is the piece that began last; where that one has ended and an older encloses u, none is taken
    order = np.argsort(low)
    piece = order[begun[once] - 1]
    enclosed = u[once] < high[piece]
    fraction = (u[once] - low[piece]) / (high[piece] - low[piece])
    place[asked[once]] = np.where(enclosed, columns[piece] + fraction, np.nan)
    return place, several
