"""Find the centres of round dots in an image: calibration plates and other printed grids.

Signal chain: image -> upsampled by up to eight, Gaussian filter of 1 px -> adaptive threshold, for several diameters ->
closed, round outlines -> new outline half-way between the levels of the dot and of its background -> centre of gravity.
The diameter that yields the most dots of equal size is used.

The adaptive threshold depends on the neighbourhood of a dot. It would shift the dots at the rim of a plate by 0.04 px,
since they have neighbours on one side only. The plate would then be 0.04 % too large. The second threshold is constant
within a dot and has no such error.

The centre of gravity of an ellipse differs from the image of a circle's centre. At an angle of 30 deg and a distance of
thirty diameters, the difference is 0.004 of a diameter. It has the same direction for neighbouring dots.

Dots may have a bright middle, since only their outer outline is used.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from characterisation.point_cloud import ViewGrid
from mitsim.sensor.camera import Camera

#: factor of upsampling, which makes the outline of a dot of six pixels smooth
_UPSAMPLING = 8

#: largest side of the upsampled image [px]; the factor is lower for larger images, but at least 2
_LARGEST_UPSAMPLED_PX = 8000

#: expected dot diameters [px], in steps of about sqrt(2), since each accepts 0.5 to 2 times its area
_DIAMETERS = (6.0, 9.0, 13.0, 18.0, 26.0, 36.0, 52.0)

#: least difference between a dot and the mean around it [DN of 8 bit]
_THRESHOLD_OFFSET_DN = 6

#: least circularity 4 pi area / perimeter^2 of an outline. It is 1 for a circle and 0.84 for an ellipse of half the
#: width; for outlines that follow pixels it is a tenth smaller
_MINIMUM_CIRCULARITY = 0.75

#: width of the ring of background around a dot, and of the gap between dot and ring, in dot diameters
_RING = 0.12

#: percentile of the levels in a dot that is taken as its ink; a bright middle does not affect it
_INK_PERCENTILE = 20

#: depth at which an image is resampled to a grid [mm]; its value has no effect, since camera and grid share an origin
_DEPTH_MM = 1000.0

#: limits of a dot's area over the median area
_AREA_RATIOS = (0.6, 1.6)


def dot_centres(image: NDArray[np.uint8], dark: bool = True) -> NDArray[np.float64]:
    """Return the centres (n, 2) [px], column and row, of round dots of equal size in an image; no row without dots.

    ``image`` (H, W) has grey levels [DN]; ``dark``: whether the dots are darker than their background.
    """
    dots_dark = image if dark else np.asarray(255 - image, np.uint8)
    scale = max(min(_UPSAMPLING, _LARGEST_UPSAMPLED_PX // max(image.shape)), 2)
    size = (image.shape[1] * scale, image.shape[0] * scale)
    fine = cv2.GaussianBlur(cv2.resize(dots_dark, size, interpolation=cv2.INTER_CUBIC), (0, 0), scale)
    best = np.empty((0, 2))
    for diameter in _DIAMETERS:
        if 2 * diameter > min(image.shape):
            break
        centres = _dots_of_diameter(fine, diameter, scale)
        if len(centres) > len(best):
            best = centres
    return best


def resample_to_grid(image: NDArray[np.uint8], camera: Camera, grid: ViewGrid) -> NDArray[np.uint8]:
    """Return a camera's image (H, W) resampled to the pixels of a grid with the same origin, by cubic interpolation."""
    positions = np.nan_to_num(camera.project(grid.origin + _DEPTH_MM * grid.rays()), nan=-1.0).astype(np.float32)
    return np.asarray(
        cv2.remap(image, positions[..., 0], positions[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    )


def _dots_of_diameter(fine: NDArray[Any], diameter: float, scale: int) -> NDArray[np.float64]:
    """Return the centres (n, 2) [px] of dots with about one diameter [px] in the upsampled image ``fine``."""
    window = int(2 * diameter) * scale + 1
    mask = cv2.adaptiveThreshold(
        fine, 1, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY_INV, window, _THRESHOLD_OFFSET_DN
    )
    outlines, hierarchy = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    expected_area = np.pi / 4 * diameter**2
    centres, areas = [], []
    for outline, (_, _, _, parent) in zip(outlines, hierarchy[0] if hierarchy is not None else (), strict=True):
        area = cv2.contourArea(outline) / scale**2
        if parent >= 0 or not 0.5 * expected_area < area < 2 * expected_area:
            continue
        perimeter = cv2.arcLength(outline, True) / scale
        if 4 * np.pi * area / perimeter**2 < _MINIMUM_CIRCULARITY:
            continue
        centre = _centre(fine, outline)
        if centre is not None:
            centres.append((centre + 0.5) / scale - 0.5)
            areas.append(area)
    if not centres:
        return np.empty((0, 2))
    relative_area = np.array(areas) / np.median(areas)
    similar = (relative_area > _AREA_RATIOS[0]) & (relative_area < _AREA_RATIOS[1])
    return np.array(centres)[similar]


def _centre(fine: NDArray[Any], outline: NDArray[Any]) -> NDArray[np.float64] | None:
    """Return the centre of gravity (2,) [upsampled px] of a dot below half level; None without a closed outline."""
    column, row, width, height = cv2.boundingRect(outline)
    step = max(round(_RING * (width + height) / 2), 1)
    left, top = max(column - 2 * step, 0), max(row - 2 * step, 0)
    patch = fine[top : row + height + 2 * step, left : column + width + 2 * step]
    inside = cv2.drawContours(np.zeros(patch.shape, np.uint8), [outline - [left, top]], -1, 1, cv2.FILLED)
    distance = cv2.distanceTransform(np.uint8(1) - inside, cv2.DIST_L2, cv2.DIST_MASK_5)
    background = patch[(distance > step) & (distance <= 2 * step)]
    if not background.size:
        return None
    level = (float(np.percentile(patch[inside > 0], _INK_PERCENTILE)) + float(np.median(background))) / 2
    mask = np.asarray((patch < level) & (distance <= step), np.uint8)
    outlines, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if not outlines:
        return None
    moments = cv2.moments(max(outlines, key=cv2.contourArea))
    if moments["m00"] <= 0:
        return None
    return np.array([left + moments["m10"] / moments["m00"], top + moments["m01"] / moments["m00"]])
