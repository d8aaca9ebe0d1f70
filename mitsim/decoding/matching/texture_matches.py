"""Match the texture of a surface between two cameras over all rows, for codes of columns alone.

Signal chain: texture and projector columns of both raw images -> features of the texture (SIFT: Lowe, IJCV 60(2), 2004)
-> pairs of features, each clearly the best, at the same projector column -> row offsets that vary smoothly over the
image -> pixels of both images.

The calibration is not used. So the matches can contradict it, however wrong it is: by hundreds of rows, or by exchanged
cameras.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from characterisation.files.arrays import Floats

#: longest side of the images that are compared [px]; larger ones are averaged
_LONGEST_PX = 1000

#: largest number of features of an image, those of most contrast
_FEATURES = 3000

#: largest distance of a feature's descriptor from the best one in the other image, as a share of that from the second
#: best (Lowe)
_RATIO = 0.8

#: largest difference of the columns of one point, as a share of all columns that are seen
_SAME_COLUMN = 0.02

#: largest deviation of an offset from a plane over the image, as a share of the rows; chosen
_SMOOTH = 0.03

#: least share of the pairs that follow this plane; chosen
_LEAST_SHARE = 0.6

#: least number of pairs; chosen
LEAST_PAIRS = 12


def texture_matches(textures: tuple[Floats, Floats], columns: tuple[Floats, Floats]) -> tuple[Floats, Floats]:
    """Return pixels (n, 2) of the first raw image, and (n, 2) of the second that show the same texture.

    ``textures`` [DN] and ``columns`` [projector px], (H, W) each, NaN where unknown. Pixels are (column, row). They are
    empty if fewer than :data:`LEAST_PAIRS` features match, or their offsets do not agree.
    """
    none = np.empty((0, 2)), np.empty((0, 2))
    features = [_features(*pair) for pair in zip(textures, columns, strict=True)]
    if min(len(pixels) for pixels, _ in features) < LEAST_PAIRS:
        return none
    nearest = cv2.BFMatcher(cv2.NORM_L2).knnMatch(features[0][1], features[1][1], 2)
    pairs = [(best.queryIdx, best.trainIdx) for best, second in nearest if best.distance < _RATIO * second.distance]
    if len(pairs) < LEAST_PAIRS:
        return none
    first, second = (
        pixels[list(numbers)] for (pixels, _), numbers in zip(features, zip(*pairs, strict=True), strict=True)
    )
    seen = [
        map_coordinates(values, pixels.T[::-1], order=1, cval=np.nan)
        for values, pixels in zip(columns, (first, second), strict=True)
    ]
    same = np.abs(seen[0] - seen[1]) <= _SAME_COLUMN * np.ptp(columns[0][np.isfinite(columns[0])])
    first, second = first[same], second[same]
    if len(first) < LEAST_PAIRS:
        return none
    kept = _smooth(first, second[:, 1] - first[:, 1], _SMOOTH * textures[0].shape[0])
    if kept.sum() < max(LEAST_PAIRS, _LEAST_SHARE * len(first)):
        return none
    return first[kept], second[kept]


def _features(texture: Floats, columns: Floats) -> tuple[Floats, NDArray[np.float32]]:
    """Return the pixels (n, 2) of features of a texture where the column is known, and their descriptors (n, 128)."""
    finite = np.isfinite(texture) & np.isfinite(columns)
    if not finite.any():
        return np.empty((0, 2)), np.empty((0, 128), np.float32)
    low, high = np.percentile(texture[finite], [1, 99])
    image = np.clip(255 * (np.where(finite, texture, low) - low) / max(high - low, 1.0), 0, 255).astype(np.uint8)
    scale = max(1.0, max(image.shape) / _LONGEST_PX)
    size = (round(image.shape[1] / scale), round(image.shape[0] / scale))
    small, mask = (
        cv2.resize(array, size, interpolation=cv2.INTER_AREA) for array in (image, 255 * finite.astype(np.uint8))
    )
    points, descriptors = cv2.SIFT.create(_FEATURES).detectAndCompute(small, (mask == 255).astype(np.uint8))
    if not points:
        return np.empty((0, 2)), np.empty((0, 128), np.float32)
    pixels = (np.array([point.pt for point in points]) + 0.5) * np.divide(image.shape[::-1], size) - 0.5
    return pixels, np.asarray(descriptors, np.float32)


def _smooth(pixels: Floats, offsets: Floats, tolerance: float) -> NDArray[np.bool_]:
    """Return which offsets (n,) at ``pixels`` (n, 2) lie within ``tolerance`` of the plane that most of them fit."""
    table = np.column_stack([np.ones(len(pixels)), pixels])
    rng = np.random.default_rng(0)
    best = np.zeros(len(pixels), bool)
    for _ in range(200):
        chosen = rng.choice(len(pixels), 3, replace=False)
        if abs(np.linalg.det(table[chosen])) < 1:
            continue
        fits = np.abs(table @ np.linalg.solve(table[chosen], offsets[chosen]) - offsets) < tolerance
        if fits.sum() > best.sum():
            best = fits
    return best
