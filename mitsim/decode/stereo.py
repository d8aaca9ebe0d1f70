"""Passive and active stereo: a raw pair and its calibration to an organised point cloud.

Signal chain: raw pair [DN] -> undistorted and rectified (bilinear, 8 bit) -> local contrast, where asked
-> SGBM from the left and from the right
-> left-right check -> disparity d [px] -> depth Z = f B / (d + cx_right - cx_left) [mm] -> points in the sensor frame.

The matcher takes 8 bits: images are scaled by 255 / full scale after rectification and rounded. Nothing is filled,
filtered or smoothed: the recovered fraction is that of the matcher. There is one rejection beyond the left-right check
and uniqueness: SGBM's smoothness term readily paints a disparity over a blank area, so a pixel whose block has less
contrast than ``minimum_contrast_dn`` is no point, and its reason is ``LOW_MODULATION``.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from characterisation.errors import InputError
from characterisation.point_cloud import PointCloud, Status, ViewGrid
from mitsim.decode.evidence import at_right, block_deviation, block_saturated, nearest_value, reasons
from mitsim.decode.sgbm import local_contrast, match_both_ways, search_range
from mitsim.sensor.camera import Camera, Rectification, Rig, stereo_rectification
from mitsim.sensor.matcher import MatcherSettings

Raw = NDArray[np.uint8] | NDArray[np.uint16]

#: pixels matched beyond a window on each side, so that SGBM's paths forget the cut before they reach it
WINDOW_MARGIN_PX = 16


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
            "rig", "cameras", f"the second camera at {np.round(to_right, 1).tolist()} mm from the first, rectified",
            "a second camera to the right (+x) of the first", "name the left camera first",
        )  # fmt: skip
    map_left, seen_left = _rectifying_map(left, rectification.matrix_left, rectification.rotation_left, rectification)
    map_right, seen_right = _rectifying_map(
        right, rectification.matrix_right, rectification.rotation_right, rectification
    )
    K = rectification.matrix_left
    grid = ViewGrid(
        fx=float(K[0, 0]), fy=float(K[1, 1]), cx=float(K[0, 2]), cy=float(K[1, 2]),
        width=rectification.width, height=rectification.height,
        rotation=left.sensor_from_camera.rotation @ rectification.rotation_left.T, origin=left.centre,
    )  # fmt: skip
    sizes = ((left.height, left.width), (right.height, right.width))
    return StereoGeometry(
        rectification, map_left, map_right, seen_left, seen_right, sizes, grid, rig.baseline_direction
    )


def decode_stereo(
    left: Raw,
    right: Raw,
    rig: Rig | StereoGeometry,
    settings: MatcherSettings,
    *,
    sensor: str,
    source: str,
    full_scale: float,
    window: tuple[int, int, int, int] | None = None,
) -> PointCloud:
    """Decode one raw stereo pair.

    Parameters
    ----------
    left, right
        (H, W) raw images [DN], uint8 or uint16, of the first and second camera of the rig.
    rig
        The calibration; or the :func:`stereo_geometry` made of it, which saves making the maps for every pair.
    settings
        Search range and limits of the matcher.
    sensor, source
        Carried into the cloud.
    full_scale
        Value of a saturated pixel [DN], ``2**bits - 1``.
    window
        (column0, row0, column1, row1) in the rectified left grid, ends not included: match only this part. Pixels
        outside are ``NO_SURFACE``.

    Returns
    -------
    PointCloud
        On the rectified left grid, points in the sensor frame [mm].

    Raises
    ------
    InputError
        If the images are not what the calibration says, or the window does not lie in the grid.
    """
    geometry = rig if isinstance(rig, StereoGeometry) else stereo_geometry(rig)
    grid, rectification = geometry.grid, geometry.rectification
    _check_image("left", left, geometry.raw_size[0], full_scale)
    _check_image("right", right, geometry.raw_size[1], full_scale)
    column0, row0, column1, row1 = _checked_window(window, grid)
    # the part to be matched: the window and a margin, whole rows of both images
    begin, end = max(column0 - WINDOW_MARGIN_PX, 0), min(column1 + WINDOW_MARGIN_PX, grid.width)
    rows = slice(max(row0 - WINDOW_MARGIN_PX, 0), min(row1 + WINDOW_MARGIN_PX, grid.height))

    left_strip, left_full = _rectified(left, geometry.map_left[:, rows], full_scale)
    right_strip, right_full = _rectified(right, geometry.map_right[:, rows], full_scale)
    first, count = search_range(rectification, settings)
    matches = match_both_ways(
        local_contrast(left_strip, settings.contrast_window_px),
        local_contrast(right_strip, settings.contrast_window_px),
        (begin, end), first, count, settings,
    )  # fmt: skip
    disparity = matches.disparity
    depth = rectification.depth(disparity)

    columns = np.arange(begin, end)
    block = settings.block_size
    seen_left, seen_right = geometry.seen_left[rows, begin:end], geometry.seen_right[rows]
    blank_left = (block_deviation(left_strip, block) < settings.minimum_contrast_dn)[:, begin:end]
    matched = np.isfinite(disparity)
    in_range = (depth >= settings.near_mm) & (depth <= settings.far_mm)
    confirmed = matches.disagreement <= settings.left_right_px
    where = np.where(matched, disparity, 0)
    right_exists = at_right(seen_right, columns, where, outside=False)
    valid = matched & in_range & confirmed & seen_left & right_exists & ~blank_left

    # where the right camera would see the pixel, were it a part of the nearest surface that was found
    expected = nearest_value(disparity, valid, first + count / 2)
    blank_right = block_deviation(right_strip, block) < settings.minimum_contrast_dn
    saturated = block_saturated(left_full, block)[:, begin:end] | at_right(
        block_saturated(right_full, block), columns, expected, outside=False
    )
    evidence = [
        (Status.NO_SURFACE, ~seen_left | ~at_right(seen_right, columns, expected, outside=False)),
        (Status.SATURATED, saturated),
        (Status.LOW_MODULATION, blank_left | at_right(blank_right, columns, expected, outside=False)),
        (Status.OUT_OF_RANGE, matched & ~in_range),
        (Status.HIDDEN, ~matches.claimed | (matches.disagreement > settings.left_right_px)),
    ]
    status = reasons(valid, evidence, Status.AMBIGUOUS)

    inner = (slice(row0 - rows.start, row1 - rows.start), slice(column0 - begin, column1 - begin))
    outer = (slice(row0, row1), slice(column0, column1))
    cloud_status = np.full((grid.height, grid.width), Status.NO_SURFACE, np.uint8)
    cloud_status[outer] = status[inner]
    points = np.full((grid.height, grid.width, 3), np.nan, np.float32)
    points[outer] = _points(np.where(valid, depth, np.nan)[inner], column0, row0, grid)
    return PointCloud(points, cloud_status, grid, sensor, source, geometry.baseline)


def _points(depth: NDArray[np.float64], column0: int, row0: int, grid: ViewGrid) -> NDArray[np.float64]:
    """Points (h, w, 3) in the sensor frame of depths (h, w) along the grid's axis, first pixel at (column0, row0)."""
    x = (np.arange(column0, column0 + depth.shape[1]) - grid.cx) / grid.fx
    y = (np.arange(row0, row0 + depth.shape[0]) - grid.cy) / grid.fy
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
    inside = (column >= -0.5) & (column <= camera.width - 0.5) & (row >= -0.5) & (row <= camera.height - 0.5)
    return np.stack([column, row]), unfolded & inside


def _rectified(
    raw: Raw, positions: NDArray[np.float32], full_scale: float
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Rectified 8-bit strip, and the strip of its saturation (255 where a raw pixel is at full scale)."""
    blown = (raw >= full_scale).astype(np.uint8) * np.uint8(255)
    image, full = (
        np.asarray(cv2.remap(each, positions[0], positions[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))
        for each in (raw, blown)
    )
    if raw.dtype != np.uint8 or full_scale != 255:
        image = np.clip(np.rint(image * (255.0 / full_scale)), 0, 255)
    return image.astype(np.uint8), full.astype(np.uint8)


def _check_image(name: str, image: Raw, size: tuple[int, int], full_scale: float) -> None:
    if image.shape != size:
        raise InputError(f"{name} image", "shape", image.shape, f"{size} (rows, columns), as the calibration says")
    if image.dtype not in (np.uint8, np.uint16):
        raise InputError(f"{name} image", "dtype", image.dtype, "uint8 or uint16 raw values")
    if not 0 < full_scale <= np.iinfo(image.dtype).max:
        raise InputError(f"{name} image", "full_scale", full_scale, f"1 to {np.iinfo(image.dtype).max} DN")


def _checked_window(window: tuple[int, int, int, int] | None, grid: ViewGrid) -> tuple[int, int, int, int]:
    if window is None:
        return 0, 0, grid.width, grid.height
    column0, row0, column1, row1 = (int(edge) for edge in window)
    if not (0 <= column0 < column1 <= grid.width and 0 <= row0 < row1 <= grid.height):
        raise InputError(
            "decode_stereo",
            "window",
            window,
            f"(column0, row0, column1, row1) within 0, 0, {grid.width}, {grid.height}",
        )
    return column0, row0, column1, row1
