"""Centres of round dots in an image: calibration plates, and other printed grids.

Signal chain: image -> brought up eight times and smoothed by a pixel -> adaptive threshold, at several sizes of dot ->
closed outlines that are round -> outline anew, half-way between the levels of this dot and of the ground around it ->
centre of gravity.

The adaptive threshold follows its neighbourhood: dots at the rim of a plate, with neighbours on one side only, come out
shifted by 0.04 px, and the plate 0.04 % too large. A threshold that is one number for each dot does not.

The size that finds the most dots of one another's size is kept. The centre of gravity of an ellipse is not the image of
a circle's centre: seen at an angle of 30 deg, from thirty diameters away, it is off by 0.004 of a diameter, toward the
same side for neighbours. The dots of a plate may have a bright middle; only their outer outline counts.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from characterisation.point_cloud import ViewGrid
from mitsim.sensor.camera import Camera

#: finer pixels of one, so that an outline follows a dot of six pixels
_BLOW_UP = 8

#: widest image that is brought up so far [px]; a larger one is brought up less
_LARGEST_PX = 8000

#: diameters that are tried [px], in steps of about sqrt(2), as the area may be 0.5 to 2 times the expected
_DIAMETERS = (6.0, 9.0, 13.0, 18.0, 26.0, 36.0, 52.0)

#: levels [DN of 8 bit] by which a dot must be darker than the mean around it
_DARKER = 6

#: 4 pi area / circumference^2 of an outline, 1 for a circle, and 0.79 for an ellipse of half its width
_ROUND = 0.75

#: width of the ring of ground around a dot, and of the gap before it, over its diameter
_RING = 0.12

#: percentile of the levels in a dot that is its ink's: its middle may be bright
_INK_PERCENTILE = 20

#: depth at which an image is laid on a grid [mm]: any, since both look from one place
_DEPTH_MM = 1000.0

#: share of one another's area within which dots are of one size
_AREAS = (0.6, 1.6)


def dot_centres(image: NDArray[np.uint8], dark: bool = True) -> NDArray[np.float64]:
    """Find round dots of one size in an image (H, W); dark ones on bright ground, or the other way round.

    Returns
    -------
    (n, 2)
        Centres [px] as column and row, pixel centres at integers.
    """
    shown = image if dark else np.asarray(255 - image, np.uint8)
    scale = max(min(_BLOW_UP, _LARGEST_PX // max(image.shape)), 2)
    size = (image.shape[1] * scale, image.shape[0] * scale)
    fine = cv2.GaussianBlur(cv2.resize(shown, size, interpolation=cv2.INTER_CUBIC), (0, 0), scale)
    best = np.empty((0, 2))
    for diameter in _DIAMETERS:
        if 2 * diameter > min(image.shape):
            break
        found = _of_size(fine, diameter, scale)
        if len(found) > len(best):
            best = found
    return best


def seen_on_grid(image: NDArray[np.uint8], camera: Camera, grid: ViewGrid) -> NDArray[np.uint8]:
    """Resample the image of a camera at the origin of a grid as the grid's pixels see it."""
    at = camera.project(grid.origin + _DEPTH_MM * grid.rays()).astype(np.float32)
    return np.asarray(cv2.remap(image, at[..., 0], at[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE))


def _of_size(fine: NDArray[Any], diameter: float, scale: int) -> NDArray[np.float64]:
    """Dots of about one diameter [px] in the finer image."""
    window = int(2 * diameter) * scale + 1
    mask = cv2.adaptiveThreshold(fine, 1, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY_INV, window, _DARKER)
    outlines, family = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    like = np.pi / 4 * diameter**2
    centres, areas = [], []
    for outline, (_, _, _, parent) in zip(outlines, family[0] if family is not None else (), strict=True):
        area = cv2.contourArea(outline) / scale**2
        if parent >= 0 or not 0.5 * like < area < 2 * like:
            continue
        length = cv2.arcLength(outline, True) / scale
        if 4 * np.pi * area / length**2 < _ROUND:
            continue
        centre = _centre(fine, outline)
        if centre is not None:
            centres.append((centre + 0.5) / scale - 0.5)
            areas.append(area)
    if not centres:
        return np.empty((0, 2))
    size = np.array(areas) / np.median(areas)
    alike = (size > _AREAS[0]) & (size < _AREAS[1])
    return np.array(centres)[alike]


def _centre(fine: NDArray[Any], outline: NDArray[Any]) -> NDArray[np.float64] | None:
    """Centre of gravity (2,) of the dot in an outline, by its half level; None if that is no closed outline."""
    column, row, width, height = cv2.boundingRect(outline)
    step = max(round(_RING * (width + height) / 2), 1)
    left, top = max(column - 2 * step, 0), max(row - 2 * step, 0)
    patch = fine[top : row + height + 2 * step, left : column + width + 2 * step]
    inside = cv2.drawContours(np.zeros(patch.shape, np.uint8), [outline - [left, top]], -1, 1, cv2.FILLED)
    away = cv2.distanceTransform(np.uint8(1) - inside, cv2.DIST_L2, cv2.DIST_MASK_5)
    ground = patch[(away > step) & (away <= 2 * step)]
    if not ground.size:
        return None
    level = (float(np.percentile(patch[inside > 0], _INK_PERCENTILE)) + float(np.median(ground))) / 2
    mask = np.asarray((patch < level) & (away <= step), np.uint8)
    outlines, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if not outlines:
        return None
    moments = cv2.moments(max(outlines, key=cv2.contourArea))
    if moments["m00"] <= 0:
        return None
    return np.array([left + moments["m10"] / moments["m00"], top + moments["m01"] / moments["m00"]])
