"""Decode passive and active stereo: a raw pair and its calibration to an organised point cloud.

Signal chain: raw pair [DN], of one frame or several -> undistorted and rectified (bilinear) -> matched from the left
and from the right -> left-right check -> disparity d [px], in steps if the device has them -> depth Z = f B / (d +
cx_right - cx_left) [mm] -> points in the sensor frame.

There are two matchers:

- SGBM of one frame, in 8 bits, with equalised local contrast if set (:mod:`mitsim.decoding.matching.sgbm`)
- correlation of all frames (:mod:`mitsim.decoding.matching.correlation`)

SGBM needs 8 bits, so images are scaled by 255 / full scale after rectification and rounded. Nothing is filled, filtered
or smoothed, so the recovered fraction is that of the matcher.

There is one rejection in addition to the left-right check and uniqueness. SGBM's smoothness term extends disparities
into areas without texture. A pixel whose block has a contrast below ``minimum_contrast_dn`` is therefore rejected as
``LOW_MODULATION``.

A region of interest is matched with a margin of :data:`ROI_MARGIN_PX`. By correlation it has the same points as in the
whole image, up to its edge. With SGBM, the cut may change points some pixels inside the edge where the pattern is
faint.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from characterisation.files.errors import InputError
from characterisation.point_cloud import PointCloud, Status, ViewGrid
from characterisation.region_of_interest import Roi, checked_roi
from mitsim.decoding.grid_cloud import cloud_on_grid
from mitsim.decoding.image_context import ImageContext
from mitsim.decoding.interpolated import needed_region, was_read_out
from mitsim.decoding.matching.census import match_census_both_ways
from mitsim.decoding.matching.correlation import correlate_both_ways
from mitsim.decoding.matching.disparity_filters import median_of_neighbours, without_speckles
from mitsim.decoding.matching.evidence import (
    block_deviation,
    block_saturated,
    first_reason,
    nearest_value,
    right_property,
)
from mitsim.decoding.matching.sgbm import Matches, local_contrast, match_both_ways, search_range
from mitsim.decoding.matching.stereo_geometry import StereoGeometry
from mitsim.sensor.matcher import MatcherSettings

Raw = NDArray[np.uint8] | NDArray[np.uint16]
Strips = list[NDArray[Any]]
#: pixels that are matched beyond a region of interest on each side, to reduce the effect of the cut on SGBM's paths
ROI_MARGIN_PX = 16


def decode_stereo(
    left: Raw,
    right: Raw,
    geometry: StereoGeometry,
    settings: MatcherSettings,
    context: ImageContext,
    *,
    noisy_right: bool = True,
) -> PointCloud:
    """Decode one raw stereo pair, or the pairs of several frames together.

    Parameters
    ----------
    left, right
        (H, W) or (F, H, W) raw images [DN], uint8 or uint16, of the first and second camera of the rig. Several frames
        show the same scene with different patterns.
    geometry
        From :func:`~mitsim.decoding.matching.stereo_geometry.stereo_geometry`.
    settings
        Search range and limits of the matcher.
    context
        Of the images. Its ``roi`` is a region of the rectified left grid.
    noisy_right
        False if the right image is a reference without noise.

    Returns
    -------
    PointCloud
        On the rectified left grid, points in the sensor frame [mm]. Status of a pixel without a point, by the first
        condition that holds:

        - ``NO_SURFACE``: outside an image, or beyond the fold of a camera's distortion
        - ``SATURATED``: a quarter of the block, in either image
        - ``LOW_MODULATION``: too little contrast, in either image
        - ``OUT_OF_RANGE``: the depth is not between near and far
        - ``HIDDEN``: no match from the right image, or a contradicting one
        - ``AMBIGUOUS``: None of these, so there is no unique match

    Raises
    ------
    InputError
        If the images do not fit the calibration, there are several frames for SGBM, or the region of interest does not
        lie in the grid.

    See Also
    --------
    mitsim.decoding.matching.reference_matching.decode_reference : one camera and its projector
    """
    grid, rectification = geometry.grid, geometry.rectification
    full_scale, roi, read_out = context.full_scale, context.roi, context.read_out
    left, right = (image[None] if image.ndim == 2 else image for image in (left, right))
    _check_images("left", left, geometry.raw_size[0], full_scale)
    _check_images("right", right, geometry.raw_size[1], full_scale)
    if len(left) != len(right) or (settings.method == "sgbm" and len(left) > 1):
        allowed = "one pair" if settings.method == "sgbm" else "as many of each"
        raise InputError(
            "stereo",
            "images",
            f"{len(left)} left and {len(right)} right for {settings.method}",
            allowed,
            'several frames are matched by method = "correlation" or "census"',
        )
    if roi is None and read_out[0] is not None:
        roi = rectified_roi(geometry, read_out[0])
    roi = checked_roi(roi, grid.width, grid.height, "decode_stereo")
    # the region is matched with a margin, and with whole rows of both images
    begin, end = max(roi.left - ROI_MARGIN_PX, 0), min(roi.right + ROI_MARGIN_PX, grid.width)
    rows = slice(max(roi.top - ROI_MARGIN_PX, 0), min(roi.bottom + ROI_MARGIN_PX, grid.height))

    left_strips, left_full = _rectified(left, geometry.map_left[:, rows], full_scale, settings.method)
    right_strips, right_full = _rectified(right, geometry.map_right[:, rows], full_scale, settings.method)
    first, count = search_range(rectification, settings)
    matches: Matches
    if settings.method == "census":
        matches = match_census_both_ways(
            np.stack(left_strips), np.stack(right_strips), (begin, end), first, count, settings
        )
    elif settings.method == "correlation":
        longest = np.float32(1 / context.share)  # in levels of the longest exposure
        matches = correlate_both_ways(
            longest * _centred(left_strips, left, read_out[0], full_scale),
            longest * _centred(right_strips, right, read_out[1], full_scale),
            (begin, end),
            first,
            count,
            settings,
            noisy_right=noisy_right,
        )
    else:
        equalised_left, equalised_right = (
            local_contrast(strips[0], settings.contrast_window_px) for strips in (left_strips, right_strips)
        )
        matches = match_both_ways(equalised_left, equalised_right, (begin, end), first, count, settings)
    disparity = matches.disparity
    if settings.disparity_step > 0:
        disparity = settings.disparity_step * np.rint(disparity / settings.disparity_step)
    depth = rectification.depth(disparity)

    columns = np.arange(begin, end)
    block = settings.support_px
    seen_left, seen_right = geometry.seen_left[rows, begin:end], geometry.seen_right[rows]
    if read_out[0] is not None:
        seen_left = seen_left & _read_out_pixels(
            geometry.map_left[:, rows, begin:end], read_out[0], geometry.raw_size[0]
        )
    if read_out[1] is not None:
        seen_right = seen_right & _read_out_pixels(geometry.map_right[:, rows], read_out[1], geometry.raw_size[1])
    blank_left = _lacks_contrast(left_strips, settings)[:, begin:end]
    matched = np.isfinite(disparity)
    in_range = (depth >= settings.near_mm) & (depth <= settings.far_mm)
    confirmed = matches.disagreement <= settings.left_right_px
    disparity_or_zero = np.where(matched, disparity, 0)
    right_exists = right_property(seen_right, columns, disparity_or_zero)
    valid = matched & in_range & confirmed & seen_left & right_exists & ~blank_left
    if settings.speckle_px or settings.median_px:
        kept = np.where(valid, disparity, np.float32(np.nan))
        kept = without_speckles(kept, settings.speckle_px, settings.speckle_range_px)
        depth = rectification.depth(median_of_neighbours(kept, settings.median_px))
        valid = np.isfinite(kept)

    # disparity at which the right camera would see the pixel, if the pixel belonged to the nearest decoded surface
    expected = nearest_value(disparity, valid, first + count / 2)
    blank_right = _lacks_contrast(right_strips, settings)
    saturated_left, saturated_right = (
        np.any([block_saturated(frame, block) for frame in full], axis=0) for full in (left_full, right_full)
    )
    saturated = saturated_left[:, begin:end] | right_property(saturated_right, columns, expected)
    evidence = [
        (Status.NO_SURFACE, ~seen_left | ~right_property(seen_right, columns, expected)),
        (Status.SATURATED, saturated),
        (Status.LOW_MODULATION, blank_left | right_property(blank_right, columns, expected)),
        (Status.OUT_OF_RANGE, matched & ~in_range),
        (Status.HIDDEN, ~matches.matched_back | (matches.disagreement > settings.left_right_px)),
    ]
    status = first_reason(valid, evidence, Status.AMBIGUOUS)

    inside_margin = Roi(roi.left - begin, roi.top - rows.start, roi.width, roi.height).slices
    points = _points(np.where(valid, depth, np.nan)[inside_margin], roi, grid)
    return cloud_on_grid(points, status[inside_margin], None, roi, geometry, context.sensor, context.source)


def rectified_roi(geometry: StereoGeometry, read_out: Roi) -> Roi | None:
    """Return the region of the rectified left grid that shows a region of the raw left image; None if it is empty."""
    return Roi.around(geometry.seen_left & _read_out_pixels(geometry.map_left, read_out, geometry.raw_size[0]))


def _read_out_pixels(positions: NDArray[np.float32], read_out: Roi, raw_size: tuple[int, int]) -> NDArray[np.bool_]:
    return was_read_out(positions, read_out, raw_size[1], raw_size[0])


def _points(depth: NDArray[np.float64], roi: Roi, grid: ViewGrid) -> NDArray[np.float64]:
    """Return points (h, w, 3) in the sensor frame from the depths (h, w) [mm] of a region along the grid's axis."""
    x = (np.arange(roi.left, roi.right) - grid.cx) / grid.fx
    y = (np.arange(roi.top, roi.bottom) - grid.cy) / grid.fy
    local = np.stack([x[None, :] * depth, y[:, None] * depth, depth], axis=-1)
    return local @ grid.rotation.T + grid.origin


def _centred(strips: Strips, raw: Raw, read_out: Roi | None, full_scale: float) -> NDArray[np.float32]:
    """Return strips (F, h, W) without the mean of each raw frame, or of its region that was read out."""
    pixels = raw if read_out is None else raw[:, *read_out.slices]
    mean = pixels.mean(axis=(1, 2)) * (255.0 / full_scale)
    return np.asarray(np.stack(strips) - mean.astype(np.float32)[:, None, None])


def _lacks_contrast(strips: Strips, settings: MatcherSettings) -> NDArray[np.bool_]:
    """Return where a block has too little contrast in every frame (h, W)."""
    deviation = np.max([block_deviation(strip, settings.support_px) for strip in strips], axis=0)
    return np.asarray(deviation < settings.minimum_contrast_dn)


def _rectified(
    raw: Raw, positions: NDArray[np.float32], full_scale: float, method: str
) -> tuple[Strips, list[NDArray[np.uint8]]]:
    """Return the rectified strip (h, w) of each frame [DN of 8 bit], and of its saturation.

    The saturation is 255 at a saturated raw pixel, else 0. Levels are rounded to 8 bits, but for correlation.
    """
    strips: Strips = []
    saturation = []
    region = needed_region(positions, raw.shape[2], raw.shape[1])
    # exact, since these are integers
    positions = positions - np.array([region.left, region.top], np.float32)[:, None, None]
    for frame in raw[:, *region.slices]:
        saturated = frame >= full_scale
        unsaturated = np.zeros(positions.shape[1:], np.uint8)
        saturation.append(
            _resampled(saturated.astype(np.uint8) * np.uint8(255), positions) if saturated.any() else unsaturated
        )
        if method == "correlation":
            strips.append(_resampled(frame.astype(np.float32) * np.float32(255.0 / full_scale), positions))
            continue
        image = _resampled(frame, positions)
        if frame.dtype != np.uint8 or full_scale != 255:
            image = np.clip(np.rint(image * (255.0 / full_scale)), 0, 255)
        strips.append(image.astype(np.uint8))
    return strips, saturation


def _resampled(image: NDArray[Any], positions: NDArray[np.float32]) -> NDArray[Any]:
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
