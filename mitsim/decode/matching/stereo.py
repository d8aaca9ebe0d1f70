"""Passive and active stereo: a raw pair and its calibration to an organised point cloud.

Signal chain: raw pair [DN], of one frame or several -> undistorted and rectified (bilinear) -> SGBM of the one frame,
in 8 bit and with its local contrast evened where asked (:mod:`mitsim.decode.matching.sgbm`), or correlation of all
frames (:mod:`mitsim.decode.matching.correlation`), from the left and from the right -> left-right check -> disparity d
[px], in steps where asked -> depth Z = f B / (d + cx_right - cx_left) [mm] -> points in the sensor frame.

SGBM takes 8 bits: images are scaled by 255 / full scale after rectification and rounded. Nothing is filled,
filtered or smoothed: the recovered fraction is that of the matcher. There is one rejection beyond the left-right check
and uniqueness: SGBM's smoothness term readily paints a disparity over a blank area, so a pixel whose block has less
contrast than ``minimum_contrast_dn`` is no point, and its reason is ``LOW_MODULATION``.

A region of interest is matched with :data:`ROI_MARGIN_PX` around it. By correlation its points are those of the whole
image up to its very edge; SGBM's smoothness lets the cut change points some pixels into it where the pattern is faint.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from characterisation.errors import InputError
from characterisation.point_cloud import PointCloud, Status, ViewGrid
from mitsim.decode.grid_cloud import placed_cloud
from mitsim.decode.image_context import ImageContext
from mitsim.decode.interpolated import has_been_read, reach
from mitsim.decode.matching.correlation import correlate_both_ways
from mitsim.decode.matching.evidence import at_right, block_deviation, block_saturated, nearest_value, reasons
from mitsim.decode.matching.sgbm import local_contrast, match_both_ways, search_range
from mitsim.sensor.camera import Camera, Rectification, Rig, stereo_rectification
from mitsim.sensor.matcher import MatcherSettings
from mitsim.sensor.roi import Roi, checked_roi

Raw = NDArray[np.uint8] | NDArray[np.uint16]
Strips = list[NDArray[Any]]
#: pixels matched beyond a region of interest on each side, so that SGBM's paths forget the cut before they reach it
ROI_MARGIN_PX = 16


@dataclass(frozen=True)
class StereoGeometry:
    """All that decoding needs of a rig, computed once: rectifying maps, what they can see, and the grid of the cloud.

    ``map_left``, ``map_right`` (2, H, W) float32: raw column and row shown at each rectified pixel; ``seen_left``,
    ``seen_right`` (H, W): whether that raw pixel exists; ``raw_size`` (H, W) of the raw images.
    """

    rectification: Rectification
    map_left: NDArray[np.float32]
    map_right: NDArray[np.float32]
    seen_left: NDArray[np.bool_]
    seen_right: NDArray[np.bool_]
    raw_size: tuple[tuple[int, int], tuple[int, int]]
    grid: ViewGrid
    baseline: NDArray[np.float64]

    @property
    def seen(self) -> NDArray[np.bool_]:
        """Pixels of the grid that the reference camera has."""
        return self.seen_left


def stereo_geometry(rig: Rig) -> StereoGeometry:
    """Rectify the first two cameras of a rig: by its own rectification where it has one, else by Bouguet's method.

    Raises
    ------
    InputError
        If the rig has fewer than two cameras, or its second camera is not to the right of the first.
    """
    if len(rig.cameras) < 2:
        raise InputError("rig", "cameras", f"{len(rig.cameras)}", "two or more for stereo")
    left, right = list(rig.cameras.values())[:2]
    rectification = rig.rectification or stereo_rectification(left, right)
    to_right = rectification.rotation_left @ left.sensor_from_camera.inverse().points(right.centre)
    if to_right[0] < 0.9 * np.linalg.norm(to_right) or rectification.baseline <= 0:
        raise InputError(
            "rig",
            "cameras",
            f"the second camera at {np.round(to_right, 1).tolist()} mm from the first, rectified",
            "a second camera to the right (+x) of the first",
            "name the left camera first",
        )
    map_left, seen_left = _rectifying_map(left, rectification.matrix_left, rectification.rotation_left, rectification)
    map_right, seen_right = _rectifying_map(
        right, rectification.matrix_right, rectification.rotation_right, rectification
    )
    K = rectification.matrix_left
    grid = ViewGrid(
        fx=float(K[0, 0]),
        fy=float(K[1, 1]),
        cx=float(K[0, 2]),
        cy=float(K[1, 2]),
        width=rectification.width,
        height=rectification.height,
        rotation=left.sensor_from_camera.rotation @ rectification.rotation_left.T,
        origin=left.centre,
    )
    sizes = ((left.height, left.width), (right.height, right.width))
    return StereoGeometry(
        rectification, map_left, map_right, seen_left, seen_right, sizes, grid, rig.baseline_direction
    )


def decode_stereo(
    left: Raw,
    right: Raw,
    rig: Rig | StereoGeometry,
    settings: MatcherSettings,
    context: ImageContext,
    *,
    noisy_right: bool = True,
) -> PointCloud:
    """Decode one raw stereo pair, or the pairs of several frames together.

    Parameters
    ----------
    left, right
        (H, W) or (F, H, W) raw images [DN], uint8 or uint16, of the first and second camera of the rig. Several
        frames are of the same scene under different patterns.
    rig
        The calibration; or the :func:`stereo_geometry` made of it, which saves making the maps for every pair.
    settings
        Search range and limits of the matcher.
    context
        Of the images; its ``roi`` is one of the rectified left grid.
    noisy_right
        False where the right image is a reference without noise.

    Returns
    -------
    PointCloud
        On the rectified left grid, points in the sensor frame [mm].

    Raises
    ------
    InputError
        If the images are not what the calibration says, the method takes one frame and there are several, or the
        region of interest does not lie in the grid.
    """
    geometry = rig if isinstance(rig, StereoGeometry) else stereo_geometry(rig)
    grid, rectification = geometry.grid, geometry.rectification
    full_scale, roi, read_out = context.full_scale, context.roi, context.read_out
    left, right = (each[None] if each.ndim == 2 else each for each in (left, right))
    _check_images("left", left, geometry.raw_size[0], full_scale)
    _check_images("right", right, geometry.raw_size[1], full_scale)
    if len(left) != len(right) or (settings.method == "sgbm" and len(left) > 1):
        allowed = "one pair" if settings.method == "sgbm" else "as many of each"
        raise InputError(
            "stereo",
            "images",
            f"{len(left)} left and {len(right)} right for {settings.method}",
            allowed,
            'several frames are matched by method = "correlation"',
        )
    if roi is None and read_out[0] is not None:
        roi = rectified_roi(geometry, read_out[0])
    roi = checked_roi(roi, grid.width, grid.height, "decode_stereo")
    # matched are the region and a margin, whole rows of both images
    begin, end = max(roi.left - ROI_MARGIN_PX, 0), min(roi.right + ROI_MARGIN_PX, grid.width)
    rows = slice(max(roi.top - ROI_MARGIN_PX, 0), min(roi.bottom + ROI_MARGIN_PX, grid.height))

    left_strips, left_full = _rectified(left, geometry.map_left[:, rows], full_scale, settings.method)
    right_strips, right_full = _rectified(right, geometry.map_right[:, rows], full_scale, settings.method)
    first, count = search_range(rectification, settings)
    if settings.method == "correlation":
        matches = correlate_both_ways(
            _centred(left_strips, left, read_out[0], full_scale),
            _centred(right_strips, right, read_out[1], full_scale),
            (begin, end),
            first,
            count,
            settings,
            noisy_right=noisy_right,
        )
    else:
        even_left, even_right = (
            local_contrast(strips[0], settings.contrast_window_px) for strips in (left_strips, right_strips)
        )
        matches = match_both_ways(even_left, even_right, (begin, end), first, count, settings)
    disparity = matches.disparity
    if settings.disparity_step > 0:
        disparity = settings.disparity_step * np.rint(disparity / settings.disparity_step)
    depth = rectification.depth(disparity)

    columns = np.arange(begin, end)
    block = settings.block_size
    seen_left, seen_right = geometry.seen_left[rows, begin:end], geometry.seen_right[rows]
    if read_out[0] is not None:
        seen_left = seen_left & _read(geometry.map_left[:, rows, begin:end], read_out[0], geometry.raw_size[0])
    if read_out[1] is not None:
        seen_right = seen_right & _read(geometry.map_right[:, rows], read_out[1], geometry.raw_size[1])
    blank_left = _blank(left_strips, settings)[:, begin:end]
    matched = np.isfinite(disparity)
    in_range = (depth >= settings.near_mm) & (depth <= settings.far_mm)
    confirmed = matches.disagreement <= settings.left_right_px
    where = np.where(matched, disparity, 0)
    right_exists = at_right(seen_right, columns, where, outside=False)
    valid = matched & in_range & confirmed & seen_left & right_exists & ~blank_left

    # where the right camera would see the pixel, were it a part of the nearest surface that was found
    expected = nearest_value(disparity, valid, first + count / 2)
    blank_right = _blank(right_strips, settings)
    blown_left, blown_right = (
        np.any([block_saturated(frame, block) for frame in full], axis=0) for full in (left_full, right_full)
    )
    saturated = blown_left[:, begin:end] | at_right(blown_right, columns, expected, outside=False)
    evidence = [
        (Status.NO_SURFACE, ~seen_left | ~at_right(seen_right, columns, expected, outside=False)),
        (Status.SATURATED, saturated),
        (Status.LOW_MODULATION, blank_left | at_right(blank_right, columns, expected, outside=False)),
        (Status.OUT_OF_RANGE, matched & ~in_range),
        (Status.HIDDEN, ~matches.claimed | (matches.disagreement > settings.left_right_px)),
    ]
    status = reasons(valid, evidence, Status.AMBIGUOUS)

    inner = Roi(roi.left - begin, roi.top - rows.start, roi.width, roi.height).slices
    points = _points(np.where(valid, depth, np.nan)[inner], roi, grid)
    return placed_cloud(points, status[inner], None, roi, geometry, context.sensor, context.source)


def rectified_roi(geometry: StereoGeometry, read_out: Roi) -> Roi | None:
    """Return the region of the rectified left grid that a region of the raw left image fills; None if it fills none."""
    return Roi.around(geometry.seen_left & _read(geometry.map_left, read_out, geometry.raw_size[0]))


def _read(positions: NDArray[np.float32], read_out: Roi, raw_size: tuple[int, int]) -> NDArray[np.bool_]:
    return has_been_read(positions, read_out, raw_size[1], raw_size[0])


def _points(depth: NDArray[np.float64], roi: Roi, grid: ViewGrid) -> NDArray[np.float64]:
    """Points (h, w, 3) in the sensor frame of the depths (h, w) of a region, along the grid's axis."""
    x = (np.arange(roi.left, roi.right) - grid.cx) / grid.fx
    y = (np.arange(roi.top, roi.bottom) - grid.cy) / grid.fy
    local = np.stack([x[None, :] * depth, y[:, None] * depth, depth], axis=-1)
    return local @ grid.rotation.T + grid.origin


def _rectifying_map(
    camera: Camera, K: NDArray[np.float64], rotation: NDArray[np.float64], rectification: Rectification
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Raw pixel of each rectified pixel, and whether the camera has it."""
    size = (rectification.width, rectification.height)
    if camera.model == "fisheye":
        distortion = camera.distortion.reshape(-1, 1)
        raw = cv2.fisheye.initUndistortRectifyMap(camera.matrix, distortion, rotation, K, size, cv2.CV_32FC1)
    else:
        raw = cv2.initUndistortRectifyMap(camera.matrix, camera.distortion, rotation, K, size, cv2.CV_32FC1)
    column, row = np.asarray(raw[0]), np.asarray(raw[1])
    # A distortion polynomial folds back far outside the image it was fitted to: there the map turns inside out.
    (column_down, column_along), (row_down, row_along) = np.gradient(column), np.gradient(row)
    unfolded = column_along * row_down - column_down * row_along > 0
    exists = (column >= -0.5) & (column <= camera.width - 0.5) & (row >= -0.5) & (row <= camera.height - 0.5)
    return np.stack([column, row]), unfolded & exists


def _centred(strips: Strips, raw: Raw, read_out: Roi | None, full_scale: float) -> NDArray[np.float32]:
    """Strips (F, h, W) less the mean of each whole raw frame, or of what was read out of it."""
    seen = raw if read_out is None else raw[:, *read_out.slices]
    mean = seen.mean(axis=(1, 2)) * (255.0 / full_scale)
    return np.asarray(np.stack(strips) - mean.astype(np.float32)[:, None, None])


def _blank(strips: Strips, settings: MatcherSettings) -> NDArray[np.bool_]:
    """Blocks without contrast in any frame."""
    deviation = np.max([block_deviation(strip, settings.block_size) for strip in strips], axis=0)
    return np.asarray(deviation < settings.minimum_contrast_dn)


def _rectified(
    raw: Raw, positions: NDArray[np.float32], full_scale: float, method: str
) -> tuple[Strips, list[NDArray[np.uint8]]]:
    """Rectified strip of every frame [DN of 8 bit], and the strip of its saturation, 255 where a raw pixel is full.

    SGBM takes whole levels; correlation is spared the rounding.
    """
    strips: Strips = []
    blown = []
    needed = reach(positions, raw.shape[2], raw.shape[1])
    positions = positions - np.array([needed.left, needed.top], np.float32)[:, None, None]  # exact: whole numbers
    for frame in raw[:, *needed.slices]:
        full = frame >= full_scale
        shown = np.zeros(positions.shape[1:], np.uint8)
        blown.append(_remapped(full.astype(np.uint8) * np.uint8(255), positions) if full.any() else shown)
        if method == "correlation":
            strips.append(_remapped(frame.astype(np.float32) * np.float32(255.0 / full_scale), positions))
            continue
        image = _remapped(frame, positions)
        if frame.dtype != np.uint8 or full_scale != 255:
            image = np.clip(np.rint(image * (255.0 / full_scale)), 0, 255)
        strips.append(image.astype(np.uint8))
    return strips, blown


def _remapped(image: NDArray[Any], positions: NDArray[np.float32]) -> NDArray[Any]:
    mapped = cv2.remap(image, positions[0], positions[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(mapped)


def _check_images(name: str, images: Raw, size: tuple[int, int], full_scale: float) -> None:
    if images.ndim != 3 or images.shape[1:] != size:
        found = images.shape[1:] if len(images) == 1 else images.shape
        raise InputError(f"{name} image", "shape", found, f"{size} (rows, columns), as the calibration says")
    if images.dtype not in (np.uint8, np.uint16):
        raise InputError(f"{name} image", "dtype", images.dtype, "uint8 or uint16 raw values")
    if not 0 < full_scale <= np.iinfo(images.dtype).max:
        raise InputError(f"{name} image", "full_scale", full_scale, f"1 to {np.iinfo(images.dtype).max} DN")
