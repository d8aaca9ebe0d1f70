"""Centres of round dots in an image: calibration plates, and other printed grids.

Signal chain: image -> brought up eight times and smoothed by a pixel -> adaptive threshold, at several sizes of dot ->
closed outlines that are round -> centre of gravity of each.

The size that finds the most dots of one another's size is kept. The centre of gravity of an ellipse is not the image of
a circle's centre: seen at an angle of 30 deg, from thirty diameters away, it is off by 0.004 of a diameter, toward the
same side for neighbours. The dots of a plate may have a bright middle; only their outer outline counts.
"""

from __future__ import annotations

from dataclasses import dataclass
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

#: depth at which an image is laid on a grid [mm]: any, since both look from one place
_DEPTH_MM = 1000.0

#: share of one another's area within which dots are of one size
_AREAS = (0.6, 1.6)


@dataclass(frozen=True)
class DotCentres:
    """Centres (n, 2) [px] as column and row, pixel centres at integers, and the dots' median ``diameter`` [px]."""

    centres: NDArray[np.float64]
    diameter: float


def dot_centres(image: NDArray[np.uint8], dark: bool = True) -> DotCentres:
    """Find round dots of one size in an image (H, W); dark ones on bright ground, or the other way round."""
    shown = image if dark else np.asarray(255 - image, np.uint8)
    scale = max(min(_BLOW_UP, _LARGEST_PX // max(image.shape)), 2)
    size = (image.shape[1] * scale, image.shape[0] * scale)
    fine = cv2.GaussianBlur(cv2.resize(shown, size, interpolation=cv2.INTER_CUBIC), (0, 0), scale)
    best = DotCentres(np.empty((0, 2)), 0.0)
    for diameter in _DIAMETERS:
        if 2 * diameter > min(image.shape):
            break
        found = _of_size(fine, diameter, scale)
        if len(found.centres) > len(best.centres):
            best = found
    return best


def seen_on_grid(image: NDArray[np.uint8], camera: Camera, grid: ViewGrid) -> NDArray[np.uint8]:
    """Resample the image of a camera at the origin of a grid as the grid's pixels see it."""
    at = camera.project(grid.origin + _DEPTH_MM * grid.rays()).astype(np.float32)
    return np.asarray(cv2.remap(image, at[..., 0], at[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE))


def _of_size(fine: NDArray[Any], diameter: float, scale: int) -> DotCentres:
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
        moments = cv2.moments(outline)
        centre = np.array([moments["m10"], moments["m01"]]) / moments["m00"]
        centres.append((centre + 0.5) / scale - 0.5)
        areas.append(area)
    if not centres:
        return DotCentres(np.empty((0, 2)), 0.0)
    size = np.array(areas) / np.median(areas)
    alike = (size > _AREAS[0]) & (size < _AREAS[1])
    return DotCentres(np.array(centres)[alike], float(np.sqrt(4 / np.pi * np.median(np.array(areas)[alike]))))
